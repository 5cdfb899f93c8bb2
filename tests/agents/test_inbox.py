"""A robot that is sent more than it can handle: it keeps its rate, hears everybody, and says so."""

import re

from support.buses import MS, SECOND, TeamOnBus, saw, standing
from support.nodes import NOW, only_me

from cpcbl_agents.inbox import INBOX, INBOX_BYTES, STRANGERS, Inbox
from cpcbl_agents.load import first
from cpcbl_team.inputs import Sighting
from cpcbl_transport import topics
from cpcbl_transport.messages import LARGEST_PAYLOAD, Status

FIX_KEY = topics.FIX.at(robot="me", tier=2, observer="mate")
ODOMETRY, SIGHTINGS = topics.IN_ODOMETRY.at(robot="me"), topics.IN_SIGHTINGS.at(robot="me")
FLOOD = 600  # messages between two steps
A_STEP = 40  # messages for which a step has time


def taken(inbox: Inbox) -> list[bytes]:
    return [inbox.take()[1] for _ in range(len(inbox))]


def test_messages_are_taken_in_the_order_of_their_arrival() -> None:
    inbox = Inbox(frozenset({"me", "mate"}))
    for number, key in enumerate((ODOMETRY, FIX_KEY, ODOMETRY, SIGHTINGS, FIX_KEY)):
        inbox.put(key, bytes([number]))
    assert taken(inbox) == [bytes([number]) for number in range(5)]


def test_the_quietest_are_heard_first_while_it_is_too_much() -> None:
    inbox = Inbox(frozenset({"me", "mate"}))
    for number in range(9):
        inbox.put(SIGHTINGS, b"loud")
        if number % 3 == 0:
            inbox.put(ODOMETRY, b"quiet")
    inbox.is_fair = True
    assert taken(inbox) == [b"quiet"] * 3 + [b"loud"] * 9


def test_the_oldest_of_the_loudest_is_dropped() -> None:
    inbox = Inbox(frozenset({"me", "mate"}))
    inbox.put(ODOMETRY, b"first")
    dropped = [inbox.put(SIGHTINGS, b"%d" % number) for number in range(INBOX)]
    assert sum(dropped) == 1
    assert inbox.pop_dropped() == {SIGHTINGS: 1}
    assert not inbox.pop_dropped()
    assert taken(inbox)[:2] == [b"first", b"1"]


def test_an_inbox_is_bounded_in_bytes() -> None:
    inbox = Inbox(frozenset({"me", "mate"}))
    inbox.put(ODOMETRY, b"small")
    dropped = sum(inbox.put(SIGHTINGS, bytes(LARGEST_PAYLOAD)) for _ in range(200))
    left = taken(inbox)
    assert left[0] == b"small"
    assert len(left) == 201 - dropped
    assert INBOX_BYTES - 2 * LARGEST_PAYLOAD < sum(map(len, left)) < INBOX_BYTES


def test_names_are_free_so_strangers_are_one_sender() -> None:
    inbox = Inbox(frozenset({"me", "mate"}))
    inbox.put(FIX_KEY, b"mate")
    for number in range(INBOX + 5):
        inbox.put(topics.FIX.at(robot="me", tier=0, observer=f"ghost{number}"), b"")
    assert inbox.pop_dropped() == {STRANGERS: 6}
    inbox.is_fair = True
    assert inbox.take() == (FIX_KEY, b"mate")


