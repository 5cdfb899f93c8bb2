"""Errors of ranges that do not change, and ranges without them."""

from typing import Final, NamedTuple


class RangeErrors(NamedTuple):
    """Readings are too short by this share of the range, and by these metres."""

    share: float = 0.0
    bias_m: float = 0.0

    @property
    def scale(self) -> float:
        """True range = scale x reading + offset."""
        return 1.0 / (1.0 - self.share)

    @property
    def offset_m(self) -> float:
        return self.bias_m / (1.0 - self.share)


NO_RANGE_ERRORS: Final = RangeErrors()
