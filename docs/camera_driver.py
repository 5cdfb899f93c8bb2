"""A camera driver in ten lines: it publishes images as JPEG. Another driver publishes odometry.

python camera_driver.py [CAMERA [TEAM [ROBOT [ENDPOINT]]]]     # a device's number, a file or a URL
"""

import sys
import time

import cv2

from cpcbl_transport import topics
from cpcbl_transport.messages import Frame, encode
from cpcbl_transport.zenoh_bus import open_bus

given, usual = sys.argv[1:], ("0", "lab", "r2", "tcp/127.0.0.1:7447")
camera, team, robot, endpoint = (*given, *usual[len(given) :])
capture = cv2.VideoCapture(int(camera)) if camera.isdigit() else cv2.VideoCapture(camera)
with open_bus(team, [endpoint]) as bus:
    frames = bus.publisher(topics.IN_FRAME.at(robot=robot), topics.IN_FRAME.qos)
    while capture.grab():
        stamp_ns = time.time_ns()  # as close to the exposure as possible
        _, pixels = capture.retrieve()
        frames.put(encode(Frame(stamp_ns, cv2.imencode(".jpg", pixels)[1].tobytes())))
        time.sleep(0.1)
