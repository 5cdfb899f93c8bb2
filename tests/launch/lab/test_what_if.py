"""What-if beside the truth: a run is recorded, made again with something changed, and really made
with that change."""

from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest
from msgspec.structs import replace
from support.logs import log_team, write_log
from support.paired import World, changed_world, open_loop, pair, simulate_world

from cpcbl_launch.lab.evaluation import evaluate_log
from cpcbl_launch.lab.experiments.mixed_teams import mixed_team
from cpcbl_launch.lab.seeds import Workers
from cpcbl_launch.lab.what_if.changes import Change, with_change
from cpcbl_launch.lab.what_if.comparison import WhatIf, what_if
from cpcbl_launch.lab.what_if.inputs import (
    BUS,
    RecordedInputs,
    Taken,
    inputs_of_log,
    read_inputs,
)
from cpcbl_launch.lab.what_if.rerun import run_again
from cpcbl_launch.lab.what_if.tables import remarks
from cpcbl_launch.reporting.recorder import Report
from cpcbl_launch.run.logged_team import load_logged_team
from cpcbl_team.errors import InputError
from cpcbl_transport.decoding import decode_by_key
from cpcbl_transport.json_messages import encode_json
from cpcbl_transport.messages import Refusal

HERE = Workers(jobs=1)


