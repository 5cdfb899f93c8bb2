"""How far apart two senders say that this robot is, by pairs of their reports and odometry."""

import math
import random
from collections.abc import Mapping

import pytest
from msgspec.structs import replace
from support.core import SECOND
from support.trust import AGREES, RULES

from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.mean_offsets import CONFLICT, FadingOffsets, MeanOffset, contradicts
from cpcbl_team.position_pairs import CLEAR, LEAST_PAIRS, LONGEST_PAIR_NS, with_pair
from cpcbl_team.reported_tracks import OdometryErrors, ReportedPosition
from cpcbl_team.sender_differences import (
    MOST_PARTNERS,
    ORIGIN,
    differences,
    positions_about,
    with_pairs,
    without_pairs,
)
from cpcbl_team.sender_records import QuarantineReason, SenderRecord, TeammateReport
from cpcbl_team.trust import assess

WHEELS = OdometryErrors(0.1**2, 0.0, 0.1**2, 0.1**2)
TURNED = 0.7  # the heading of the robot in the field minus that of its odometry, rad
Records = Mapping[str, SenderRecord]


def report(
    stamp_s: float, pose: Pose2, odometry: Pose2, sigma_m: float, x: float = 0.0, y: float = 0.0
) -> ReportedPosition:
    """What a sender reports of a robot at this pose, with an error."""
    part = Covariance2(sigma_m * sigma_m, 0.0, sigma_m * sigma_m)
    about = pose.x + x, pose.y + y, sigma_m * sigma_m
    stamp_ns = round(stamp_s * SECOND)
    return ReportedPosition(stamp_ns, *about, odometry, TURNED, 0, WHEELS, part)


def drive(
    senders: Mapping[str, tuple[float, float, float]],
    *,
    seconds: float = 20.0,
    hz: float = 2.0,
    seed: int = 1,
    is_noisy: bool = True,
    records: Records | None = None,
) -> Records:
    """The records after these senders (their constant errors in m, and sigma) reported a robot that
    drives on arcs, one after the other within each period."""
    dice = random.Random(seed)
    known = dict(records or {name: SenderRecord() for name in senders})
    true, odometry = Pose2(1.0, 2.0, TURNED), Pose2(0.0, 0.0, 0.0)
    shift_s = 0.9 / (hz * len(senders))
    for i in range(round(seconds * hz)):
        for k, (name, (x, y, sigma_m)) in enumerate(sorted(senders.items())):
            way, turn = 0.5 * shift_s, 0.3 * shift_s * math.sin(0.5 * i)
            true = step(true, way, turn)
            slips = dice.gauss(0.0, 0.1 * math.sqrt(way)), dice.gauss(0.0, 0.02 * math.sqrt(way))
            slips = slips if is_noisy else (0.0, 0.0)
            odometry = step(odometry, way + slips[0], turn + slips[1])
            errors = [dice.gauss(0.0, sigma_m) if is_noisy else 0.0 for _ in "xy"]
            stamp_s = i / hz + k * shift_s
            now = report(stamp_s, true, odometry, sigma_m, x + errors[0], y + errors[1])
            # The heading of the estimate follows the robot.
            now = now._replace(turn_rad=true.heading - odometry.heading)
            ns = now.stamp_ns
            told = {"last_position": now, "last_report_ns": ns, "interval_ns": round(SECOND / hz)}
            known[name] = replace(known[name], **told)
            known = dict(with_pairs(known, name))
    return known


def mean(records: Records, name: str, other: str) -> MeanOffset:
    return differences(records, name)[other]


# Pairs --------------------------------------------------------------------------------------------


def test_without_noise_the_difference_is_that_of_the_errors_of_both() -> None:
    records = drive({"a": (0.1, -0.2, 0.03), "b": (0.4, 0.3, 0.03)}, is_noisy=False)
    found = mean(records, "b", "a")
    assert (found.x, found.y) == pytest.approx((0.3, 0.5), abs=1e-9)
    back = mean(records, "a", "b")
    assert (back.x, back.y) == pytest.approx((-0.3, -0.5), abs=1e-9)


