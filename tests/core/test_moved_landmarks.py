"""Landmarks that a robot has found itself and that move: named, with numbers, and found anew."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from support.core import (
    LOOP_START,
    SECOND,
    diagonal,
    driven,
    frame,
    localizer,
    loop,
    position_error,
)

from cpcbl_team.camera_errors import NO_ERRORS
from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.config import Field, Landmark, SensorSettings, Start, Unsurveyed
from cpcbl_team.estimate import Estimate
from cpcbl_team.gaussian import Covariance2, Gaussian2
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry, Sightings
from cpcbl_team.localizer import Localizer
from cpcbl_team.misplacements import misplacements
from cpcbl_team.moved_landmarks import (
    MOST_MOVES,
    SAID_NS,
    InnovationSum,
    LandmarkInnovations,
    MovedLandmark,
    biased_landmark,
    with_found_anew,
    with_move,
)
from cpcbl_team.state import State

PLACES = {"ne": (4.0, 3.0), "nw": (-1.0, 3.0), "sw": (-1.0, -2.0), "se": (4.0, -2.0)}
TRUE = Field(landmarks={n: Landmark(x_m=x, y_m=y) for n, (x, y) in PLACES.items()})
NO_CAMERA = CommonErrors.of_camera(0.0, NO_ERRORS)


def mapping_robot() -> Localizer:
    field = Field(unsurveyed={name: Unsurveyed() for name in PLACES})
    start = Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.0, heading_sigma_deg=0.0)
    sensor = SensorSettings(range_share=0.02, bearing_sigma_deg=1.0, max_range_m=20.0)
    return localizer("joint", field, start=start, sensor=sensor)


def driven_among(
    robot: Localizer,
    state: State,
    pose: Pose2,
    field: Callable[[int], Field],
    watch: Callable[[State], object] = lambda state: None,
) -> tuple[State, Pose2, float]:
    """The state after two rounds, the true pose, and the largest error of the position (m)."""
    worst = 0.0
    for piece, there in driven(pose, loop(), start_ns=state.stamp_ns):
        state, pose = robot.add_odometry(state, piece), there
        state = robot.cycle(state, frame(pose, piece.stamp_ns, field(piece.stamp_ns)))
        worst = max(worst, position_error(state.estimate, pose))
        watch(state)
    return state, pose, worst


def pushed(x_m: float, y_m: float) -> Field:
    """The field on which the landmark in the north-east was pushed so far."""
    x, y = PLACES["ne"]
    return Field(landmarks={**TRUE.landmarks, "ne": Landmark(x_m=x + x_m, y_m=y + y_m)})


def place_error(state: State, name: str, x_m: float, y_m: float) -> float:
    common = state.common_errors
    assert common is not None
    return math.dist(common.place_error(name), (x_m, y_m))


def test_a_landmark_that_was_pushed_is_named_and_found_anew() -> None:
    robot = mapping_robot()
    state, pose, _ = driven_among(robot, robot.start(0), LOOP_START, lambda _: TRUE)
    assert "ne" in state.common_errors.objects  # type: ignore[union-attr]
    said: list[dict[str, int]] = []

    def watch(state: State) -> None:
        said.append(misplacements(state.memory, state.stamp_ns))

    state, pose, worst = driven_among(robot, state, pose, lambda _: pushed(0.6, 0.8), watch)
    assert worst < 0.1
    assert not state.lost
    assert place_error(state, "ne", 4.6, 3.8) < 0.2
    assert said[-1]["misplaced_ne"] == pytest.approx(1000, abs=200)
    assert said[-1]["moves_ne"] == 1
    assert {name for counts in said for name in counts} <= {
        *("misplaced_ne", "rejected_ne", "moves_ne")
    }


def test_one_that_moves_again_and_again_is_not_looked_for_any_more() -> None:
    """So are two with one name that are seen in turn."""
    robot = mapping_robot()
    state, pose, _ = driven_among(robot, robot.start(0), LOOP_START, lambda _: TRUE)

    def field(stamp_ns: int) -> Field:
        return pushed(1.0, 1.0) if stamp_ns // (6 * SECOND) % 2 else TRUE

    for _ in range(2):
        state, pose, worst = driven_among(robot, state, pose, field)
        assert worst < 0.1
    counts = misplacements(state.memory, state.stamp_ns)
    assert counts["moves_ne"] == MOST_MOVES
    assert "ne" not in state.common_errors.objects  # type: ignore[union-attr]
    assert set(state.common_errors.objects) == {"nw", "sw", "se"}  # type: ignore[union-attr]


def test_of_a_robot_that_is_wrong_itself_no_landmark_moves() -> None:
    """It sees one landmark alone, and was carried: what it rejects shows that it is lost."""
    robot = mapping_robot()
    state, pose, _ = driven_among(robot, robot.start(0), LOOP_START, lambda _: TRUE)
    elsewhere = Pose2(pose.x + 1.5, pose.y, pose.heading + 1.0)
    for k in range(1, 30):
        seen = frame(elsewhere, state.stamp_ns + SECOND // 5, TRUE)
        alone = tuple(s for s in seen.sightings if s.id == "ne")
        state = robot.add_odometry(state, Odometry(state.stamp_ns, seen.stamp_ns, 0.0, 0.0))
        state = robot.cycle(state, Sightings(seen.stamp_ns, alone))
        assert not state.memory.calibration.moved, k
    assert state.lost


# Sums of innovations ------------------------------------------------------------------------------


def sums_of(bias: float, number: int = 30, stamp_ns: int = 0) -> LandmarkInnovations:
    rng, total = np.random.default_rng(1), InnovationSum()
    for _ in range(number):
        total = total.plus(bias + 0.3 * float(rng.normal()))
    return LandmarkInnovations(stamp_ns, ranges=total)


def test_only_a_landmark_whose_innovations_alone_have_one_sign_is_biased() -> None:
    white = {"nw": sums_of(0.0), "sw": sums_of(0.1)}
    assert biased_landmark({**white, "ne": sums_of(2.0)}, SECOND) == "ne"
    assert biased_landmark({**white, "ne": sums_of(0.5)}, SECOND) == ""
    assert biased_landmark({**white, "ne": sums_of(2.0), "se": sums_of(-1.8)}, SECOND) == ""
    assert biased_landmark({"nw": sums_of(0.0), "ne": sums_of(2.0)}, SECOND) == ""  # of two
    assert biased_landmark({**white, "ne": sums_of(2.0, number=2)}, SECOND) == ""  # too few
    later = 10 * SECOND  # the others were not seen meanwhile: the robot may have moved
    assert biased_landmark({**white, "ne": sums_of(2.0, stamp_ns=later)}, later) == ""


def placed(x_m: float, y_m: float) -> CommonErrors:
    own = Estimate(Pose2(0.0, 0.0, 0.0), diagonal(0.1, 0.1), diagonal(0.0, 0.0))
    return NO_CAMERA.with_place("ne", own, Gaussian2(x_m, y_m, Covariance2(0.01, 0.0, 0.01)))


def test_what_is_found_anew_where_it_stood_has_not_moved() -> None:
    found = Gaussian2(2.0, 0.0, Covariance2(0.01, 0.0, 0.01))
    moves = with_move({}, "ne", placed(2.0, 0.0), SECOND)
    assert moves["ne"] == MovedLandmark(2.0, 0.0, 1, SECOND)
    assert with_found_anew(moves, "ne", placed(2.3, 0.0), found, SECOND) == {}
    moved = with_found_anew(moves, "ne", placed(3.0, 0.0), found, 2 * SECOND)["ne"]
    assert moved[:4] == (2.0, 0.0, 1, 2 * SECOND)
    assert moved.apart_m == pytest.approx(1.0)
    assert moved.is_current(2 * SECOND)
    assert not moved.is_current(3 * SECOND + SAID_NS)
    assert moved._replace(times=MOST_MOVES).is_current(3 * SECOND + SAID_NS)


def test_without_an_object_all_others_are_as_before() -> None:
    own = Estimate(Pose2(1.0, 2.0, 0.3), diagonal(0.1, 0.1), diagonal(0.0, 0.0))
    common = NO_CAMERA
    for k, name in enumerate("abc"):
        common = common.with_place(name, own, Gaussian2(1.0 + k, k, Covariance2(0.01, 0.0, 0.02)))
    left = common.without_object("b")
    assert set(left.objects) == {"a", "c"}
    for name in "ac":
        assert left.place_error(name) == common.place_error(name)
        assert left.place_covariance(name) == common.place_covariance(name)
        i, j = left.objects[name], common.objects[name]
        assert left.parameters.with_pose[i] == common.parameters.with_pose[j]
        assert i in left.found
    i, j = left.objects["a"], left.objects["c"]
    a, c = common.objects["a"], common.objects["c"]
    assert left.parameters.covariance[i][j] == common.parameters.covariance[a][c]
