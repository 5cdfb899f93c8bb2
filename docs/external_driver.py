"""A driver in five lines: it publishes the odometry and the sightings of a robot.

python external_driver.py [TEAM_FILE [ROBOT]]
"""

import sys
import time
from contextlib import suppress

from cpcbl_client import Driver

team, robot = (*sys.argv[1:], *("team.toml", "r1")[len(sys.argv) - 1 :])
with suppress(KeyboardInterrupt), Driver(team, robot) as driver:  # until Ctrl-C
    while True:
        time.sleep(0.1)
        driver.odometry(distance_m=0.02, turn_rad=0.0)  # since the last call
        driver.sighting("door", range_m=2.0, bearing_rad=0.1)
