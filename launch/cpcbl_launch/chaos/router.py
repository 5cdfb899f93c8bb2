"""A team's router as a process of its own: `python -m cpcbl_launch.chaos.router TEAM LISTEN
PARENT [CONNECT]`."""

import sys
import time
from pathlib import Path

from cpcbl_agents.process import Stop
from cpcbl_launch.team_file import load_team
from cpcbl_transport.guards import guard_rules
from cpcbl_transport.zenoh_bus import open_router


def main(team_file: str, listen: str, parent: str, *connect: str) -> None:
    team, stop = load_team(Path(team_file)), Stop(int(parent))
    with open_router(team.name, [listen], connect, guard_rules(team)):
        while not stop():
            time.sleep(0.1)


if __name__ == "__main__":
    main(*sys.argv[1:])
