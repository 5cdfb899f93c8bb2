"""What the README must say, and the team file of the reference."""

import re
import tomllib
from pathlib import Path

from cpcbl_launch.team.file import parse_team
from cpcbl_team.config import (
    COLOURS,
    CameraSettings,
    GuestSettings,
    PositionSensor,
    VisionSettings,
)

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
TEAM_FILE = (ROOT / "docs" / "team_file.md").read_text()
TOML = re.findall(r"```toml\n(.*?)```", TEAM_FILE, re.DOTALL)


def test_the_readme_has_the_commands_that_matter() -> None:
    for words in ("make demo", "make test", "cpcbl-team init lab", "cpcbl-team check team.toml"):
        assert words in README
    for words in ("cpcbl-team robot team.toml r1", "cpcbl-team evaluate mrclam MRCLAM6"):
        assert words in README


def test_the_documented_team_file_is_good() -> None:
    team = parse_team(TOML[0])
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
