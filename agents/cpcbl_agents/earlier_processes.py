"""Whether a robot ran before, and whether it has moved since: only the team's router knows.

Each process tells it by liveliness tokens, twice in its life, and the router repeats them as long
as it lives. So the router's start is the team's start, and the order of all other starts is free.
"""

from collections.abc import Sequence
from typing import NamedTuple

from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle
from cpcbl_transport.topics import namespace

STILL, MOVED = "still", "moved"
ROUTER = "router"  # in place of an incarnation: what the router repeats


class Before(NamedTuple):
    """What is known of the earlier processes of a robot."""

    moved: bool = False  # the robot is not where it started
    ran: bool = False  # and may have spent its budget

    @staticmethod
    def by_tokens(tokens: Sequence[str]) -> "Before":
        """By the tokens of this robot that are there."""
        known = [names["how"] for token in tokens if (names := topics.RAN.names(token))]
        return Before(MOVED in known, bool(known))


NEVER_RAN = Before()


class OwnTokens:
    """The tokens of one process."""

    def __init__(self, bus: Bus, robot: str, incarnation: str) -> None:
        self._bus, self._names = bus, {"robot": robot, "incarnation": incarnation}
        self._has_moved = False
        bus.declare_token(topics.RAN.at(**self._names, how=STILL))

    def tell_moved(self) -> None:
        """The robot is no longer where it started. May be called again and again."""
        if not self._has_moved:
            self._has_moved = True
            self._bus.declare_token(topics.RAN.at(**self._names, how=MOVED))


def repeat_tokens(bus: Bus, space: str = "") -> None:
    """For a router: it repeats the tokens of all processes. `space`: what keys begin with in its
    session, which has no namespace of a team then."""
    kept: dict[str, Handle] = {}

    def on_token(key: str, alive: bool) -> None:
        head, _, incarnation = key.rpartition("/")
        if alive and incarnation != ROUTER and head not in kept:
            kept[head] = bus.declare_token(f"{head}/{ROUTER}")

    bus.watch_liveliness(space + topics.RAN.at(), on_token)


ALL_TEAMS = namespace("*") + "/"
