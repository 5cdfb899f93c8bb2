"""A team with some of its settings changed for one run, as the command line asks for."""

from collections.abc import Collection
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_launch.team.requirements import require_robots
from cpcbl_team.config import Team


class Overrides(NamedTuple):
    """What a command line sets for all robots; None leaves the team file's value."""

    bytes_per_s: float | None = None
    messages_per_minute: float | None = None
    match_messages: int | None = None  # of the team; the two above are each robot's
    variant: str | None = None
    collaboration: str | None = None  # none, passive, active, both
    fusion: str | None = None
    direction: str | None = None

    def set_fields(self, *names: str) -> dict[str, object]:
        """Those of these fields that are set."""
        values = {name: getattr(self, name) for name in names}
        return {name: value for name, value in values.items() if value is not None}


def with_overrides(team: Team, overrides: Overrides) -> Team:
    """The team with these settings for all its robots."""
    rules = overrides.set_fields("fusion", "direction")
    if (kinds := overrides.collaboration) is not None:
        rules |= {"passive": kinds in ("passive", "both"), "active": kinds in ("active", "both")}
    limits = overrides.set_fields("bytes_per_s", "messages_per_minute")
    robots = {}
    for name, robot in team.robots.items():
        own = robot.collaboration
        robots[name] = replace(
            robot,
            localizer=replace(robot.localizer, **overrides.set_fields("variant")),
            collaboration=replace(own, budget=replace(own.budget, **limits), **rules),
        )
    if overrides.match_messages is not None:
        team = replace(team, match=replace(team.match, messages=overrides.match_messages))
    return replace(team, robots=robots)


def with_blind_robots(team: Team, blind: Collection[str], absent: Collection[str] = ()) -> Team:
    """The team with some robots blind to landmarks; `absent` robots may be among them. Raises
    InputError for an unknown name."""
    blind = [name for name in blind if name not in absent]
    require_robots("--blind", blind, team)
    robots = dict(team.robots)
    for name in blind:
        sensor = replace(robots[name].sensor, sees_landmarks=False)
        robots[name] = replace(robots[name], sensor=sensor)
    return replace(team, robots=robots)
