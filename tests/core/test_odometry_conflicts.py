"""Distances between reported positions are compared with odometry."""

import math
import random
from collections.abc import Callable

import pytest
from msgspec.structs import replace
from support.core import (
    SECOND,
)
from support.trust import AGREES, CONTRADICTS, MS, RULES, Receiver

from cpcbl_team.geometry import Pose2
from cpcbl_team.reported_tracks import OdometryErrors, ReportedPosition
from cpcbl_team.sender_records import (
    SenderRecord,
    TeammateReport,
    distances_between,
    with_report,
)
from cpcbl_team.trust import assess

Reported = Callable[[float], tuple[float, float]]


@pytest.fixture
def receiver() -> Receiver:
    return Receiver()


def drive(
    receiver: Receiver,
    seconds: float,
    speed_m_s: float = 0.5,
    nis: float | None = None,
    **senders: Reported,
) -> None:
    """The robot drives along x. The senders report its position as functions of the distance."""
    for _ in range(round(10 * seconds)):
        receiver.now_ns += 100 * MS
        x = speed_m_s * receiver.now_ns / SECOND
        for name, reported in senders.items():
            odometry = Pose2(5.0, x, 0.5 * math.pi)  # of another frame: distances are compared
            position = ReportedPosition(receiver.now_ns, *reported(x), 0.05**2, odometry)
            receiver.report(name, TeammateReport(receiver.now_ns, nis, (0.0, 0.0), position))


def along(x: float) -> tuple[float, float]:
    return x, 0.0


def jumping(x: float) -> tuple[float, float]:
    return x, 1.5 * (int(x) % 2)


def scattered(sigma_m: float, seed: int = 1) -> Reported:
    rng = random.Random(seed)
    return lambda x: (x + rng.gauss(0.0, sigma_m), rng.gauss(0.0, sigma_m))


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (lambda x: (1.0, 0.0), "frozen"),
        (jumping, "jumps"),
        (scattered(1.0), "overconfident"),
    ],
)
def test_odometry_reveals_a_faulty_only_sender(
    receiver: Receiver, fault: Reported, reason: str
) -> None:
    drive(receiver, 2.0, liar=along)
    drive(receiver, 6.0, liar=fault)
    assert receiver.quarantined == {"liar": reason}
    drive(receiver, RULES.readmit_s - 1.0, liar=along)
    assert receiver.quarantined
    drive(receiver, 2.0, liar=along)
    assert receiver.quarantined == {}  # although no other source confirms it


def test_correct_positions_agree_with_odometry(receiver: Receiver) -> None:
    drive(receiver, 120.0, honest=scattered(0.05), other=scattered(0.02))
    assert receiver.events == []


@pytest.mark.parametrize("stated", [0.25**2, 0.0])
def test_noise_of_the_wheels_that_the_settings_state_is_no_fault_of_a_sender(
    receiver: Receiver, stated: float
) -> None:
    """A blind robot expelled a correct observer as frozen: three times within five seconds its
    wheels had reported twice the distance."""
    dice, read = random.Random(7), 0.0
    for i in range(1, 3000):
        receiver.now_ns = i * 100 * MS
        read += 0.05 + dice.gauss(0.0, 0.25 * math.sqrt(0.05))
        wheels, x = Pose2(read, 0.0, 0.0), 0.05 * i + dice.gauss(0.0, 0.06)
        place = ReportedPosition(
            receiver.now_ns, x, 0.0, 0.06**2, wheels, errors=OdometryErrors(stated)
        )
        receiver.report("honest", TeammateReport(receiver.now_ns, None, (0.0, 0.0), place))
    assert bool(receiver.events) is not bool(stated)


def test_a_scale_of_the_wheels_that_may_be_off_is_no_fault_of_a_sender() -> None:
    then, now = (ReportedPosition(i, 5.0 * i, 0.0, 4e-4, Pose2(6.0 * i, 0.0, 0.0)) for i in (0, 1))
    *_, sigma = distances_between(then, now._replace(errors=OdometryErrors(share=0.2)))
    *_, exact = distances_between(then, now)
    assert sigma**2 - exact**2 == pytest.approx((0.2 * 6.0) ** 2)


def test_a_standing_robot_takes_no_sender_for_frozen(receiver: Receiver) -> None:
    drive(receiver, 60.0, speed_m_s=0.0, honest=along)
    assert receiver.events == []


def test_odometry_that_all_senders_contradict_quarantines_nobody(receiver: Receiver) -> None:
    """The robot is stuck and its wheels spin, so all senders report that it stands."""
    drive(receiver, 20.0, a=lambda x: (0.0, 0.0), b=lambda x: (0.1, 0.0))
    assert receiver.events == []


