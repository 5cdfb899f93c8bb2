"""Objects of the map whose places are uncertain: formulas, and what repetition makes of them."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import (
    CORNERS,
    LOOP_START,
    MIXED,
    PROBABILISTIC,
    SECOND,
    Matrix,
    covariance3,
    diagonal,
    displaced,
    driven,
    followed,
    frame,
    least_eigenvalue,
    localizer,
    loop,
    matrix2,
    matrix3,
    point_sighting,
    position_error,
    random_matrix,
    sensor_noise,
    state_at,
    wall_sighting,
)

from cpcbl_team.augmented_update import AugmentedUpdate, Reading, estimated_of
from cpcbl_team.camera_errors import NO_ERRORS
from cpcbl_team.common_error_filter import common_error_filter
from cpcbl_team.common_errors import CAMERA, CommonErrors
from cpcbl_team.config import (
    Field,
    Gives,
    Landmark,
    LocalizationSettings,
    LocalizerSettings,
    OdometrySettings,
    SensorSettings,
    Start,
    Variant,
    Wall,
)
from cpcbl_team.estimate import POSE, Estimate
from cpcbl_team.gaussian import Covariance2, Gaussian2
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Odometry
from cpcbl_team.measurements import constraints_of, measurement_of, sensitivities_of
from cpcbl_team.motion import motion_noise
from cpcbl_team.parameters import Parameters
from cpcbl_team.places import map_object, moved_wall, place_covariance
from cpcbl_team.sensors import sighting_sigmas

JOINT = LocalizerSettings()
SETTINGS = LocalizationSettings(localizer=JOINT)
ONE = Field(landmarks={"box": Landmark(x_m=3.0, y_m=1.0, sigma_m=0.2)})
WALL = Wall(from_m=(-5.0, -3.0), to_m=(5.0, -2.0), sigma_m=0.1, direction_sigma_deg=3.0)
STEP = 1e-5


def uncertain(field: Field, sigma_m: float) -> Field:
    """The field whose landmarks and walls are known to so much."""
    return Field(
        landmarks={n: replace(m, sigma_m=sigma_m) for n, m in field.landmarks.items()},
        walls={n: replace(w, sigma_m=sigma_m) for n, w in field.walls.items()},
    )


def parameters_of(p: Matrix) -> Parameters:
    """Those of a covariance of the pose and of them."""
    rows = tuple(tuple(float(b) for b in row) for row in p[3:, 3:])
    with_pose = tuple((float(a), float(b), float(c)) for a, b, c in p[3:, :3])
    return Parameters(rows, with_pose)


def common_of(p: Matrix) -> CommonErrors:
    """A camera, and one object."""
    return CommonErrors(0.0, (0.0,) * (len(p) - 3), parameters_of(p), {"box": CAMERA})


def full(common: CommonErrors) -> Matrix:
    return np.array(common.parameters.covariance)


# Formulas ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["box", "wall"])
@pytest.mark.parametrize("pose", [Pose2(0.2, 0.4, 0.3), Pose2(4.0, -5.0, 2.0)])
def test_residuals_follow_the_error_of_a_place(name: str, pose: Pose2) -> None:
    """Against finite differences: the object is really moved."""
    field = Field(landmarks={"box": Landmark(x_m=3.0, y_m=1.0)}, walls={"wall": WALL})

    def residuals(error: Matrix) -> Matrix:
        a, b = float(error[0]), float(error[1])
        if name == "box":
            seen = point_sighting(pose, name, 3.0 + a, 1.0 + b)
        else:
            seen = wall_sighting(pose, name, moved_wall(WALL, a, b))
        m = measurement_of(seen, 0, pose, field, {}, SETTINGS)
        assert m is not None
        return np.array([c.residual for c in constraints_of(pose, m, POSE, JOINT)])

    derivatives = [(residuals(STEP * e) - residuals(-STEP * e)) / (2 * STEP) for e in np.eye(2)]
    common = common_of(np.eye(8))._replace(objects={name: CAMERA})
    seen = frame(pose, 0, field, [name]).sightings[0]
    m = measurement_of(seen, 0, pose, field, {}, SETTINGS, common)
    assert m is not None
    found = sensitivities_of(m, constraints_of(pose, m, POSE, JOINT), common)
    of_object = [[dict(sensitivity)[i] for sensitivity in found] for i in (CAMERA, CAMERA + 1)]
    assert of_object == [pytest.approx(d.tolist(), abs=1e-6) for d in derivatives]


@pytest.mark.parametrize(
    "estimated", [(False, False, True, True), (True, True, True, True), (False,) * 4, ()]
)
def test_an_update_estimates_some_errors_and_considers_the_others(
    estimated: tuple[bool, ...],
) -> None:
    """Against the general form of a Kalman filter with a gain of zero for what is considered
    (Schmidt 1966)."""
    rng = np.random.default_rng(3)
    p, x = random_matrix(rng, 7), np.zeros(7)
    common, cov = common_of(p), covariance3(p[:3, :3])
    free = np.array([True, True, True, *(estimated or (False,) * 4)])
    update = AugmentedUpdate(cov, common, estimated)
    for _ in range(3):
        h, residual, variance = rng.normal(size=7), float(rng.normal()), 0.3
        row, sensitivity = (float(h[0]), float(h[1]), float(h[2])), tuple(enumerate(h[3:].tolist()))
        update.add(Reading(row, sensitivity, residual, variance))
        total = h @ p @ h + variance
        gain = np.where(free, p @ h / total, 0.0)
        x = x + gain * (residual - h @ x)
        left = np.eye(7) - np.outer(gain, h)
        p = left @ p @ left.T + variance * np.outer(gain, gain)
    estimate, common = update.result(Estimate(Pose2(0.0, 0.0, 0.0), cov))
    assert estimate.pose == pytest.approx((x[0], x[1], wrap_angle(x[2])))
    assert matrix3(estimate.covariance) == pytest.approx(p[:3, :3])
    assert common.values == pytest.approx(tuple(x[3:]))
    assert full(common) == pytest.approx(p[3:, 3:])
    assert np.array(common.parameters.with_pose) == pytest.approx(p[3:, :3])


def test_a_new_place_is_as_uncertain_as_what_it_was_seen_from() -> None:
    """Its covariance, also that with the pose and with all other errors, is J P J^T."""
    rng = np.random.default_rng(7)
    p = random_matrix(rng, 8) * 0.01
    pose, place = Pose2(1.0, 2.0, 0.7), Gaussian2(2.0, 0.5, Covariance2(0.01, 0.002, 0.02))
    common = common_of(p)
    after = common.with_place("new", Estimate(pose, covariance3(p[:3, :3])), place)

    def at(e: Matrix) -> Matrix:
        """The place by a pose and a camera with these errors."""
        own = Pose2(pose.x + e[0], pose.y + e[1], pose.heading + e[2])
        depth, across = place.x * math.exp(e[4]), place.y - e[5] * place.x
        angle = math.atan2(across, depth) - e[3]
        r = math.hypot(depth, across)
        return np.array(own.transform(r * math.cos(angle), r * math.sin(angle)))

    unit = np.eye(8)
    jacobian = np.array([(at(STEP * e) - at(-STEP * e)) / (2 * STEP) for e in unit]).T
    noise = matrix2(place.covariance.rotated(pose.heading))
    due = np.vstack([np.hstack([p, p @ jacobian.T]), np.hstack([jacobian @ p, np.zeros((2, 2))])])
    due[8:, 8:] = jacobian @ p @ jacobian.T + noise
    assert full(after) == pytest.approx(due[3:, 3:], abs=1e-7)
    assert np.array(after.parameters.with_pose) == pytest.approx(due[3:, :3], abs=1e-7)
    assert after.place_error("new") == pytest.approx(pose.transform(place.x, place.y))
    assert after.place_covariance("new") == pytest.approx(
        (due[8, 8], due[8, 9], due[9, 9]), abs=1e-7
    )


def test_the_errors_of_a_walls_middle_are_those_of_the_team_file() -> None:
    """Its offset there has `sigma_m`, and nothing to do with its direction."""
    covariance = matrix2(place_covariance(Field(walls={"w": WALL}), "w"))
    half_m = 0.5 * math.dist(WALL.from_m, WALL.to_m)
    to_middle = np.array([[1.0, half_m], [0.0, 1.0]])
    turn = math.radians(3.0)
    at_middle = to_middle @ covariance @ to_middle.T
    assert at_middle == pytest.approx(np.diag([0.1**2, turn**2]), abs=1e-12)
    moved = moved_wall(WALL, 0.2, 0.1)
    assert moved.direction_rad == pytest.approx(WALL.direction_rad + 0.1)
    assert math.dist(moved.from_m, moved.to_m) == pytest.approx(2.0 * half_m)
    assert math.dist(moved.from_m, WALL.from_m) == pytest.approx(0.2)


def test_a_covariance_stands_in_place_of_a_sigma() -> None:
    field = Field(landmarks={"box": Landmark(x_m=0.0, y_m=0.0, covariance_m2=(0.04, 0.01, 0.09))})
    assert place_covariance(field, "box") == (0.04, 0.01, 0.09)
    assert not field.is_exact
    known = map_object(field, "box")
    assert known is not None
    assert known.position.covariance == (0.04, 0.01, 0.09)
    assert map_object(field, "nowhere") is None


# In the filter -----------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", PROBABILISTIC)
@pytest.mark.parametrize("gives", ["both", "range", "bearing"])
def test_repetition_never_averages_the_error_of_a_place_away(
    variant: Variant, gives: Gives
) -> None:
    """A robot that stands and sees one landmark for a minute knows its position along the line of
    sight no better than the landmark's place and its own prior together allow."""
    field = Field(landmarks={"box": replace(ONE.landmarks["box"], gives=gives)})
    standing = OdometrySettings(moves=False)
    robot, pose = localizer(variant, field, odometry=standing), Pose2(0.0, 0.0, 0.0)
    state = state_at(pose, diagonal(0.3, 0.1))
    state = state._replace(memory=robot.start(0).memory)
    for k in range(1, 300):
        state = robot.cycle(state, frame(pose, k * SECOND // 5, field))
    c = state.estimate.covariance
    direction = np.array([3.0, 1.0]) / math.sqrt(10.0)
    along = float(direction @ matrix3(c)[:2, :2] @ direction)
    assert along >= 0.99 / (1.0 / 0.3**2 + 1.0 / 0.2**2)
    assert along <= 0.3**2 * 1.01
    assert c.hh <= 0.1**2 * 1.01


@pytest.mark.parametrize("variant", PROBABILISTIC)
def test_exact_readings_of_an_exact_map_that_is_called_uncertain_give_no_error(
    variant: Variant,
) -> None:
    field = uncertain(MIXED, 0.1)
    start = Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.1, heading_sigma_deg=3.0)
    robot = localizer(variant, field, start=start)
    states = list(followed(robot, robot.start(0), LOOP_START, loop()))
    assert max(position_error(state.estimate, truth) for state, truth in states) < 1e-6
    assert states[-1][0].counts.get("gated", 0) == 0


def test_an_exact_map_has_no_common_errors() -> None:
    assert common_error_filter(SETTINGS, CORNERS, None) is None
    assert localizer("joint").start(0).common_errors is None
    field = uncertain(CORNERS, 0.1)
    assert localizer("joint", field).start(0).common_errors is not None
    for variant in ("oval", "circular", "weighted"):
        assert localizer(variant, field).start(0).common_errors is None


def test_places_are_estimated_from_when_they_are_first_seen() -> None:
    """Landmarks that truly stand 0.2 m elsewhere are found, relative to the start, and what is
    found is as certain as it says."""
    rng, field = np.random.default_rng(1), uncertain(CORNERS, 0.2)
    moved = {
        n: replace(m, x_m=m.x_m + rng.normal(0.0, 0.2), y_m=m.y_m + rng.normal(0.0, 0.2))
        for n, m in CORNERS.landmarks.items()
    }
    start = Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.01, heading_sigma_deg=0.5)
    robot = localizer("joint", field, start=start)
    state = robot.start(0)
    assert state.common_errors is not None
    assert not state.common_errors.objects
    for piece, pose in driven(LOOP_START, loop()):
        state = robot.add_odometry(state, piece)
        state = robot.cycle(state, frame(pose, piece.stamp_ns, Field(landmarks=moved)))
    common = state.common_errors
    assert common is not None
    assert set(common.objects) == set(moved)
    for name, mark in moved.items():
        dx, dy = common.place_error(name)
        nominal = CORNERS.landmarks[name]
        off = np.array([nominal.x_m + dx - mark.x_m, nominal.y_m + dy - mark.y_m])
        assert math.hypot(*off) < 0.08
        assert off @ np.linalg.solve(matrix2(common.place_covariance(name)), off) < 13.8


