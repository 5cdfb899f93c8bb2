"""The mean of the headings that a source reports, and which others contradict it."""

import math

import numpy as np
import pytest
from support.trust import RULES

from cpcbl_team.estimate import Covariance3
from cpcbl_team.geometry import Pose2
from cpcbl_team.mean_headings import NO_TURNS, FadingTurns, MeanTurn, contradicting
from cpcbl_team.mean_offsets import FadingOffsets
from cpcbl_team.reported_tracks import ReportedPosition
from cpcbl_team.sender_records import NEVER_NS, TeammateReport
from cpcbl_team.trust import assess
from cpcbl_team.voters import SenderRecords

SECOND = 1_000_000_000
DEGREE = math.radians(1.0)


def turns(offset: float, sigma: float, count: int = 10) -> FadingTurns:
    found = NO_TURNS
    for i in range(count):
        found = found.with_report(i * SECOND // 10, offset, sigma * sigma)
    return found


def test_the_mean_is_that_of_the_reports_and_its_sigma_falls_with_their_number() -> None:
    few, many = turns(0.1, 0.05, 5).mean(), turns(0.1, 0.05, 20).mean()
    assert few is not None
    assert many is not None
    assert few.rad == pytest.approx(0.1)
    assert math.sqrt(few.variance) == pytest.approx(0.05 / math.sqrt(5), rel=0.05)
    assert math.sqrt(many.variance) == pytest.approx(0.05 / math.sqrt(20), rel=0.05)


def test_few_or_uncertain_reports_have_no_mean() -> None:
    assert turns(0.1, 0.05, 3).mean() is None
    assert turns(0.1, 1.0, 10).mean() is None


def test_the_sums_of_two_sources_are_those_of_all_their_reports() -> None:
    one, other = turns(0.1, 0.05, 6), turns(0.3, 0.05, 6)
    mean = one.plus(other).mean()
    assert mean is not None
    assert mean.rad == pytest.approx(0.2)
    assert one.plus(NO_TURNS).mean() == one.mean()


def test_headings_contradict_beyond_noise_and_usual_misalignment() -> None:
    mean = MeanTurn(0.0, DEGREE**2)
    assert contradicting(mean, [None, MeanTurn(6.0 * DEGREE, DEGREE**2)]) is None
    far = MeanTurn(10.0 * DEGREE, DEGREE**2)
    assert contradicting(mean, [None, far]) == far
    assert contradicting(MeanTurn(3.1, DEGREE**2), [MeanTurn(-3.1, DEGREE**2)]) is None


def test_own_evidence_tells_of_the_heading_whatever_the_position_is() -> None:
    """Bearings to two objects and ranges: an offset of the pose is found as it is."""
    offset, rng = np.array([0.2, -0.1, 0.15]), np.random.default_rng(1)
    rows = rng.normal(size=(4, 3))
    matrix, vector = rows.T @ rows * 1e4, rows.T @ rows @ offset * 1e4
    xx, xy, yy, xh, yh, hh = (
        matrix[i, j] for i, j in [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)]
    )
    sums = FadingOffsets()
    for i in range(8):
        evidence = Covariance3(xx, xy, yy, xh, yh, hh), tuple(vector)
        sums = sums.with_report(i * SECOND // 10, 6 * SECOND, evidence)
    turn = sums.turn()
    assert turn is not None
    assert turn.rad == pytest.approx(0.15)
    one_object = Covariance3(xx, xy, yy, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    blind = FadingOffsets()
    for i in range(8):
        blind = blind.with_report(i * SECOND // 10, 6 * SECOND, one_object)
    assert blind.turn() is None


def driven(turn_rad: float, heading_of: dict[str, float], seconds: float) -> SenderRecords:
    """The records of a robot that drives along x, and whose estimate is turned by `turn_rad`. All
    report its true positions; some report this heading, as an offset from the estimate."""
    senders: SenderRecords = {}
    for i in range(round(10 * seconds)):
        at_m, now = 0.05 * i, i * SECOND // 10
        for name in ("a", "b", "liar"):
            odometry = Pose2(at_m, 0.0, 0.0)
            place = ReportedPosition(now, at_m, 0.0, 0.02**2, odometry, turn_rad)
            heading = (heading_of[name], DEGREE**2) if name in heading_of else None
            report = TeammateReport(now, 1.0, (0.0, 0.0), place, heading=heading)
            senders = assess(senders, name, report, NEVER_NS, RULES).senders
    return senders


def test_a_sender_whose_headings_took_the_estimate_along_is_found_by_the_courses() -> None:
    led_astray = driven(20.0 * DEGREE, {"liar": 0.0}, 15.0)
    assert {n: r.reason for n, r in led_astray.items() if r.reason} == {"liar": "heading"}
    right = driven(0.0, {"liar": 0.0}, 15.0)
    assert not any(r.reason for r in right.values())


def test_headings_that_others_saw_right_are_kept_while_the_estimate_is_wrong() -> None:
    senders = driven(20.0 * DEGREE, {"liar": -20.0 * DEGREE}, 15.0)
    assert not any(r.reason for r in senders.values())