def test_a_single_jump_does_not_quarantine(receiver: Receiver) -> None:
    """The observer has found its pose again, or the robot was carried away."""
    drive(receiver, 5.0, honest=along)
    drive(receiver, 20.0, honest=lambda x: (x + 3.0, 0.0))
    assert receiver.events == []


def test_conflicts_fade_at_any_rate_of_reports(receiver: Receiver) -> None:
    """Conflicts fade with time, also by sightings, which contain no distance."""
    record = SenderRecord(last_report_ns=0, odometry_conflicts=2.0, comparisons=20.0)
    left = 2.0 * math.exp(-3.0)
    for count in (1, 30, 300):
        faded = record
        for i in range(1, count + 1):
            faded = with_report(
                faded, TeammateReport(30 * SECOND * i // count, AGREES), RULES.limit
            )
        assert faded.odometry_conflicts == pytest.approx(left)


def test_a_sender_in_conflict_with_odometry_does_not_count_against_one_that_is_not() -> None:
    """Of two dissenters only the one without a conflict counts, so the dispute is a tie."""
    now_ns = 10 * SECOND
    dissenter = SenderRecord(
        last_report_ns=now_ns - 1, dispute_since_ns=9 * SECOND, score=40.0, mean_offset=(1.0, 0.0)
    )
    senders = {
        "conflicting": replace(dissenter, odometry_conflicts=1.0, last_conflict_ns=8 * SECOND),
        "other": dissenter,
        "honest": SenderRecord(last_report_ns=now_ns - 1, last_accepted_ns=now_ns - 1),
    }
    decision = assess(
        senders, "other", TeammateReport(now_ns, CONTRADICTS, (1.0, 0.0)), now_ns - 1, RULES
    )
    assert (decision.event, decision.quarantined, decision.trusted) == ("", frozenset(), False)
    senders = {
        **senders,
        "other": replace(dissenter, odometry_conflicts=1.0, last_conflict_ns=8 * SECOND),
    }  # without a dissenter that counts
    decision = assess(
        senders, "other", TeammateReport(now_ns, CONTRADICTS, (1.0, 0.0)), now_ns - 1, RULES
    )
    assert decision.quarantined == {"other"}


@pytest.mark.parametrize(
    ("conflicts", "conflict_s", "outvoted"),
    [(0.6, 5.0, {"liar"}), (0.6, 8.0, set()), (1.6, 5.0, set())],
    ids=["long before", "as it began", "repeated"],
)
def test_one_conflict_long_before_a_dispute_takes_no_vote(
    conflicts: float, conflict_s: float, outvoted: set[str]
) -> None:
    """One distance that odometry contradicted by chance took the vote of one of two correct
    senders, and a liar led a blind robot astray by ten times its error."""
    now_ns = 10 * SECOND
    dissenter = SenderRecord(
        last_report_ns=now_ns - 1, dispute_since_ns=9 * SECOND, score=40.0, mean_offset=(1.0, 0.0)
    )
    senders = {
        "north": replace(
            dissenter, odometry_conflicts=conflicts, last_conflict_ns=round(conflict_s * SECOND)
        ),
        "south": dissenter,
        "liar": SenderRecord(last_report_ns=now_ns - 1, last_accepted_ns=now_ns - 1),
    }
    report = TeammateReport(now_ns, CONTRADICTS, (1.0, 0.0))
    assert assess(senders, "south", report, now_ns - 1, RULES).quarantined == outvoted


def test_odometry_decides_between_two_senders(receiver: Receiver) -> None:
    """The estimate follows a frozen sender, and a correct one contradicts the estimate."""
    for _ in range(30):
        drive(receiver, 0.1, nis=AGREES, frozen=lambda x: (0.0, 0.0))
        receiver.now_ns -= 100 * MS
        drive(receiver, 0.1, nis=CONTRADICTS, honest=along)
    assert "honest" not in receiver.quarantined
    assert "frozen" in receiver.quarantined


def test_a_lost_robot_uses_every_sender_out_of_quarantine(receiver: Receiver) -> None:
    receiver.receive(1.0, a=AGREES, b=AGREES)
    receiver.receive(0.5, a=AGREES, b=CONTRADICTS)  # the dispute is undecided
    for name in ("a", "b"):
        assert receiver.report(name, TeammateReport(receiver.now_ns + 1, None)).trusted


def test_senders_that_a_frozen_one_contradicted_are_released(receiver: Receiver) -> None:
    receiver.receive(3.0, liar=AGREES, honest=AGREES)
    receiver.receive(3.0, liar=AGREES, honest=CONTRADICTS)
    assert receiver.quarantined == {"honest": "biased"}
    drive(receiver, 4.0, liar=lambda x: (0.0, 0.0))
    assert receiver.quarantined == {"liar": "frozen"}
    (decision,) = (d for name, d in receiver.decisions if name == "liar" and d.event)
    assert decision.estimate_error_m == pytest.approx(0.5)  # the offset of the released sender
