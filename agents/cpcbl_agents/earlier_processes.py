"""Whether a robot ran before, and whether it has moved since: only the team's router knows.

Each process tells it by liveliness tokens, twice in its life, and the router repeats them as long
as it lives. So the router's start is the team's start, and the order of all other starts is free.
"""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from cpcbl_team.errors import InputError
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle
from cpcbl_transport.topics import namespace

STILL, MOVED = "still", "moved"
LEASE_S = 6.0  # the token of a process that ended stays no longer, over two routers either
LOOK_S = 0.2
MOST_REPEATED = 8192
ROUTER = "router"  # in place of an incarnation: what the router repeats


class EarlierRuns(NamedTuple):
    """What is known of the earlier processes of a robot."""

    moved: bool = False  # the robot is not where it started
    ran: bool = False  # and may have spent its budget

    @staticmethod
    def from_tokens(tokens: Sequence[str]) -> "EarlierRuns":
        """By the tokens of this robot that are there."""
        known = [names["how"] for token in tokens if (names := topics.RAN.names(token))]
        return EarlierRuns(MOVED in known, bool(known))


NEVER_RAN = EarlierRuns()


def wait_until_alone(
    tokens: Callable[[str], Sequence[str]],
    robot: str,
    stop: Callable[[], bool] = lambda: False,
    within_s: float = LEASE_S,
) -> EarlierRuns:
    """What is known of the earlier processes of a robot, once none of them runs any more. Two at a
    time would share inputs, and teammates would mix what they say. `tokens`: those that are there
    now, by key. Raises InputError when one goes on running."""
    until_s = time.monotonic() + within_s
    while True:
        there = tokens(topics.RAN.at(robot=robot))
        others = {key.rpartition("/")[2] for key in there} - {ROUTER}
        if not others or stop():
            return EarlierRuns.from_tokens(there)
        if time.monotonic() >= until_s:
            raise InputError(
                f"robot {robot}: another process is this robot already; stop it first (its status"
                f" has the incarnation {', '.join(sorted(others))})"
            )
        time.sleep(LOOK_S)


class OwnTokens:
    """The tokens of one process."""

    def __init__(
        self, bus: Bus, robot: str, incarnation: str, before: EarlierRuns = NEVER_RAN
    ) -> None:
        """`before`: what the robot did in earlier processes. A router that is started again learns
        it from this one."""
        self._bus, self._names = bus, {"robot": robot, "incarnation": incarnation}
        self._has_moved = False
        bus.declare_token(topics.RAN.at(**self._names, how=STILL))
        if before.moved:
            self.declare_moved()

    def declare_moved(self) -> None:
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
        is_known = head.rpartition("/")[2] in (STILL, MOVED) and len(kept) < MOST_REPEATED
        if alive and is_known and incarnation != ROUTER and head not in kept:
            kept[head] = bus.declare_token(f"{head}/{ROUTER}")

    bus.watch_liveliness(space + topics.RAN.at(), on_token)


ALL_TEAMS = namespace("*") + "/"
