"""The liar of the experiments: what it says in place of the truth, and what a team makes of it."""

import json
import math
from pathlib import Path

import msgspec
import pytest
from support.buses import MS, SECOND, Ear
from support.processes import cpcbl_team

from cpcbl_launch.lab.experiments import liars
from cpcbl_launch.lab.experiments.pictures import draw_liars
from cpcbl_launch.lab.faulty_robot import CLAIM_M, Liar, Lie, LyingBus, lying
from cpcbl_launch.team_file import builtin
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Belief, Fix
from cpcbl_transport import topics
from cpcbl_transport.bus import MemoryHub
from cpcbl_transport.compact import encode_help
from cpcbl_transport.messages import Track, encode

PART = (0.01, 0.0, 0.01)
FIX_KEY = topics.FIX.at(robot="me", tier=2, observer="liar")
BELIEF_KEY = topics.BELIEF.at(tier=2, robot="liar")


def fix(at_s: float, x: float = 1.0, y: float = 2.0) -> Fix:
    return Fix("me", "liar", round(at_s * SECOND), x, y, PART, PART)


def belief(at_s: float, x: float = 1.0) -> Belief:
    return Belief("liar", round(at_s * SECOND), x, 0.0, 0.0, (0.01, 0.0, 0.01, 0.0, 0.0, 0.01))


def liar(text: str) -> Liar:
    return Liar(Lie.parse(text), "liar", 0)


@pytest.mark.parametrize(
    ("text", "lie"),
    [
        ("bias:0.5,-0.5@10-30", Lie("bias", (0.5, -0.5), 10.0, 30.0)),
        ("frozen", Lie("frozen", (), 0.0, math.inf)),
        ("jumps:1.5@3-", Lie("jumps", (1.5,), 3.0, math.inf)),
        ("overconfident:0.3@0-1.5", Lie("overconfident", (0.3,), 0.0, 1.5)),
        ("clock:-0.5", Lie("clock", (-0.5,), 0.0, math.inf)),
    ],
)
def test_a_lie_is_read_from_text(text: str, lie: Lie) -> None:
    assert Lie.parse(text) == lie


@pytest.mark.parametrize(
    "text",
    ["", "nothing", "bias", "bias:1", "bias:a,b", "frozen:1", "jumps:nan", "bias:1,1@x-2", "@1-2"],
)
def test_what_is_no_lie_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(InputError, match="--lie"):
        Lie.parse(text)


def test_before_and_after_its_time_the_truth_is_said() -> None:
    for kind in ("bias:1,1", "frozen", "jumps:1", "overconfident:1", "clock:1"):
        teller = liar(f"{kind}@10-20")
        for at_s in (0.0, 9.9, 20.0, 30.0):
            assert teller.said(fix(at_s)) == fix(at_s)
        assert teller.said(fix(10.0, x=5.0)) != fix(10.0, x=5.0)


def test_each_kind_says_what_it_states() -> None:
    biased = liar("bias:0.5,-0.25").said(fix(1.0))
    assert (biased.x_m, biased.y_m) == (1.5, 1.75)
    late = liar("clock:-0.5").said(fix(1.0))
    assert late == msgspec.structs.replace(fix(1.0), stamp_ns=500 * MS)
    frozen = liar("frozen@1-9")
    frozen.said(fix(0.5))
    assert frozen.said(fix(1.0, x=7.0)).x_m == frozen.said(fix(2.0, x=8.0)).x_m == 1.0
    sure = liar("overconfident:0.3").said(fix(1.0))
    assert isinstance(sure, Fix)
    assert sure.sensor_covariance == (CLAIM_M**2, 0.0, CLAIM_M**2)


def test_jumps_last_two_seconds_and_are_as_far_as_stated() -> None:
    teller = liar("jumps:1.5")
    places = [teller.said(fix(at_s)) for at_s in (0.0, 1.9, 2.0, 3.9)]
    assert places[0].x_m == places[1].x_m != places[2].x_m == places[3].x_m
    assert all(math.hypot(p.x_m - 1.0, p.y_m - 2.0) == pytest.approx(1.5) for p in places)


