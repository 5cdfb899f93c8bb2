"""Which object of the map stands elsewhere: the one that is rejected while others are accepted."""

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

FADING_S: Final = 120.0  # of rejections of objects of the map
LEAST_MISPLACED: Final = 6.0  # rejections of an object that stands elsewhere,
MISPLACED_SHARE: Final = 0.7  # of all, and
MISPLACED_REJECTED: Final = 0.003  # of what is accepted, of any object
_NONE: Final[Mapping[str, float]] = {}


class MapRejections(NamedTuple):
    """How often each object of the map was rejected of late, and how often objects were accepted:
    sums that fade."""

    of_object: Mapping[str, float] = _NONE
    accepted: float = 0.0
    counted: int = 0  # accepted observations since the start, until
    stamp_ns: int = 0

    def plus(self, names: Sequence[str], stamp_ns: int, accepted: int) -> "MapRejections":
        """With these rejections now; so many observations have been `accepted` since the start."""
        passed = max((stamp_ns - self.stamp_ns) * 1e-9, 1e-3)
        k = math.exp(-passed / FADING_S)
        of_object = {name: k * count for name, count in self.of_object.items()}
        for name in names:
            of_object[name] = of_object.get(name, 0.0) + 1.0
        rate = (accepted - self.counted) / passed
        total = k * self.accepted + (1.0 - k) * FADING_S * rate
        return MapRejections(of_object, total, accepted, stamp_ns)

    def misplaced(self, stamp_ns: int) -> str:
        """The object that must stand elsewhere than on the map, for it alone is rejected time after
        time while others are accepted; empty if there is none."""
        if not self.of_object:
            return ""
        name, most = max(self.of_object.items(), key=lambda item: item[1])
        now = most * math.exp(-(stamp_ns - self.stamp_ns) * 1e-9 / FADING_S)
        total = sum(self.of_object.values())
        is_clear = most > MISPLACED_SHARE * total and most > MISPLACED_REJECTED * self.accepted
        return name if is_clear and now > LEAST_MISPLACED else ""
