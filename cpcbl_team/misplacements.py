"""What a robot says of objects that stand elsewhere than it believed, as counts of its status."""

from typing import Final

from cpcbl_team.map_residuals import NO_OFFSET
from cpcbl_team.state import Memory

MISPLACED: Final = "misplaced_"
"""The count of such an object begins with this: how far it is from its place (mm), 1: not known."""
REJECTED: Final = "rejected_"  # how often it was rejected of late
MOVES: Final = "moves_"  # how often it has moved, of one that the robot has found itself


def misplacements(memory: Memory, stamp_ns: int) -> dict[str, int]:
    """The counts of all such objects."""
    unused, calibration = memory.recovery.unused_objects(stamp_ns), memory.calibration
    counts = {MISPLACED + name: 1 for name in sorted(unused)}
    if name := calibration.misplaced(stamp_ns):
        offset = calibration.residuals.of_object.get(name, NO_OFFSET)
        rejected = round(calibration.rejections.of_object.get(name, 0.0))
        if calibration.residuals.misplaced == name:
            counts[MISPLACED + name] = max(round(1e3 * offset.distance_m), 1)
        else:
            counts[MISPLACED + name] = 1
        if rejected:
            counts[REJECTED + name] = rejected
    for name, moved in calibration.moved.items():
        if moved.is_current(stamp_ns):
            counts[MISPLACED + name] = max(round(1e3 * moved.apart_m), 1)
            counts[MOVES + name] = moved.times
    return counts
