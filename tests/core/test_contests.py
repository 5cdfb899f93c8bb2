"""Senders that contradict each other without a decision: both sides count until there is one."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import CORNERS, SECOND, fix, localizer, matrix3
from support.observed_drive import Drive, Observed, correct, faulty
from support.sweeps import sampled
from support.trust import AGREES, RULES

from cpcbl_team.config import Field, Start, Unsurveyed
from cpcbl_team.contests import contest_m, open_rivals
from cpcbl_team.estimate import Covariance3
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2
from cpcbl_team.inflation import inflate_to
from cpcbl_team.inputs import BeliefShared
from cpcbl_team.mean_offsets import FadingOffsets, MeanOffset
from cpcbl_team.own_errors import reset_scores
from cpcbl_team.sender_records import (
    OWN_SENSORS,
    OffsetEvidence,
    QuarantineReason,
    SenderRecord,
    TeammateReport,
    with_report,
)
from cpcbl_team.trust import assess
from cpcbl_team.trust_status import trust_statuses

NOW_NS = 100 * SECOND
Records = dict[str, SenderRecord]


def says(x: float, stamp_ns: int = NOW_NS, sigma: float = 0.01, **more: Any) -> SenderRecord:
    """A sender whose reports have this offset on average."""
    covariance = Covariance2(sigma * sigma, 0.0, sigma * sigma)
    mean = MeanOffset(x, 0.0, covariance, stamp_ns=stamp_ns)
    sums = FadingOffsets(stamp_ns=stamp_ns)
    return SenderRecord(
        stamp_ns, last_agreement_ns=stamp_ns, offsets=(sums, sums), means=(mean, mean), **more
    )


def after_reports(senders: Mapping[str, SenderRecord], now_ns: int = NOW_NS) -> Records:
    """The records after one more report of each that speaks at this time."""
    found = dict(senders)
    for name, record in senders.items():
        if record.last_report_ns == now_ns and name != OWN_SENSORS:
            found = dict(assess(found, name, TeammateReport(now_ns, AGREES), 0, RULES).senders)
    return found


def rivals(senders: Records) -> dict[str, set[str]]:
    return {name: {r.name for r in open_rivals(senders, name)} for name in senders}


def later(senders: Records, silent: str, seconds: float) -> Records:
    """The same records when all but the silent ones have just reported again."""
    now_ns = NOW_NS + round(seconds * SECOND)
    moved = {}
    for name, record in senders.items():
        mean = record.means[0]
        if name not in silent and mean is not None:
            sums, mean = FadingOffsets(stamp_ns=now_ns), mean._replace(stamp_ns=now_ns)
            record = replace(
                record, last_report_ns=now_ns, offsets=(sums, sums), means=(mean, mean)
            )
        moved[name] = record
    return after_reports(moved, now_ns)


TWO_AND_TWO = {"a": says(0.0), "b": says(0.0), "c": says(0.3), "d": says(0.3)}


def test_two_sides_without_a_majority_are_rivals_of_each_other() -> None:
    senders = after_reports(TWO_AND_TWO)
    assert rivals(senders) == {"a": {"c", "d"}, "b": {"c", "d"}, "c": {"a", "b"}, "d": {"a", "b"}}
    assert all(status.contested for status in trust_statuses(senders, NOW_NS))


@pytest.mark.parametrize("seconds", [0.5, 2.0, 5.0, 60.0])
def test_a_side_of_which_one_is_silent_is_no_minority(seconds: float) -> None:
    senders = later(after_reports(TWO_AND_TWO), "b", seconds)
    now_ns = NOW_NS + round(seconds * SECOND)
    assert [senders[n].wrong_ns > 0 for n in "acd"] == [False] * 3
    assert all(senders[n].bias_variance > 0.25**2 for n in "cd")
    assert {s.robot for s in trust_statuses(senders, now_ns) if s.contested} >= set("acd")


def test_where_only_one_side_is_heard_the_estimate_stays_as_uncertain_as_they_differ() -> None:
    senders = later(after_reports({"a": says(0.3), "b": says(0.0)}), "a", 20.0)
    assert contest_m(senders, "b") == pytest.approx(0.3)
    lost = assess(senders, "b", TeammateReport(NOW_NS + 21 * SECOND, None), 0, RULES)
    assert lost.least_sigma_m == pytest.approx(0.3)


def test_a_pose_that_is_found_begins_all_means_anew_and_forgets_no_contest() -> None:
    """They are offsets from an estimate that is no longer the robot's."""
    senders = reset_scores(after_reports(TWO_AND_TWO))
    assert all(record.means == (None, None) for record in senders.values())
    assert rivals(dict(senders))["a"] == {"c", "d"}
    assert contest_m(senders, "a") == pytest.approx(0.3)