@pytest.mark.parametrize("hz", [0.7, 1.0, 2.0, 10.0])
def test_correct_senders_differ_by_no_more_than_their_noise(hz: float) -> None:
    """The chi-square of the mean is at most 2 on average at any rate, and never a contradiction:
    odometry counts with at least a fifth of each distance."""
    values = []
    for seed in range(40):
        records = drive({"a": (0.0, 0.0, 0.03), "b": (0.0, 0.0, 0.06)}, hz=hz, seed=seed)
        found = mean(records, "b", "a")
        values.append(found.covariance.mahalanobis_squared(found.x, found.y))
    assert 0.3 < sum(values) / len(values) < 2.6
    assert max(values) < CONFLICT


@pytest.mark.parametrize("hz", [1.0, 2.0])
def test_a_sender_that_is_20_cm_off_is_found_within_six_seconds(hz: float) -> None:
    for seed in range(10):
        senders = {"a": (0.0, 0.0, 0.02), "b": (0.2, 0.0, 0.02)}
        records = drive(senders, seconds=6.0, hz=hz, seed=seed)
        assert contradicts(ORIGIN, mean(records, "b", "a"))


def test_each_report_is_in_one_pair() -> None:
    pose, sums = Pose2(0.0, 0.0, TURNED), FadingOffsets()
    first, second, third = (report(t, pose, Pose2(0.0, 0.0, 0.0), 0.03) for t in (1.0, 1.1, 1.2))
    sums = with_pair(sums, first, second)
    assert sums.reports == 1.0
    assert with_pair(sums, second, third) is sums
    assert with_pair(sums, first, third) is sums


def test_no_pair_is_of_reports_before_and_after_a_gap_or_a_long_time() -> None:
    pose, none = Pose2(0.0, 0.0, TURNED), FadingOffsets()
    late_s = 1.1 + LONGEST_PAIR_NS * 1e-9
    first, second, late = (report(t, pose, Pose2(0.0, 0.0, 0.0), 0.03) for t in (1.0, 1.5, late_s))
    assert with_pair(none, first, second._replace(gaps=1)) is none
    assert with_pair(none, first, late) is none
    assert with_pair(none, second, first) is none
    assert with_pair(none, first, second) is not none


def test_an_uncertain_heading_counts_where_the_robot_drove_between_two_reports() -> None:
    start, end = Pose2(0.0, 0.0, TURNED), step(Pose2(0.0, 0.0, TURNED), 0.5, 0.0)
    first = report(1.0, start, Pose2(0.0, 0.0, 0.0), 0.03)
    second = report(2.0, end, Pose2(0.5, 0.0, 0.0), 0.03)
    vague = second._replace(turn_variance=0.2**2)
    certain, doubted = (
        with_pair(FadingOffsets(), first, now).mean(1.0, least=1.0) for now in (second, vague)
    )
    assert certain is not None
    assert doubted is not None
    added = doubted.covariance.xx - certain.covariance.xx
    assert added == pytest.approx(0.25 * 0.2**2, rel=1e-6)


def test_what_all_reports_have_in_common_does_not_average_away() -> None:
    pose, sums = Pose2(0.0, 0.0, TURNED), FadingOffsets()
    common = Covariance2(0.05**2, 0.0, 0.05**2)
    for i in range(40):
        first, second = (
            report(i + t, pose, Pose2(0.0, 0.0, 0.0), 0.01)._replace(dependent=common)
            for t in (0.1, 0.2)
        )
        sums = with_pair(sums, first, second)
    found = sums.mean(1.0, least=LEAST_PAIRS)
    assert found is not None
    assert 0.9 * 0.05**2 * 2.0 < found.covariance.xx < 1.1 * 0.05**2 * 2.0 + 0.01**2


