"""Finding oneself: the pose from recent evidence alone."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from support.core import CORNERS, heading_error, position_error
from support.evidence import piece

from cpcbl_team.config import Gives, OdometrySettings
from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.recovery_evidence import SPACING_NS
from cpcbl_team.relocalization import relocalize
from cpcbl_team.state import Evidence


def fix_piece(stamp_ns: int, robot: Pose2) -> Evidence:
    return Evidence(stamp_ns, robot, "fix:mate", robot.x, robot.y, None, None, 0.0, 0.0, 0.1, True)


def headed_piece(stamp_ns: int, robot: Pose2, sigma_rad: float = 0.05) -> Evidence:
    """A fix with the heading, half of whose variance is the observer's."""
    part = sigma_rad * math.sqrt(0.5)
    reported = fix_piece(stamp_ns, robot)._replace(bearing_sigma_rad=part)
    return reported._replace(heading_rad=robot.heading, teammate_sigma_rad=part)


def measured_along(
    path: Iterable[Pose2], names: Sequence[str], gives: Gives = "both"
) -> tuple[Evidence, ...]:
    """What of these corners is known, from each place of a path."""
    corners = CORNERS.landmarks
    return tuple(
        piece(i * SPACING_NS, robot, n, corners[n].x_m, corners[n].y_m, gives=gives)
        for i, robot in enumerate(path)
        for n in names
    )


def dead_reckoned(evidence: Iterable[Evidence], field_from_odometry: Pose2) -> tuple[Evidence, ...]:
    """The same, by a dead reckoning that began elsewhere."""
    odometry_from_field = field_from_odometry.inverse()
    return tuple(
        e._replace(odometry_from_robot=odometry_from_field @ e.odometry_from_robot)
        for e in evidence
    )


NOISE = OdometrySettings()
PATH = [Pose2(-1.0, 0.4, 0.3), Pose2(-0.5, 0.6, 0.5), Pose2(0.0, 1.0, 0.9)]
BEGUN = Pose2(2.0, -3.0, 1.1)


def found_at(evidence: Iterable[Evidence], truth: Pose2) -> Estimate | None:
    found = relocalize(dead_reckoned(evidence, BEGUN), BEGUN.inverse() @ truth, CORNERS, NOISE)
    if found is not None:
        assert position_error(found, truth) < 1e-3
        assert heading_error(found, truth) < 1e-3
    return found


@pytest.mark.parametrize(
    "evidence",
    [
        pytest.param(measured_along(PATH[-1:], ["ne", "sw"]), id="two ranges and bearings at once"),
        pytest.param(
            measured_along(PATH[:1], ["ne"]) + measured_along(PATH[1:2], ["nw"]),
            id="two ranges and bearings on the way",
        ),
        pytest.param(measured_along(PATH, ["ne", "nw", "se"], "bearing"), id="three bearings"),
        pytest.param(
            measured_along(PATH, ["ne", "nw", "se"], "range"), id="three ranges on a bend"
        ),
        pytest.param(
            tuple(fix_piece(i * SPACING_NS, pose) for i, pose in enumerate(PATH)),
            id="fixes along the way",
        ),
        pytest.param(
            (fix_piece(0, PATH[0]), *measured_along(PATH[1:], ["ne"])), id="a fix and a landmark"
        ),
        pytest.param(
            tuple(headed_piece(i * SPACING_NS, PATH[0]) for i in range(2)),
            id="two fixes with a heading at one place",
        ),
        pytest.param(
            (headed_piece(0, PATH[0]), *measured_along(PATH[1:2], ["ne"], "bearing")),
            id="a fix with a heading, and a bearing",
        ),
        pytest.param(
            (headed_piece(0, PATH[0]), fix_piece(SPACING_NS, PATH[0])),
            id="a fix with a heading, and one without",
        ),
    ],
)
def test_a_robot_is_found_by_triangulation(evidence: tuple[Evidence, ...]) -> None:
    assert found_at(evidence, PATH[-1]) is not None


