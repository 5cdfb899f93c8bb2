"""What a robot takes with it into another frame: the landmarks, as uncertain as they then are."""

import math

import numpy as np
import pytest
from support.core import SECOND, localizer

from cpcbl_team.camera_errors import NO_ERRORS
from cpcbl_team.common_errors import CAMERA, CommonErrors
from cpcbl_team.config import Field, Unsurveyed
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.frame_changes import (
    INFLATION,
    after_frame_change,
    begun_in_frame,
    frame_change,
)
from cpcbl_team.frames import ORIGIN
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import Odometry
from cpcbl_team.parameters import Parameters
from cpcbl_team.state import State, with_common_errors, with_recovery

NAMES = ("oak", "elm", "ash")
FIELD = Field(unsurveyed={name: Unsurveyed() for name in NAMES})
ROBOT = localizer(field=FIELD)
OLD_POSE, NEW_POSE = Pose2(2.0, 1.0, 0.7), Pose2(-8.0, 5.0, -2.0)
PLACES = np.array([3.0, 2.5, -1.0, 4.0, 6.0, -2.0])
NO_CAMERA = CommonErrors.of_camera(0.0, NO_ERRORS)


def random_covariance(random: np.random.Generator, size: int, sigma: float) -> np.ndarray:
    a = sigma * random.normal(size=(size, size))
    return np.asarray(a @ a.T / size + 0.05 * sigma**2 * np.eye(size))


def covariance3(c: np.ndarray) -> Covariance3:
    return Covariance3(c[0, 0], c[0, 1], c[1, 1], c[0, 2], c[1, 2], c[2, 2])


def full(c: Covariance3) -> np.ndarray:
    return np.array([[c.xx, c.xy, c.xh], [c.xy, c.yy, c.yh], [c.xh, c.yh, c.hh]])


def state_with(pose: Pose2, joint: np.ndarray, places: np.ndarray) -> State:
    """A robot at a pose, with places of landmarks; their joint covariance."""
    n = len(places)
    zeros = np.zeros((n + CAMERA, n + CAMERA))
    zeros[CAMERA:, CAMERA:] = joint[3:, 3:]
    with_pose = np.vstack([np.zeros((CAMERA, 3)), joint[3:, :3]])
    parameters = Parameters(tuple(map(tuple, zeros)), tuple(map(tuple, with_pose)))
    numbers = tuple(range(CAMERA, n + CAMERA, 2))
    objects = dict(zip(NAMES, numbers, strict=False))
    common = NO_CAMERA._replace(
        values=((0.0,) * CAMERA + tuple(places)),
        parameters=parameters,
        objects=objects,
        found=numbers,
    )
    state = State(SECOND, Estimate(pose, covariance3(joint[:3, :3])), odometry_until_ns=SECOND)
    return with_common_errors(state, common)


def joined(old: State, estimate: Estimate) -> State:
    new = with_common_errors(State(SECOND, estimate, odometry_until_ns=SECOND), NO_CAMERA)
    return after_frame_change(new, frame_change(old))


def joint_of(state: State) -> tuple[np.ndarray, np.ndarray]:
    """The pose and the places of a state, and their covariance."""
    common = state.common_errors
    assert common is not None
    n = len(common.values) - CAMERA
    covariance = np.zeros((n + 3, n + 3))
    covariance[:3, :3] = full(state.estimate.covariance)
    covariance[3:, 3:] = np.array(common.parameters.covariance)[CAMERA:, CAMERA:]
    cross = np.array(common.parameters.with_pose)[CAMERA:]
    covariance[3:, :3], covariance[:3, 3:] = cross, cross.T
    return np.array([*state.estimate.pose, *common.values[CAMERA:]]), covariance


def test_places_stand_where_the_robot_sees_them() -> None:
    joint = random_covariance(np.random.default_rng(1), 9, 0.1)
    new = joined(state_with(OLD_POSE, joint, PLACES), Estimate(NEW_POSE, covariance3(joint)))
    new_from_old = NEW_POSE @ OLD_POSE.inverse()
    common = new.common_errors
    assert common is not None
    for name, x, y in zip(NAMES, PLACES[::2], PLACES[1::2], strict=True):
        assert common.place_error(name) == pytest.approx(new_from_old.transform(x, y))


