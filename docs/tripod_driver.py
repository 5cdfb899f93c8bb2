"""A driver for a tripod camera in five lines: it publishes the robots that the camera sees.

python tripod_driver.py [TEAM_FILE [NAME]]
"""

import sys
import time
from contextlib import suppress

from cpcbl_client import Driver

team, name = (*sys.argv[1:], *("team.toml", "tripod")[len(sys.argv) - 1 :])
with suppress(KeyboardInterrupt), Driver(team, name, observer=True) as driver:  # until Ctrl-C
    while True:
        time.sleep(0.1)
        driver.sighting("r1", range_m=2.0, bearing_rad=0.0)  # what your camera measures
