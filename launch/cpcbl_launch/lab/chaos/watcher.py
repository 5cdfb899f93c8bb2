"""What `cpcbl-team up --record` does besides starting processes, beside a team that runs already.

A team under test is started by the tests. This process stands for its `up`: the same recorder,
recording and loop, so that its memory can be watched under faults.
"""

import sys
from pathlib import Path

from msgspec.structs import replace

from cpcbl_agents.stop import StopSignal
from cpcbl_launch.run.one_heap import use_one_heap
from cpcbl_launch.run.up import Run, run_team
from cpcbl_launch.team.file import load_team


def main(team_file: str, endpoint: str, record: str, parent: str) -> None:
    """`python -m cpcbl_launch.lab.chaos.watcher TEAM_FILE ENDPOINT RECORD PARENT`"""
    use_one_heap()  # as every command does
    team, stop = load_team(Path(team_file)), StopSignal(int(parent))
    robots = {name: replace(robot, source="external") for name, robot in team.robots.items()}
    team = replace(team, robots=robots)  # so that it starts no field
    run = Run(team, None, here=(), connect=(endpoint,), record=Path(record))
    run_team(run, lambda recorder, processes, elapsed_s: None, stop)


if __name__ == "__main__":
    main(*sys.argv[1:])
