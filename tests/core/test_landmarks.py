"""The fast path for plain landmarks gives what the general path gives."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.core import (
    CORNERS,
    LOOP_START,
    PROBABILISTIC,
    SECOND,
    covariance3,
    diagonal,
    localizer,
    point_sighting,
    random_matrix,
    state_at,
)

from cpcbl_team.config import Field, Gives, Landmark, LocalizerSettings, SensorSettings, Variant
from cpcbl_team.estimate import (
    POSE,
    POSITION,
    Estimate,
    Information,
    Scope,
    merge,
    with_circular_position,
)
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import MarkerSighting, Sighting, Sightings
from cpcbl_team.localizer import Localizer
from cpcbl_team.measurements import (
    Measurement,
    constrains,
    constraints_of,
    curved,
    gated_object,
    measurement_of,
)
from cpcbl_team.relinearization import BENT_VARIANCE
from cpcbl_team.sensors import sighting_fault
from cpcbl_team.state import State, Updates

NOW = 5 * SECOND
NAMES = "abcde"
gives = st.sampled_from(("both", "both", "both", "range", "bearing", "none"))
errors = st.one_of(st.floats(-0.2, 0.2), st.sampled_from((0.0, 1.0, -1.0, 2.5)))
marks = st.builds(Landmark, x_m=st.floats(-5.0, 5.0), y_m=st.floats(-5.0, 5.0), gives=gives)
fields = st.lists(marks, min_size=1, max_size=len(NAMES)).map(
    lambda found: Field(landmarks=dict(zip(NAMES, found, strict=False)))
)
kinds = st.sampled_from(
    3 * ("both",) + ("range", "bearing", "none", "nan", "own", "headed", "faulty")
)
readings = st.lists(
    st.tuples(kinds, errors, errors),
    min_size=len(NAMES),
    max_size=len(NAMES),
)
sensors = st.builds(
    SensorSettings,
    range_share=st.sampled_from((0.03, 0.2)),
    range_floor_m=st.sampled_from((0.01, 0.0)),
    bearing_sigma_deg=st.sampled_from((2.0, 20.0)),
    max_range_for_range_m=st.sampled_from((1000.0, 3.0)),
    correlation_s=st.sampled_from((0.0, 0.0, 0.0, 0.0, 1.0)),
)
rules = st.builds(
    LocalizerSettings,
    variant=st.sampled_from(PROBABILISTIC),
    alternate=st.sampled_from((None, True, False)),
    minimum_interval_s=st.sampled_from((0.0, 0.25)),
    object_interval_s=st.sampled_from((0.0, 0.25)),
    bearing_for_position=st.sampled_from((True, True, False)),
    paper_uncertainty=st.sampled_from((False, False, False, False, True)),
    gate_probability=st.sampled_from((0.999, 0.6)),
)


def read_as(exact: Sighting, kind: str, range_error: float, bearing_error: float) -> Sighting:
    """A reading with these errors, one that lacks something, or one with a fault."""
    assert exact.range_m is not None
    assert exact.bearing_rad is not None
    range_m, bearing = exact.range_m + range_error, wrap_angle(exact.bearing_rad + bearing_error)
    return {
        "both": Sighting(exact.id, range_m, bearing),
        "range": Sighting(exact.id, range_m),
        "bearing": Sighting(exact.id, None, bearing),
        "none": Sighting(exact.id),
        "nan": Sighting(exact.id, math.nan, bearing),
        "own": Sighting(exact.id, range_m, bearing, 0.3, 0.1),
        "headed": Sighting(exact.id, range_m, bearing, None, None, 0.5, 0.1),
        "faulty": Sighting(exact.id, range_m, bearing, None, None, 0.5),
    }[kind]


def since(last_ns: int | None, seconds: float) -> bool:
    return last_ns is None or NOW - last_ns >= seconds * 1e9


def scope_of(robot: Localizer, updates: Updates, visible: Sequence[Measurement]) -> Scope | None:
    """The type that waits longer, of those that have anything; None: neither."""
    r = robot.settings.localizer
    last_ns = {Scope.POSITION: updates.position_ns, Scope.HEADING: updates.heading_ns}
    ready = [
        scope
        for scope in (Scope.POSITION, Scope.HEADING)
        if since(last_ns[scope], r.minimum_interval_s)
        and any(constrains(m, scope, r) for m in visible)
    ]
    if not r.alternates:
        return POSE if ready else None
    if len(ready) == 2:
        return ready[0] if updates.heading_is_latest else ready[1]
    return ready[0] if ready else None


def composed(robot: Localizer, state: State, frame: Sightings) -> tuple[Estimate, dict[str, int]]:
    """One cycle among landmarks without motion, and its counts, formula by formula."""
    r, prior, updates = robot.settings.localizer, state.estimate, state.updates
    good = [s for s in frame.sightings if not sighting_fault(s)]
    found = (measurement_of(s, NOW, prior.pose, robot.field, {}, robot.settings) for s in good)
    visible = [
        m for m in found if m and since(updates.objects_ns.get(m.source), r.object_interval_s)
    ]
    tau_s = robot.settings.sensor.correlation_s
    if tau_s:
        rho = math.exp(-0.1 / tau_s)
        visible = [
            m.inflated((1 + rho) / (1 - rho)) if m.source in updates.objects_ns else m
            for m in visible
        ]
    counts = {"accepted": 0, "gated": 0}
    scope, evidence = scope_of(robot, updates, visible), Information.none()
    for m in visible if scope else ():
        assert scope is not None
        cs = constraints_of(prior.pose, m, scope, r)
        if not r.paper_uncertainty:
            cs = curved(prior, m, cs)
        bound = -2.0 * math.log(1.0 - r.gate_probability)
        if len(cs) == 1:
            bound = robot._gates[0]
        if cs and gated_object(prior, m, cs).nis > bound:
            counts["gated"] += 1
        elif cs:
            counts["accepted"] += 1
            for c in cs:
                evidence = evidence.add(c.row, c.residual, c.sigma**2)
    if scope is None:
        return prior, counts
    ranges_turn = r.variant == "oval" and robot.field.gives_only_ranges and not r.paper_uncertainty
    is_whole = r.variant == "joint" or (ranges_turn and scope is POSITION)
    after = merge(prior, evidence, POSE if is_whole else scope)
    if r.paper_uncertainty and r.variant != "joint":
        after = after._replace(covariance=after.covariance._replace(xh=0.0, yh=0.0))
    return with_circular_position(after) if r.variant == "circular" else after, counts


@given(fields, readings, sensors, rules, st.integers(0, 2**32 - 1))
def test_a_frame_gives_the_evidence_of_its_constraints_one_by_one(
    field: Field,
    kinds: list[tuple[str, float, float]],
    sensor: SensorSettings,
    rules: LocalizerSettings,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    robot = localizer(field=field, rules=rules, sensor=sensor)
    true = Pose2(*rng.uniform(-3.0, 3.0, size=3))
    covariance = covariance3(10.0 ** rng.uniform(-4.0, -1.0) * random_matrix(rng, 3))
    if covariance.hh > BENT_VARIANCE:  # see `relinearization.py`
        narrower = 0.9 * math.sqrt(BENT_VARIANCE / covariance.hh)
        covariance = covariance.transformed((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, narrower))
    if rules.variant == "circular":
        covariance = with_circular_position(Estimate(true, covariance)).covariance
    before = NOW - SECOND // 10
    updates = Updates(
        position_ns=before if rng.random() < 0.5 else None,
        heading_is_latest=bool(rng.random() < 0.5),
        objects_ns={name: before for name in NAMES if rng.random() < 0.5},
    )
    if not rules.alternates:
        updates = updates._replace(heading_ns=updates.position_ns)  # there one timer is both
    state = state_at(true, covariance, NOW)._replace(updates=updates)
    exact = [point_sighting(true, n, p.x_m, p.y_m) for n, p in field.landmarks.items()]
    visible = [read_as(s, *kind) for s, kind in zip(exact, kinds, strict=False)]
    frame = Sightings(NOW, tuple(visible))

    expected, counts = composed(robot, state, frame)
    after = robot.cycle(state, frame)
    assume(after.mixture is None)  # which no Gaussian contains: see `mixture_update.py`
    assert after.estimate.pose == pytest.approx(expected.pose, rel=1e-9, abs=1e-9)
    assert after.estimate.covariance == pytest.approx(expected.covariance, rel=1e-9, abs=1e-9)
    assert (after.updates.accepted, after.updates.gated) == (counts["accepted"], counts["gated"])
    assert sum(after.memory.events.get(e, 0) for e in ("not_finite", "empty_sighting")) == sum(
        kind in ("none", "nan") for kind, *_ in kinds[: len(exact)]
    )


@pytest.mark.parametrize("given", ["both", "range", "bearing"])
@pytest.mark.parametrize("variant", PROBABILISTIC)
def test_new_evidence_is_that_of_a_measurement(variant: Variant, given: Gives) -> None:
    field = Field(landmarks={"post": Landmark(x_m=1.0, y_m=2.0, gives=given)})
    robot = localizer(variant, field)
    visible = Sighting("post", 5.0, 0.3)  # farther than it can be
    state = state_at(LOOP_START, covariance3(0.1 * np.eye(3)), NOW)
    (piece,) = robot.recovery.evidence(
        robot.cycle(state, Sightings(NOW, (visible,))).memory.recovery
    )
    m = measurement_of(visible, NOW, LOOP_START, field, {}, robot.settings)
    assert m is not None
    assert (piece.source, piece.x, piece.y) == ("post", 1.0, 2.0)
    assert (piece.range_m, piece.bearing_rad) == (m.range_m, m.bearing)
    assert not piece.from_teammate
    if m.range_m is not None:
        assert piece.range_sigma_m == pytest.approx(m.range_sigma, rel=1e-12)
    assert piece.bearing_sigma_rad == pytest.approx(m.bearing_sigma, rel=1e-12)


def test_a_plain_landmark_is_not_measured_the_general_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """Or else the test above would compare the general way with itself."""
    monkeypatch.setattr("cpcbl_team.localizer.measurement_of", lambda *_: pytest.fail("general"))
    for variant in PROBABILISTIC:
        state = state_at(LOOP_START, diagonal(0.3, 0.08), NOW)
        robot = localizer(variant)
        exact = (point_sighting(LOOP_START, n, p.x_m, p.y_m) for n, p in CORNERS.landmarks.items())
        after = robot.cycle(state, Sightings(NOW, tuple(exact)))
        assert after.updates.accepted == 4


def test_a_ray_to_an_object_behind_says_nothing() -> None:
    """Its reading points the other way, however little the robot knows of its heading."""
    robot = localizer("oval", Field(landmarks={"post": Landmark(x_m=2.0, y_m=0.0)}))
    state = state_at(Pose2(0.0, 0.0, 0.0), diagonal(0.1, 1.5), NOW)
    updates = state.updates._replace(heading_is_latest=True)
    behind = Sightings(NOW, (Sighting("post", None, 2.0),))
    after = robot.cycle(state._replace(updates=updates), behind)
    assert after.estimate == state.estimate


def test_a_teammate_s_marker_is_seen_beside_landmarks() -> None:
    """Its sighting has more numbers than those of landmarks have."""
    name, place = next(iter(CORNERS.landmarks.items()))
    seen = point_sighting(LOOP_START, name, place.x_m, place.y_m)
    marker = MarkerSighting("mate", 1.0, 0.1, 0.1, 0.1, 0.2, 0.1, heading_per_focal=0.5)
    state = state_at(LOOP_START, diagonal(0.1, 0.1), NOW)
    after = localizer().cycle(state, Sightings(NOW, (marker, seen)))
    assert after.estimate == localizer().cycle(state, Sightings(NOW, (seen,))).estimate
    assert after.estimate != state.estimate
