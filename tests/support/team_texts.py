"""Team files as texts."""

from cpcbl_launch.team.file import parse_team
from cpcbl_team.config import RobotSettings, Team

ROBOT = """
[robots.r1]
start = { x_m = 1.0, y_m = 2.0 }
"""


def team(text: str) -> Team:
    return parse_team(f'name = "t"\n{text}')


def robots(text: str) -> dict[str, RobotSettings]:
    return team(text).robots
