"""Whatever a bus lets through leaves a covariance: nothing is sharper than arithmetic."""

import math
import random
from collections.abc import Iterator
from itertools import chain

import pytest
from msgspec.structs import replace
from support.core import (
    PROBABILISTIC,
    SECOND,
    VARIANTS,
    belief,
    diagonal,
    least_eigenvalue,
    localizer,
    matrix3,
    placed_at,
    state_at,
)
from support.sweeps import sampled

from cpcbl_team.config import (
    Field,
    Landmark,
    OdometrySettings,
    SensorSettings,
    Start,
    Unsurveyed,
    Variant,
)
from cpcbl_team.estimate import POSITION, Covariance3, Estimate, Information, merge
from cpcbl_team.fixes import fix_for
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import (
    BeliefShared,
    Fix,
    InitialPose,
    Input,
    Odometry,
    Position,
    Sighting,
    Sightings,
)
from cpcbl_team.state import State
from cpcbl_team.timeline import Timeline

ORIGIN = Pose2(0.0, 0.0, 0.0)
STILL = OdometrySettings(moves=False)
FAR = Field(landmarks={"near": Landmark(x_m=4.0, y_m=2.0), "far": Landmark(x_m=250.0, y_m=-90.0)})
UNSURE = Field(
    landmarks={"near": Landmark(x_m=4.0, y_m=2.0, sigma_m=0.3)}, unsurveyed={"far": Unsurveyed()}
)
probabilistic = pytest.mark.parametrize("variant", PROBABILISTIC)


def assert_sound(state: State) -> None:
    estimate = state.estimate
    assert all(map(math.isfinite, (*estimate.pose, *estimate.covariance)))
    assert min(estimate.covariance.xx, estimate.covariance.yy, estimate.covariance.hh) >= 0.0
    assert estimate.position_sigma_m >= 0.0
    if (common := state.common_errors) is not None:
        covariance, with_pose = common.parameters
        assert all(map(math.isfinite, (*common.values, *chain(*covariance, *with_pose))))
        assert min(row[i] for i, row in enumerate(covariance)) >= 0.0


