"""A camera driver in ten lines: it publishes images as JPEG. Another driver publishes odometry.

python camera_driver.py [CAMERA [TEAM_FILE [ROBOT]]]     # a device's number, a file or a URL
"""

import sys
import time
from contextlib import suppress

import cv2

from cpcbl_client import Driver

given, usual = sys.argv[1:], ("0", "team.toml", "r2")
camera, team, robot = (*given, *usual[len(given) :])
capture = cv2.VideoCapture(int(camera)) if camera.isdigit() else cv2.VideoCapture(camera)
with suppress(KeyboardInterrupt), Driver(team, robot) as driver:  # until Ctrl-C
    while capture.grab():
        stamp_ns = time.time_ns()  # as close to the exposure as possible
        _, pixels = capture.retrieve()
        driver.frame(cv2.imencode(".jpg", pixels)[1].tobytes(), stamp_ns=stamp_ns)
        time.sleep(0.1)
