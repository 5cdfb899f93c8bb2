"""Help that leads the estimate away from where the robot's own sensors say that it is."""

from collections.abc import Sequence
from typing import NamedTuple

import pytest
from msgspec.structs import replace
from support.core import (
    LOOP_START,
    SECOND,
    belief,
    diagonal,
    driven,
    fix,
    frame,
    localizer,
    loop,
    point_sighting,
    position_error,
)

from cpcbl_team.config import OdometrySettings, SensorSettings, Start
from cpcbl_team.estimate import Estimate, Information
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import Odometry, Sightings
from cpcbl_team.led_astray import distance_squared, with_misleading
from cpcbl_team.localizer import Localizer
from cpcbl_team.miscalibration import AS_CONFIGURED
from cpcbl_team.motion import NO_VARIANCE, move
from cpcbl_team.own_pose import OwnPose
from cpcbl_team.own_pose_conflicts import own_pose_conflict
from cpcbl_team.scale_errors import ScaleErrors
from cpcbl_team.sender_records import OWN_SENSORS, QuarantineReason, SenderRecord
from cpcbl_team.state import State

NOW_NS = 100 * SECOND
NOISE = OdometrySettings(distance_sigma_m_per_sqrt_m=0.1, turn_sigma_rad_per_sqrt_m=0.1)
ROBOT = localizer(odometry=NOISE, start=Start(x_m=LOOP_START.x, y_m=LOOP_START.y))
OWN = Estimate(Pose2(1.0, 2.0, 0.3), diagonal(0.05, 0.05))


def estimate_at(x: float) -> Estimate:
    """One that is so far (m) from the pose by own sensors, and sure of it."""
    return OWN._replace(pose=Pose2(1.0 + x, 2.0, 0.3), covariance=diagonal(0.02, 0.02))


class Driven(NamedTuple):
    state: State
    truth: Pose2


def says(own_nis: float, *, ago_s: float = 0.1) -> SenderRecord:
    return SenderRecord(last_report_ns=NOW_NS - int(ago_s * SECOND), own_nis=own_nis)


def misleading(
    senders: dict[str, SenderRecord], estimate: Estimate, own: Estimate
) -> frozenset[str]:
    """The senders that led this estimate away from this pose by own sensors."""
    names, bound = own_pose_conflict(senders, NOW_NS)
    return names if distance_squared(estimate, own) > bound else frozenset()


TWO_OF_FOUR = {"a": says(1.0), "b": says(3.0), "c": says(30.0), "d": says(25.0)}


def test_those_that_contradict_own_sensors_led_an_estimate_astray_that_does_too() -> None:
    senders = {**TWO_OF_FOUR, OWN_SENSORS: says(0.0)}
    assert misleading(senders, estimate_at(0.3), OWN) == {"c", "d"}
    assert misleading(senders, estimate_at(0.15), OWN) == set()


def test_nobody_is_blamed_where_nobody_contradicts_own_sensors_as_clearly_as_the_estimate() -> None:
    """Own sensors were off by chance, and a correct observer by 20."""
    senders = {**TWO_OF_FOUR, "c": says(20.0), "d": says(20.5)}
    assert misleading(senders, estimate_at(0.3), OWN) == set()
    assert misleading({**senders, "d": says(25.0)}, estimate_at(0.3), OWN) == {"c", "d"}


def test_whoever_is_silent_or_in_quarantine_leads_nobody_astray() -> None:
    for change in (says(30.0, ago_s=5.0), replace(says(30.0), reason=QuarantineReason.BIASED)):
        senders = {**TWO_OF_FOUR, "c": change}
        assert misleading(senders, estimate_at(0.3), OWN) == {"d"}


def test_against_most_senders_own_sensors_need_a_larger_chi_square() -> None:
    senders = {"a": says(1.0), "c": says(40.0), "d": says(50.0)}
    assert misleading(senders, estimate_at(0.25), OWN) == set()
    assert misleading(senders, estimate_at(0.4), OWN) == {"c", "d"}
    doubtful = {**senders, "c": says(30.0)}
    assert misleading(doubtful, estimate_at(0.4), OWN) == {"d"}


def test_all_beyond_usual_noise_count_as_most_where_one_contradicts_own_sensors() -> None:
    """A landmark came into sight after three seconds, and four correct observers said that the pose
    by own sensors was off by three of its sigmas: one by 25, so it came into quarantine."""
    senders = {"a": says(2.0), "b": says(8.0), "c": says(25.0), "d": says(9.0)}
    assert misleading(senders, estimate_at(0.4), OWN) == set()
    assert misleading({**senders, "c": says(40.0)}, estimate_at(0.4), OWN) == {"c"}
    assert misleading({**senders, "b": says(3.0)}, estimate_at(0.4), OWN) == {"c"}


