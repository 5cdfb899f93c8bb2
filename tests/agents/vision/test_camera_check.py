"""What landmarks and odometry tell of a camera: drives without pictures, with known errors."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.sweeps import sampled

from cpcbl_agents.vision.camera_correction import CameraCorrection
from cpcbl_team.camera_errors import NO_ERRORS, CameraErrors, without_errors
from cpcbl_team.config import (
    CameraSettings,
    Field,
    Landmark,
    OdometrySettings,
    RobotSettings,
    Start,
    Team,
)
from cpcbl_team.estimate import ZERO3, Estimate
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import InputsMended, Odometry, Sighting, Sightings

STEP_NS = 250_000_000
NOISE = OdometrySettings(
    distance_sigma_m_per_sqrt_m=0.05,
    turn_sigma_rad_per_sqrt_rad=0.05,
    turn_sigma_rad_per_sqrt_m=0.05,
)
FOUR = {"sw": (0.0, 0.0), "se": (6.0, 0.0), "ne": (6.0, 4.0), "nw": (0.0, 4.0)}
SIX = {**FOUR, "s": (3.0, 0.0), "n": (3.0, 4.0)}
YAW, FOCAL = CameraErrors(math.radians(3.0), 0.0), CameraErrors(0.0, 0.05)
CENTRE = CameraErrors(0.0, 0.0, 0.05)


class Drive(NamedTuple):
    """A drive on a figure of eight through a field of 6 x 4 m, and what is wrong in it."""

    errors: CameraErrors = NO_ERRORS
    landmarks: dict[str, tuple[float, float]] = SIX
    distance_scale: float = 1.0  # true distance / odometry's
    seconds: float = 40.0
    axis_rad: float = 0.0
    moves: bool = True
    corrects: bool = True
    has_exact_start: bool = False
    misplaced: str = ""
    half_view_deg: float = 39.0
    stated: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Sigmas of yaw (deg), focal length and centre; then the filter knows of these errors."""


def correction_of(drive: Drive) -> CameraCorrection:
    yaw_sigma_deg, focal_share, centre_share = drive.stated
    camera = CameraSettings(
        yaw_deg=math.degrees(drive.axis_rad),
        self_calibration=drive.corrects,
        yaw_sigma_deg=yaw_sigma_deg,
        focal_share=focal_share,
        centre_share=centre_share,
    )
    sigmas = (0.0, 0.0) if drive.has_exact_start else (0.02, 0.3)
    start = Start(x_m=3.0, y_m=2.0, sigma_m=sigmas[0], heading_sigma_deg=sigmas[1])
    odometry = replace(NOISE, moves=drive.moves)
    robot = RobotSettings(sensing="camera", camera=camera, odometry=odometry, start=start)
    places = {name: Landmark(x_m=x, y_m=y) for name, (x, y) in drive.landmarks.items()}
    return CameraCorrection("r1", Team(name="t", robots={"r1": robot}, map=Field(landmarks=places)))


def read_by(true: Sighting, errors: CameraErrors, axis_rad: float) -> Sighting:
    """What a camera with these errors reads in place of a sighting."""
    turned = replace(true, bearing_rad=wrap_angle((true.bearing_rad or 0.0) + errors.yaw_rad))
    magnified = without_errors(turned, CameraErrors(0.0, -errors.focal), axis_rad)
    return without_errors(magnified, CameraErrors(0.0, 0.0, -errors.centre), axis_rad)


def frame_at(pose: Pose2, drive: Drive, random: np.random.Generator) -> tuple[Sighting, ...]:
    sightings = []
    for name, (x, y) in drive.landmarks.items():
        if name == drive.misplaced:
            x += 0.5
        r, b = math.hypot(x - pose.x, y - pose.y), math.atan2(y - pose.y, x - pose.x) - pose.heading
        if abs(wrap_angle(b - drive.axis_rad)) > math.radians(drive.half_view_deg):
            continue
        sigma_r, sigma_b = 0.01 * r, math.radians(0.3)
        noisy = r + sigma_r * random.normal(), wrap_angle(b + sigma_b * random.normal())
        read = read_by(Sighting(name, *noisy), drive.errors, drive.axis_rad)
        sightings.append(replace(read, range_sigma_m=sigma_r, bearing_sigma_rad=sigma_b))
    return tuple(sightings)


