"""Whether the positions that one sender reports follow one another as the odometry says."""

import math
import random
from collections.abc import Callable, Iterator

import pytest
from msgspec.structs import replace
from support.core import SECOND
from support.trust import AGREES, MS, RULES, Receiver

from cpcbl_team.geometry import Pose2, step
from cpcbl_team.reported_tracks import (
    LIMIT,
    QUIET,
    OdometryErrors,
    ReportedPosition,
    ReportedTrack,
    is_refuted,
    with_reported,
)
from cpcbl_team.sender_comparisons import with_track_result
from cpcbl_team.sender_records import (
    REFUTED_CONFLICTS,
    QuarantineReason,
    SenderRecord,
    TeammateReport,
)

SIGMA_M = 0.03
WHEELS = OdometryErrors(0.01**2, 0.0, 0.02**2, 0.02**2)
Offset = Callable[[float], tuple[float, float]]


def right(_: float) -> tuple[float, float]:
    return 0.0, 0.0


def positions(
    seconds: float,
    offset: Offset = right,
    *,
    seed: int = 1,
    sigma_m: float = SIGMA_M,
    scale: float = 1.0,
    turned: float = 0.0,
    every: int = 1,
) -> Iterator[ReportedPosition]:
    """What a sender reports ten times a second of a robot that drives on arcs: its error is that
    `offset` of the time, and noise. `scale`: by which the wheels are wrong; `turned`: by how much
    the heading of the estimate is wrong when the track begins."""
    dice = random.Random(seed)
    true, odometry = Pose2(0.0, 0.0, 0.0), Pose2(3.0, 1.0, 2.0)
    for i in range(round(10 * seconds)):
        way, turn = 0.04, 0.05 * math.sin(0.15 * i)
        true = step(true, way, turn)
        slip = dice.gauss(0.0, 0.01 * math.sqrt(way))
        odometry = step(odometry, scale * way + slip, turn + dice.gauss(0.0, 0.02 * 0.2))
        x, y = offset(0.1 * i)
        if i % every == 0:
            yield ReportedPosition(
                i * 100 * MS,
                true.x + x + dice.gauss(0.0, sigma_m),
                true.y + y + dice.gauss(0.0, sigma_m),
                sigma_m**2,
                odometry,
                turned - 2.0,
                errors=WHEELS,
            )


def track_of(reports: Iterator[ReportedPosition]) -> ReportedTrack:
    track = None
    for report in reports:
        track = with_reported(track, report)
    assert track is not None
    return track


def loudest(reports: Iterator[ReportedPosition]) -> float:
    track, most = None, 0.0
    for report in reports:
        track = with_reported(track, report)
        most = max(most, track.score)
    return most


def amplified(t: float) -> tuple[float, float]:
    """An error that grows by half of itself in a tenth of a second, again and again after 3 s."""
    return (0.02 * 1.5 ** (10.0 * (t % 1.0)) if t > 3.0 else 0.0), 0.0


@pytest.mark.parametrize("every", [1, 10])
@pytest.mark.parametrize("scale", [1.0, 1.1, 0.9])
def test_a_correct_sender_is_quiet(scale: float, every: int) -> None:
    """Also with wheels that are wrong by 10 %."""
    worst = [loudest(positions(60.0, seed=s, scale=scale, every=every)) for s in range(20)]
    assert max(worst) < LIMIT


@pytest.mark.parametrize("turned", [0.5, 1.5, 3.0])
def test_a_wrong_heading_at_the_beginning_makes_no_sender_loud(turned: float) -> None:
    """The estimate was led astray when the track began."""
    worst = [loudest(positions(30.0, seed=s, turned=turned)) for s in range(20)]
    assert max(worst) < LIMIT


def test_the_pose_of_a_track_is_that_of_the_robot() -> None:
    track = track_of(positions(30.0, sigma_m=1e-3, turned=0.4))
    last, pose = track.last, track.estimate.pose
    assert math.hypot(pose.x - last.x, pose.y - last.y) < 5e-3
    turned = math.remainder(pose.heading - last.odometry_from_robot.heading, math.tau)
    assert turned == pytest.approx(-2.0, abs=0.1)


@pytest.mark.parametrize("seed", range(5))
def test_an_error_that_grows_faster_than_noise_is_loud(seed: int) -> None:
    assert loudest(positions(10.0, amplified, seed=seed)) > LIMIT