@pytest.mark.parametrize("correlation", [-1.0, 0.0, 1.0])
def test_the_covariance_is_never_less_than_the_error_whatever_the_correlation(
    correlation: float,
) -> None:
    """Monte Carlo: the pose in the new frame errs as the one in the old frame does, not at all like
    it, or the other way round. The NEES of all nine is at most nine."""
    random = np.random.default_rng(7)
    joint = random_covariance(random, 9, 0.01)
    new_cov = joint[:3, :3] if correlation else random_covariance(random, 3, 0.01)
    values = []
    for _ in range(400):
        error = random.multivariate_normal(np.zeros(9), joint)
        moved = correlation * error[:3]
        if not correlation:
            moved = random.multivariate_normal(np.zeros(3), new_cov)
        believed = Pose2(*(np.array(OLD_POSE) + error[:3]))
        old = state_with(believed, joint, PLACES + error[3:])
        there = Pose2(*(np.array(NEW_POSE) + moved))
        found, covariance = joint_of(joined(old, Estimate(there, covariance3(new_cov))))
        new_from_old = NEW_POSE @ OLD_POSE.inverse()
        true = [new_from_old.transform(*p) for p in PLACES.reshape(-1, 2)]
        off = found - np.array([*NEW_POSE, *np.ravel(true)])
        off[2] = wrap_angle(off[2])
        values.append(off @ np.linalg.solve(covariance, off))
    assert np.mean(values) < 9.0
    assert np.mean(values) > (1.5 if correlation else 3.0)  # and not far more than need be


def test_the_joint_covariance_is_that_of_both_sides_twice() -> None:
    """Against the Jacobian of the composition, by numbers."""
    random = np.random.default_rng(3)
    joint, new_cov = random_covariance(random, 9, 0.02), random_covariance(random, 3, 0.02)

    def compose(x: np.ndarray) -> np.ndarray:
        old, new = Pose2(*x[:3]), Pose2(*x[9:])
        new_from_old = new @ old.inverse()
        return np.array(
            [*new, *np.ravel([new_from_old.transform(*p) for p in x[3:9].reshape(-1, 2)])]
        )

    at = np.array([*OLD_POSE, *PLACES, *NEW_POSE])
    steps = 1e-6 * np.eye(12)
    jacobian = np.array([(compose(at + d) - compose(at - d)) / 2e-6 for d in steps]).T
    both = np.zeros((12, 12))
    both[:9, :9], both[9:, 9:] = joint, new_cov
    due = INFLATION * jacobian @ both @ jacobian.T
    state = joined(state_with(OLD_POSE, joint, PLACES), Estimate(NEW_POSE, covariance3(new_cov)))
    assert joint_of(state)[1] == pytest.approx(due, abs=1e-9)


def test_without_landmarks_nothing_becomes_less_certain() -> None:
    estimate = Estimate(NEW_POSE, covariance3(random_covariance(np.random.default_rng(1), 3, 0.1)))
    old = with_common_errors(State(SECOND, estimate), NO_CAMERA)
    assert joined(old, estimate).estimate == estimate


def test_a_lost_robot_takes_no_landmarks_with_it() -> None:
    old = state_with(OLD_POSE, random_covariance(np.random.default_rng(1), 9, 0.1), PLACES)
    lost = with_recovery(old, old.memory.recovery._replace(lost="kidnapped"))
    assert frame_change(old).landmarks == NAMES
    assert frame_change(lost).landmarks == ()


def test_what_is_found_in_both_frames_stays_as_it_is() -> None:
    random = np.random.default_rng(5)
    old = state_with(OLD_POSE, random_covariance(random, 9, 0.1), PLACES)
    new = state_with(NEW_POSE, random_covariance(random, 5, 0.1), np.array([9.0, 9.0]))
    found = after_frame_change(new, frame_change(old)).common_errors
    assert found is not None
    assert found.place_error("oak") == (9.0, 9.0)
    assert found.objects.keys() == set(NAMES)


def test_counts_go_on_and_dead_reckoning_too() -> None:
    old = ROBOT.add_odometry(ROBOT.start(0), Odometry(0, SECOND, 1.0, math.pi))
    old = ROBOT.predict(old, SECOND).counted("lost")
    old = old._replace(updates=old.updates._replace(accepted=7, gated=2))
    new = begun_in_frame(old, ORIGIN, FIELD)
    assert new.estimate.pose == (0.0, 0.0, 0.0)
    assert new.odometry_from_robot == old.odometry_from_robot
    assert new.counts == {}
    assert after_frame_change(new, frame_change(old)).counts == old.counts
    assert begun_in_frame(old, None, FIELD).lost