class Recorded(NamedTuple):
    """A short run of three robots in open loop, with its recording."""

    world: World
    folder: Path
    report: Report
    inputs: RecordedInputs


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Six seconds: r00 guides r01 and r02, which see no landmarks."""
    folder = tmp_path_factory.mktemp("what_if") / "run"
    world = open_loop(World(mixed_team(3, 4), 4, 6.0))
    report = simulate_world(world, folder=folder)
    return Recorded(world, folder, report, read_inputs(folder))


def foretold(world: World, folder: Path, change: Change) -> tuple[WhatIf, Report]:
    """What is foretold of a recorded run, and what really comes."""
    result = what_if(read_inputs(folder), change, where=HERE)
    return result, simulate_world(*changed_world(world, change))


def require_equal(result: WhatIf, truth: Report) -> None:
    assert result.changed is not None
    assert result.changed.robots.keys() == truth.robots.keys()
    for name, robot in truth.robots.items():
        mine = result.changed.robots[name]
        assert mine.rmse_m == robot.position_rmse_m
        assert (mine.messages_sent, mine.bytes_sent) == (robot.messages_sent, robot.bytes_sent)


def test_a_run_is_made_again_to_the_bit(run: Recorded) -> None:
    again = run_again(run.inputs)
    for name, robot in run.report.robots.items():
        assert again.report.robots[name] == robot
        assert robot.messages_sent or name != "r00"


@pytest.mark.parametrize(
    "change",
    [
        Change(without=("r00",)),  # the only helper
        Change(without=("r01",), settings=("robots.r00.collaboration.fusion=naive",)),
        Change(hide=("m0", "m1", "m2", "m3", "m4")),  # all that there are
    ],
    ids=str,
)
def test_what_is_foretold_is_what_really_comes_to_the_bit(run: Recorded, change: Change) -> None:
    result, truth = foretold(run.world, run.folder, change)
    require_equal(result, truth)
    assert run.report.team.position_rmse_m != truth.team.position_rmse_m
    assert result.again.robots["r02"].apart_m == 0.0
    assert not result.control  # nobody drives by an estimate


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("number", range(1, 41))
def test_forty_pairs_are_foretold_to_the_bit(number: int, tmp_path: Path) -> None:
    world, change = pair(number, is_open=True)
    simulate_world(world, folder=tmp_path / "run")
    require_equal(*foretold(world, tmp_path / "run", change))


def test_robots_that_drive_by_their_estimates_are_named(tmp_path: Path) -> None:
    world = World(mixed_team(2, 1), 1, 4.0)
    simulate_world(world, folder=tmp_path)
    result = what_if(
        read_inputs(tmp_path), Change(hide=tuple(world.team.map.landmarks)), where=HERE
    )
    (said,) = [text for text in remarks(result) if text.startswith("r00 drives by its estimate")]
    assert "open loop" in said
    assert result.control["r00"].speed_m_s > 0.0


def test_the_ledger_says_what_each_was_worth(run: Recorded) -> None:
    """Of what nobody saw or sent nothing is made again: its worth is none."""
    inputs = run.inputs.until(run.inputs.start_ns + 2_000_000_000)  # the shortest
    result = what_if(inputs, None, with_ledger=True, where=HERE)
    ledger = {(entry.kind, entry.name): entry for entry in result.ledger}
    assert result.basis == "truth"
    assert {("robot", "r00"), ("sensor", "r02 sightings"), ("message", "belief")} <= ledger.keys()
    for entry in result.ledger:
        assert entry.with_m is not None
        assert entry.without_m is not None
        assert entry.worth_m == entry.without_m - entry.with_m
    blind = what_if(inputs, Change(sensors=(("r00", "sightings"),)), where=HERE)
    assert blind.changed is not None
    assert ledger["sensor", "r00 sightings"].without_m == blind.changed.team.rmse_m
    without = what_if(inputs, Change(without=("r00",)), where=HERE)
    assert without.changed is not None
    assert ledger["robot", "r00"].without_m == without.changed.team.rmse_m
    sent = sum(robot.bytes_sent for robot in result.again.robots.values())
    kilobytes = [ledger["message", kind].kilobytes or 0.0 for kind in ("fix", "belief")]
    assert sum(kilobytes) == pytest.approx(sent * 1e-3)


def test_without_truth_what_is_stated_is_compared(run: Recorded) -> None:
    inputs = run.inputs._replace(truth={})
    result = what_if(inputs, Change(without=("r00",)), where=HERE)
    assert result.basis == "stated sigma"
    assert result.changed is not None
    assert result.changed.team.rmse_m is None
    assert (result.changed.team.sigma_m or 0.0) > 0.0
    assert (result.changed.robots["r01"].apart_m or 0.0) > 0.0


def test_inputs_as_json_are_the_same_inputs(run: Recorded) -> None:
    def as_json(taken: Taken) -> Taken:
        message = decode_by_key(taken.key, taken.payload)
        assert not isinstance(message, Refusal)
        return taken._replace(payload=encode_json(message)) if taken.way == BUS else taken

    processes = [p._replace(taken=tuple(map(as_json, p.taken))) for p in run.inputs.processes]
    inputs = run.inputs._replace(processes=tuple(processes))
    for change in (Change(), Change(hide=("m0", "m1"))):
        mine, theirs = (run_again(with_change(i, change)) for i in (inputs, run.inputs))
        assert mine.report.team.position_rmse_m == theirs.report.team.position_rmse_m


def test_a_process_that_ended_is_gone_until_the_next_one_starts(run: Recorded) -> None:
    """The robot sends and estimates nothing meanwhile; the next one finds its pose."""
    first, *others = run.inputs.processes
    start = first.start
    second_ns = start.stamp_ns + 4_000_000_000
    second = first._replace(
        start=start._replace(stamp_ns=second_ns, incarnation="second"),
        robot_start_ns=second_ns,
        is_pose_given=False,
        restarted=True,
        taken=tuple(t for t in first.taken if t.now_ns >= second_ns),
    )
    end_ns = start.stamp_ns + 2_000_000_000
    first = first._replace(end_ns=end_ns, taken=tuple(t for t in first.taken if t.now_ns <= end_ns))
    again = run_again(run.inputs._replace(processes=(first, second, *others)))
    stamps_ns = again.paths["r00"].stamps_ns - start.stamp_ns
    assert not ((stamps_ns > 2_000_000_000) & (stamps_ns < 4_000_000_000)).any()
    assert stamps_ns.max() > 5_000_000_000
    whole = run_again(run.inputs).report.robots["r00"]
    assert again.report.robots["r00"].lost_share > whole.lost_share


def test_a_log_is_a_run_whose_robots_take_inputs_at_their_stamps(tmp_path: Path) -> None:
    write_log(tmp_path, ("1", "2"), 4.0)
    logged = load_logged_team(log_team("1", "2"), tmp_path)
    inputs = inputs_of_log(logged, "log")
    evaluated = evaluate_log(logged).report
    assert run_again(inputs).report.team == evaluated.team
    result = what_if(inputs, Change(hide=("6",)), where=HERE)
    assert result.recorded is None
    assert result.changed is not None
    assert (result.changed.robots["1"].apart_m or 0.0) > 0.0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (Change(without=("r1",)), "--without r1: the run has no robot of this name; did you mean"),
        (Change(without=("r00", "r01", "r02")), "no robot is left"),
        (Change(hide=("dor",)), "--hide dor: the run has no landmark or wall of this name"),
        (Change(settings=("fusoin=naive",)), "no such key; did you mean fusion?"),
        (Change(settings=("variant=ovall",)), "did you mean 'oval'"),
        (Change(settings=("collaboration=some",)), "write one of none, passive, active, both"),
        (Change(settings=("sensor.range_shar=0.1",)), "did you mean 'range_share'"),
        (Change(settings=("sensor.rate_hz=3",)), "changes nothing in a recorded run"),
        (Change(settings=("simulation.noise=2",)), "changes nothing in a recorded run"),
        (Change(settings=("robots.r9.sensor.delay_s=1",)), "r9: the run has no robot"),
        (Change(settings=("position_sensor.sigma_m=1",)), "there is no position_sensor in this"),
        (Change(settings=("match.messages=-3",)), "expected a whole number >= 0"),
        (Change(settings=("odometry.distance_scale=nan",)), "not a finite number"),
        (Change(settings=("variant",)), "not KEY=VALUE"),
    ],
)
def test_what_cannot_be_changed_is_one_clear_line(run: Recorded, change: Change, said: str) -> None:
    with pytest.raises(InputError) as refused:
        with_change(run.inputs, change)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_setting_of_the_whole_team_or_of_the_map_is_taken(run: Recorded) -> None:
    settings = ("match.messages=7", "map.landmarks.m0.x_m=1.5", "robots.r01.localizer.variant=oval")
    team = with_change(run.inputs, Change(settings=settings)).team
    assert team.match.messages == 7
    assert team.map.landmarks["m0"].x_m == 1.5
    variants = {name: robot.localizer.variant for name, robot in team.robots.items()}
    before = {name: r.localizer.variant for name, r in run.inputs.team.robots.items()}
    assert variants == {**before, "r01": "oval"}
    assert replace(team.robots["r00"]) == run.inputs.team.robots["r00"]


def test_the_result_is_json(run: Recorded) -> None:
    inputs = run.inputs.until(run.inputs.start_ns + 1_000_000_000)
    result = what_if(inputs, Change(settings=("collaboration=none",)), where=HERE)
    read = msgspec.json.decode(msgspec.json.encode(result))
    assert read["change"] == "collaboration=none"
    assert read["changed"]["team"]["messages_sent"] == 0
