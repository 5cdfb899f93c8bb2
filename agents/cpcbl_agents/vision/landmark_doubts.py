"""How many of the latest landmarks were rejected, and why: a person should know of it."""

from collections import Counter, deque
from collections.abc import Iterable

from cpcbl_agents.vision.detections import Ambiguity

LATEST, LEAST = 40, 10  # pairs of bands that are judged together
MOST_REJECTED = 0.5  # share: some are always partly hidden, or reflected
CAUSES = {
    "ranges_disagree": "is the camera mounted as stated, and do `[vision]` and the lens fit?",
    "wrong_shape": "do the cylinders have the shape that `[vision]` states?",
}
"""Reasons that a wrong setting has, and what to look at."""


class LandmarkDoubts:
    """The latest pairs of colour bands, each with the reason for which it was rejected, or ""."""

    def __init__(self) -> None:
        self._latest: deque[str] = deque(maxlen=LATEST)

    def add(self, found: int, ambiguities: Iterable[Ambiguity]) -> None:
        """What one frame shows: how many cylinders were found, and what was rejected."""
        rejected = [one.reason for one in ambiguities if one.reason in CAUSES]
        self._latest += [""] * found + rejected

    @property
    def problems(self) -> tuple[str, ...]:
        """Whole sentences for people, none when all is well."""
        reasons = Counter(reason for reason in self._latest if reason)
        if len(self._latest) < LEAST or reasons.total() <= MOST_REJECTED * len(self._latest):
            return ()
        ((reason, _),) = reasons.most_common(1)
        number = f"{reasons.total()} of {len(self._latest)} landmarks"
        return (f"{number} are rejected ({reason}); {CAUSES[reason]}",)