def test_whom_own_readings_support_leads_nobody_astray() -> None:
    """Liars are in quarantine, and own readings are far more likely by what a correct observer says
    than by the pose by own sensors alone: that one is off by chance."""
    supported = {OWN_SENSORS: -10.0, "liar": -30.0}
    for behind, found in (
        (supported, {"d"}),
        ({**supported, OWN_SENSORS: -4.0}, {"c", "d"}),
        ({OWN_SENSORS: -10.0, "b": 0.0}, {"c", "d"}),  # as a liar has that was correct until now
    ):
        senders = {**TWO_OF_FOUR, "c": replace(says(30.0), behind=behind)}
        assert misleading(senders, estimate_at(0.3), OWN) == found


def test_whom_they_made_look_wrong_of_late_is_released() -> None:
    blamed = {
        "a": replace(says(1.0), reason=QuarantineReason.BIASED, since_ns=NOW_NS - SECOND),
        "b": replace(says(1.0), reason=QuarantineReason.BIASED, since_ns=NOW_NS - 60 * SECOND),
        "e": replace(says(50.0), reason=QuarantineReason.BIASED, since_ns=NOW_NS - SECOND),
    }
    found = with_misleading({**TWO_OF_FOUR, **blamed}, frozenset({"c"}), NOW_NS)
    reasons = {name: record.reason for name, record in found.items()}
    biased, outvoted = QuarantineReason.BIASED, QuarantineReason.OUTVOTED
    assert reasons == {"a": None, "b": biased, "c": outvoted, "d": None, "e": biased}
    assert found["c"].last_failure_ns == NOW_NS  # it is not released at once
    assert found["c"].quarantines == 1


def test_evidence_about_another_pose_is_the_same_evidence() -> None:
    own = OwnPose(0, OWN, AS_CONFIGURED, 0)
    row, variance = (0.6, 0.8, 0.5), 0.01
    about = Pose2(1.2, 1.9, 0.35)
    here = Information.none().add(row, 0.1, variance)
    moved = 0.1 - (0.6 * 0.2 - 0.8 * 0.1 + 0.5 * 0.05)
    there = Information.none().add(row, moved, variance)
    found, expected = own.with_evidence(about, there), own.with_evidence(OWN.pose, here)
    assert found.estimate.pose == pytest.approx(expected.estimate.pose)
    assert found.estimate.covariance == pytest.approx(expected.estimate.covariance)


def test_without_sensors_it_follows_each_step_of_the_odometry_and_becomes_uncertain() -> None:
    """It turns left and back: its turn from end to end is none."""
    own, expected = OwnPose(0, OWN, AS_CONFIGURED, 0), OWN
    for turn in [0.1] * 10 + [-0.1] * 10:
        own = own.after_step(0.05, turn, NOISE, 0.0, NO_VARIANCE)
        expected = move(expected, 0.05, turn, NOISE)
    later = own.at(SECOND)
    assert later.estimate.pose == pytest.approx(expected.pose)
    assert later.estimate.covariance == pytest.approx(expected.covariance)
    assert later.estimate.position_sigma_m > OWN.position_sigma_m
    assert later.is_known
    lost = later._replace(estimate=OWN._replace(covariance=diagonal(1.0, 0.05)))
    assert not lost.is_known


def drive(
    seconds: float,
    off_m: float = 0.0,
    names: Sequence[str] | None = None,
    robot: Localizer = ROBOT,
) -> Driven:
    """A robot that sees these landmarks, and whose teammate reports a place so far off in x."""
    state, truth = robot.start(0), LOOP_START
    for piece, truth in driven(LOOP_START, loop()[: round(10 * seconds)]):
        state = robot.add_odometry(state, piece)
        state = robot.cycle(state, frame(truth, piece.stamp_ns, names=names))
        place = truth.x + off_m, truth.y
        state = robot.add_fix(state, fix(*place, piece.stamp_ns, sensor_m=0.01, observer_m=0.01))
    return Driven(state, truth)


