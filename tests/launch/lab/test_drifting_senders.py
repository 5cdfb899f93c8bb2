"""Senders that drift slowly are found, and correct ones are not quarantined."""

from collections.abc import Sequence
from functools import partial

import pytest
from msgspec.structs import replace
from support.quarantine_use import watched_quarantines

from cpcbl_launch.lab.experiments import attacks, liars
from cpcbl_launch.lab.faulty_robot import Fault, FaultyBus
from cpcbl_launch.reporting.metrics import score
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_team.config import Team
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.messages import Status

DURATION_S = 60.0


def biased(team: Team) -> Team:
    """The team as it really is where no sensor is calibrated to better than this."""
    robots = {
        name: replace(
            robot,
            sensor=replace(robot.sensor, range_bias_m=0.01 * sign, bearing_bias_deg=0.5 * sign),
        )
        for sign, (name, robot) in zip((1, -1, 1, -1, 1, -1), team.robots.items(), strict=False)
    }
    return replace(team, robots=robots)


THREE = liars.liars_team(liars.Case(lie=""))
SHAPES = {
    "three observers": (THREE, THREE),
    "two observers": (liars.liars_team(liars.Case(lie="", liar=False)),) * 2,
    "one observer": (liars.liars_team(liars.Case(lie="", liar=False, honest=1)),) * 2,
    "four and a navigator": (
        attacks.attack_team(attacks.Attack(victim="navigator", liars=attacks.TWO)),
    )
    * 2,
    "biased sensors": (THREE, biased(THREE)),
}


def distrust_without_liars(
    shape: str, seeds: Sequence[int], duration_s: float = DURATION_S
) -> list[tuple[int, str, str, str]]:
    """By whom of whom and why, where all robots are correct."""
    found: list[tuple[int, str, str, str]] = []
    team, truth = SHAPES[shape]
    for seed in seeds:

        def arrived(received: Received[Status], seed: int = seed) -> None:
            status = received.message
            found.extend((seed, status.robot, t.peer, t.reason) for t in status.trust if t.reason)

        subscribers: list[Subscriber[Status]] = []

        def watch(bus: Bus, arrived=arrived, subscribers=subscribers) -> None:  # type: ignore[no-untyped-def]
            subscribers.append(Subscriber(bus, Status, arrived))

        simulate(team, seed, duration_s, truth, watch=watch)
    return found


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("shape", "seed"),
    [
        pytest.param("three observers", 1, marks=pytest.mark.thorough),
        pytest.param("biased sensors", 2, marks=pytest.mark.thorough),
    ],
)
def test_no_correct_robot_is_quarantined_in_two_runs(shape: str, seed: int) -> None:
    assert distrust_without_liars(shape, [seed], 25.0) == []


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("shape", SHAPES)
def test_no_correct_robot_is_quarantined_in_two_hundred_runs(shape: str) -> None:
    """Forty of each shape."""
    assert distrust_without_liars(shape, range(1000, 1040)) == []


@pytest.mark.long
@pytest.mark.timeout(600)
def test_observers_that_stand_for_three_minutes_are_still_believed() -> None:
    """They found errors of their ranges that cancel each other, and their fixes became wrong."""
    for victim in ("scout", "navigator"):
        run = attacks.run_attack(attacks.Attack(victim=victim, from_s=120.0, end_s=180.0), 401)
        assert run.false_quarantines == 0
        assert run.score.position_rmse_m is not None
        assert run.score.position_rmse_m < 0.06  # 0.18 and 0.08 m before
        assert run.score.inside_3_sigma is not None
        assert run.score.inside_3_sigma > 0.97


@pytest.mark.thorough
def test_a_drifting_observer_that_states_a_small_sigma_is_found_and_does_little_harm() -> None:
    fault = Fault.parse("drift:0.02,0.0,0.01@10-45")
    through = {liars.LIAR: partial(FaultyBus, fault=fault, name=liars.LIAR, start_ns=0)}
    team = liars.liars_team(liars.Case(lie="drift"))
    with watched_quarantines() as quarantines:
        _, recorder = simulate(team, 7, 45.0, bus_wrappers=through)
    assert quarantines.heard == {liars.LIAR}
    assert quarantines.used == set()
    truth = recorder.simulated_truth()
    for name in liars.DRIVERS:
        trust = {t.peer: t for t in recorder.status[name].trust}
        assert trust[liars.LIAR].reason, name
        assert not trust["north"].quarantines, name
        assert not trust["south"].quarantines, name
        figures = score(recorder.samples(name, truth[name], liars.FROM_S))
        assert figures.position_rmse_m is not None
        assert figures.position_rmse_m < 0.08, name


@pytest.mark.thorough
@pytest.mark.timeout(300)
def test_a_sudden_error_beside_one_correct_observer_is_decided_by_the_earlier_estimate() -> None:
    """Test 3 called both observers contested before test 1 could decide; odometry was lost then."""
    case = liars.Case(lie="bias:0.5,0.5", honest=1)
    with watched_quarantines() as quarantines:
        run = liars.run_fault(case, 4)
    assert quarantines.heard == {liars.LIAR}
    assert quarantines.used == set()
    assert max(run.rmse_m.values()) < 0.07  # 0.17 m before
    assert {q.of for q in run.quarantines} == {liars.LIAR}