def test_a_constant_error_and_a_slow_drift_are_none_of_this_test() -> None:
    assert loudest(positions(60.0, lambda _: (0.5, 0.2))) < LIMIT
    assert loudest(positions(60.0, lambda t: (0.01 * t, 0.0))) < LIMIT


def test_one_outlier_is_no_contradiction() -> None:
    assert loudest(positions(20.0, lambda t: (0.5 * (10.0 < t < 10.15), 0.0))) < LIMIT


def test_a_track_begins_anew_after_a_gap_of_the_odometry_and_ignores_older_reports() -> None:
    *before, last = positions(10.0, amplified)
    track = track_of(iter(before))
    assert track.score > QUIET
    assert with_reported(track, before[3]) is track
    anew = with_reported(track, last._replace(gaps=1))
    assert (anew.score, anew.first) == (0.0, anew.last)
    late = last._replace(stamp_ns=last.stamp_ns + 11 * SECOND)
    assert with_reported(track, late).score == 0.0


# Who is blamed ------------------------------------------------------------------------------------


def loud() -> ReportedTrack:
    """A track in the moment in which it becomes loud."""
    track = None
    for report in positions(10.0, amplified):
        track = with_reported(track, report)
        if track.is_loud:
            return track
    raise AssertionError


def test_a_loud_sender_is_blamed_if_another_would_have_noticed_wrong_odometry() -> None:
    accused = loud()
    until_s = accused.last.stamp_ns / SECOND
    witness = track_of(positions(until_s, seed=2))
    assert is_refuted(accused, [witness])
    assert not is_refuted(witness, [accused])
    assert not is_refuted(accused, [])
    assert not is_refuted(accused, [accused])  # odometry is wrong
    assert is_refuted(accused, [accused, witness, witness])
    vague = track_of(positions(until_s, seed=2, sigma_m=0.5))
    assert not is_refuted(accused, [vague])


def test_one_that_reported_before_the_robot_was_carried_away_is_no_witness() -> None:
    """It is out of sight now: the other correct one sees the jump alone."""

    def carried(t: float) -> tuple[float, float]:
        return 0.5 * (10.0 * (t - 4.0)) * (t > 4.0), 0.0

    track = None
    for report in positions(10.0, carried):
        track = with_reported(track, report)
        if track.is_loud:
            break
    assert track is not None
    newcomer = track_of(positions(10.0, seed=2))._replace(since_ns=4 * SECOND + 1)
    assert not is_refuted(track, [newcomer])  # it sees the robot only since then
    unaware = track_of(positions(4.0, seed=2))
    assert track.last.stamp_ns - unaware.last.stamp_ns < SECOND
    assert not is_refuted(track, [unaware])


def with_tracks(**tracks: ReportedTrack) -> dict[str, SenderRecord]:
    return {n: SenderRecord(t.last.stamp_ns, track=t) for n, t in tracks.items()}


def test_guests_are_no_witnesses_and_one_in_quarantine_stays_there() -> None:
    accused = loud()
    witness = track_of(positions(accused.last.stamp_ns / SECOND, seed=2))
    senders = with_tracks(liar=accused, north=witness)
    found = with_track_result(senders, "liar")
    assert found.odometry_conflicts == REFUTED_CONFLICTS
    assert found.last_failure_ns == accused.last.stamp_ns
    assert with_track_result(senders, "north") is senders["north"]
    guest = {**senders, "north": replace(senders["north"], is_guest=True)}
    assert with_track_result(guest, "liar") is guest["liar"]
    held = replace(senders["liar"], reason=QuarantineReason.BIASED, agreements=9)
    assert with_track_result({**guest, "liar": held}, "liar").agreements == 0


def test_a_sender_that_amplifies_is_quarantined_without_a_third_one() -> None:
    receiver = Receiver()
    both = zip(positions(8.0, amplified), positions(8.0, seed=2), strict=True)
    for liar, honest in both:
        receiver.now_ns = liar.stamp_ns
        for name, position in (("liar", liar), ("honest", honest)):
            report = TeammateReport(position.stamp_ns, AGREES, (0.0, 0.0), position)
            receiver.report(name, report)
    assert receiver.quarantined.keys() == {"liar"}
    assert receiver.rules == RULES
