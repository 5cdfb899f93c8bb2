"""A driver for a tripod camera in ten lines: it publishes the robots that the camera sees.

python tripod_driver.py [TEAM [NAME [ENDPOINT]]]
"""

import sys
import time

from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.messages import encode
from cpcbl_transport.zenoh_bus import open_bus

team, name, endpoint = (
    *sys.argv[1:],
    *("lab", "tripod", "tcp/127.0.0.1:7447")[len(sys.argv) - 1 :],
)
with open_bus(team, [endpoint]) as bus:
    sightings = bus.publisher(topics.IN_SIGHTINGS.at(robot=name), topics.IN_SIGHTINGS.qos)
    while True:
        time.sleep(0.1)
        seen = Sighting("r1", range_m=2.0, bearing_rad=0.0)  # what your camera measures
        sightings.put(encode(Sightings(time.time_ns(), (seen,))))
