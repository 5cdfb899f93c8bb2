"""A recording that is kept, so that every change of the program is tried on it.

`make recording` records it anew, for a change that is meant to move numbers, and prints what moved.
The bits hold for the platform that recorded them (`net.recording.platform_fingerprint`).
"""

import shutil
from collections.abc import Iterator
from pathlib import Path

from msgspec.structs import replace
from net.recording import platform_fingerprint

from cpcbl_launch.recordings.read import read_run
from cpcbl_launch.recordings.replay import replay_run
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_launch.team.overrides import Overrides, with_overrides
from cpcbl_team.config import Start, Team
from support.simulated import ScheduledGuest, record_run

FOLDER = Path(__file__).parents[1] / "launch" / "recordings" / "kept"
PLATFORM = FOLDER / "platform.txt"
SECONDS = 12.0  # the demo's robots help each other from its tenth second on


def mixed_team() -> Team:
    """The demo with budgets; each robot has another variant, and one has to find its pose."""
    team = with_overrides(load_team(builtin_path("demo")), Overrides(bytes_per_s=120.0))
    variants = "joint", "circular", "oval", "weighted"
    robots = {
        name: replace(robot, localizer=replace(robot.localizer, variant=variant))
        for (name, robot), variant in zip(team.robots.items(), variants, strict=True)
    }
    start = robots["scout"].start
    assert start is not None
    robots["scout"] = replace(robots["scout"], start=replace(start, known=False))
    return replace(team, robots=robots)


def tripod(team: Team) -> ScheduledGuest:
    """A guest that sees the field for some seconds."""
    start = Start(x_m=4.0, y_m=3.0, heading_deg=-90.0)
    settings = replace(team.robots["observer"], start=start, waypoints_m=())
    return ScheduledGuest("tripod", settings, 3.0, 11.0)


def record_mixed_run(folder: Path) -> None:
    """Records the mixed team with its guest."""
    team = mixed_team()
    record_run(folder, team, 1, SECONDS, [tripod(team)])


def renew() -> Iterator[str]:
    """Records it anew; yields a line for each process about what moved."""
    if FOLDER.exists():
        for process in replay_run(read_run(FOLDER)).processes:
            yield (
                f"moved: {process.difference}" if process.difference else f"{process.robot}: equal"
            )
        shutil.rmtree(FOLDER)
    record_mixed_run(FOLDER)
    PLATFORM.write_text(platform_fingerprint() + "\n", encoding="utf-8")
    size = sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file())
    yield f"{FOLDER.name}: {size / 1000:.0f} kB"


if __name__ == "__main__":
    for line in renew():
        print(line)  # noqa: T201
