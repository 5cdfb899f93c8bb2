"""A consumer in five lines: it prints where a robot is.

python pose_consumer.py [TEAM_FILE [ROBOT]]
"""

import sys
from contextlib import suppress

from cpcbl_client import poses

team, robot = (*sys.argv[1:], *("team.toml", "r1")[len(sys.argv) - 1 :])
with suppress(KeyboardInterrupt):  # until Ctrl-C
    for pose in poses(team, robot):
        where = f"{pose.x_m:.3f} {pose.y_m:.3f} {pose.heading_rad:.3f}"
        print(f"{where} lost: {pose.lost}" if pose.lost else where, flush=True)