STRAIGHT = [Pose2(0.1 * i, 0.0, 0.0) for i in range(4)]
# Two posts on the line that the robot drives along: left of it is as good as right.
ON_THE_LINE = tuple(
    piece(i * SPACING_NS, robot, name, x, 0.5, gives="range")
    for i, robot in enumerate(Pose2(0.4 * i, -0.5, 0.0) for i in range(4))
    for name, x in (("a", -3.0), ("b", 3.0))
)


@pytest.mark.parametrize(
    "evidence",
    [
        pytest.param((), id="nothing"),
        pytest.param(measured_along(PATH[-1:], ["ne"]), id="one landmark"),
        pytest.param(measured_along(PATH, ["ne"]), id="one landmark along the way"),
        pytest.param(measured_along(PATH[-1:] * 3, ["ne", "nw"], "range"), id="two ranges"),
        pytest.param(ON_THE_LINE, id="two ranges, the same on either side"),
        pytest.param(measured_along(STRAIGHT[-1:] * 3, ["ne", "nw"], "bearing"), id="two bearings"),
        pytest.param(
            tuple(fix_piece(i * SPACING_NS, PATH[0]) for i in range(4)), id="fixes at one place"
        ),
        pytest.param((headed_piece(0, PATH[0]),), id="one fix with a heading: nothing confirms it"),
    ],
)
def test_ambiguous_evidence_gives_no_pose(evidence: tuple[Evidence, ...]) -> None:
    truth = evidence[-1].odometry_from_robot if evidence else PATH[-1]
    assert found_at(evidence, truth) is None


def test_a_few_wrong_pieces_are_left_out() -> None:
    evidence = measured_along(PATH, ["ne", "nw", "se"])
    wrong = evidence[4]._replace(bearing_rad=2.0, range_m=0.5)
    assert found_at((*evidence[:4], wrong, *evidence[5:]), PATH[-1]) is not None


def test_evidence_that_contradicts_itself_gives_no_pose() -> None:
    evidence = measured_along(PATH[-1:], ["ne", "nw"])
    wrong = [e._replace(range_m=1.0, bearing_rad=0.1 * i) for i, e in enumerate(evidence)]
    assert relocalize(tuple(wrong), PATH[-1], CORNERS, NOISE) is None


def test_headings_that_contradict_each_other_give_no_pose() -> None:
    one, other = (headed_piece(i * SPACING_NS, PATH[0]) for i in range(2))
    other = other._replace(heading_rad=PATH[0].heading + 1.0)
    assert relocalize((one, other), PATH[0], CORNERS, NOISE) is None


def test_a_wrong_heading_among_right_ones_is_left_out() -> None:
    evidence = [headed_piece(i * SPACING_NS, pose) for i, pose in enumerate(PATH * 2)]
    evidence[1] = evidence[1]._replace(heading_rad=-2.0)
    assert found_at(evidence, PATH[-1]) is not None


@pytest.mark.parametrize("times", [1, 6])
def test_an_observer_that_repeats_a_heading_gets_no_more_weight(times: int) -> None:
    """Of its own 0.1 rad nothing is averaged away, and nothing of it by its position either."""
    reported = [headed_piece(i, PATH[0], 0.1 * math.sqrt(2.0)) for i in range(2 * times)]
    sure = [e._replace(bearing_sigma_rad=0.001) for e in reported]
    found = relocalize(tuple(sure), PATH[0], CORNERS, NOISE)
    assert found is not None
    assert found.heading_sigma_rad > 0.1
    assert found.shared == found.covariance


@pytest.mark.parametrize("times", [1, 6])
def test_teammates_that_repeat_themselves_get_no_more_weight(times: int) -> None:
    """Their error, of 0.1 m, may be the same each time."""
    exact = OdometrySettings(
        distance_sigma_m_per_sqrt_m=0.0,
        turn_sigma_rad_per_sqrt_m=0.0,
        turn_sigma_rad_per_sqrt_rad=0.0,
    )
    reported = [fix_piece(i, pose) for i, pose in enumerate(PATH * times)]
    found = relocalize(tuple(reported), PATH[-1], CORNERS, exact)
    own = relocalize(
        tuple(e._replace(from_teammate=False) for e in reported), PATH[-1], CORNERS, exact
    )
    assert found is not None
    assert own is not None
    assert found.position_sigma_m > 0.1
    assert own.position_sigma_m < 0.14 / math.sqrt(times)