def anything(rng: random.Random, count: int) -> Iterator[Input]:
    """Inputs with sigmas from a picometre to a megametre, each of which the bus lets through."""
    now = 0

    def size(low: float = -12.0, high: float = 6.0) -> float:
        return float(10.0 ** rng.uniform(low, high))

    def maybe(number: float) -> float | None:
        return rng.choice([None, number])

    def place() -> tuple[float, float]:
        return rng.uniform(-5.0, 5.0), rng.uniform(-5.0, 5.0)

    for _ in range(count):
        now += rng.choice([1, SECOND // 10, SECOND, 30 * SECOND])
        a, b = size(), size()
        kind = rng.randrange(7)
        if kind == 0:
            yield Odometry(now - 1, now, rng.choice([0.0, size()]), rng.uniform(-9.0, 9.0))
        elif kind == 1:
            names = rng.sample(["near", "far", "mate"], rng.randint(1, 3))
            bearing = rng.uniform(-3.0, 3.0)
            sights = (
                Sighting(n, maybe(size(-1, 3)), maybe(bearing), maybe(size()), maybe(size()))
                for n in names
            )
            yield Sightings(now, tuple(sights))
        elif kind == 2:
            tilt = rng.choice([0.0, 1.0, -1.0, 0.9999999, 1.0000003]) * math.sqrt(a * b)
            yield Position(now, *place(), (a, tilt, b))
        elif kind == 3:
            heading = rng.choice([(), (rng.uniform(-3.0, 3.0), size(), size())])
            yield Fix("me", "mate", now, *place(), (a, 0.0, a), (b, 0.0, b), *heading)
        elif kind == 4:
            told = belief(*place(), now)
            yield replace(told, covariance=(a, 0.0, a, 0.0, 0.0, b), speed_m_s=rng.uniform(-9, 9))
        elif kind == 5:
            yield InitialPose(now, *place(), rng.uniform(-9.0, 9.0), (a, 0.0, a, 0.0, 0.0, b))
        else:
            yield BeliefShared(now)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("field", [FAR, UNSURE], ids=["exact", "uncertain"])
@pytest.mark.parametrize("seed", sampled(range(20), range(4)))
def test_any_history_leaves_a_covariance(variant: Variant, field: Field, seed: int) -> None:
    rng = random.Random(seed)
    robot = localizer(variant, field, start=Start(known=seed % 2 == 0, x_m=0.0, y_m=0.0))
    timeline = Timeline(robot, robot.start(0))
    for item in anything(rng, 60):
        timeline.add(item)
        assert_sound(timeline.state)


# Each sharpness that once broke one --------------------------------------------------------------


@probabilistic
@pytest.mark.parametrize("told", [False, True])
@pytest.mark.parametrize("variance", [0.0, 1e-12, 1e-10, 1e-8, 1e-6])
def test_what_is_shared_is_a_part_of_the_covariance(
    variant: Variant, told: bool, variance: float
) -> None:
    robot, state = localizer(variant, odometry=STILL), state_at(ORIGIN, diagonal(0.05, 0.066))
    state = robot.mark_shared(state, BeliefShared(1)) if told else state
    sharp = variance, 0.0, variance
    for stamp_ns in range(2, 7):
        fix = Fix("me", "mate", stamp_ns, 0.01, -0.01, sharp, sharp, 0.0, 1e-4, 1e-4)
        state = robot.add_fix(state, fix)
        whole, shared = (matrix3(c) for c in (state.estimate.covariance, state.estimate.shared))
        assert_sound(state)
        for part in (shared, whole - shared):
            assert least_eigenvalue(part) > -1e-6 * whole.max()


@pytest.mark.parametrize("beyond", [0.0, 4e-7, 1e-6])
@pytest.mark.parametrize("variance", [100.0, 1e4, 9e5])
def test_a_position_whose_rounded_correlation_is_one_does_not_pass_the_gate(
    variance: float, beyond: float
) -> None:
    robot, before = localizer(odometry=STILL), state_at(ORIGIN, diagonal(0.05, 0.05))
    seen = Position(1, 50.0, -50.0, (variance, variance * (1.0 + beyond), variance))
    after = robot.add_position(before, seen)
    assert after.counts == {"gated": 1}
    assert after.estimate == before.estimate


def test_sharp_bearings_among_loose_positions_find_no_pose() -> None:
    """Nor a pose that is not there."""
    rng = random.Random(1)
    exact = SensorSettings(bearing_sigma_deg=0.0)
    for _ in range(60):
        robot = localizer(start=Start(known=False, x_m=0, y_m=0), odometry=STILL, sensor=exact)
        x, y = rng.uniform(-4.0, 4.0), rng.uniform(-2.0, 2.0)
        state = robot.start(0)
        for stamp_ns in (1, SECOND + 1):
            state = robot.add_position(state, placed_at(x, y, stamp_ns, 10.0))
            bearing = Sighting("ne", None, rng.uniform(-3.0, 3.0))
            state = robot.cycle(state, Sightings(stamp_ns + 1, (bearing,)))
            assert_sound(state)
            assert state.lost


def test_evidence_that_drowns_in_rounding_changes_nothing() -> None:
    """A bearing of 0.1 mrad to a landmark 230 m away, by a robot that hardly knows its heading."""
    prior = Estimate(Pose2(-2.4, 1.5, 1.4), Covariance3(3.2, 0.0, 3.2, 0.0, 0.0, 2.7))
    matrix = Covariance3(
        48780048.67, -49985114.97, 51219951.33, -11431268315.23, 11713667299.41, 2678838968961.58
    )
    evidence = Information(matrix, (11187511574.7, -11463888772.5, -2621716256283.3))
    assert merge(prior, evidence, POSITION) == prior


@pytest.mark.parametrize("sigma_rad", [0.5 * math.pi, 3.0, math.pi, 6.3])
def test_a_bearing_that_is_not_known_says_nothing_across_the_line_of_sight(
    sigma_rad: float,
) -> None:
    certain = Estimate(ORIGIN, diagonal(0.0, 0.0))
    fix = fix_for("b", 1, certain, Sighting("a", 3.0, 0.0, 0.1, sigma_rad), SensorSettings())
    assert fix is not None
    assert fix.sensor_covariance[2] == pytest.approx(9.0)
