"""What a robot has read of a landmark whose place it does not know yet."""

from typing import Final, NamedTuple

from cpcbl_team.geometry import Pose2

MOST_READINGS: Final = 12
SPACING_NS: Final = 500_000_000  # between two that are kept
WINDOW_NS: Final = 20_000_000_000


class LandmarkReading(NamedTuple):
    """One reading of a landmark that is not on the map."""

    stamp_ns: int
    odometry_from_robot: Pose2  # dead reckoning at that time
    range_m: float | None
    bearing_rad: float | None
    range_sigma_m: float
    bearing_sigma_rad: float


def with_reading(
    readings: tuple[LandmarkReading, ...], reading: LandmarkReading
) -> tuple[LandmarkReading, ...]:
    """The readings with one more, without what is too old; the same if it comes too soon. Of too
    many the one goes that has the nearest neighbours in time, so that the others are far apart."""
    if readings and reading.stamp_ns - readings[-1].stamp_ns < SPACING_NS:
        return readings
    kept = [r for r in readings if reading.stamp_ns - r.stamp_ns <= WINDOW_NS]
    kept.append(reading)
    if len(kept) > MOST_READINGS:
        inner = range(1, len(kept) - 1)
        del kept[min(inner, key=lambda i: kept[i + 1].stamp_ns - kept[i - 1].stamp_ns)]
    return tuple(kept)
