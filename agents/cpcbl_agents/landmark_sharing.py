"""Places of landmarks that travel: which of them a robot tells, and which it asks for.

A landmark that is not on the team's map has a tier, by the sigma of its place. A robot asks for the
place of a landmark that it sees in better tiers than that of its own knowledge, and tells what it
has found or known itself while somebody asks. Whoever has taken a place asks for better ones alone,
so nothing is sent for long, and no robot's belief comes back to it as a better one. Of many robots
that know a place each waits another time before it tells it, so that the first ones suffice.
"""

import math
import zlib
from collections.abc import Iterable, Mapping
from typing import Final

from cpcbl_team.inputs import LandmarkBelief, Sightings
from cpcbl_team.tiers import tier_of

TIER_WIDTH: Final = 2.0  # ratio of the sigmas of two tiers
UNKNOWN_TIER: Final = 8  # beyond 1.28 m a place is not sent
ROUNDING: Final = 1.01  # by which a sigma on the wire may be larger
IN_SIGHT_NS: Final = 10_000_000_000  # a place is asked for so long after its landmark was seen
SLOT_NS: Final = 50_000_000  # of waiting, a robot of the team
REPEAT_NS: Final = 1_000_000_000  # between two beliefs about a landmark of the same tier


def landmark_tier(place: LandmarkBelief, rounding: float = 1.0) -> int:
    """The tier of a landmark's place. `rounding`: by how much its sigma may have grown."""
    xx, _, yy = place.covariance
    sigma_m = math.sqrt(0.5 * (xx + yy)) / rounding
    return min(tier_of(sigma_m, TIER_WIDTH), UNKNOWN_TIER)


def known_tiers(places: Iterable[LandmarkBelief]) -> dict[str, int]:
    """The best tier in which each of these landmarks is known."""
    known: dict[str, int] = {}
    for place in places:
        tier = landmark_tier(place, ROUNDING)
        known[place.landmark] = min(tier, known.get(place.landmark, UNKNOWN_TIER))
    return known


class LandmarkSharing:
    """What one robot tells of landmarks, and what it asks for."""

    def __init__(self, robot: str, names: frozenset[str], robots: int = 1) -> None:
        """`names`: of the landmarks that are not on the team's map. `robots`: of the team."""
        self._robot, self._names = robot, names
        self._waits_ns = {name: _share(f"{name}/{robot}") * robots * SLOT_NS for name in names}
        self._seen_ns: dict[str, int] = {}
        self._sent: dict[str, tuple[int, int]] = {}  # tier and time of the last belief about each
        self._own: dict[str, LandmarkBelief] = {}
        self._known: dict[str, int] = {}  # the best tier in which each is known, by whomever
        self._asked_ns: dict[str, int] = {}
        self.tiers: dict[str, int] = {}
        """The landmarks whose places this robot knows of its own, and the tiers in which it tells
        them."""

    @property
    def asked_for(self) -> frozenset[str]:
        """The landmarks whose places somebody asks for in the tiers in which this robot knows
        them."""
        return frozenset(self._asked_ns)

    def ask(self, names: frozenset[str], now_ns: int) -> None:
        """Somebody asks for the places of these landmarks now, and of no others."""
        self._asked_ns = {name: self._asked_ns.get(name, now_ns) for name in names}

    def see(self, frame: Sightings) -> None:
        """The robot has seen this."""
        for sighting in frame.sightings:
            if sighting.id in self._names:
                self._seen_ns[sighting.id] = frame.stamp_ns

    def update(self, places: tuple[LandmarkBelief, ...]) -> None:
        """The robot knows these places now: of its own, or from others."""
        self._own = {place.landmark: place for place in places if place.robot == self._robot}
        tiers = {name: landmark_tier(place) for name, place in self._own.items()}
        self.tiers = {name: tier for name, tier in tiers.items() if tier < UNKNOWN_TIER}
        self._known = known_tiers(places)

    def wanted(
        self, now_ns: int, known: Mapping[str, int] | None = None
    ) -> frozenset[tuple[str, int]]:
        """The landmarks in sight, with the tiers in which the robot asks for their places. `known`:
        the tiers in which it knows them; None for what it knows in its own frame."""
        known = self._known if known is None else known
        return frozenset(
            (name, tier)
            for name, seen_ns in self._seen_ns.items()
            if now_ns - seen_ns <= IN_SIGHT_NS
            for tier in range(known.get(name, UNKNOWN_TIER))
        )

    def begin_frame(self) -> None:
        """The robot's places are in another frame from now on."""
        self._sent, self._own, self._known, self._asked_ns, self.tiers = {}, {}, {}, {}, {}

    def next_belief(self, now_ns: int) -> tuple[LandmarkBelief, int] | None:
        """What is to be sent next, if anything, and the time of the last belief about it (0: none).
        The most certain place comes first, then the one that waits longest. One at a time, for
        routers drop what follows too soon."""
        due = []
        for name, tier in self.tiers.items():
            last_tier, last_ns = self._sent.get(name, (UNKNOWN_TIER, 0))
            is_due = tier < last_tier or now_ns - last_ns >= REPEAT_NS
            asked_ns = self._asked_ns.get(name)
            if is_due and asked_ns is not None and now_ns - asked_ns >= self._waits_ns[name]:
                due.append((tier, last_ns, name))
        if not due:
            return None
        _, last_ns, name = min(due)
        return self._own[name], last_ns

    def note_sent(self, belief: LandmarkBelief) -> None:
        """This was sent."""
        self._sent[belief.landmark] = landmark_tier(belief), belief.stamp_ns


def _share(text: str) -> float:
    """From 0 to 1: the same for the same text on every machine."""
    return zlib.crc32(text.encode()) / 2**32
