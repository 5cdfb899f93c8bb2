"""A driver in ten lines: it publishes the odometry and the sightings of a robot.

python external_driver.py [TEAM [ROBOT [ENDPOINT]]]
"""

import sys
import time

from cpcbl_team.inputs import Odometry, Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.messages import encode
from cpcbl_transport.zenoh_bus import open_bus

team, robot, endpoint = (*sys.argv[1:], *("lab", "r1", "tcp/127.0.0.1:7447")[len(sys.argv) - 1 :])
with open_bus(team, [endpoint]) as bus:
    odometry = bus.publisher(topics.IN_ODOMETRY.at(robot=robot), topics.IN_ODOMETRY.qos)
    sightings = bus.publisher(topics.IN_SIGHTINGS.at(robot=robot), topics.IN_SIGHTINGS.qos)
    last_ns = time.time_ns()
    while True:
        time.sleep(0.1)
        now_ns = time.time_ns()
        odometry.put(encode(Odometry(last_ns, now_ns, distance_m=0.02, turn_rad=0.0)))
        sightings.put(encode(Sightings(now_ns, (Sighting("door", range_m=2.0, bearing_rad=0.1),))))
        last_ns = now_ns