def test_sigmas_of_sightings_come_from_where_the_object_is_taken_to_be() -> None:
    """The share of a range is that of the expected one, by the place as it is estimated."""
    common = CommonErrors.of_camera(0.0, NO_ERRORS)
    common = common.with_object("box", Covariance2(1.0, 0.0, 1.0))
    common = common._replace(values=(0.0, 0.0, 0.0, 1.0, 0.0))
    seen = point_sighting(Pose2(0.0, 0.0, 0.0), "box", 4.0, 1.0)
    m = measurement_of(seen, 0, Pose2(0.0, 0.0, 0.0), ONE, {}, SETTINGS, common)
    assert m is not None
    assert (m.position.x, m.position.y) == (4.0, 1.0)
    assert m.is_estimated
    assert not m.is_dependent
    expected = sighting_sigmas(seen, SETTINGS.sensor, math.hypot(4.0, 1.0))
    assert (m.range_sigma, m.bearing_sigma) == pytest.approx(expected)


def test_a_turn_of_everything_stays_unknown_however_much_is_corrected() -> None:
    """A robot and the landmarks that it found may all be turned about the origin: no reading tells.
    So no update may make the variance along this turn smaller, wherever it moves the estimates."""
    rng = np.random.default_rng(5)
    pose, cov = Pose2(1.0, 2.0, 0.7), diagonal(1e-6, 0.2)
    common = CommonErrors.of_camera(0.0, NO_ERRORS)
    estimate = Estimate(pose, cov)
    for k in range(3):
        place = Gaussian2(2.0 + k, 0.5 - k, Covariance2(0.04, 0.0, 0.04))
        common = common.with_place(f"box{k}", estimate, place)
    for _ in range(40):
        update = AugmentedUpdate(estimate.covariance, common, estimated_of(common, False))
        i = common.found[int(rng.integers(3))]
        x, y = common.values[i : i + 2]
        dx, dy = x - estimate.pose.x, y - estimate.pose.y
        squared = dx * dx + dy * dy
        u, v = -dy / squared, dx / squared  # how the heading that a bearing gives follows x and y
        off = 0.2 * float(rng.normal())
        update.add(Reading((u, v, 1.0), ((i, -u), (i + 1, -v)), off, 0.002))
        estimate, common = update.result(estimate)
        assert estimate.covariance.hh == pytest.approx(0.04, rel=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_places_and_scales_that_are_both_uncertain_keep_a_covariance(seed: int) -> None:
    """A robot drives to and fro. On the way back wrong scales take away what they have added on the
    way there; how much of that has gone into the places nobody keeps. The joint covariance of pose
    and places became indefinite after a minute, and the robot ended."""
    rng, now = np.random.default_rng(seed), 0
    sensor = SensorSettings(bearing_sigma_deg=0.5, field_of_view_deg=360.0)
    odometry = OdometrySettings(distance_scale_sigma=0.1, turn_scale_sigma=0.1)
    places = {
        n: replace(m, x_m=m.x_m + 0.1 * rng.normal(), y_m=m.y_m + 0.1 * rng.normal())
        for n, m in CORNERS.landmarks.items()
    }
    start = Start(x_m=0.0, y_m=-1.0, sigma_m=0.05, heading_sigma_deg=3.0)
    field, noise = uncertain(CORNERS, 0.1), sensor_noise(rng, sensor)
    robot = localizer(field=field, start=start, sensor=sensor, odometry=odometry)
    state, pose, squares = robot.start(0), Pose2(0.0, -1.0, 0.0), list[float]()
    by_distance, by_turn = 1.0 + 0.1 * rng.normal(size=2)
    for i in range(300):
        odometer = (0.0, math.pi / 10) if i % 30 > 19 else (0.1, 0.02)
        true = odometer[0] * by_distance, odometer[1] * by_turn
        drift = motion_noise(pose.heading, *true, odometry)
        pose, before, now = displaced(step(pose, *true), drift, rng), now, now + SECOND // 10
        state = robot.add_odometry(state, Odometry(before, now, *odometer))
        state = robot.predict(state, now)
        seen = frame(pose, now, Field(landmarks=places), noise=noise)
        state = robot.cycle(state, seen)
        common = state.common_errors
        assert common is not None
        pose_places = np.array(common.parameters.with_pose)
        whole = np.block(
            [
                [matrix3(state.estimate.covariance), pose_places.T],
                [pose_places, np.array(common.parameters.covariance)],
            ]
        )
        assert least_eigenvalue(whole) > -1e-12
        (x, y, _), covariance, _ = state.reported
        squares.append(covariance.position().mahalanobis_squared(x - pose.x, y - pose.y))
    assert np.mean(squares) < 4.0
