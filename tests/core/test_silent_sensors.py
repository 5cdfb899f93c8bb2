"""Own sensors overrule a teammate also while they are silent for some seconds."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import SECOND
from support.observed_drive import Drive, Observed, correct, faulty
from support.trust import AGREES, CONTRADICTS, RULES, Receiver

from cpcbl_team.geometry import Pose2
from cpcbl_team.hypotheses import OLD_FADING_NS, with_faded_gains
from cpcbl_team.reported_tracks import ReportedPosition
from cpcbl_team.sender_records import (
    SILENCE_NS,
    QuarantineReason,
    SenderRecord,
    TeammateReport,
    with_report,
)
from cpcbl_team.silent_sensors import OUTNUMBERED_NS, is_contested, with_own_agreement
from cpcbl_team.trust_status import TrustStatus, trust_statuses
from cpcbl_team.voters import BELIEVED_NS, SenderRecords

OFF_M, FAR_M = 0.6, 3.0
LIAR: dict[str, Observed] = {"liar": faulty("bias", 5.0, 100.0)}
END_S = 52.8  # of the drives


def statuses(drive: Drive) -> dict[str, TrustStatus]:
    senders = drive.state.senders
    return {s.robot: s for s in trust_statuses(senders, drive.state.stamp_ns)}


def test_a_robot_that_sees_no_landmark_does_not_follow_one_teammate_that_contradicts_it() -> None:
    """It was lost after fourteen of these reports, and found its pose in them: 0.6 m off."""
    drive = Drive(LIAR, sees_landmarks=True, hidden_s=(4.0, 100.0))
    assert max(drive.errors) < 0.1
    assert "lost" not in drive.state.counts
    assert drive.quarantines == {}
    assert statuses(drive)["liar"].contested
    more = drive.state.reported.covariance.xx - drive.state.estimate.covariance.xx
    assert math.sqrt(more) > 0.5 * OFF_M  # of what others are told: perhaps it was carried away


def test_its_own_sensors_tell_as_soon_as_they_measure_anything() -> None:
    drive = Drive(LIAR, sees_landmarks=True, hidden_s=(4.0, 14.0))
    assert max(drive.errors) < 0.1
    status = statuses(drive)["liar"]
    assert status.reason == "biased"
    assert status.since_ns < 15 * SECOND
    assert drive.state.reported.position_sigma_m < 0.1


def test_several_teammates_that_agree_are_believed_after_a_while() -> None:
    def carried(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float]:
        x, y = correct(ns, truth, rng)
        return (x + FAR_M, y) if ns >= 5 * SECOND else (x, y)

    drive = Drive({"a": carried, "b": carried}, sees_landmarks=True, hidden_s=(4.0, 100.0))
    until = sum(error < 0.5 * FAR_M for error in drive.errors) / len(drive.errors) * END_S
    assert abs(until - 4.0 - OUTNUMBERED_NS / SECOND) < 1.0
    assert drive.quarantines == {}


def test_one_teammate_is_believed_after_a_minute() -> None:
    silent_ns = BELIEVED_NS - SECOND
    for late_ns, is_used in ((silent_ns, False), (BELIEVED_NS + SECOND, True)):
        receiver = Receiver()
        receiver.senders = with_own_agreement({}, 0)
        for i in range(4):
            now_ns = late_ns + i
            report = TeammateReport(now_ns, CONTRADICTS, (OFF_M, 0.0))
            decision = receiver.report("mate", report)
        assert decision.trusted is is_used


def test_silent_own_sensors_have_a_vote_beside_a_teammate_that_agrees_with_them() -> None:
    """The two teammates were contested, and the robot was as uncertain as they were apart."""

    def newcomer(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float] | None:
        x, y = correct(ns, truth, rng)
        return (x + FAR_M, y) if ns >= 8 * SECOND else None

    drive = Drive({"a": correct, "new": newcomer}, sees_landmarks=True, hidden_s=(4.0, 100.0))
    assert max(drive.errors) < 0.1
    assert drive.quarantines == {"new": 1}
    assert drive.state.estimate.position_sigma_m < 0.1


def test_own_sensors_that_contradict_the_estimate_overrule_nobody() -> None:
    receiver = Receiver()
    receiver.senders = with_own_agreement({}, 0)
    receiver.receive(0.5, own=CONTRADICTS)
    for i in range(4):
        now_ns = receiver.now_ns + i
        report = TeammateReport(now_ns, CONTRADICTS, (OFF_M, 0.0))
        decision = receiver.report("mate", report)
    assert decision.trusted  # the robot was carried away


def test_a_guest_makes_no_robot_uncertain() -> None:
    record = SenderRecord(overruled_ns=SECOND)
    assert is_contested({"mate": record}, "mate", 2 * SECOND)
    assert not is_contested({"mate": replace(record, is_guest=True)}, "mate", 2 * SECOND)


def test_a_contest_with_silent_own_sensors_lasts_while_the_teammate_is_out_of_sight() -> None:
    """A robot that was carried away drove out of sight of the one that said so, and was certain of
    where it was not: 12 % inside 3 sigma."""

    def seen(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float] | None:
        x, y = correct(ns, truth, rng)
        return (x + FAR_M, y) if 5 * SECOND <= ns < 7 * SECOND else None

    drive = Drive({"mate": seen}, sees_landmarks=True, hidden_s=(4.0, 100.0))
    assert drive.state.reported.covariance.xx > 0.4 * FAR_M * FAR_M
    drive = Drive({"mate": seen}, sees_landmarks=True, hidden_s=(4.0, 20.0))
    assert drive.state.reported.position_sigma_m < 0.1  # its own sensors have told


def test_what_own_readings_said_of_earlier_hypotheses_fades() -> None:
    """It was kept for ever, and kept later disputes open: a teammate that was 0.85 m off was used
    for 20 s beside landmarks."""
    drive = Drive({"liar": faulty("bias", 5.0, 15.0), "a": correct}, sees_landmarks=True)
    later = Drive({"liar": faulty("bias", 5.0, 15.0), "a": correct}, sees_landmarks=True, rounds=3)
    found = [d.state.memory.teammates.senders["liar"].behind["a"] for d in (drive, later)]
    more_ns = later.state.stamp_ns - drive.state.stamp_ns
    assert found[1] == pytest.approx(found[0] * math.exp(-more_ns / OLD_FADING_NS), rel=0.01)
    senders: SenderRecords = {"a": SenderRecord(behind={"b": -9.0, "c": 0.4})}
    faded = with_faded_gains(senders, 0, OLD_FADING_NS)["a"].behind
    assert faded == {"b": pytest.approx(-9.0 / math.e)}


def test_old_evidence_keeps_no_dispute_open() -> None:
    for is_compared in (True, False):
        receiver = Receiver()
        receiver.receive(1.0, own=AGREES, mate=AGREES)
        receiver.senders = {**receiver.senders, "mate": SenderRecord(behind={"": -9.0})}
        for _ in range(20):
            receiver.receive(0.1, own=AGREES)
            compared = ("mate",) if is_compared else ()
            at_ns = receiver.now_ns
            about = CONTRADICTS, (OFF_M, 0.0)
            report = TeammateReport(at_ns, *about, compared=compared)
            receiver.report("mate", report)
        assert ("mate" in receiver.quarantined) is not is_compared


def test_a_quarantine_does_not_end_by_what_was_confirmed_before_a_silence() -> None:
    """On a log one ended with the first report after a minute, with an NIS of 105."""
    record = SenderRecord(reason=QuarantineReason.BIASED)
    way = Pose2(1.0, 0.0, 0.0)
    for i, at_ns in enumerate((0, SECOND, 2 * SECOND, 2 * SECOND + SILENCE_NS + 1)):
        odometry = Pose2(i * way.x, 0.0, 0.0)
        position = ReportedPosition(at_ns, 5.0 + i * way.x, 5.0, 0.01, odometry)
        report = TeammateReport(at_ns, CONTRADICTS, (1.0, 1.0), position)
        before, record = record, with_report(record, report, RULES.limit)
    assert before.confirmations == 2
    assert record.confirmations == 0