def test_a_contest_ends_when_both_agree() -> None:
    senders = after_reports(TWO_AND_TWO)
    agreeing = {name: replace(r, means=says(0.01).means) for name, r in senders.items()}
    assert not any(rivals(after_reports(agreeing)).values())


def test_a_contest_ends_when_one_of_both_is_quarantined_or_found_wrong_by_a_majority() -> None:
    senders = after_reports({"a": says(0.0), "c": says(0.3)})
    assert rivals(senders) == {"a": {"c"}, "c": {"a"}}
    out = {**senders, "c": replace(senders["c"], reason=QuarantineReason.BIASED)}
    assert rivals(out)["a"] == set()
    silent = later(senders, "c", 5.0)
    assert rivals(silent)["a"] == {"c"}
    silent["b"] = says(0.0, NOW_NS + 6 * SECOND)
    assert rivals(later(silent, "c", 6.0))["a"] == set()


def test_own_sensors_decide_a_contest_though_one_side_is_silent() -> None:
    senders = after_reports({"a": says(0.0), "c": says(0.3)})
    senders = {**later(senders, "c", 5.0), OWN_SENSORS: says(0.0, NOW_NS + 5 * SECOND, sigma=0.03)}
    assert rivals(later(senders, "c", 5.0))["a"] == set()


def test_a_sender_too_vague_to_take_a_side_ends_no_contest() -> None:
    senders = after_reports({"a": says(0.0), "c": says(0.15)})
    vague = {**senders, "v": says(0.07, sigma=0.1)}
    assert rivals(after_reports(vague))["a"] == {"c"}


def test_a_majority_decides_a_contest_by_both_means() -> None:
    """Of a sender that reported less of late, the mean of a long time is that of another estimate:
    a blind robot in a contest moved by 0.2 m, and quarantined a correct observer."""
    senders = after_reports(TWO_AND_TWO)
    late = replace(senders["a"], means=(says(0.0).means[0], says(-0.3).means[1]))
    slow = {"b": 0.06, "c": 0.12, "d": 0.12}
    others = {
        n: replace(senders[n], means=(senders[n].means[0], says(x).means[1]))
        for n, x in slow.items()
    }
    for own, is_wrong in ((None, False), (says(0.06, sigma=0.02), True)):
        seen = {} if own is None else {OWN_SENSORS: own}
        found = after_reports({**others, "a": late, **seen})["a"]
        assert (found.wrong_ns > 0) is is_wrong
    assert after_reports({**others, "a": replace(late, rivals=())})["a"].wrong_ns > 0


def test_a_rival_whose_mean_is_no_longer_precise_is_none() -> None:
    """It reports, so nothing has to be remembered of it; a correct one seemed wrong once."""
    senders = after_reports({"a": says(0.0), "c": says(0.4, sigma=0.08)})
    assert rivals(senders)["a"] == {"c"}
    vague = {**senders, "c": replace(senders["c"], means=says(0.4, sigma=0.2).means)}
    assert rivals(after_reports(vague))["a"] == set()


