"""The loop around a node: who steps it, and when."""

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import pytest
from bus_helpers import wait_until

from cpcbl_agents import process
from cpcbl_agents.clock import Clock
from cpcbl_agents.process import Loop


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

    def step(self, now_ns: int) -> None:
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
        self.loop.arrived()

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
