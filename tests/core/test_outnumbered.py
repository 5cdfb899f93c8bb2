"""A robot that sees only teammates and is elsewhere: most of them show it, whatever they stated."""

from collections.abc import Sequence

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import LOOP_START, SECOND, driven, frame, localizer, loop, position_error

from cpcbl_team.config import OdometrySettings, Start
from cpcbl_team.disputes import united_majority
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Fix
from cpcbl_team.reported_tracks import ReportedPosition
from cpcbl_team.sender_records import Rival, SenderRecord
from cpcbl_team.state import State, with_senders, with_teammates

AWAY = Pose2(1.5, 1.0, 2.0)  # where the field is, in the robot's belief: it was carried
CARRIED_S, EVERY_S = 10.0, 1.5
NOISE = OdometrySettings(distance_sigma_m_per_sqrt_m=0.05)


class Carried:
    """A robot that drives rounds, sees teammates only, and is carried away. One observer after the
    other sends a fix. Liars go on as if nobody had carried it, or as if somebody had."""

    def __init__(
        self,
        observers: Sequence[str],
        *,
        liars: Sequence[str] = (),
        is_carried: bool = True,
        landmarks_every_s: float = 0.0,
        seconds: float = 16.0,
        seed: int = 1,
        contest_m: float = 0.0,
    ) -> None:
        """`contest_m`: how far another teammate, silent since, contradicted all of them."""
        rng = np.random.default_rng(seed)
        self.robot = localizer(
            odometry=NOISE,
            start=Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.05),
        )
        self.state, self.wrong_s, self.reasons = self.robot.start(0), 0.0, set[str]()
        self.sigmas_m: list[float] = []  # since it was carried
        every, sees_landmarks = round(10 * EVERY_S), landmarks_every_s > 0.0
        for i, (piece, path) in enumerate(driven(LOOP_START, (loop() * 3)[: round(10 * seconds)])):
            is_away = i > 10 * CARRIED_S
            if contest_m and i == 10 * CARRIED_S:
                self.state = contested(self.state, contest_m)
            truth = AWAY @ path if is_away and is_carried else path
            distance = piece.distance_m * (1.0 + 0.05 * rng.normal())
            self.state = self.robot.add_odometry(self.state, replace(piece, distance_m=distance))
            if sees_landmarks and i % round(10 * landmarks_every_s) == 0:
                self.state = self.robot.cycle(self.state, frame(truth, piece.stamp_ns))
            if i % every in (0, 5):
                name = observers[(i // every * 2 + (i % every) // 5) % len(observers)]
                seen = AWAY @ path if name in liars and is_away else truth
                self.state = self.robot.add_fix(self.state, self.fix(name, seen, rng))
            if is_away:
                self.sigmas_m.append(self.state.estimate.position_sigma_m)
            self.truth = truth
            self.reasons.add(self.state.lost)
            if not self.state.lost and position_error(self.state.estimate, truth) > 0.5:
                self.wrong_s += 0.1

    def fix(self, name: str, truth: Pose2, rng: np.random.Generator) -> Fix:
        x, y = truth.x + 0.05 * rng.normal(), truth.y + 0.05 * rng.normal()
        c = 0.0025, 0.0, 0.0025
        return Fix("me", name, self.state.stamp_ns, x, y, c, (1e-4, 0.0, 1e-4))

    @property
    def quarantined(self) -> set[str]:
        senders = self.state.memory.teammates.senders
        return {name for name, record in senders.items() if record.quarantines}


def contested(state: State, by_m: float) -> State:
    """All teammates in a contest with as many that are silent."""
    teammates = state.memory.teammates
    names = [f"silent {name}" for name in teammates.senders]
    rivals = tuple(Rival(name, by_m, 0.0) for name in names)
    senders = {n: replace(record, rivals=rivals) for n, record in teammates.senders.items()}
    silent = SenderRecord(rivals=tuple(Rival(name, -by_m, 0.0) for name in senders))
    senders |= dict.fromkeys(names, silent)
    return with_teammates(state, with_senders(teammates, senders))


@pytest.mark.parametrize("observers", [("a", "b"), ("a", "b", "c"), ("a", "b", "c", "d")])
def test_a_robot_that_is_carried_away_doubts_itself_after_few_reports(
    observers: tuple[str, ...],
) -> None:
    for seed in range(3):
        run = Carried(observers, seed=seed)
        assert run.wrong_s < 5.0  # else 13 reports have to come: 10 s
        assert run.state.counts["gated"] <= 6
        assert position_error(run.state.estimate, run.truth) < 0.4
        assert not run.state.lost
        assert run.quarantined == set()


def test_a_pose_found_in_reports_of_one_side_of_a_contest_is_as_uncertain_as_that() -> None:
    run = Carried("abc", contest_m=0.4)
    assert run.state.counts["found_again"] == 1
    assert position_error(run.state.estimate, run.truth) < 0.4
    assert min(run.sigmas_m[10:]) >= 0.399
    assert min(Carried("abc").sigmas_m[10:]) < 0.2


@pytest.mark.parametrize(
    ("observers", "liars"), [("ab", "b"), ("abc", "c"), ("aaabbb", "b"), ("ababcdcd", "cd")]
)
def test_half_of_them_are_not_enough(observers: Sequence[str], liars: Sequence[str]) -> None:
    for seed in range(3):
        run = Carried(observers, liars=liars, is_carried=False, seed=seed, seconds=25.0)
        assert run.wrong_s == 0.0
        if len(liars) == 1:  # two beside two are contested, and the robot may become lost by that
            assert "lost" not in run.state.counts


def test_a_robot_that_sees_landmarks_believes_these() -> None:
    run = Carried("abc", liars="abc", is_carried=False, landmarks_every_s=4.0, seconds=25.0)
    assert run.reasons == {""}
    assert "lost" not in run.state.counts
    assert run.wrong_s == 0.0


# The majority -------------------------------------------------------------------------------------


def test_who_contradicts_must_agree_on_where_the_robot_is() -> None:
    run = Carried("ab", seconds=CARRIED_S + 2.5)
    senders, now_ns = run.state.memory.teammates.senders, run.state.stamp_ns
    since_ns = max(record.last_agreement_ns for record in senders.values())
    senders = {n: replace(r, last_failure_ns=since_ns - 1) for n, r in senders.items()}
    contradicting = {n: replace(r, last_failure_ns=since_ns + 1) for n, r in senders.items()}
    place = Pose2(0.0, 0.0, 0.0)
    for apart_m, united in ((0.1, ("a", "b")), (1.0, ())):
        reported = {
            name: replace(record, position=ReportedPosition(now_ns, x, 0.0, 0.0025, place))
            for (name, record), x in zip(contradicting.items(), (0.0, apart_m), strict=True)
        }
        assert united_majority(reported, now_ns) == united
    assert united_majority(contradicting, now_ns + 11 * SECOND) == ()
    assert united_majority({"a": contradicting["a"]}, now_ns) == ()  # one alone
    silent = {n: replace(senders[o], last_report_ns=now_ns) for n, o in (("c", "a"), ("d", "b"))}
    against = {n: replace(r, position=None) for n, r in contradicting.items()}
    assert united_majority({**against, "c": silent["c"]}, now_ns) == ("a", "b")
    assert united_majority({**against, **silent}, now_ns) == ()  # two of four are no majority
