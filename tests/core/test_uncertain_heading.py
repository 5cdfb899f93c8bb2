"""A robot that drives with an uncertain heading before it sees anything."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.core import (
    SECOND,
    covariance3,
    diagonal,
    displaced,
    frame,
    localizer,
    point_sighting,
    random_matrix,
    sensor_noise,
    state_at,
)
from support.sweeps import over_seeds, sampled, thorough

from cpcbl_launch.reporting.metrics import Samples, Score, score
from cpcbl_team.arc_fit import ArcFit
from cpcbl_team.arcs import Arc, square_root
from cpcbl_team.config import Field, Gives, Landmark, OdometrySettings, SensorSettings, Start
from cpcbl_team.constraints import TELLS_NOTHING
from cpcbl_team.estimate import Estimate, dot
from cpcbl_team.gate import AMBIGUOUS
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import Odometry, Sighting, Sightings
from cpcbl_team.measurements import measurement_of
from cpcbl_team.motion import motion_noise
from cpcbl_team.relinearization import Linearization
from cpcbl_team.state import State

ODOMETRY, SENSOR = OdometrySettings(), SensorSettings()
BAD_ODOMETRY = OdometrySettings(
    distance_sigma_m_per_sqrt_m=0.15,
    turn_sigma_rad_per_sqrt_rad=0.25,
    turn_sigma_rad_per_sqrt_m=0.15,
)
PIECE_NS = SECOND // 10
BLIND, SEEN = 200, 150  # pieces
AHEAD = 0.05  # m a piece
Drive = list[tuple[State, Pose2]]  # states with the true poses
seeds_of_priors = st.integers(0, 10_000)
ONE = {"post": Landmark(x_m=12.0, y_m=2.0)}
FOUR = {
    "a": Landmark(x_m=8.0, y_m=3.0),
    "b": Landmark(x_m=13.0, y_m=-3.0),
    "c": Landmark(x_m=14.0, y_m=4.0),
    "d": Landmark(x_m=7.0, y_m=-4.0),
}


def giving(gives: Gives, names: Sequence[str] = "abcd") -> dict[str, Landmark]:
    return {n: Landmark(x_m=FOUR[n].x_m, y_m=FOUR[n].y_m, gives=gives) for n in names}


def run(landmarks: dict[str, Landmark], sigma_deg: float, seed: int) -> Drive:
    """Ten metres ahead that nothing is seen in, then a circle among the landmarks."""
    rng = np.random.default_rng(seed)
    start = Start(x_m=0.0, y_m=0.0, sigma_m=0.05, heading_sigma_deg=sigma_deg)
    robot = localizer(field=Field(landmarks=landmarks), start=start, odometry=ODOMETRY)
    noise, state, now = sensor_noise(rng, SENSOR), robot.start(0), 0
    truth = displaced(state.estimate.pose, state.estimate.covariance, rng)
    found = []
    for k in range(BLIND + SEEN):
        turn = AHEAD / 2.0 if k >= BLIND else 0.0
        drift = motion_noise(truth.heading, AHEAD, turn, ODOMETRY)
        truth = displaced(step(truth, AHEAD, turn), drift, rng)
        state = robot.add_odometry(state, Odometry(now, now + PIECE_NS, AHEAD, turn))
        now += PIECE_NS
        names = list(landmarks) if k >= BLIND else []
        seen = [noise(point_sighting(truth, n, landmarks[n].x_m, landmarks[n].y_m)) for n in names]
        state = robot.cycle(state, Sightings(now, tuple(seen)))
        found.append((state, truth))
    return found


def circling(post: tuple[float, float], share: float, bearing_deg: float, seed: int) -> Drive:
    """A robot with bad odometry drives circles of 2 m about (4, 3) for a minute. It sees one post,
    with this noise."""
    rng, now = np.random.default_rng(seed), 0
    field = Field(landmarks={"post": Landmark(x_m=post[0], y_m=post[1])})
    sensor = SensorSettings(range_share=share, bearing_sigma_deg=bearing_deg)
    start = Start(x_m=6.0, y_m=3.0, heading_deg=90.0, sigma_m=0.05, heading_sigma_deg=2.0)
    robot = localizer(field=field, start=start, sensor=sensor, odometry=BAD_ODOMETRY)
    noise, state = sensor_noise(rng, sensor), robot.start(0)
    truth = displaced(state.estimate.pose, state.estimate.covariance, rng)
    found = []
    for k in range(600):
        drift = motion_noise(truth.heading, 0.04, 0.02, BAD_ODOMETRY)
        truth = displaced(step(truth, 0.04, 0.02), drift, rng)
        state = robot.add_odometry(state, Odometry(now, now + PIECE_NS, 0.04, 0.02))
        now += PIECE_NS
        if k % 2:
            seen = noise(point_sighting(truth, "post", *post))
            state = robot.cycle(state, Sightings(now, (seen,)))
            found.append((state, truth))
    return found


def turned_after_a_way(gives: Gives, seed: int) -> Drive:
    """A robot with bad odometry drives 3.5 m and turns by -100 degrees before it sees a post for a
    second, or two that give bearings alone."""
    rng, now = np.random.default_rng(seed), 0
    odometry = OdometrySettings(turn_sigma_rad_per_sqrt_rad=0.15, turn_sigma_rad_per_sqrt_m=0.15)
    sensor = SensorSettings(bearing_sigma_deg=1.0, field_of_view_deg=360.0)
    posts = {"post": Landmark(x_m=-4.0, y_m=-1.0, gives=gives)}
    if gives == "bearing":
        posts["other"] = Landmark(x_m=4.0, y_m=-7.0, gives=gives)
    start = Start(x_m=0.0, y_m=0.0, sigma_m=0.02, heading_sigma_deg=2.0)
    robot = localizer(field=Field(landmarks=posts), start=start, sensor=sensor, odometry=odometry)
    noise, state = sensor_noise(rng, sensor), robot.start(0)
    truth, found = displaced(state.estimate.pose, state.estimate.covariance, rng), []
    for distance, turn in [(0.1, 0.0)] * 35 + [(0.0, -0.175)] * 10 + [(0.02, 0.0)] * 10:
        drift = motion_noise(truth.heading, distance, turn, odometry)
        truth = displaced(step(truth, distance, turn), drift, rng)
        state = robot.add_odometry(state, Odometry(now, now + PIECE_NS, distance, turn))
        now += PIECE_NS
        if distance == 0.02:
            seen = tuple(noise(point_sighting(truth, n, p.x_m, p.y_m)) for n, p in posts.items())
            state = robot.cycle(state, Sightings(now, seen))
            found.append((state, truth))
    return found


def scored(runs: list[Drive], first: int, last: int) -> Score:
    rows = [row for run in runs for row in run[first:last]]
    estimates = np.array([state.reported.pose for state, _ in rows])
    covariances = np.array([state.reported.covariance for state, _ in rows])
    return score(Samples(estimates, np.array([truth for _, truth in rows]), covariances))


@over_seeds(30, 200)
@pytest.mark.parametrize(("gives", "most"), [("both", 2.7), ("bearing", 2.2)])
def test_a_turn_after_the_way_does_not_straighten_the_way(
    gives: Gives, most: float, seeds: range
) -> None:
    """Its noise makes the heading say less of the way. An arc by the heading alone had a NEES of
    3.2 and 2.4 in 200 runs, with 94 and 97 % inside 3 sigma."""
    found = scored([turned_after_a_way(gives, seed) for seed in seeds], 0, 10)
    assert found.nees is not None
    assert found.inside_3_sigma is not None
    assert found.nees < most
    assert found.inside_3_sigma > 0.96


@over_seeds(12, 60)
@pytest.mark.parametrize("sigma_deg", sampled([10.0, 20.0, 45.0], [45.0]))
@pytest.mark.parametrize(
    "landmarks",
    [
        ONE,
        thorough(FOUR),
        thorough(giving("range")),
        giving("bearing"),
        thorough(giving("bearing", "ac")),
    ],
    ids=["one", "four", "four ranges", "four bearings", "two bearings"],
)
def test_it_is_as_certain_as_it_may_be_before_and_after(
    landmarks: dict[str, Landmark], sigma_deg: float, seeds: range
) -> None:
    """Linear about the tangent, a robot with 20 degrees that then saw one landmark had a NEES of 21
    and was lost for a fifth of the time; with 45 degrees it was never found rightly."""
    runs = [run(landmarks, sigma_deg, seed) for seed in seeds]
    blind, first, rest = (
        scored(runs, *part) for part in ((BLIND - 5, BLIND), (BLIND, BLIND + 20), (BLIND + 20, -1))
    )
    for part, most in ((blind, 4.5), (first, 4.5), (rest, 3.5)):
        assert part.nees is not None
        assert part.inside_3_sigma is not None
        assert part.nees < most
        assert part.inside_3_sigma > 0.9
    seen = [state for run in runs for state, _ in run[BLIND + 20 :]]
    assert np.mean([bool(state.lost) for state in seen]) < 0.02


@over_seeds(6, 60)
@pytest.mark.parametrize(
    ("post", "share", "bearing_deg"),
    [
        thorough((1.0, 1.0), 0.05, 5.0),
        thorough((1.0, 1.0), 0.01, 1.0),
        ((4.0, 3.0), 0.05, 5.0),
    ],
    ids=["beside the circle", "precise", "in its centre"],
)
def test_many_frames_make_no_certainty_of_a_turn_about_the_only_landmark(
    post: tuple[float, float], share: float, bearing_deg: float, seeds: range
) -> None:
    """Each frame was linearized where it fitted best, and so followed its own noise: beside the
    circle a NEES of 7 and 8, 83 and 85 % inside 3 sigma (seeds 0 to 39). Now it is 2.2 and 2.4, 96
    and 95 %."""
    found = scored([circling(post, share, bearing_deg, seed) for seed in seeds], 25, 300)
    assert found.nees is not None
    assert found.inside_3_sigma is not None
    assert found.nees < 3.0
    assert found.inside_3_sigma > 0.93


@given(seeds_of_priors, st.floats(-1.0, 1.0), st.floats(-0.3, 0.3))
def test_one_landmark_tells_nothing_of_a_turn_about_it(
    seed: int, nearer_m: float, beside: float
) -> None:
    """The information about that turn is that of the prior, wherever the estimate moves to."""
    robot, prior = localizer(field=Field(landmarks=ONE)), np.diag((0.0, 0.0, 0.04))
    prior[:2, :2] = 0.01 * random_matrix(np.random.default_rng(seed), 2)
    before = state_at(Pose2(9.0, 0.0, 0.3), covariance3(prior))
    distance_m, ahead = math.hypot(3.0, 2.0), math.atan2(2.0, 3.0) - 0.3
    seen = Sighting("post", distance_m - nearer_m, ahead + beside)
    after = robot.cycle(before, Sightings(0, (seen,)))
    assume(after.counts.get("accepted"))
    told = [about_post(state.estimate) for state in (before, after)]
    assert told[1] == pytest.approx(told[0], rel=1e-6)


def about_post(estimate: Estimate) -> float:
    """The information about a turn about the post."""
    (x, y, _), covariance, _ = estimate
    turn = -(y - ONE["post"].y_m), x - ONE["post"].x_m, 1.0
    return dot(turn, covariance.inverse().times(turn))


def test_both_mirror_images_are_kept() -> None:
    """A range to a post straight ahead agrees with two poses: the estimate contains both."""
    field = Field(landmarks={"post": Landmark(x_m=16.0, y_m=0.0, gives="range")})
    robot = localizer(field=field)
    begin = state_at(Pose2(0.0, 0.0, 0.0), diagonal(0.05, math.radians(30.0)))
    blind = robot.predict(robot.add_odometry(begin, Odometry(0, SECOND, 10.0, 0.0)), SECOND)
    truth = Pose2(10.0 * math.cos(0.5), 10.0 * math.sin(0.5), 0.5)
    seen = robot.cycle(blind, frame(truth, SECOND, field))
    assert seen.counts["accepted"] == 1
    mixture = seen.memory.mixture
    assert mixture is not None
    for side in (1.0, -1.0):
        near = [
            c
            for c in mixture.components
            if math.hypot(c.pose.x - truth.x, c.pose.y - side * truth.y) < 0.6
        ]
        assert sum(c.weight for c in near) == pytest.approx(0.5, abs=0.1)
    (x, y, _), (_, _, yy, *_), _ = seen.estimate
    assert (x, y) == pytest.approx((truth.x, 0.0), abs=0.1)
    assert math.sqrt(yy) == pytest.approx(truth.y, rel=0.1)


def test_two_poses_that_agree_with_uncertain_places_are_not_taken() -> None:
    """The same where the place of the post is uncertain: then nothing of it is used."""
    post = Landmark(x_m=16.0, y_m=0.0, gives="range", sigma_m=0.05)
    field = Field(landmarks={"post": post})
    start = Start(x_m=0.0, y_m=0.0, sigma_m=0.05, heading_sigma_deg=30.0)
    robot = localizer(field=field, start=start)
    ahead = Odometry(0, SECOND, 10.0, 0.0)
    blind = robot.predict(robot.add_odometry(robot.start(0), ahead), SECOND)
    truth = Pose2(10.0 * math.cos(0.5), 10.0 * math.sin(0.5), 0.5)
    seen = robot.cycle(blind, frame(truth, SECOND, field))
    assert seen.counts[AMBIGUOUS] == 1
    assert "accepted" not in seen.counts
    assert seen.estimate.pose == blind.estimate.pose


def test_a_driver_that_is_wrong_is_rejected_and_moves_nothing() -> None:
    field = Field(landmarks=ONE)
    robot = localizer(field=field)
    state = state_at(Pose2(10.0, 0.0, 0.0), diagonal(0.05, math.radians(10.0)))
    behind = frame(Pose2(10.0, 0.0, math.pi), 0, field)
    after = robot.cycle(state, behind)
    assert after.counts == {"gated": 1}
    assert after.estimate == state.estimate


@pytest.mark.parametrize("place", [(1.0, 1.0), (2.0, 1.0), (1.0 + 1e-9, 1.0)])
@pytest.mark.parametrize("reading", [(0.05, 0.0), (2.0, 1.0), (None, 0.3), (0.05, None)])
def test_an_object_that_the_robot_touches_is_no_error(
    place: tuple[float, float], reading: tuple[float | None, float | None]
) -> None:
    """Its direction means nothing where the estimate, or another pose of the arc, is."""
    field = Field(landmarks={"post": Landmark(x_m=place[0], y_m=place[1])})
    robot = localizer(field=field)
    stands = state_at(Pose2(1.0, 1.0, 0.0), diagonal(0.05, math.radians(20.0)))
    drove = robot.predict(robot.add_odometry(stands, Odometry(0, SECOND, 1.0, 0.0)), SECOND)
    for state in (stands, drove):
        seen = Sightings(state.stamp_ns, (Sighting("post", *reading),))
        after = robot.cycle(state, seen)
        assert all(map(math.isfinite, (*after.estimate.pose, *after.estimate.covariance)))


def test_a_constraint_whose_bend_cannot_be_told_tells_nothing() -> None:
    """One sigma to the side the robot would touch the post, where there is no bearing."""
    estimate = Estimate(Pose2(0.0, 0.0, 0.0), diagonal(0.5, math.radians(20.0)))
    arc = Arc.of(estimate)
    beside, _, _ = square_root(arc.covariance)
    robot = localizer(field=Field(landmarks={"post": Landmark(x_m=beside[0], y_m=0.0)}))
    seen = Sighting("post", 0.5, 0.0)
    m = measurement_of(seen, 0, estimate.pose, robot.field, {}, robot.settings)
    assert m is not None
    about = Linearization(arc, ArcFit((0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), arc.covariance, 2))
    found = about.constraints_of(estimate, m, robot.settings.localizer)
    assert [c.sigma for c in found] == [math.sqrt(TELLS_NOTHING)] * 2
