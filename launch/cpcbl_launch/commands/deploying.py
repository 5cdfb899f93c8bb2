"""Commands that put a team on other machines."""

from pathlib import Path
from typing import Annotated, Optional

import typer

from cpcbl_launch.commands import options
from cpcbl_launch.commands.arguments import Image, TeamArgument, print_not_written
from cpcbl_launch.team_file import find_team


def compose(
    file: TeamArgument = None,
    image: Image = None,
    seed: Annotated[int, typer.Option(help="Seed of the simulated noise.")] = 1,
    output: Annotated[
        Optional[Path],
        typer.Option(
            callback=options.writable_file,
            help="File to write, with paths relative to its folder; default: standard output.",
        ),
    ] = None,
) -> None:
    """Print a team's compose file: for docker-compose, docker compose, a swarm."""
    from cpcbl_launch.reporting.files import write_or_reason
    from cpcbl_launch.run.containers.compose import deployment_text

    team = find_team(file or Path("demo"))
    folder = Path() if output is None else output.parent
    text = deployment_text(team, file or Path("demo"), folder, image, seed)
    if output is None:
        typer.echo(text, nl=False)
    else:
        print_not_written(
            write_or_reason(output, lambda: output.write_text(text, encoding="utf-8"))
        )
