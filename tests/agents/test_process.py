"""The loop around a node: who steps it, and when."""

import re
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import pytest
from support.buses import robot_at, team_of, wait_until, with_robot

from cpcbl_agents import process
from cpcbl_agents.clock import Clock
from cpcbl_agents.earlier_processes import EarlierRuns
from cpcbl_agents.load import MayGoOn, everything
from cpcbl_agents.process import Loop, make_robot, new_incarnation, stop_on_clock_step
from cpcbl_agents.stop import StopSignal
from cpcbl_team.config import BudgetSettings
from cpcbl_team.errors import ClockError
from cpcbl_transport.compact import STAMP_NS


class Counting:
    """A node with an inbox that notes which threads step it."""

    def __init__(self) -> None:
        self.inbox: list[int] = []
        self.taken: list[int] = []
        self.threads: list[int] = []
        self.at_once = self.most_at_once = 0
        self.during: Callable[[], None] = lambda: None

    @property
    def next_ns(self) -> int:
        return 2**62

    @property
    def waiting(self) -> bool:
        return bool(self.inbox)

    def step(self, now_ns: int, may_go_on: MayGoOn = everything) -> None:
        self.at_once += 1
        self.most_at_once = max(self.most_at_once, self.at_once)
        self.threads.append(threading.get_ident())
        while self.inbox:
            self.taken.append(self.inbox.pop(0))
        self.during()
        self.at_once -= 1


class Running:
    """A loop on its own thread."""

    def __init__(self) -> None:
        self.node, self.loop = Counting(), Loop(Clock.wall())
        self.stop, self.bugs = threading.Event(), list[BaseException]()
        self.thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        try:
            self.loop.run(self.node, self.stop.is_set)
        except ArithmeticError as bug:
            self.bugs.append(bug)

    def arrives(self, number: int = 0) -> None:
        self.node.inbox.append(number)
        self.loop.on_arrival()

    def arrives_here(self) -> bool:
        """Whether what arrives on this thread is stepped on it."""
        before = self.node.threads.count(threading.get_ident())
        self.arrives()
        return self.node.threads.count(threading.get_ident()) > before


@contextmanager
def running() -> Iterator[Running]:
    on = Running()
    on.thread.start()
    try:
        yield on
    finally:
        on.stop.set()
        on.loop.wake()
        on.thread.join()


def test_what_arrives_is_handled_by_the_thread_that_brings_it() -> None:
    with running() as on:
        wait_until(on.arrives_here)
        assert on.node.taken
        assert not on.node.inbox


def test_what_comes_right_after_is_left_to_the_robots_own_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Else a flood would be handled as it comes, and the bus's thread never be free for it."""
    monkeypatch.setattr(process, "BUSY_NS", 2**62)
    with running() as on:
        wait_until(on.arrives_here)
        assert not on.arrives_here()
        wait_until(lambda: not on.node.inbox)


def test_what_comes_while_another_steps_is_not_waited_for_and_not_lost() -> None:
    with running() as on:
        wait_until(lambda: bool(on.node.threads))
        inside, go_on = threading.Event(), threading.Event()

        def works() -> None:
            inside.set()
            go_on.wait(10.0)

        on.node.during = works
        on.loop.wake()
        inside.wait()
        on.arrives(7)
        assert on.node.inbox == [7]
        go_on.set()
        wait_until(lambda: on.node.taken == [7])
        assert set(on.node.threads) == {on.thread.ident}


