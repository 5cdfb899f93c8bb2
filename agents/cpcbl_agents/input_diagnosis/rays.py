"""Where a landmark may be seen again of which only the bearing is known: on a ray, at any range."""

import math

from cpcbl_team.geometry import phase

NEAREST_M = 0.2


def ray_error(before: complex, after: complex, displacement: complex) -> float:
    """How far (rad) a direction is off those that a motion permits.

    `before`: the farthest place at which the landmark may have been (m, in the robot's frame); it
    was there or nearer, but not within `NEAREST_M`. `after`: the direction in which it is seen now.
    `displacement`: of the robot (m). Both are in the frame that the robot had before.
    """
    far = before - displacement
    near = before / abs(before) * NEAREST_M - displacement
    direction = after / abs(after)
    from_near, from_far = (phase(direction * end.conjugate()) for end in (near, far))
    if from_near * from_far <= 0.0 and abs(from_near - from_far) < math.pi:
        return 0.0
    return min(abs(from_near), abs(from_far))
