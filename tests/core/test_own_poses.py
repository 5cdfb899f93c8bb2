"""The pose by own sensors of robots with a camera, and of those with a position sensor."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import (
    CORNERS,
    LOOP_START,
    SECOND,
    driven,
    fix,
    frame,
    loop,
    placed_at,
    position_error,
)

from cpcbl_team.camera_errors import bearing_sensitivity, range_sensitivity
from cpcbl_team.common_error_filter import common_error_filter, common_errors_of
from cpcbl_team.config import (
    CameraSettings,
    Field,
    Landmark,
    LocalizationSettings,
    OdometrySettings,
    SensorSettings,
    Start,
)
from cpcbl_team.estimate import Estimate
from cpcbl_team.fusion import Observation
from cpcbl_team.gaussian import Covariance2, Gaussian2
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_team.localizer import Localizer
from cpcbl_team.measurements import GatedObject, measurement_of
from cpcbl_team.own_pose import OwnPose
from cpcbl_team.state import State, with_common_errors, with_teammates

NOISE = OdometrySettings(distance_sigma_m_per_sqrt_m=0.1, turn_sigma_rad_per_sqrt_m=0.1)
SENSOR = SensorSettings(range_share=0.05, bearing_sigma_deg=2.0)
START = Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.02, heading_sigma_deg=1.0)
SETTINGS = LocalizationSettings(odometry=NOISE, sensor=SENSOR, start=START)
CAMERA = CameraSettings()
TEAM = frozenset({"a", "b", "mate"})
LANDMARK = next(iter(CORNERS.landmarks))

Help = Callable[[Localizer, State, Pose2], State]


def camera_robot(field: Field = CORNERS) -> Localizer:
    return Localizer(SETTINGS, field, TEAM, CAMERA)


class Driven(NamedTuple):
    state: State
    truth: Pose2
    nees: list[float]  # of the positions of the pose by own sensors


def own_pose_of(state: State) -> OwnPose:
    own = state.memory.teammates.own
    assert own is not None
    return own


def nees(estimate: Estimate, truth: Pose2) -> float:
    """Of two degrees of freedom."""
    off = estimate.pose.x - truth.x, estimate.pose.y - truth.y
    return estimate.covariance.position().mahalanobis_squared(*off)


def drive(robot: Localizer, seconds: float, own: Help, help_: Help) -> Driven:
    """A loop at 10 Hz: what the robot's own sensors say, and then its teammates."""
    state, truth, found = robot.start(0), LOOP_START, []
    for piece, truth in driven(LOOP_START, loop()[: round(10 * seconds)]):
        state = own(robot, robot.add_odometry(state, piece), truth)
        state = help_(robot, robot.predict(state, piece.stamp_ns), truth)
        known = state.memory.teammates.own
        if known is not None and known.stamp_ns == state.stamp_ns:
            found.append(nees(known.estimate, truth))
    return Driven(state, truth, found)


def sees(names: tuple[str, ...] | None = None) -> Help:
    """Exact sightings of these landmarks."""

    def own(robot: Localizer, state: State, truth: Pose2) -> State:
        stamp_ns = state.odometry_until_ns
        return robot.cycle(state, frame(truth, stamp_ns, robot.field, names))

    return own