def test_a_robot_that_sees_no_landmark_is_not_carried_on_until_it_sees_one() -> None:
    """An echo is ahead of its estimate each time."""
    state, truth = drive(4.0)
    now_ns, step_ns = state.stamp_ns, SECOND // 10
    for i in range(1, 21):
        stamp_ns, truth = now_ns + i * step_ns, step(truth, 0.03, 0.0)
        state = ROBOT.add_odometry(state, Odometry(stamp_ns - step_ns, stamp_ns, 0.03, 0.0))
        x, y, _ = state.estimate.pose
        state = ROBOT.add_fix(state, fix(x, y + 0.05, stamp_ns, sensor_m=0.01, observer_m=0.01))
    assert state.memory.events["outvoted"] == 1
    assert position_error(state.estimate, truth) < 0.1  # 0.57 m if only frames of landmarks decide


def test_nobody_is_to_blame_for_a_frame_that_the_estimate_has_not_used_yet() -> None:
    """For a second the robot saw no landmark, and turned by 17 deg that its odometry does not tell.
    The next frame says so, and shows its teammates as well: one that states too little is not where
    it says. What the frame corrects is not what they did."""
    odometry = replace(NOISE, turn_sigma_rad_per_sqrt_m=0.3)
    sensor = SensorSettings(range_share=0.0, range_floor_m=0.01, bearing_sigma_deg=0.3)
    start = Start(x_m=LOOP_START.x, y_m=LOOP_START.y)
    robot = localizer(odometry=odometry, sensor=sensor, start=start)
    state, truth = drive(4.0, robot=robot)
    for piece, _ in driven(truth, [(0.05, 0.0)] * 10, start_ns=state.stamp_ns):
        state = robot.add_odometry(state, piece)
        truth, now_ns = step(truth, 0.05, 0.03), piece.stamp_ns
    sightings = list(frame(truth, now_ns).sightings)
    for name, dx, off_m in (("mate", 3.0, 0.1), ("other", -2.0, 0.0)):
        x, y = truth.x + dx, truth.y + 1.0
        of_it = replace(belief(x, y, now_ns, sigma_m=0.01), robot=name)
        state = robot.add_teammate_belief(state, of_it)
        sightings.append(point_sighting(truth, name, x + off_m, y))
    state = robot.cycle(state, Sightings(now_ns, tuple(sightings)))
    assert state.memory.teammates.senders["mate"].own_nis > 18.0
    assert position_error(state.estimate, truth) < 0.03
    assert "outvoted" not in state.counts


@pytest.mark.parametrize(("distance", "turn"), [(0.05, 0.0), (0.0, 0.08)])
def test_scales_that_are_not_known_make_it_as_uncertain_as_the_whole_way(
    distance: float, turn: float
) -> None:
    """A share of all that it drives or turns in three seconds, at least."""
    start = Pose2(0.0, 0.0, 0.0)
    exact = OwnPose(0, Estimate(start, diagonal(0.01, 0.01)), AS_CONFIGURED, 0)
    off, scales = exact, ScaleErrors.of_sigmas(0.1, 0.2)
    for i in range(1, 31):
        off = off.after_step(distance, turn, NOISE, 0.0, NO_VARIANCE)
        exact = exact.after_step(distance, turn, NOISE, 0.0, NO_VARIANCE)
        off, exact = off.at(i * SECOND // 10, scales), exact.at(i * SECOND // 10)
    least = (0.1 * 30 * distance) ** 2, (0.2 * 30 * turn) ** 2
    for i, added in zip((0, 5), least, strict=True):
        assert off.estimate.covariance[i] - exact.estimate.covariance[i] >= added


def test_help_does_not_move_the_pose_by_own_sensors() -> None:
    state, truth = drive(3.0, 0.1, [next(iter(ROBOT.field.landmarks))])
    own = state.memory.teammates.own
    assert own is not None
    assert position_error(own.estimate, truth) < 0.02
    assert position_error(state.estimate, truth) > 0.05


@pytest.mark.parametrize("has_odometry", [True, False])
def test_nobody_is_to_blame_for_a_guess_of_a_robot_without_odometry(has_odometry: bool) -> None:
    state, truth = drive(3.0)
    begin_ns = state.stamp_ns
    for i in range(1, 4):
        now_ns = begin_ns + i * SECOND // 5
        if has_odometry:
            before_ns = now_ns - SECOND // 5
            state = ROBOT.add_odometry(state, Odometry(before_ns, now_ns, 0.0, 0.0))
        state = ROBOT.add_fix(state, fix(truth.x, truth.y + 1.5, now_ns))
    record = state.memory.teammates.senders["mate"]
    assert (record.score > 0.0) is has_odometry
    assert (record.last_failure_ns > begin_ns) is has_odometry
