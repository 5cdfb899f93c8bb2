"""The command `keys`, and commands of a secured team."""

import json
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from cpcbl_launch.app import build_app
from cpcbl_launch.team.file import builtin_path
from support.processes import command_line

SECURED = '\n[transport]\nsecurity = "mtls"\n'


TEAM = f"""
name = "lab"
[robots.r1]
source = "external"
[robots.r2]
source = "external"
{SECURED}"""


def keys(file: Path, *more: object) -> dict[str, dict[str, Any]]:
    """What `keys FILE MORE --json` says, by member."""
    done = CliRunner().invoke(build_app(), [str(word) for word in ("keys", file, *more, "--json")])
    assert done.exit_code == 0, done.output
    return {member["who"]: member for member in json.loads(done.stdout)}


def refused(*command: object) -> str:
    """The one line with which a command ends that cannot be done."""
    done = command_line(*command)
    assert done.returncode == 2, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("cpcbl-team: ")]
    return line


def demo(folder: Path, security: str) -> Path:
    """The demonstration, helping from its second second on."""
    path = folder / f"{security}.toml"
    text = builtin_path("demo").read_text().replace("after_s = 10.0", "after_s = 2.0")
    path.write_text(f'{text}\n[transport]\nsecurity = "{security}"\n')
    return path
