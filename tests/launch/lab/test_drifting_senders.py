"""Senders that drift slowly are found, and correct ones are not quarantined."""

from collections.abc import Sequence
from functools import partial

import pytest

from cpcbl_launch.lab.experiments import liars
from cpcbl_launch.lab.faulty_robot import Fault, FaultyBus
from cpcbl_launch.reporting.metrics import score
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.messages import Status

DURATION_S = 60.0


def distrust_without_liars(seeds: Sequence[int]) -> list[tuple[int, str, str, str]]:
    """By whom of whom and why, with three observers that are correct."""
    found: list[tuple[int, str, str, str]] = []
    for seed in seeds:

        def arrived(received: Received[Status], seed: int = seed) -> None:
            status = received.message
            found.extend((seed, status.robot, t.peer, t.reason) for t in status.trust if t.reason)

        subscribers: list[Subscriber[Status]] = []

        def watch(bus: Bus, arrived=arrived, subscribers=subscribers) -> None:  # type: ignore[no-untyped-def]
            subscribers.append(Subscriber(bus, Status, arrived))

        simulate(liars.liars_team(liars.Case(lie="")), seed, DURATION_S, watch=watch)
    return found


def test_no_correct_robot_is_quarantined_in_two_runs() -> None:
    assert distrust_without_liars(range(1, 3)) == []


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_no_correct_robot_is_quarantined_in_two_hundred_runs() -> None:
    assert distrust_without_liars(range(1000, 1200)) == []


def test_a_drifting_observer_that_states_a_small_sigma_is_found_and_does_little_harm() -> None:
    fault = Fault.parse("drift:0.02,0.0,0.01@10-45")
    through = {liars.LIAR: partial(FaultyBus, fault=fault, name=liars.LIAR, start_ns=0)}
    team = liars.liars_team(liars.Case(lie="drift"))
    _, recorder = simulate(team, 7, 45.0, bus_wrappers=through)
    truth = recorder.simulated_truth()
    for name in liars.DRIVERS:
        trust = {t.peer: t for t in recorder.status[name].trust}
        assert trust[liars.LIAR].reason, name
        assert not trust["north"].quarantines, name
        assert not trust["south"].quarantines, name
        figures = score(recorder.samples(name, truth[name], liars.FROM_S))
        assert figures.position_rmse_m is not None
        assert figures.position_rmse_m < 0.08, name
