"""THE table of processes of a run, on one machine or in containers."""

import os
import sys
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from cpcbl_agents.clock import Clock
from cpcbl_launch.run.supervisor import ProcessSpec
from cpcbl_team.config import Team
from cpcbl_transport.security import Identity
from cpcbl_transport.topics import Role

PROGRAM = (sys.executable, "-m", "cpcbl_launch")
ROBOT = "robot-"


class Task(NamedTuple):
    """One row: what `cpcbl-team ARGUMENTS` does."""

    name: str
    arguments: tuple[str, ...]
    identity: Identity  # whose keys it needs in a secured team
    on_restart: tuple[str, ...] = ()


def tasks(team: Team, common: tuple[str, ...], seed: int, here: Collection[str]) -> list[Task]:
    """name | arguments | when: the field if any robot is simulated, one process a robot."""
    rows = [
        Task(ROBOT + name, ("robot", name, *common), Identity(Role.ROBOT, name), ("--restarted",))
        for name in team.robots
        if name in here
    ]
    if team.simulated:
        field = ("field", "--seed", str(seed), *common)
        rows.insert(0, Task("field", field, Identity(Role.FIELD)))
    return rows


def process_table(
    team: Team, team_file: Path, endpoint: str, clock: Clock, seed: int, here: Collection[str]
) -> list[ProcessSpec]:
    """The same as processes of this machine, which end with the one that started them."""
    common = (
        *("--team", str(team_file), "--connect", endpoint),
        *("--clock", str(clock), "--parent", str(os.getpid())),
    )
    clocks = {
        ROBOT + name: ("--clock", str(clock._replace(epoch_ns=clock.epoch_ns + int(s * 1e9))))
        for name, s in team.simulation.clocks_ahead_s.items()
    }
    return [
        ProcessSpec(
            task.name, (*PROGRAM, *task.arguments, *clocks.get(task.name, ())), task.on_restart
        )
        for task in tasks(team, common, seed, here)
    ]