def test_a_pose_found_by_a_teammates_reports_is_shared() -> None:
    reported = relocalize(
        tuple(fix_piece(i, pose) for i, pose in enumerate(PATH)), PATH[-1], CORNERS, NOISE
    )
    measured = relocalize(measured_along(PATH, ["ne", "nw"]), PATH[-1], CORNERS, NOISE)
    assert reported is not None
    assert measured is not None
    assert reported.shared == reported.covariance
    assert set(measured.shared) == {0.0}


def test_a_pose_whose_evidence_disagrees_is_as_uncertain_as_that() -> None:
    """Readings that are off by about two sigmas: the covariance grows by chi-square a residual."""
    exact = measured_along(PATH, ["ne", "nw", "se"])
    off = [
        e._replace(range_m=e.range_m + (-1) ** i * 2.0 * e.range_sigma_m)
        for i, e in enumerate(exact)
        if e.range_m is not None
    ]
    agreeing, disagreeing = (
        relocalize(tuple(pieces), PATH[-1], CORNERS, NOISE) for pieces in (exact, off)
    )
    assert agreeing is not None
    assert disagreeing is not None
    ratio = disagreeing.covariance.determinant() / agreeing.covariance.determinant()
    assert ratio > 1.5**3


def test_evidence_without_a_sigma_is_no_division_by_zero() -> None:
    exact = measured_along(PATH, ["ne", "nw", "se"])
    sharp = tuple(e._replace(range_sigma_m=0.0, bearing_sigma_rad=0.0) for e in exact)
    assert found_at(sharp, PATH[-1]) is not None


# Dead reckoning drifts ----------------------------------------------------------------------------


def drifted_evidence(seed: int, names: Sequence[str], gives: Gives) -> tuple[Evidence, ...]:
    """One corner at a time along 3.5 m of noisy dead reckoning, by noisy readings."""
    rng = np.random.default_rng(seed)
    true, reckoned, pieces = Pose2(-1.5, -1.0, 0.4), Pose2(0.0, 0.0, 0.0), []
    for i in range(14):
        corner = CORNERS.landmarks[names[i % len(names)]]
        exact = piece(i * SPACING_NS, true, names[i % len(names)], corner.x_m, corner.y_m)
        assert exact.range_m is not None
        assert exact.bearing_rad is not None
        pieces.append(
            exact._replace(
                odometry_from_robot=reckoned,
                range_m=exact.range_m + 0.1 * rng.normal() if gives == "both" else None,
                bearing_rad=exact.bearing_rad + 0.03 * rng.normal(),
            )
        )
        reckoned = step(reckoned, 0.25, 0.2)
        distance = 0.25 + 0.05 * math.sqrt(0.25) * rng.normal()
        around = NOISE.turn_sigma_rad_per_sqrt_m**2 * 0.25
        around += NOISE.turn_sigma_rad_per_sqrt_rad**2 * 0.2
        true = step(true, distance, 0.2 + math.sqrt(around) * rng.normal())
    # the pieces say where the robot was; the truth is wanted in their frame
    return (*pieces, pieces[-1]._replace(odometry_from_robot=reckoned, x=true.x, y=true.y))


@pytest.mark.parametrize(
    ("names", "gives"),
    [(("ne", "sw"), "both"), (("ne", "nw", "se"), "bearing")],
    ids=["two landmarks", "three bearings"],
)
def test_a_found_pose_errs_as_far_as_it_claims(names: Sequence[str], gives: Gives) -> None:
    """Where drift counts for each piece alone, the NEES is three times as large."""
    nees = []
    for seed in range(40):
        *pieces, end = drifted_evidence(seed, names, gives)
        found = relocalize(tuple(pieces), end.odometry_from_robot, CORNERS, NOISE)
        if found is None:
            continue
        error = np.array([found.pose.x - end.x, found.pose.y - end.y])
        xx, xy, yy, *_ = found.covariance
        nees.append(error @ np.linalg.solve([[xx, xy], [xy, yy]], error))
    assert len(nees) > 30
    assert 1.3 < np.mean(nees) < 3.0
    assert max(nees) < 13.8  # the bound of 99.9 %
