"""Write a driver or a consumer of poses in five lines.

    with Driver("team.toml", "r1") as driver:
        driver.odometry(distance_m=0.02, turn_rad=0.0, duration_s=0.1)
        driver.sighting("door", range_m=2.0, bearing_rad=0.1)

    for pose in poses("team.toml", "r1"):
        print(pose.x_m, pose.y_m, pose.heading_rad, pose.lost)

Metres, radians, seconds; time stamps are Unix time in nanoseconds. Warnings go to the log
`cpcbl_client`, which Python shows on standard error unless the program sets up logging.
"""

from cpcbl_client.consumer import poses
from cpcbl_client.driver import Driver, odometry_from_pose
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Sighting
from cpcbl_transport.messages import Pose

__all__ = ["Driver", "InputError", "Pose", "Sighting", "odometry_from_pose", "poses"]
