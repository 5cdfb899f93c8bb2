"""Commands that put a team on other machines."""

from pathlib import Path
from typing import Annotated, Optional

import typer

from cpcbl_launch.commands.arguments import Image, TeamArgument, say_not_written
from cpcbl_launch.team_file import find_team


def compose(
    file: TeamArgument = None,
    image: Image = None,
    seed: Annotated[int, typer.Option(help="Of the simulated noise.")] = 1,
    output: Annotated[
        Optional[Path], typer.Option(help="Write it to this file, with paths from its folder.")
    ] = None,
) -> None:
    """Print a team's compose file: for docker-compose, docker compose, a swarm."""
    from cpcbl_launch.options import file_for, not_written
    from cpcbl_launch.run.containers.deployment import deployed

    if output is not None:
        file_for("--output", output)
    team = find_team(file or Path("demo"))
    folder = Path() if output is None else output.parent
    text = deployed(team, file or Path("demo"), folder, image, seed)
    if output is None:
        typer.echo(text, nl=False)
    else:
        say_not_written(not_written(output, lambda: output.write_text(text, encoding="utf-8")))
