"""The word of a robot's state, by worked examples: one for each word, and which is the worst."""

import math
from typing import Any

import pytest
from support.buses import SECOND
from support.traffic import status

from cpcbl_agents.robot_state import RobotState, robot_state
from cpcbl_transport.messages import Status, Track, Trust

STOOD, MIRRORED = "the heading is not confirmed: the robot stood", "bearings look mirrored"
SIGMA = "position sigma 0.7 m"
MISCALIBRATED = {"accepted": 985, "gated": 15, "miscalibrated": 2, "odometry_sigma_percent": 210}


def track(at_s: float, lost: str = "") -> Track:
    return Track("r1", int(at_s * SECOND), 1.0, 2.0, 0.5, None, 3, lost)


def latest(**more: Any) -> Status:
    return status("r1", 10.0, 3, **more)


@pytest.mark.parametrize(
    ("found", "word", "reasons", "severity"),
    [
        (robot_state(latest()), "ok", [], "good"),
        (robot_state(latest(unconfirmed=STOOD)), "unconfirmed", [STOOD], "warning"),
        (robot_state(latest(problems=(MIRRORED,))), "problem", [MIRRORED], "warning"),
        (robot_state(latest(lost=SIGMA)), "lost", [f"lost: {SIGMA}"], "error"),
        (robot_state(latest(), silent_s=2.1), "gone", ["gone: silent for 2 s"], "error"),
        (robot_state(None, is_alive=False), "waiting", ["waiting: nothing was heard"], "warning"),
        # The worst that is known
        (
            robot_state(latest(unconfirmed=STOOD, problems=(MIRRORED,))),
            "problem",
            [MIRRORED, STOOD],
            "warning",
        ),
        (
            robot_state(latest(lost=SIGMA, problems=(MIRRORED,))),
            "lost",
            [f"lost: {SIGMA}", MIRRORED],
            "error",
        ),
    ],
)
def test_each_state_has_its_word_its_reasons_and_its_severity(
    found: RobotState, word: str, reasons: list[str], severity: str
) -> None:
    assert (found.word, list(found.reasons), found.severity) == (word, reasons, severity)
    assert bool(found.why) is (word != "ok")


def test_fixes_that_state_too_little_noise_are_a_problem_if_they_are_many() -> None:
    text = "20 fixes of west state less noise than its sensor has by the team file"
    for number, problems in ((19, ()), (20, (text,))):
        found = robot_state(latest(counts={"overclaimed_west": number}))
        assert found.problems == problems


def test_what_a_robot_says_of_teammates_calibration_and_map_is_a_problem() -> None:
    counts = {**MISCALIBRATED, "misplaced_door": 520, "rejected_door": 14}
    found = robot_state(latest(trust=(Trust("west", "biased"),), counts=counts))
    assert (found.word, found.problems) == (
        "problem",
        (
            "distrusts west (biased)",
            "miscalibrated: σ of its odometry × 2.1, 1.5% of observations rejected",
            "finds door elsewhere than on the map: 0.52 m from there, rejected 14 times of late,"
            " not used",
        ),
    )
    learned = robot_state(latest(counts=MISCALIBRATED, learned=(0.9, 1.0, 0.0)))
    assert learned.why.startswith("miscalibrated: distance × 0.90, turn × 1.00")


@pytest.mark.parametrize(
    ("counts", "text"),
    [
        ({"misplaced_box": 1, "moves_box": 1}, "before: looked for"),
        ({"misplaced_box": 980, "moves_box": 1}, "before: 0.98 m from there"),
        (
            {"misplaced_box": 980, "moves_box": 3},
            "before: 0.98 m from there, 3 times: it moves, or two have this name; not used",
        ),
    ],
)
def test_a_landmark_that_moved_is_named_with_its_numbers(counts: dict[str, int], text: str) -> None:
    assert robot_state(latest(counts=counts)).problems == (f"finds box elsewhere than {text}",)


def test_what_an_observer_finds_comes_first() -> None:
    found = robot_state(latest(problems=(MIRRORED,)), observed=["2 processes have this name"])
    assert found.problems == ("2 processes have this name", MIRRORED)


def test_the_newest_message_says_whether_the_robot_is_lost() -> None:
    assert robot_state(latest(lost=SIGMA), track(10.1)).word == "ok"
    assert robot_state(latest(), track(10.1, SIGMA)).why == SIGMA
    assert robot_state(latest(), track(9.9, SIGMA)).word == "ok"
    assert robot_state(None, track(1.0)).word == "ok"


@pytest.mark.parametrize(
    ("presence", "word", "why"),
    [
        ({"silent_s": 1.9}, "ok", ""),
        ({"silent_s": 5.9, "pause_s": 2.0}, "ok", ""),  # its time runs slowly
        ({"ended_s": 0.4}, "ok", ""),  # it changes its tier
        ({"ended_s": 0.6}, "gone", "its process or its link ended 1 s ago"),
        ({"ended_s": math.inf}, "gone", "its process or its link ended"),
    ],
)
def test_a_robot_is_gone_when_it_is_silent_or_ended(
    presence: dict[str, float], word: str, why: str
) -> None:
    assert robot_state(latest(), **presence)[:2] == (word, why)  # type: ignore[arg-type]


def test_a_robot_that_has_sent_nothing_waits_unless_it_ended() -> None:
    assert robot_state(None).why == "its process runs, but has sent nothing yet"
    assert robot_state(None, ended_s=math.inf).word == "gone"