def measures(sigma_m: float, every_ns: int = SECOND // 5) -> Help:
    """A position sensor with this noise."""
    random = np.random.default_rng(1)

    def own(robot: Localizer, state: State, truth: Pose2) -> State:
        stamp_ns = state.odometry_until_ns
        if stamp_ns % every_ns:
            return state
        x, y = sigma_m * random.normal(size=2)
        return robot.add_position(state, placed_at(truth.x + x, truth.y + y, stamp_ns, sigma_m))

    return own


def told(off_m: float, names: tuple[str, ...] = ("mate",)) -> Help:
    """Teammates that see the robot so far off in x after half a second."""

    def help_(robot: Localizer, state: State, truth: Pose2) -> State:
        x = truth.x + (off_m if state.stamp_ns > SECOND // 2 else 0.0)
        said = fix(x, truth.y, state.stamp_ns, sensor_m=0.01, observer_m=0.01)
        for name in names:
            state = robot.add_fix(state, replace(said, observer=name))
        return state

    return help_


def led_astray(state: State) -> State:
    """The state with an estimate that a teammate has moved by a metre."""
    x, y, heading = state.estimate.pose
    memory = state.memory.teammates
    senders = {**memory.senders, "a": replace(memory.senders["a"], own_nis=50.0)}
    away = state.estimate._replace(pose=Pose2(x + 1.0, y, heading))
    return with_teammates(state._replace(estimate=away), memory._replace(senders=senders))


def test_help_does_not_move_the_own_pose_of_a_robot_with_a_camera() -> None:
    state, truth, _ = drive(camera_robot(), 3.0, sees((LANDMARK,)), told(0.1))
    own = own_pose_of(state)
    assert position_error(own.estimate, truth) < 0.03
    assert position_error(state.estimate, truth) > 0.05
    assert own.common is not None
    assert own.common.camera_sigmas.yaw_rad > 0.0


def test_help_does_not_move_the_own_pose_of_a_robot_with_a_position_sensor() -> None:
    robot = Localizer(SETTINGS, Field(), TEAM)
    liar, correct = (drive(robot, 6.0, measures(0.3), told(off)).state for off in (0.1, 0.0))
    pose, expected = (own_pose_of(state).estimate.pose for state in (liar, correct))
    assert pose == pytest.approx(expected, abs=1e-9)
    assert liar.estimate.pose.x - correct.estimate.pose.x > 0.05


def test_who_led_a_robot_away_from_its_position_sensor_is_found_out() -> None:
    """The estimate rejects what the sensor reads by then."""
    robot = Localizer(SETTINGS, Field(), TEAM)
    state, truth, _ = drive(robot, 3.0, measures(0.05), told(0.0, ("a", "b")))
    stamp_ns, gated = state.stamp_ns + SECOND // 10, state.updates.gated
    state = robot.add_position(led_astray(state), placed_at(truth.x, truth.y, stamp_ns))
    assert state.updates.gated == gated + 1
    assert position_error(state.estimate, truth) < 0.05
    reasons = {name: r.reason for name, r in state.memory.teammates.senders.items() if r.reason}
    assert reasons == {"a": "outvoted"}
    assert not state.lost


@pytest.mark.parametrize("has_team", [True, False])
def test_a_rejected_position_of_the_own_sensor_counts_towards_being_lost(has_team: bool) -> None:
    """It is no guest without a vote."""
    robot = Localizer(SETTINGS, Field(), TEAM if has_team else None)
    state = robot.start(0)
    for i in range(1, 31):
        state = robot.add_position(state, placed_at(8.0, 8.0, i * SECOND // 5))
    assert "lost" in state.counts
    assert "distrusted" not in state.counts


def reads(share: float, seed: int) -> Help:
    """A camera with errors of its stated sigmas, and ranges that are too long by this share all
    the time."""
    random = np.random.default_rng(seed)
    sigmas = math.radians(CAMERA.yaw_sigma_deg), CAMERA.focal_share, CAMERA.centre_share
    errors = random.normal(size=3) * sigmas

    def own(robot: Localizer, state: State, truth: Pose2) -> State:
        stamp_ns, seen = state.odometry_until_ns, []
        for s in frame(truth, stamp_ns).sightings:
            assert s.range_m is not None
            assert s.bearing_rad is not None
            if abs(s.bearing_rad) > math.radians(50.0):
                continue
            r = s.range_m * (1.0 + share + 0.02 * random.normal())
            r += float(errors @ range_sensitivity(s.range_m, s.bearing_rad))
            b = s.bearing_rad + SENSOR.bearing_sigma_rad * random.normal()
            b += float(errors @ bearing_sensitivity(s.bearing_rad))
            seen.append(Sighting(s.id, r, b))
        return robot.cycle(state, Sightings(stamp_ns, tuple(seen)))

    return own


def test_the_own_pose_contains_an_error_of_ranges_that_stays() -> None:
    """As that of a tilt which is off by one and a half sigmas. Else it would blame correct
    teammates."""
    found: list[float] = []
    for seed in range(1, 7):
        share = 0.075 if seed % 2 else -0.075
        result = drive(camera_robot(), 20.0, reads(share, seed), told(0.0, ("a", "b")))
        assert not any(r.quarantines for r in result.state.memory.teammates.senders.values())
        found += result.nees[20:]
    assert np.mean(found) < 2.0  # 2.3 if each frame counted as independent
    assert np.mean(np.array(found) < 9.0) > 0.99


def test_a_robot_that_was_led_astray_goes_on_with_what_its_own_sensors_say_of_its_camera() -> None:
    robot = camera_robot()
    state, _, _ = drive(robot, 3.0, sees(), told(0.0, ("a", "b")))
    own = own_pose_of(state)
    assert own.common != state.common_errors
    state = robot.screen.own.without_misleading(led_astray(state))
    assert state.memory.teammates.senders["a"].reason == "outvoted"
    assert state.estimate == own.estimate
    assert state.common_errors == own.common


def test_objects_that_the_robot_has_seen_since_are_as_the_map_says_in_the_own_pose() -> None:
    marks = {n: replace(m, sigma_m=0.1) for n, m in CORNERS.landmarks.items()}
    field = Field(landmarks={**marks, "new": Landmark(x_m=0.0, y_m=3.0)}, unsurveyed={})
    common = common_error_filter(SETTINGS, field, CAMERA)
    assert common is not None
    first, *others = marks
    state = common.with_object(common.started(Localizer(SETTINGS, field, TEAM).start(0)), first)
    known = common_errors_of(state)
    own = OwnPose(0, state.estimate, state.memory.calibration.adaptation, 0, known)
    assert common.own_pose_for(own, state) is own
    for name in others:
        state = common.with_object(state, name)
    found = common.own_pose_for(own, state)
    assert found is not None
    assert found.common == common_errors_of(state)
    place = known.with_place(
        "new", state.estimate, Gaussian2(1.0, 0.0, Covariance2(0.01, 0.0, 0.01))
    )
    assert common.own_pose_for(own, with_common_errors(state, place)) is None
    gone = common_errors_of(state).without_object(first)
    assert common.own_pose_for(found, with_common_errors(state, gone)) is None


def test_a_sighting_of_a_teammate_is_judged_by_what_own_sensors_say_of_the_camera() -> None:
    """Help turned what the estimate takes for the yaw of the camera."""
    robot = camera_robot()
    state, truth, _ = drive(robot, 3.0, sees(), told(0.0))
    own, rows = own_pose_of(state), ((0.0, 0.0, 1.0),)
    known = common_errors_of(state)
    m = measurement_of(
        Sighting(LANDMARK, 1.0, 0.0), state.stamp_ns, truth, robot.field, {}, SETTINGS
    )
    assert m is not None
    nothing = Covariance2(0.0, 0.0, 0.0)
    seen = Observation(rows, (0.0,), Covariance2(1e-4, 0.0, 0.0), nothing)
    found = GatedObject(m, [], 0.0, seen, (((0, -1.0),),))
    yaw, *values = known.values
    turned = known._replace(values=(yaw + 0.5, *values))
    before = robot.screen.own.nis_of_sighting(state, found)
    after = robot.screen.own.nis_of_sighting(with_common_errors(state, turned), found)
    assert after > before + 10.0
    assert own.common is not None