def test_the_same_liar_tells_the_same_lies() -> None:
    said = [
        [teller.said(fix(0.1 * i)) for i in range(20)]
        for teller in (liar("overconfident:0.3"), liar("overconfident:0.3"))
    ]
    assert said[0] == said[1]


def test_only_fixes_and_beliefs_are_changed_on_their_way_out() -> None:
    hub = MemoryHub()
    ear = Ear(hub.session(), "**")
    bus = lying(Lie.parse("bias:1,0"), "liar", 0)(hub.session())
    assert isinstance(bus, LyingBus)
    track = Track("liar", 0, 1.0, 0.0, 0.0, None, 3)
    with bus:
        for key, payload in (
            (FIX_KEY, encode_help(fix(1.0))),
            (BELIEF_KEY, encode_help(belief(1.0))),
            (topics.TRACK.at(robot="liar"), encode(track)),
        ):
            bus.publisher(key, topics.Qos.FRESH).put(payload)
    assert [getattr(m, "x_m", None) for m in ear.messages] == [2.0, 2.0, 1.0]


def test_without_a_lie_the_bus_is_the_robots_own() -> None:
    bus = MemoryHub().session()
    assert lying(None, "honest", 0)(bus) is bus


def test_a_robot_process_refuses_a_lie_that_is_none() -> None:
    result = cpcbl_team("robot", "patrol", "--team", builtin("demo"), "--lie", "bias:1")
    assert result.returncode == 2
    assert "--lie bias:1: bias takes 2 numbers" in result.stderr


# The experiment -----------------------------------------------------------------------------------

CASES = [
    liars.Case(lie="", liar=False, honest=1),
    liars.Case(lie="bias:0.5,0.5", honest=1),
    liars.Case(lie="bias:0.5,0.5", honest=1, trust=False),
]


@pytest.fixture(scope="module")
def measured() -> liars.Liars:
    return liars.measured(1, 1, lambda: None, CASES)


def test_the_liar_is_found_and_taken_back_and_does_little_harm(measured: liars.Liars) -> None:
    alone, judged, believed = measured.rows
    assert alone.found == alone.false_quarantines == judged.false_quarantines == 0
    assert judged.found == judged.listening == len(liars.DRIVERS)
    assert judged.reasons == {"biased": 3}
    assert judged.found_after_s is not None
    assert judged.found_after_s.high < 2.0
    assert judged.readmitted_after_s is not None
    assert 4.0 < judged.readmitted_after_s.median < 8.0
    assert judged.ratio is not None
    assert judged.ratio.median <= liars.MOST_RATIO
    assert measured.held
    assert believed.found == 0


def test_the_same_seed_gives_the_same_figures(measured: liars.Liars) -> None:
    again = liars.measured(1, 1, lambda: None, CASES[:1])
    assert again.rows[0] == measured.rows[0]


def test_it_is_shown_in_80_columns_and_drawn(
    measured: liars.Liars, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from rich.console import Console

    console = Console(width=80)
    for shown in liars.tables(measured):
        console.print(shown)
    text = capsys.readouterr().out
    assert "bias:0.5,0.5" in text
    assert "…" not in text
    assert all(len(line) <= 80 for line in text.splitlines())
    draw_liars(measured, tmp_path / "liars.png")
    assert (tmp_path / "liars.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads(msgspec.json.encode(measured))["experiment"] == "liars"


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_every_lie_is_found_beside_two_honest_observers() -> None:
    cases = [c for c in liars.cases() if c.honest == 2 and c.trust]
    result = liars.measured(4, 2, lambda: None, cases)
    assert result.held
    for row in result.rows:
        assert row.false_quarantine_s < 1.0
        if row.case.lie and not row.case.lie.startswith("clock:-0.3"):
            assert row.found == row.listening
