"""Being lost, the evidence that is kept, and the way back."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import (
    CORNERS,
    LOOP_START,
    SECOND,
    VARIANTS,
    diagonal,
    driven,
    fix,
    followed,
    frame,
    heading_error,
    localizer,
    loop,
    placed_at,
    point_sighting,
    position_error,
    sensor_noise,
    state_at,
)
from support.evidence import piece

from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.config import (
    Field,
    Gives,
    Landmark,
    LocalizerSettings,
    OdometrySettings,
    SensorSettings,
    Start,
    Variant,
)
from cpcbl_team.estimate import Estimate
from cpcbl_team.fixes import from_fix, from_position_sensor
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inflation import inflate_covariance
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_team.lost_reasons import Limits, lost_reason, with_innovations
from cpcbl_team.measurements import Measurement
from cpcbl_team.miscalibration import Adaptation, noise_with_factor
from cpcbl_team.places import ObjectPosition
from cpcbl_team.range_errors import RangeErrors
from cpcbl_team.recovery_evidence import (
    MOST_PIECES,
    SPACING_NS,
    WINDOW_NS,
    evidence_from_measurement,
    evidence_from_observation,
    with_evidence,
    with_measurements,
)
from cpcbl_team.relocalization import relocalize
from cpcbl_team.state import Memory, RecoveryMemory, State, Updates

ORIGIN = Pose2(0.0, 0.0, 0.0)
HERE = Pose2(-1.0, 0.4, 0.3)
RULES = LocalizerSettings()
LIMITS = Limits.of(RULES)
SENSOR = SensorSettings()
UNKNOWN = Start(known=False, x_m=0.0, y_m=0.0)

variants = pytest.mark.parametrize("variant", VARIANTS)


def giving(gives: Gives, *names: str) -> Field:
    """The corners (or those that are named), of this kind."""
    chosen = names or tuple(CORNERS.landmarks)
    places = {name: CORNERS.landmarks[name] for name in chosen}
    return Field(
        landmarks={n: Landmark(x_m=p.x_m, y_m=p.y_m, gives=gives) for n, p in places.items()}
    )


# Being lost ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sigma_m", "sigma_rad", "reason"),
    [
        (0.1, 0.1, ""),
        (2.1, 0.1, "position sigma 2.10 m"),
        (0.1, math.radians(61.0), "heading sigma 61 deg"),
    ],
)
def test_a_robot_is_lost_by_its_own_uncertainty(
    sigma_m: float, sigma_rad: float, reason: str
) -> None:
    estimate = Estimate(ORIGIN, diagonal(sigma_m, sigma_rad))  # row 20, resolution f
    assert lost_reason(estimate, 1, LIMITS) == reason


@pytest.mark.parametrize(
    ("rejected", "accepted", "reason"),
    [
        (12, 8, ""),
        (13, 7, "13 of the last 20 innovations rejected"),
        (13, 0, "13 of the last 13 innovations rejected"),
        (9, 0, ""),
    ],
)
def test_a_robot_is_lost_when_most_of_its_measurements_are_rejected(
    rejected: int, accepted: int, reason: str
) -> None:
    innovations = with_innovations(1, accepted, rejected, 20)
    assert lost_reason(Estimate(ORIGIN, diagonal(0.1, 0.1)), innovations, LIMITS) == reason


@pytest.mark.parametrize(("sigma_m", "still"), [(1.1, True), (0.9, False)])
def test_being_lost_ends_at_half_the_limit(sigma_m: float, still: bool) -> None:
    robot = localizer(rules=RULES)
    memory = Memory(RecoveryMemory(lost="before"))
    state = state_at(ORIGIN, diagonal(sigma_m, 0.1))._replace(memory=memory)
    assert (robot.cycle(state, Sightings(1, ())).lost != "") is still
    state = state._replace(memory=Memory())
    assert robot.cycle(state, Sightings(1, ())).lost == ""


def test_inflation_doubles_sigma_up_to_the_limits_of_being_lost() -> None:
    estimate = Estimate(ORIGIN, diagonal(0.02, 0.01))
    sigmas = []
    for _ in range(8):
        estimate = inflate_covariance(estimate, RULES)
        sigmas.append(estimate.position_sigma_m)
    assert sigmas[:4] == pytest.approx([0.1, 0.2, 0.4, 0.8])
    assert sigmas[-1] == pytest.approx(RULES.lost_position_sigma_m)
    assert math.degrees(estimate.heading_sigma_rad) < RULES.lost_heading_sigma_deg
    assert inflate_covariance(estimate, RULES).covariance == pytest.approx(estimate.covariance)


# Evidence -----------------------------------------------------------------------------------------


def test_memory_keeps_little_of_each_object_and_nothing_old() -> None:
    memory = RecoveryMemory()
    for i in range(200):
        now = i * SPACING_NS // 5
        memory = with_evidence(memory, [piece(now, ORIGIN, n, 1.0, 2.0) for n in ("a", "b")])
    stamps = [e.stamp_ns for e in memory.evidence if e.source == "a"]
    assert np.diff(stamps).min() >= SPACING_NS
    assert len(memory.evidence) <= MOST_PIECES
    later = stamps[-1] + WINDOW_NS + 1
    memory = with_evidence(memory, [piece(later, ORIGIN, "c", 1.0, 2.0)])
    assert [e.source for e in memory.evidence] == ["c"]


@pytest.mark.parametrize(("age_ns", "kept"), [(SPACING_NS - 1, ["ne"]), (SPACING_NS, ["ne", "ne"])])
def test_an_object_measured_a_short_time_ago_is_no_new_evidence(
    age_ns: int, kept: list[str]
) -> None:
    state = state_at(ORIGIN, diagonal(0.1, 0.1), stamp_ns=SECOND)
    before = (piece(SECOND - age_ns, ORIGIN, "ne", 4.5, 2.5),)
    memory = Memory(RecoveryMemory(evidence=before))
    state = state._replace(memory=memory)
    place, both = ObjectPosition(4.5, 2.5, Covariance2(0.0, 0.0, 0.0)), (5.0, 0.5)
    visible = [Measurement(name, place, None, False, *both, 0.1, 0.1) for name in ("ne", "ne")]
    assert [e.source for e in with_measurements(state, visible).evidence] == kept


@pytest.mark.parametrize("gives", ["none", "bearing"])
def test_a_reading_that_may_not_be_used_is_no_evidence(gives: Gives) -> None:
    """It must not be taken for a fix, which has neither range nor bearing."""
    robot = localizer(field=giving(gives, "ne"))
    visible = point_sighting(ORIGIN, "ne", 4.5, 2.5)
    ranged = Sightings(1, (Sighting("ne", visible.range_m),))
    state = robot.cycle(state_at(ORIGIN, diagonal(0.1, 0.1)), ranged)
    assert all(
        (e.range_m, e.bearing_rad) != (None, None)
        for e in robot.recovery.evidence(state.memory.recovery)
    )


def test_evidence_is_as_uncertain_as_the_teammate_that_gave_it() -> None:
    """Of a place the mean variance of both axes: that of a belief, or the observer's part."""
    state = state_at(ORIGIN, diagonal(0.1, 0.1), stamp_ns=SECOND)
    place = ObjectPosition(4.5, 2.5, Covariance2(0.01, 0.0, 0.07))
    visible = Measurement("mate", place, None, True, 5.0, 0.5, 0.1, 0.1, sender="mate")
    by_belief = evidence_from_measurement(state, visible)
    assert by_belief.teammate_sigma_m == pytest.approx(0.2)
    assert by_belief.from_teammate
    by_fix = evidence_from_observation(state, from_fix(fix(1.0, 2.0, observer_m=0.3)))
    assert by_fix.teammate_sigma_m == pytest.approx(0.3)
    own = evidence_from_observation(state, from_position_sensor(placed_at(1.0, 2.0)))
    assert (own.teammate_sigma_m, own.from_teammate) == (0.0, False)