class Flooded:
    """The robot `me`, to which odd sightings come that it cannot handle in time, beside honest
    inputs at 10 Hz."""

    def __init__(self) -> None:
        self.stand: TeamOnBus = only_me()
        self.node = self.stand.nodes["me"]
        self.tracks = self.stand.ear(topics.TRACK.at(robot="me"))
        self.said = self.stand.ear(topics.STATUS.at(robot="me"))

    def run(self, steps: int) -> None:
        for _ in range(steps):
            self.stand.now_ns += 100 * MS
            now_ns = self.stand.now_ns
            for number in range(FLOOD):
                odd = saw(now_ns - number * MS, Sighting("oak", 4.0, 0.01 + 1e-5 * number))
                self.stand.sightings("me", odd)
            self.stand.odometry("me", standing(now_ns, now_ns - 100 * MS))
            self.node.step(now_ns, first(A_STEP))

    @property
    def statuses(self) -> list[Status]:
        return [s for s in self.said.messages if isinstance(s, Status)]


def test_a_flood_leaves_a_robot_its_rate_and_its_odometry() -> None:
    on = Flooded()
    on.run(40)
    assert len(on.tracks.samples) >= 36  # of 40
    stamps_ns = [m.stamp_ns for m in on.tracks.messages]  # type: ignore[union-attr]
    assert on.stand.now_ns - stamps_ns[-1] <= 200 * MS
    assert on.node.robot.counts["odometry"] >= 4 * 9


def test_what_was_dropped_is_counted_and_said_with_its_sender() -> None:
    on = Flooded()
    on.run(40)
    counts = on.node.counts
    waiting = 40 * FLOOD - on.node.robot.counts["sightings"] - counts["inbox_overflow"]
    assert counts["inbox_overflow"] > 0
    assert 0 < waiting <= INBOX
    problem = on.statuses[-1].problems[0]
    number = r"\d+(\.\d+)?"
    said = f"overloaded: up to {number} s late, behind with its messages for {number} s, {number}"
    rest = f"wait, {number} were dropped, most of {SIGHTINGS}; send less, or give this robot more"
    assert re.fullmatch(f"{said} {rest} CPU", problem)


def test_a_robot_that_keeps_up_is_not_overloaded_and_a_single_stop_is_no_load() -> None:
    stand = only_me()
    said = stand.ear(topics.STATUS.at(robot="me"))
    stand.stand_still(3.0)
    before_ns, stand.now_ns = stand.now_ns, stand.now_ns + 4 * SECOND
    stand.odometry("me", standing(stand.now_ns, before_ns))
    stand.step()
    stand.stand_still(3.0)
    statuses = [m for m in said.messages if isinstance(m, Status)]
    assert len(statuses) >= 6
    assert not [p for s in statuses for p in s.problems if "overloaded" in p]


def test_a_loop_that_is_late_again_and_again_is_overloaded() -> None:
    stand = only_me()
    said = stand.ear(topics.STATUS.at(robot="me"))
    for _ in range(5):
        before_ns, stand.now_ns = stand.now_ns, stand.now_ns + 2 * SECOND
        stand.odometry("me", standing(stand.now_ns, before_ns))
        stand.step()
    last = [m for m in said.messages if isinstance(m, Status)][-1]
    assert last.problems[0].startswith(
        "overloaded: up to 1.90 s late, behind with its messages for 0 s"
    )


def test_a_step_is_repeated_exactly_by_the_number_of_messages_that_it_took() -> None:
    """Whatever the clock said in the run itself: how much was taken is an input."""
    live, again = Flooded(), Flooded()
    numbers: list[int] = []
    for step in range(12):
        due = first(10 + 17 * step % 40)
        for on, may_go_on in ((live, due), (again, None)):
            on.stand.now_ns += 100 * MS
            now_ns = on.stand.now_ns
            for number in range(60):
                odd = saw(now_ns - number * MS, Sighting("oak", 4.0, 0.01))
                on.stand.sightings("me", odd)
            on.stand.odometry("me", standing(now_ns, now_ns - 100 * MS))
            before = on.node.arrivals.waiting_messages
            on.node.step(now_ns, may_go_on or first(numbers[-1]))
            numbers.append(before - on.node.arrivals.waiting_messages)
    assert live.tracks.payloads == again.tracks.payloads
    assert live.stand.now_ns == NOW + 12 * 100 * MS