def run(drive: Drive, seed: int = 0) -> tuple[CameraCorrection, list[InputsMended]]:
    """The correction after a drive, and what it told the filter."""
    random, correction = np.random.default_rng(seed), correction_of(drive)
    pose, changes = Pose2(3.0, 2.0, 0.0), []
    for k in range(int(drive.seconds * 1e9) // STEP_NS):
        now_ns = (k + 1) * STEP_NS
        if drive.moves:
            turn = 0.1 if (k // 63) % 2 else -0.1
            noise = math.sqrt(0.1) * 0.05 * random.normal(), 0.32 * 0.05 * random.normal()
            pose = step(pose, 0.1 * drive.distance_scale, turn)
            piece = Odometry(now_ns - STEP_NS, now_ns, 0.1 + noise[0], turn + noise[1])
            correction.add_odometry(piece)
        believed = pose._replace(heading=wrap_angle(pose.heading - drive.errors.yaw_rad))
        correction.set_estimate(Estimate(believed, ZERO3), "")
        frame = Sightings(now_ns, frame_at(pose, drive, random))
        _, change = correction.correct(frame)
        changes += [] if change is None else [change]
    return correction, changes


@given(
    st.floats(0.2, 10.0),
    st.floats(-0.6, 0.6),
    st.floats(-0.2, 0.2),
    st.floats(-0.2, 0.2),
    st.floats(-3.0, 3.0),
)
def test_a_sighting_without_errors_is_the_true_one(
    r: float, off_axis: float, yaw: float, focal: float, axis: float
) -> None:
    true = Sighting("a", r, wrap_angle(axis + off_axis), 0.1, 0.01, 0.3, 0.1)
    errors = CameraErrors(yaw, focal)
    found = without_errors(read_by(true, errors, axis), errors, axis)
    assert found.range_m == pytest.approx(r)
    assert math.remainder(
        (found.bearing_rad or 0.0) - (true.bearing_rad or 0.0), math.tau
    ) == pytest.approx(0.0, abs=1e-9)


def test_a_longer_lens_makes_things_look_nearer_and_wider_apart() -> None:
    """Worked example: a focal length 10 % longer than stated; the object is 2 m ahead, 1 m left."""
    errors = CameraErrors(0.0, math.log(1.1))
    read = read_by(Sighting("a", math.hypot(2.0, 1.0), math.atan2(1.0, 2.0)), errors, 0.0)
    assert read.range_m == pytest.approx(math.hypot(2.0 / 1.1, 1.0))
    assert read.bearing_rad == pytest.approx(math.atan2(1.0, 2.0 / 1.1))


@pytest.mark.parametrize("seed", sampled(range(2), [0]))
@pytest.mark.parametrize(
    "drive",
    [
        Drive(YAW),
        Drive(YAW, FOUR, axis_rad=math.pi / 2),
        Drive(FOCAL),
        Drive(FOCAL, FOUR),
        Drive(CameraErrors(-YAW.yaw_rad, -0.05)),
        Drive(FOCAL, distance_scale=1.1),
        Drive(YAW, moves=False),
        Drive(FOCAL, moves=False),
        Drive(YAW, moves=False, has_exact_start=True),
        Drive(CENTRE),
        Drive(CENTRE, FOUR),
        Drive(CameraErrors(0.0, 0.05, -0.05)),
        Drive(CENTRE, moves=False),
    ],
    ids=str,
)
def test_a_wrong_camera_is_named_and_its_errors_are_found(drive: Drive, seed: int) -> None:
    correction, changes = run(drive, seed)
    assert correction.found is not None
    found, sigmas = correction.found.errors, correction.found.sigmas
    for name in CameraErrors._fields:
        error = getattr(found, name) - getattr(drive.errors, name)
        assert abs(error) <= 3.5 * getattr(sigmas, name)
    assert found.yaw_rad == pytest.approx(drive.errors.yaw_rad, abs=math.radians(1.5))
    assert found.focal == pytest.approx(drive.errors.focal, abs=0.01)
    assert correction.counts["camera_miscalibrated"] == 1
    (problem,) = correction.problems
    assert ("`yaw_deg`" in problem) is (drive.errors.yaw_rad != 0.0)
    assert ("`fx_px`" in problem) is (drive.errors.focal != 0.0)
    assert ("`cx_px`" in problem) is (drive.errors.centre != 0.0)
    turned = sum(change.turn_rad for change in changes)
    due = drive.errors.yaw_rad + drive.errors.centre
    assert turned == pytest.approx(due, abs=math.radians(1.0))


@pytest.mark.parametrize(
    "drive",
    [
        Drive(),
        Drive(landmarks=FOUR, axis_rad=-math.pi / 2),
        Drive(distance_scale=1.15),
        Drive(distance_scale=0.85, landmarks=FOUR),
        Drive(moves=False),
        Drive(landmarks={"ne": (6.0, 4.0)}),
        Drive(landmarks={"ne": (6.0, 4.0), "se": (6.0, 0.0)}, distance_scale=0.9),
    ],
    ids=str,
)
def test_a_right_camera_is_not_blamed(drive: Drive) -> None:
    for seed in range(2):
        correction, changes = run(drive, seed)
        assert correction.problems == ()
        assert not changes
        assert correction.counts["camera_miscalibrated"] == 0


@pytest.mark.parametrize("errors", [YAW, FOCAL], ids=str)
def test_an_error_that_the_filter_reckons_with_is_named_and_left_to_it(
    errors: CameraErrors,
) -> None:
    correction, changes = run(Drive(errors, stated=(2.0, 0.025, 0.025)))
    assert correction.counts["camera_miscalibrated"] == 1
    assert not changes
    read = Sighting("ne", 3.0, 0.3, 0.03, 0.005)
    frame, _ = correction.correct(Sightings(10**12, (read,)))
    assert frame.sightings == (read,)


@pytest.mark.parametrize("errors", [YAW, FOCAL], ids=str)
def test_an_error_of_many_sigmas_is_corrected(errors: CameraErrors) -> None:
    _, changes = run(Drive(errors, stated=(0.1, 0.005, 0.005)))
    assert sum(c.turn_rad for c in changes) == pytest.approx(errors.yaw_rad, abs=math.radians(1.0))
    assert changes


def test_what_is_known_is_taken_from_the_sightings() -> None:
    drive = Drive(CameraErrors(math.radians(3.0), 0.05))
    correction, _ = run(drive)
    true = Sighting("ne", 3.0, 0.3)
    read = replace(read_by(true, drive.errors, 0.0), range_sigma_m=0.03, bearing_sigma_rad=0.005)
    frame, _ = correction.correct(Sightings(10**12, (read,)))
    (found,) = frame.sightings
    assert found.range_m == pytest.approx(3.0, abs=0.03)
    assert found.bearing_rad == pytest.approx(0.3, abs=math.radians(0.7))


def test_with_the_key_false_it_is_named_and_nothing_is_changed() -> None:
    correction, changes = run(Drive(YAW, corrects=False))
    assert "self_calibration" in correction.problems[0]
    assert changes == [InputsMended(changes[0].stamp_ns)]
    read = Sighting("ne", 3.0, 0.3, 0.03, 0.005)
    frame, _ = correction.correct(Sightings(10**12, (read,)))
    assert frame.sightings == (read,)


@pytest.mark.parametrize("errors", [YAW, CENTRE], ids=str)
def test_a_narrow_view_does_not_tell_the_yaw_from_the_principal_point(errors: CameraErrors) -> None:
    for seed in range(3):
        correction, changes = run(Drive(errors, half_view_deg=6.0, seconds=120.0), seed)
        (problem,) = correction.problems
        assert "its `yaw_deg` is wrong, or its `cx_px` by" in problem
        turned = sum(change.turn_rad for change in changes)
        due = errors.yaw_rad + errors.centre
        assert turned == pytest.approx(due, abs=math.radians(1.0))


@pytest.mark.parametrize("errors", [YAW, CENTRE, CameraErrors(-YAW.yaw_rad, 0.0, 0.05)], ids=str)
@pytest.mark.parametrize("half_view_deg", sampled([6.0, 10.0, 15.0, 39.0], [10.0]))
def test_what_is_named_is_never_the_wrong_one(errors: CameraErrors, half_view_deg: float) -> None:
    for seed in range(2):
        correction, _ = run(Drive(errors, half_view_deg=half_view_deg, seconds=60.0), seed)
        for problem in correction.problems:
            if "or its `cx_px`" not in problem:
                assert ("`yaw_deg`" in problem) <= (errors.yaw_rad != 0.0)
                assert ("`cx_px`" in problem) <= (errors.centre != 0.0)


def test_one_landmark_that_stands_elsewhere_does_not_blame_the_camera() -> None:
    for seed in range(3):
        correction, _ = run(Drive(misplaced="n"), seed)
        assert correction.problems == ()