def test_while_a_sender_is_in_dispute_its_reports_have_no_part_in_its_mean() -> None:
    """Test 1 decides the dispute; their mean would make the other side seem wrong meanwhile."""
    evidence = OffsetEvidence((Covariance3(100.0, 0.0, 100.0, 0.0, 0.0, 0.0), (10.0, 0.0, 0.0)))
    report = TeammateReport(NOW_NS, 20.0, (0.1, 0.0), evidence=evidence)
    for score, reports in ((0.0, 1.0), (RULES.limit, 1.0), (RULES.limit + 1.0, 0.0)):
        record = with_report(SenderRecord(NOW_NS - 1, score=score), report, RULES.limit)
        assert record.offsets[0].reports == reports


# In the filter ------------------------------------------------------------------------------------


def drifting(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float]:
    """A liar: its error grows by 2 cm/s from the third second on."""
    x, y = correct(ns, truth, rng)
    return x + 0.02 * max(0.0, ns / SECOND - 3.0), y


def silent_for_a_while(
    ns: int, truth: Pose2, rng: np.random.Generator
) -> tuple[float, float] | None:
    return None if 15 * SECOND < ns < 24 * SECOND else correct(ns, truth, rng)


@pytest.mark.parametrize("seed", sampled(range(2), [1]))
def test_without_a_majority_sigma_holds_though_a_correct_observer_is_silent_for_a_while(
    seed: int,
) -> None:
    observers: dict[str, Observed] = {
        "a": correct,
        "b": silent_for_a_while,
        "c": drifting,
        "d": drifting,
    }
    drive = Drive(observers, seed=seed, rounds=3)
    assert drive.quarantines == {}
    assert drive.inside_3_sigma > 0.95
    assert math.degrees(drive.state.estimate.heading_sigma_rad) < 60.0
    assert "lost" not in drive.state.counts


def test_where_half_are_suddenly_wrong_the_contest_lasts_and_sigma_holds() -> None:
    """Reports in a dispute have no part in a mean, so by their means both halves agreed still, and
    the next report ended the contest: a NEES of 6.5, once with both correct ones in quarantine."""
    observers: dict[str, Observed] = dict.fromkeys("ab", correct)
    observers |= {name: faulty("bias", until_s=100.0) for name in "cd"}
    drive = Drive(observers, seed=3)
    assert drive.state.counts["contested"] == 1
    assert not {"a", "b"} & drive.quarantines.keys()
    assert drive.inside_3_sigma > 0.99
    assert np.mean(drive.nees) < 2.0


@pytest.mark.parametrize("field", [CORNERS, Field(unsurveyed={"mast": Unsurveyed()})])
def test_precise_reports_in_a_contest_make_no_heading_uncertain_beyond_all_numbers(
    field: Field,
) -> None:
    """Each makes a position certain that the contest makes uncertain again, and covariance
    intersection pays with the heading: after 47 s its variance was no number, and the robot's
    process ended. (Where landmarks have no place on the map, errors are states beside the pose.)"""
    robot = localizer(field=field, start=Start(x_m=0.0, y_m=0.0))
    state = robot.mark_shared(robot.start(0), BeliefShared(0))
    for i in range(1000):
        now_ns = (i + 1) * SECOND // 10
        estimate = inflate_to(state.estimate, 0.5, robot.settings.localizer)
        state = state._replace(estimate=estimate, stamp_ns=now_ns)
        said = fix(0.0, 0.0, now_ns, sensor_m=0.01, observer_m=0.02)
        state = robot.add_fix(state, said)
        covariance, shared = (matrix3(c) for c in state.estimate[1:])
        assert np.isfinite(covariance).all()
        assert math.degrees(state.estimate.heading_sigma_rad) <= 361.0
        assert np.linalg.eigvalsh(covariance)[0] > 0.0
        assert np.linalg.eigvalsh(covariance - shared)[0] > -1e-9
