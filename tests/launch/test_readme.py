"""What the documents tell a newcomer to type is typed here."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest
from support.logs import write_log
from support.processes import cpcbl_team

from cpcbl_launch.team_file import parse_team
from cpcbl_team.config import (
    COLOURS,
    CameraSettings,
    GuestSettings,
    PositionSensor,
    VisionSettings,
)

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
REAL_ROBOTS = (ROOT / "docs" / "real_robots.md").read_text()
TEAM_FILE = (ROOT / "docs" / "team_file.md").read_text()
TOML = re.findall(r"```toml\n(.*?)```", TEAM_FILE, re.DOTALL)


def readme_commands() -> list[str]:
    """Every `cpcbl-team` command of the README and of its page on real logs without placeholder."""
    text = README + REAL_ROBOTS
    blocks = "\n".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL))
    lines = [line.split("#")[0] for line in blocks.splitlines()]
    inline = re.findall(r"`(cpcbl-team [^`]+)`", text)
    found = [line.strip() for line in (*lines, *inline) if line.startswith("cpcbl-team")]
    return [c for c in dict.fromkeys(found) if not re.search(r"\b(FILE|NAME|DIR|LOG)\b", c)]


def test_the_readme_has_the_commands_that_matter() -> None:
    said = " ".join(readme_commands())
    for words in (
        "up",
        "init lab",
        "check",
        "robot team.toml r1",
        "evaluate mrclam MRCLAM6",
        "--blind 3,4,5",
    ):
        assert words in said
    for target in ("make demo", "make test"):
        assert target in README


NEED_A_TEAM = {"router", "robot", "view", "doctor"}  # `make test-trial` runs them


@pytest.mark.parametrize(
    "command", [c for c in readme_commands() if c.split()[1] not in NEED_A_TEAM]
)
def test_a_command_of_the_readme_runs(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a folder with a short log and the documented team file; `up` for a few seconds only."""
    write_log(tmp_path / "MRCLAM6", ("1", "2", "3", "4", "5"), seconds=6.0)
    local = re.sub(r"\[(transport|gateway)\].*?\n\n", "", TOML[0], flags=re.DOTALL)
    (tmp_path / "team.toml").write_text(local)
    monkeypatch.chdir(tmp_path)
    words = shlex.split(command)[1:]
    if words[0] == "up":
        words += ["--duration", "2"]
    ran = cpcbl_team(*words)
    if words[:2] == ["up", "team.toml"]:  # nobody drives these robots here
        assert ran.returncode == 1
        assert "nothing was heard in this run" in ran.stderr
    else:
        assert ran.returncode == 0, ran.stderr
    assert ran.stdout


def test_the_documented_team_file_is_good() -> None:
    (text,) = TOML
    team = parse_team(text)
    assert team.robots.keys() == {"r1", "r2", "rover", "tripod"}
    assert team.robots["rover"].position_sensor == PositionSensor(delay_s=0.1)
    assert team.guests == GuestSettings()
    assert team.robots["r2"].start is None
    assert team.transport.listen == ("tcp/0.0.0.0:7447",)
    assert team.map.landmarks["door"].colours == ("orange", "blue")


def test_the_documented_team_file_has_every_key_of_cameras_with_its_default() -> None:
    team = parse_team(TOML[0])
    raw = tomllib.loads(TOML[0])
    camera, vision = raw["robots"]["r2"]["camera"], raw["vision"]
    assert camera.keys() == {*CameraSettings.__struct_fields__}
    assert team.robots["r2"].camera == CameraSettings()
    assert vision.keys() == {*VisionSettings.__struct_fields__}
    colours = {name: COLOURS[name] for name in vision["colours"]}
    assert team.vision == VisionSettings(colours=colours)
