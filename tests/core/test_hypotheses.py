"""Senders that contradict each other: which of them makes the robot's own readings more likely."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import (
    CORNERS,
    LOOP_START,
    SECOND,
    diagonal,
    driven,
    fix,
    frame,
    loop,
    placed_at,
)
from support.trust import RULES

from cpcbl_team.augmented_update import AugmentedUpdate, Reading, ScoredUpdate
from cpcbl_team.camera_errors import NO_ERRORS
from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.compromises import (
    DOUBTED,
    DOUBTED_M,
    FRESH_NS,
    LEAST_DOUBT,
    compromise,
    doubt_variance,
    with_contest,
)
from cpcbl_team.config import CameraSettings, LocalizationSettings, OdometrySettings, Start
from cpcbl_team.estimate import Estimate, Information
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2
from cpcbl_team.hypotheses import (
    HELD_NS,
    MOST_EVIDENCE,
    MOST_GAIN,
    MOST_HYPOTHESES,
    SUSPICIOUS_M,
    contested_names,
    with_gains,
    with_hypotheses,
)
from cpcbl_team.localizer import Localizer
from cpcbl_team.mean_comparisons import EVIDENCE, EVIDENCE_ON_MOST, compared_with_own_sensors
from cpcbl_team.mean_offsets import MeanOffset
from cpcbl_team.miscalibration import AS_CONFIGURED
from cpcbl_team.own_pose import OwnPose
from cpcbl_team.sender_records import (
    OWN_SENSORS,
    QuarantineReason,
    Rival,
    SenderRecord,
    TeammateReport,
)
from cpcbl_team.state import State
from cpcbl_team.trust import assess

NOW_NS = 100 * SECOND
PLACE = Pose2(1.0, 2.0, 0.3)
OWN = OwnPose(NOW_NS, Estimate(PLACE, diagonal(0.05, 0.05)), AS_CONFIGURED, 0)
SHARP = Covariance2(1e-4, 0.0, 1e-4)
NOISE = OdometrySettings(distance_sigma_m_per_sqrt_m=0.1, turn_sigma_rad_per_sqrt_m=0.1)
START = Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.05)
TEAM = frozenset({"0", "1", "2"})


def says(x: float, *, ago_ns: int = 0, bias_m: float = 0.0) -> SenderRecord:
    """One whose mean is this, and whose last report was so long ago."""
    mean = MeanOffset(x, 0.0, SHARP, stamp_ns=NOW_NS - ago_ns)
    return SenderRecord(
        last_report_ns=NOW_NS - ago_ns, means=(mean, mean), bias_variance=bias_m * bias_m
    )


def about(x: float) -> Information:
    """Own readings that say that the robot is so far from `PLACE` in x, with a sigma of 2 cm."""
    return Information.none().add((1.0, 0.0, 0.0), x, 0.0004).add((0.0, 1.0, 0.0), 0.0, 0.0004)


# How likely own readings are ----------------------------------------------------------------------


@pytest.mark.parametrize("off", [0.0, 0.1])
def test_the_likelihood_of_evidence_is_that_of_its_innovation(off: float) -> None:
    """Two poses compared by a reading of one scalar: e^2 / S + log S of each."""
    pose = OWN._replace(estimate=Estimate(Pose2(1.0 + off, 2.0, 0.3), diagonal(0.03, 0.05)))

    def expected(of: OwnPose) -> float:
        total = of.estimate.covariance.xx + 0.0004
        innovation = PLACE.x + 0.04 - of.estimate.pose.x
        return -0.5 * (innovation * innovation / total + math.log(total))

    evidence = Information.none().add((1.0, 0.0, 0.0), 0.04, 0.0004)
    found = pose.log_likelihood(PLACE, evidence) - OWN.log_likelihood(PLACE, evidence)
    assert found == pytest.approx(expected(pose) - expected(OWN), rel=1e-6)


def test_readings_with_common_errors_are_scored_one_by_one() -> None:
    common = CommonErrors.of_camera(0.0, NO_ERRORS)
    readings = [Reading((1.0, 0.0, 0.0), (), 0.04, 0.01), Reading((1.0, 0.0, 0.1), (), 0.02, 0.02)]
    covariance, rows = diagonal(0.05, 0.05), np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.1]])
    prior = np.diag([0.05**2, 0.05**2, 0.05**2])
    total = rows @ prior @ rows.T + np.diag([0.01, 0.02])
    residual = np.array([0.04, 0.02])
    chi_square = residual @ np.linalg.solve(total, residual)
    update = ScoredUpdate(covariance, common)
    update.after(readings)
    expected = -0.5 * (chi_square + math.log(np.linalg.det(total)))
    assert update.log_likelihood == pytest.approx(expected)
    plain = AugmentedUpdate(covariance, common).after(readings)
    assert update.covariance == plain.covariance


# Hypotheses ---------------------------------------------------------------------------------------


def test_without_a_contradiction_there_are_none() -> None:
    agreeing = {"a": says(0.0), "b": says(0.01), OWN_SENSORS: says(0.0)}
    assert contested_names(agreeing, NOW_NS) == []
    assert with_hypotheses(OWN, agreeing) is OWN


@pytest.mark.parametrize(
    "change",
    [
        {"bias_variance": SUSPICIOUS_M**2},
        {"rivals": (Rival("b", 0.1, 0.0),)},
        {"wrong_ns": NOW_NS},
        {"reason": QuarantineReason.BIASED},
    ],
)
def test_each_contradiction_begins_one_for_each_recent_sender(change: dict[str, object]) -> None:
    senders = {"a": replace(says(0.1), **change), "b": says(0.0), OWN_SENSORS: says(0.0)}
    senders["silent"] = says(0.0, ago_ns=4 * SECOND)
    own = with_hypotheses(OWN, senders)
    assert set(own.by_sender) == {"a", "b"}
    assert own.by_sender["a"].estimate == OWN.estimate._replace(shared=OWN.estimate.covariance)
    assert with_hypotheses(own, senders).by_sender == own.by_sender  # they do not begin anew
    agreeing = {"a": says(0.0), "b": says(0.0)}
    held = own._replace(stamp_ns=NOW_NS + HELD_NS)
    assert with_hypotheses(held, agreeing).by_sender == own.by_sender
    late = own._replace(stamp_ns=NOW_NS + HELD_NS + 1)
    assert with_hypotheses(late, agreeing).by_sender == {}


def test_guests_of_many_names_cost_no_more_than_a_few_and_displace_no_robot_of_the_team() -> None:
    guests = {f"g{i:02}": replace(says(0.1, bias_m=0.1), is_guest=True) for i in range(50)}
    own = with_hypotheses(OWN, {**guests, "robot": says(0.0)})
    assert len(own.by_sender) == MOST_HYPOTHESES
    assert "robot" in own.by_sender


def test_evidence_is_the_sum_of_differences_while_both_report() -> None:
    silent = says(0.0, ago_ns=FRESH_NS + 1)
    senders = {"a": says(0.1), "b": says(0.0), "silent": silent, OWN_SENSORS: says(0.0)}
    gains = {"a": -2.0, "b": -1.5, "silent": -1.0, OWN_SENSORS: -1.8}
    found = with_gains(senders, gains, NOW_NS - SECOND // 10, NOW_NS)
    assert found["a"].behind == pytest.approx({"b": 1.0, OWN_SENSORS: 0.4})
    assert found["b"].behind == pytest.approx({"a": -1.0, OWN_SENSORS: -0.6})
    assert found["silent"].behind == {}
    assert found[OWN_SENSORS] is senders[OWN_SENSORS]
    twice = with_gains(found, gains, NOW_NS - SECOND // 10, NOW_NS)
    assert 1.9 < twice["a"].behind["b"] < 2.0  # the first one has faded a little
    outlier = with_gains(senders, {**gains, "a": -50.0}, NOW_NS - SECOND // 10, NOW_NS)
    assert outlier["a"].behind["b"] == MOST_GAIN
    for _ in range(20):  # the evidence of a long time does not outweigh that of the present
        outlier = with_gains(outlier, {**gains, "a": -50.0}, NOW_NS, NOW_NS)
    assert (outlier["a"].behind["b"], outlier["b"].behind["a"]) == (MOST_EVIDENCE, -MOST_EVIDENCE)
    assert with_gains(found, {}, NOW_NS, NOW_NS)["a"].behind == {}


# What follows -------------------------------------------------------------------------------------


def test_evidence_of_own_readings_convicts_and_the_mean_of_own_sensors_does_not_beside_it() -> None:
    """That mean agrees with the estimate, which follows the liars."""
    honest, liar = MeanOffset(0.0, 0.0, SHARP), MeanOffset(0.1, 0.0, SHARP)
    misled = MeanOffset(0.09, 0.0, SHARP)
    assert compared_with_own_sensors(honest, misled, {"liar": liar}, 2).is_wrong
    assert not compared_with_own_sensors(liar, misled, {"honest": honest}, 2).is_wrong
    ahead = EVIDENCE + 0.1
    right = {"liar": -ahead, OWN_SENSORS: -5.0}
    found = compared_with_own_sensors(honest, misled, {"liar": liar}, 2, right)
    assert not found.is_wrong
    assert not found.is_contested
    assert found.bias_variance == 0.0
    assert compared_with_own_sensors(
        liar, misled, {"honest": honest}, 2, {"honest": ahead}
    ).is_wrong
    undecided = compared_with_own_sensors(liar, None, {"honest": honest}, 2, {"honest": 1.0})
    assert undecided.is_contested
    assert not undecided.is_left_out


def opposed(behind: float, **change: object) -> dict[str, SenderRecord]:
    """Two that are 0.2 m apart, and how far the first one is behind."""
    one, other = (
        replace(says(x), behind={name: b, OWN_SENSORS: 0.0})
        for x, name, b in ((0.2, "b", behind), (0.0, "a", -behind))
    )
    return {"a": one, "b": replace(other, **change)}


@pytest.mark.parametrize(
    ("behind", "is_found"),
    [(0.0, False), (EVIDENCE_ON_MOST, False), (EVIDENCE_ON_MOST + 1.0, True)],
)
def test_a_dispute_is_decided_where_own_readings_speak_clearly_against_the_sender(
    behind: float, is_found: bool
) -> None:
    """One that is suddenly far off has no new mean: each report is an outlier, by test 1."""
    limit, since_ns = RULES.limit, NOW_NS - SECOND
    liar = SenderRecord(
        NOW_NS, score=2.0 * limit, dispute_since_ns=since_ns, behind={"honest": behind}
    )
    senders = {"liar": liar, "honest": says(0.0), OWN_SENSORS: says(0.0)}
    senders = {n: r if r is liar else agreeing(r) for n, r in senders.items()}
    report = TeammateReport(NOW_NS, 50.0, (0.7, 0.0), compared=("liar", "honest"))
    decision = assess(senders, "liar", report, since_ns, RULES)
    assert decision.quarantined == ({"liar"} if is_found else set())


def agreeing(record: SenderRecord) -> SenderRecord:
    return replace(record, last_accepted_ns=NOW_NS)


def test_one_in_quarantine_is_tested_by_what_it_reports() -> None:
    """At the compromise with its opponents one that is correct again would look wrong."""
    senders = opposed(2.0)
    assert compromise(senders, "a") is not None
    senders["a"] = replace(senders["a"], reason=QuarantineReason.BIASED)
    assert compromise(senders, "a") is None


@pytest.mark.parametrize(("behind", "share"), [(0.0, 0.5), (2.0, 0.731), (-2.0, 0.269)])
def test_both_sides_count_at_the_mean_of_the_mixture(behind: float, share: float) -> None:
    senders = opposed(behind)
    one, other = compromise(senders, "a"), compromise(senders, "b")
    assert one is not None
    assert other is not None
    assert one.x == pytest.approx(-0.2 * share, abs=1e-3)
    assert 0.2 + one.x == pytest.approx(other.x, abs=1e-3)  # both at one place
    assert one.spread.xx == pytest.approx(share * (1.0 - share) * 0.04, abs=1e-4)
    estimate = with_contest(OWN.estimate, senders, NOW_NS)
    assert estimate.covariance.xx == pytest.approx(0.0025 + one.spread.xx)
    assert estimate.covariance.yy == pytest.approx(0.0025)


def test_the_estimate_says_that_either_side_may_be_right_however_likely_one_is() -> None:
    for name, x in (("a", -0.2), ("b", 0.0)):
        found = compromise(opposed(15.0), name)
        assert found is not None
        assert found.x == pytest.approx(x, abs=1e-3)
        assert found.spread.xx == pytest.approx(LEAST_DOUBT * (1.0 - LEAST_DOUBT) * 0.04)


def test_who_is_alone_in_quarantine_or_silent_takes_no_part() -> None:
    assert compromise({"a": says(0.2)}, "a") is None
    assert compromise(opposed(0.0), "unknown") is None
    for change in (
        {"reason": QuarantineReason.BIASED},
        {"wrong_ns": NOW_NS},
        {"means": says(0.0, ago_ns=SECOND).means},
        {"means": says(0.19).means},  # it says the same
    ):
        assert compromise(opposed(0.0, **change), "a") is None


def test_who_is_clearly_less_likely_is_not_used_while_its_opponents_report() -> None:
    found = compromise(opposed(4.0), "a")
    assert found is not None
    assert found.is_outweighed
    for name, behind in (("b", 4.0), ("a", 1.0)):
        found = compromise(opposed(behind), name)
        assert found is not None
        assert not found.is_outweighed


def test_without_a_present_opponent_only_the_more_likely_one_counts_at_the_mean() -> None:
    """One that repeats the pose of the robot would move that by the distance again and again."""
    silent = says(0.0, ago_ns=FRESH_NS + 1)
    for behind, is_one in ((4.0, False), (0.0, False), (-4.0, True)):
        senders = opposed(behind, last_report_ns=silent.last_report_ns, means=silent.means)
        rivals = {"a": (Rival("b", -0.2, 0.0),), "b": (Rival("a", 0.2, 0.0),)}
        senders = {n: replace(r, rivals=rivals[n]) for n, r in senders.items()}
        assert (compromise(senders, "a") is not None) is is_one


def test_who_was_clearly_less_likely_is_doubted_also_while_the_other_is_silent_or_agrees() -> None:
    doubted, believed = DOUBTED + 0.1, DOUBTED - 0.1
    assert doubt_variance(opposed(doubted, means=(None, None)), "a") == DOUBTED_M**2
    assert doubt_variance(opposed(believed), "a") == 0.0
    assert doubt_variance(opposed(doubted, reason=QuarantineReason.BIASED), "a") == 0.0
    third = replace(says(0.2), behind={})
    senders = {**opposed(0.0), "third": third}
    for behind, share in ((DOUBTED - 0.1, 0.05), (DOUBTED + 0.1, 0.5)):  # one of its own side
        more = {"b": 0.0, "third": behind, OWN_SENSORS: 0.0}
        found = compromise({**senders, "a": replace(senders["a"], behind=more)}, "a")
        assert found is not None
        assert found.x == pytest.approx(-0.2 * share, abs=0.003)


# In the filter ------------------------------------------------------------------------------------


def contested_drive(
    seconds: float, liars: int = 1, camera: CameraSettings | None = None, sensor_m: float = 0.0
) -> State:
    """A robot that sees landmarks (or has a position sensor of this sigma), a correct sender, and
    liars that are 0.15 m off."""
    settings = LocalizationSettings(odometry=NOISE, start=START)
    robot, rng = Localizer(settings, CORNERS, TEAM, camera), np.random.default_rng(1)
    state = robot.start(0)
    for piece, truth in driven(LOOP_START, (loop() * 3)[: round(10 * seconds)]):
        now_ns, distance = piece.stamp_ns, piece.distance_m * (1.0 + 0.05 * rng.normal())
        state = robot.add_odometry(state, replace(piece, distance_m=distance))
        if sensor_m:
            x, y = truth.x + sensor_m * rng.normal(), truth.y + sensor_m * rng.normal()
            state = robot.add_position(state, placed_at(x, y, now_ns, sensor_m))
        else:
            state = robot.cycle(state, frame(truth, now_ns))
        for i, off_m in enumerate([0.0] + [0.15] * liars):
            x, y = truth.x + off_m + 0.01 * rng.normal(), truth.y + 0.01 * rng.normal()
            report = fix(x, y, now_ns, sensor_m=0.01, observer_m=0.01)
            state = robot.add_fix(state, replace(report, observer=f"{i}"))
    return state


@pytest.mark.parametrize(
    ("liars", "camera", "sensor_m"),
    [(1, None, 0.0), (2, None, 0.0), (2, CameraSettings(), 0.0), (2, None, 0.05)],
)
def test_own_readings_decide_against_liars(
    liars: int, camera: CameraSettings | None, sensor_m: float
) -> None:
    senders = contested_drive(8.0, liars, camera, sensor_m).memory.teammates.senders
    assert senders["0"].reason is None
    for i in range(1, liars + 1):
        assert senders[str(i)].reason is not None
        assert senders[str(i)].behind["0"] > EVIDENCE


def test_a_team_that_agrees_has_no_hypotheses() -> None:
    state = contested_drive(8.0, 0)
    own = state.memory.teammates.own
    assert own is not None
    assert own.by_sender == {}
    assert state.reported.covariance == state.estimate.covariance