def test_one_outlier_is_no_contradiction() -> None:
    pose, sums = Pose2(0.0, 0.0, TURNED), FadingOffsets()
    for i in range(6):
        first = report(i + 0.1, pose, Pose2(0.0, 0.0, 0.0), 0.03)
        second = report(i + 0.2, pose, Pose2(0.0, 0.0, 0.0), 0.03, 3.0 if i == 3 else 0.0)
        sums = with_pair(sums, first, second)
    found = sums.mean(1.0, least=LEAST_PAIRS)
    assert found is not None
    assert found.covariance.mahalanobis_squared(found.x, found.y) < CLEAR


# Records ------------------------------------------------------------------------------------------


def test_two_that_report_often_are_not_compared_directly() -> None:
    records = drive({"a": (0.0, 0.0, 0.03), "b": (1.0, 0.0, 0.03)})
    now_ns = records["b"].last_report_ns
    assert set(positions_about(records, "a", now_ns)) == {"b"}
    records = {n: replace(record, interval_ns=SECOND // 10) for n, record in records.items()}
    assert positions_about(records, "a", now_ns) == {}


def test_those_in_quarantine_and_old_differences_do_not_count() -> None:
    records = drive({"a": (0.0, 0.0, 0.03), "b": (1.0, 0.0, 0.03)})
    now_ns = records["b"].last_report_ns
    blamed = replace(records["b"], reason=QuarantineReason.BIASED)
    assert positions_about({**records, "b": blamed}, "a", now_ns) == {}
    assert positions_about(records, "a", now_ns + 11 * SECOND) == {}


def test_senders_that_contradict_one_know_how_they_differ_from_each_other() -> None:
    records = drive({"a": (1.0, 0.0, 0.03), "b": (0.0, 0.0, 0.03), "c": (0.0, 0.0, 0.03)})
    found = positions_about(records, "a", records["c"].last_report_ns)
    assert all(contradicts(ORIGIN, found[name]) for name in "bc")
    assert not contradicts(found["b"], found["c"])
    assert set(found["b"].apart) == {"a", "c"}


def test_guests_are_in_no_pair() -> None:
    """Anybody may come as very many of them."""
    guest = SenderRecord(is_guest=True)
    records = drive(
        {"a": (0.0, 0.0, 0.03), "g": (1.0, 0.0, 0.03)}, records={"a": SenderRecord(), "g": guest}
    )
    assert all(not record.pairs for record in records.values())


def test_the_number_of_pairs_of_a_sender_is_bounded() -> None:
    senders = {f"r{i:02}": (0.0, 0.0, 0.03) for i in range(2 * MOST_PARTNERS)}
    records = drive(senders, seconds=3.0)
    found = [len(differences(records, name)) for name in senders]
    assert max(found) <= 2 * MOST_PARTNERS
    assert sum(len(record.pairs) for record in records.values()) <= len(senders) * MOST_PARTNERS


def test_a_robot_that_was_lost_forgets_its_pairs() -> None:
    """Its heading was wrong, and with it the way between two reports."""
    records = without_pairs(drive({"a": (0.0, 0.0, 0.03), "b": (0.0, 0.0, 0.03)}))
    assert differences(records, "a") == differences(records, "b") == {}
    assert without_pairs(records) is records


def test_one_that_reports_often_is_quarantined_by_two_that_report_rarely() -> None:
    """These have no mean of offsets that convicts it: it was suspected for ever, and by test 1 it
    had a correct one quarantined."""
    often = MeanOffset(0.0, 0.0, Covariance2(1e-4, 0.0, 1e-4))
    records = drive({"a": (0.0, 0.0, 0.03), "b": (0.0, 0.0, 0.03), "c": (0.5, 0.0, 0.03)})
    records = {**records, "c": replace(records["c"], means=(often, often))}
    last = records["c"].last_position
    assert last is not None
    for after_s in (0.1, 0.7):
        now_ns = last.stamp_ns + round(after_s * SECOND)
        now = TeammateReport(now_ns, AGREES, position=last._replace(stamp_ns=now_ns))
        decision = assess(records, "c", now, 0, RULES)
        assert not decision.trusted
        records = decision.senders
    assert decision.quarantined == {"c"}
    assert {name for name, record in records.items() if record.reason} == {"c"}