# The whole way back -------------------------------------------------------------------------------


def test_a_robot_with_an_unknown_start_finds_itself() -> None:
    robot = localizer(start=UNKNOWN)
    state = robot.start(0)
    state = robot.cycle(state, frame(HERE, SECOND // 10, names=["ne", "se"]))
    assert state.lost == ""
    assert state.counts["found_again"] == 1
    assert position_error(state.estimate, HERE) < 1e-3


def test_a_lost_robot_reads_its_evidence_with_what_it_found_wrong_in_its_settings() -> None:
    """A bias that it has noticed turns it no more, and sigmas that were too small are larger."""
    robot, change = localizer(start=UNKNOWN), Adaptation(bearing_bias_rad=0.2, sensor_factor=9.0)
    right, ranges = frame(HERE, SECOND // 10), RangeErrors(0.1, 0.05)
    wrong = tuple(
        replace(
            s,
            range_m=((s.range_m or 0.0) - ranges.offset_m) / ranges.scale,
            bearing_rad=wrap_angle((s.bearing_rad or 0.0) + 0.2),
        )
        for s in right.sightings
    )
    start = robot.start(0)
    of_right = robot.cycle(start, right).estimate
    calibration = CalibrationMemory(adaptation=change._replace(ranges=ranges))
    start = start._replace(memory=start.memory._replace(calibration=calibration))
    found = robot.cycle(start, Sightings(right.stamp_ns, wrong)).estimate
    assert position_error(found, HERE) < 1e-3
    assert heading_error(found, HERE) < 1e-3
    assert found.position_sigma_m == pytest.approx(3.0 * of_right.position_sigma_m, rel=0.1)


@pytest.mark.parametrize("factor", [1.0, 16.0])
def test_a_lost_robot_trusts_old_evidence_as_far_as_its_odometry(factor: float) -> None:
    """Whose noise it may have found to be larger than its settings say."""
    noise, way = OdometrySettings(), (LOOP_START, Pose2(LOOP_START.x + 2.0, LOOP_START.y, 0.3))
    seen = (("ne", "sw"), ("nw",))
    evidence = tuple(
        piece(i * SECOND, place, name, CORNERS.landmarks[name].x_m, CORNERS.landmarks[name].y_m)
        for i, (place, names) in enumerate(zip(way, seen, strict=True))
        for name in names
    )
    robot, now = localizer(start=UNKNOWN), 2 * SECOND
    start = robot.start(now)._replace(odometry_from_robot=way[-1])
    calibration = CalibrationMemory(adaptation=Adaptation(motion_factor=factor))
    memory = start.memory._replace(calibration=calibration)
    recovery = memory.recovery._replace(evidence=evidence)
    found = robot.recovery.check(start._replace(memory=memory._replace(recovery=recovery)))
    expected = relocalize(evidence, way[-1], CORNERS, noise_with_factor(noise, factor))
    assert expected is not None
    assert found.estimate.covariance == pytest.approx(expected.covariance)


def kidnapped(
    variant: Variant, names: Sequence[str], before_s: float, after_s: float = 3.0
) -> tuple[State, Pose2]:
    """Carried off 3 m and turned after so long; then frames at 10 Hz."""
    robot, noise = localizer(variant), sensor_noise(np.random.default_rng(7), SENSOR)
    begin, way = state_at(LOOP_START, diagonal(0.05, 0.05)), loop()[: int(before_s * 10)]
    before = followed(robot, begin, LOOP_START, way, names=lambda _: names, noise=noise)
    state, truth = [(begin, LOOP_START), *before][-1]
    assert not state.counts.get("lost")
    away = math.copysign(3.0, -truth.x)
    elsewhere = Pose2(truth.x + away, truth.y, wrap_angle(truth.heading + 1.2))
    on = [(0.03, 0.02)] * int(after_s * 10)
    *_, end = followed(robot, state, elsewhere, on, names=lambda _: names, noise=noise)
    return end


@pytest.mark.parametrize("before_s", [0.0, 8.0], ids=["at the start", "on the way"])
@pytest.mark.parametrize("names", [("ne", "nw", "se"), ("ne", "nw", "se", "sw")], ids=["3", "4"])
@variants
def test_a_kidnapped_robot_is_back_within_three_seconds(
    variant: Variant, names: Sequence[str], before_s: float
) -> None:
    state, truth = kidnapped(variant, names, before_s)
    assert state.counts["lost"] >= 1
    assert state.lost == ""
    assert position_error(state.estimate, truth) < 0.5
    assert heading_error(state.estimate, truth) < 0.3


@variants
def test_a_kidnapped_robot_is_not_found_where_it_no_longer_is(variant: Variant) -> None:
    """Found at the old place it would be confident and wrong, and teammates would use it."""
    state, _ = kidnapped(variant, tuple(CORNERS.landmarks), 8.0)
    assert state.counts["found_again"] == 1


@pytest.mark.parametrize("variant", ["joint", "oval"])
def test_a_kidnapped_robot_that_sees_one_landmark_stays_lost_and_says_why(
    variant: Variant,
) -> None:
    """It cannot know where on the circle about the landmark it stands."""
    state, _ = kidnapped(variant, ("ne",), 8.0, 20.0)
    assert "ne agrees: no turn about it can be observed" in state.lost
    assert "found_again" not in state.counts


def test_a_second_landmark_ends_that() -> None:
    state, truth = kidnapped("joint", ("ne",), 8.0, 20.0)
    robot, noise = localizer(), sensor_noise(np.random.default_rng(8), SENSOR)
    both = {"names": lambda _: ("ne", "sw")}
    *_, (state, truth) = followed(robot, state, truth, [(0.03, 0.02)] * 10, noise=noise, **both)
    assert state.lost == ""
    assert position_error(state.estimate, truth) < 0.5


def test_a_landmark_that_disagrees_for_a_moment_does_not_make_it_lost_for_good() -> None:
    """Half a second of a wrong bearing: the robot is where it was."""
    robot = localizer(field=Field(landmarks={"post": CORNERS.landmarks["ne"]}))
    state = state_at(HERE, diagonal(0.03, 0.03))
    for i in range(60):
        (seen,) = frame(HERE, 1, names=["ne"]).sightings
        assert seen.bearing_rad is not None
        off = 1.5 if 20 <= i < 33 else 0.0
        wrong = Sighting("post", seen.range_m, wrap_angle(seen.bearing_rad + off))
        state = robot.cycle(state, Sightings((i + 1) * SECOND // 20, (wrong,)))
    assert state.counts["lost"] == 1
    assert state.lost == ""


@variants
def test_an_overconfident_robot_with_one_visible_landmark_at_a_time_recovers(
    variant: Variant,
) -> None:
    """In turn for 2 s each: one landmark alone does not say where the robot is."""
    robot, noise = localizer(variant), sensor_noise(np.random.default_rng(3), SENSOR)
    wrong, names = state_at(Pose2(0.5, 1.0, -1.0), diagonal(0.02, 0.02)), sorted(CORNERS.landmarks)
    *_, (state, truth) = followed(
        robot,
        wrong,
        LOOP_START,
        loop()[:120],
        names=lambda piece: [names[piece // 20 % 4]],
        noise=noise,
    )
    assert state.lost == ""
    assert position_error(state.estimate, truth) < 0.5
    assert heading_error(state.estimate, truth) < 0.3


@variants
def test_an_overconfident_robot_with_one_landmark_does_not_reject_it_for_ever(
    variant: Variant,
) -> None:
    """Within 15 s; where it is on the circle about the landmark cannot be known."""
    robot = localizer(variant, odometry=OdometrySettings(moves=False))
    state = state_at(Pose2(0.5, 1.0, -1.0), diagonal(0.02, 0.02))
    for i in range(1, 46):
        state = robot.cycle(state, frame(LOOP_START, i * SECOND // 3, names=["ne"]))
    assert state.updates.innovations.bit_count() - 1 >= 10


@pytest.mark.parametrize("own", [False, True], ids=["a teammate's fixes", "its own sensor"])
@variants
def test_a_lost_robot_relocalizes_by_positions_along_the_way(variant: Variant, own: bool) -> None:
    robot = localizer(variant, Field(), start=UNKNOWN)
    state, truth = robot.start(0), LOOP_START
    for odometry, truth in driven(LOOP_START, loop()[:60]):
        now = odometry.stamp_ns
        state = robot.add_odometry(state, odometry)
        if own:
            state = robot.add_position(state, placed_at(truth.x, truth.y, now))
        else:
            state = robot.add_fix(state, fix(truth.x, truth.y, now))
    assert state.lost == ""
    assert "lost" not in state.counts  # not again
    assert position_error(state.estimate, truth) < 0.1
    assert heading_error(state.estimate, truth) < 0.2


def test_the_reason_of_being_lost_is_the_present_one() -> None:
    """Not why it was at first: the rejections are over, its heading is still unknown."""
    robot = localizer(rules=LocalizerSettings(variant="joint"))
    memory = Memory(RecoveryMemory(lost="13 of the last 20 innovations rejected"))
    updates = Updates(innovations=with_innovations(1, 20, 0, 20))
    state = state_at(ORIGIN, diagonal(0.1, 1.0))._replace(memory=memory, updates=updates)
    state = robot.cycle(state, Sightings(1, ()))
    assert state.lost == "heading sigma 57 deg"