def test_one_thread_steps_at_a_time_and_all_that_arrives_is_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(process, "BUSY_NS", 0)

    def bring(numbers: Iterable[int]) -> None:
        for number in numbers:
            on.arrives(number)

    with running() as on:
        threads = [threading.Thread(target=bring, args=(range(k, 1000, 4),)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        wait_until(lambda: len(on.node.taken) == 1000)
    assert sorted(on.node.taken) == list(range(1000))
    assert on.node.most_at_once == 1


def test_a_bug_on_a_thread_of_the_bus_ends_the_robot() -> None:
    def divides() -> None:
        if threading.get_ident() != on.thread.ident:
            raise ZeroDivisionError("here")

    with running() as on:
        on.node.during = divides
        wait_until(on.arrives_here)
        on.thread.join()
    (bug,) = on.bugs
    assert str(bug) == "here"
    where = []
    trace = bug.__traceback__
    while trace is not None:
        where.append(trace.tb_frame.f_code.co_name)
        trace = trace.tb_next
    assert where[-1] == "divides"


def test_nothing_is_stepped_before_it_runs_or_after() -> None:
    on = Running()
    assert not on.arrives_here()
    with running() as on:
        wait_until(on.arrives_here)
    steps = len(on.node.threads)
    assert not on.arrives_here()
    assert len(on.node.threads) == steps


# When it starts, and when its time is another ----------------------------------------------------

LIMITED = team_of(me=robot_at(budget=BudgetSettings(messages_per_minute=6.0)))


def test_a_team_starts_at_a_time_that_fixes_and_beliefs_can_carry() -> None:
    clock = Clock.starting_in(60.0)
    assert clock.now_ns() == clock.epoch_ns  # it stands until then
    assert clock.epoch_ns % STAMP_NS == 0
    assert abs(clock.epoch_ns - time.time_ns() - 60_000_000_000) < 10_000_000_000
    assert Clock.starting_in(0.0, epoch_ns=1_234_567, speed=2.0).epoch_ns == 1_234_567


def since(seconds: float, unix: bool = False) -> Clock:
    """The clock of a team that runs since then."""
    return Clock(0, time.monotonic_ns() - round(seconds * 1e9), 1.0, unix)


@pytest.mark.parametrize(
    ("since_s", "before", "knows_its_place", "may_send"),
    [
        (-60.0, EarlierRuns(), True, True),
        (60.0, EarlierRuns(), True, True),
        (60.0, EarlierRuns(ran=True), True, False),
        (60.0, EarlierRuns(moved=True, ran=True), False, False),
        (-60.0, EarlierRuns(moved=True), False, False),
    ],
    ids=["with the team", "late", "restarted", "restarted after it moved", "so it was told"],
)
@pytest.mark.parametrize("unix", [False, True])
def test_only_a_robot_that_ran_before_may_not_know_its_place_or_what_it_spent(
    since_s: float, before: EarlierRuns, knows_its_place: bool, may_send: bool, unix: bool
) -> None:
    clock = since(since_s, unix)
    robot = make_robot("me", LIMITED, clock, before)
    assert (not robot.filter.timeline.state.lost) is knows_its_place
    now_ns = clock.now_ns()
    assert robot.collaboration.budget.admits(now_ns, 42, urgent=True) is may_send


def test_processes_are_distinguished_in_containers_too() -> None:
    assert len({new_incarnation() for _ in range(100)}) == 100


@pytest.mark.parametrize("by_s", [3600.0, 0.5, -0.5, -3600.0])
def test_a_robot_ends_when_the_clock_of_its_machine_is_set(by_s: float) -> None:
    """As if it had been set since the robot started: the robot's time goes on as it was."""
    wall = Clock.wall()
    clock = wall._replace(epoch_ns=wall.epoch_ns - round(by_s * 1e9))
    steps = iter([False] * 10 + [True])
    with pytest.raises(ClockError, match=re.escape(f"clock was set by {by_s:+.2f} s")):
        Loop(clock).run(Counting(), stop_on_clock_step("me", LIMITED, clock, steps.__next__))


def test_a_robot_goes_on_while_its_clock_holds_or_is_none_of_the_machine() -> None:
    simulated = with_robot(LIMITED, "me", source="simulated")
    elsewhere = Clock.wall()._replace(epoch_ns=0)
    for team, clock in (
        (LIMITED, Clock.wall()),
        (LIMITED, elsewhere._replace(unix=False)),
        (simulated, elsewhere),
    ):
        steps = iter([False] * 10 + [True])
        node, loop = Counting(), Loop(clock)
        node.during = loop.wake
        loop.run(node, stop_on_clock_step("me", team, clock, steps.__next__))
        assert len(node.threads) == 10


def test_a_closed_terminal_ends_a_process_unless_nohup_protects_it() -> None:
    numbers = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        stop = StopSignal()
        signal.raise_signal(signal.SIGHUP)
        assert not stop()
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        stop = StopSignal()
        signal.raise_signal(signal.SIGHUP)
        assert stop()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
