"""What scenarios make of what was recorded: expectations that hold, and that do not."""

from typing import Any

import pytest
from support.chaos import (
    run_log_of,
    run_of,
    status_at,
    token_appeared,
    token_disappeared,
    tracks_of,
    unmet_checks,
)

from cpcbl_launch.lab.chaos import expectations as expect
from cpcbl_launch.lab.chaos.files import CommandResult, full_disk_checks, read_only_checks
from cpcbl_launch.lab.chaos.machine import MachineLog
from cpcbl_launch.lab.chaos.memory import (
    ProcessLife,
    ProcessSample,
    memory_checks,
    process_lives,
)
from cpcbl_launch.lab.chaos.schedule import PlannedFault
from cpcbl_launch.lab.chaos.soak import soak_checks

AT_S = 10.0
GOOD = run_log_of([tracks_of("a"), tracks_of("b")])


# Processes ----------------------------------------------------------------------------------------

KILLED = [
    token_appeared(0.0, "a"),
    token_appeared(0.0, "b"),
    token_disappeared(10.1, "a"),
    token_appeared(11.0, "a", "2"),
]


def test_a_killed_robot() -> None:
    good = run_log_of([tracks_of("a", silent=(10.0, 11.0)), tracks_of("b")], KILLED)
    assert not unmet_checks(expect.kill(run_of(good, "a", 13.0, incarnation="1")))
    never_back = run_log_of([tracks_of("a", silent=(10.0, 99.0)), tracks_of("b")], KILLED[:2])
    assert unmet_checks(expect.kill(run_of(never_back, "a", 13.0, incarnation="1"))) >= {
        "its token disappeared after",
        "a new process started after",
        "from then until it was localized",
        "RMSE afterwards, worst robot",
    }
    others_stop = run_log_of([tracks_of("a"), tracks_of("b", silent=(10.5, 12.5))], KILLED)
    assert unmet_checks(expect.kill(run_of(others_stop, "a", 13.0, incarnation="1"))) == {
        "others' longest gap between tracks"
    }


def test_a_killed_router() -> None:
    tokens = [token_appeared(12.0, "a"), token_appeared(12.0, "b")]
    said = [status_at("a", 13.0), status_at("a", 20.0, {"messages_received": 30})]
    tracks = [tracks_of("a", silent=(10.0, 12.0)), tracks_of("b", silent=(10.0, 12.0))]
    good = run_log_of(tracks, tokens, said)
    assert not unmet_checks(expect.kill_router(run_of(good, "router", 13.0, 21.0)))
    bad = run_log_of([tracks_of("a", silent=(10.0, 18.0)), tracks[1]], tokens[:1], said[:1])
    assert unmet_checks(expect.kill_router(run_of(bad, "router", 13.0, 21.0))) == {
        "longest gap between tracks",
        "robots with a token at the new router",
        "help received in the 8 s after",
    }


def test_a_killed_field() -> None:
    wrong_for_a_while = [tracks_of(n, lambda s: 2.0 if 11.0 < s < 14.0 else 0.02) for n in "ab"]
    good = expect.kill_field(run_of(run_log_of(wrong_for_a_while), "field", 16.0, restarted_s=11.0))
    assert not unmet_checks(good)
    stuck = run_log_of([tracks_of("a"), tracks_of("b", lambda s: 2.0 if s > 11.0 else 0.02)])
    assert unmet_checks(expect.kill_field(run_of(stuck, "field", 16.0, restarted_s=11.0))) >= {
        "from then until all were localized",
        "RMSE afterwards, worst robot",
    }


def test_a_frozen_robot() -> None:
    tokens = [
        token_appeared(0.0, "a"),
        token_appeared(0.0, "b"),
        token_disappeared(12.0, "a"),
        token_appeared(15.2, "a"),
    ]
    tracks = [tracks_of("a", silent=(10.0, 15.0)), tracks_of("b")]
    assert not unmet_checks(expect.freeze(run_of(run_log_of(tracks, tokens), "a", 15.0)))
    burst = [h._replace(at_s=15.1) if 10.0 <= h.at_s < 14.0 else h for h in tracks_of("a")]
    led_astray = tracks_of("b", lambda s: 0.8 if 15.0 < s < 17.0 else 0.02)
    bad = run_log_of([sorted(burst, key=lambda h: h.at_s), led_astray], tokens[:2])
    assert unmet_checks(expect.freeze(run_of(bad, "a", 15.0))) == {
        "its token disappeared after",
        "tracks that arrived more than 1 s late",
        "others' largest error in the 4 s after it woke",
    }


# Networks -----------------------------------------------------------------------------------------


def test_a_partition() -> None:
    near_tokens = [
        token_appeared(0, "far"),
        token_disappeared(12.0, "far"),
        token_appeared(20.5, "far"),
    ]
    far_tokens = [
        token_appeared(0, "near"),
        token_disappeared(12.0, "near"),
        token_appeared(20.5, "near"),
    ]
    both = [tracks_of("near"), tracks_of("far")]
    helped = [status_at("far", 21.0, heard=[("near", 20.6)])]
    near, far = run_log_of(both, near_tokens), run_log_of(both, far_tokens, helped)
    assert not unmet_checks(
        expect.partition(run_of(near, "far-router", 20.0, far=["far"], far_log=far))
    )
    late = run_log_of(both, [*near_tokens[:2], token_appeared(26.0, "far")])
    stopped = run_log_of([both[0], tracks_of("far", silent=(11.0, 19.0))], far_tokens)
    assert unmet_checks(
        expect.partition(run_of(late, "far-router", 20.0, far=["far"], far_log=stopped))
    ) == {
        "far side's longest gap between tracks",
        "from healing to all tokens back",
        "from healing to the first help",
    }


def test_a_cut_link() -> None:
    tokens = [token_appeared(0, "a"), token_disappeared(12.0, "a"), token_appeared(20.5, "a")]
    good = run_log_of([tracks_of("a", silent=(10.0, 20.0)), tracks_of("b")], tokens)
    assert not unmet_checks(expect.cut_link(run_of(good, "a", 20.0)))
    bad = run_log_of([tracks_of("a", silent=(10.0, 30.0)), tracks_of("b")], tokens[:1])
    assert unmet_checks(expect.cut_link(run_of(bad, "a", 20.0))) == {
        "its token disappeared after",
        "from healing to its token back",
        "from healing until it was localized",
    }


def test_an_impaired_link() -> None:
    said = [status_at("a", 9.0), status_at("a", 20.0, {"messages_received": 50})]
    good = run_log_of([tracks_of("a", late_s=0.5), tracks_of("b")], (), said)
    assert not unmet_checks(expect.bad_link(run_of(good, "a", 25.0)))
    bad = run_log_of([tracks_of("a", late_s=3.0), tracks_of("b", late_s=0.9)])
    assert unmet_checks(expect.bad_link(run_of(bad, "a", 25.0))) == {
        "its tracks' delay, 99th percentile",
        "help messages that it received",
        "others' delay, 99th percentile",
    }


# Inputs -------------------------------------------------------------------------------------------


def test_duplicates() -> None:
    said = [status_at("a", 9.0), status_at("a", 20.0, {"duplicate": 60, "too_late": 25})]
    good = run_log_of([tracks_of("a"), tracks_of("b")], (), said)
    assert not unmet_checks(expect.duplicates(run_of(good, "a", 23.0, 25.0, sent=300)))
    assert unmet_checks(expect.duplicates(run_of(GOOD, "a", 23.0, 25.0, sent=300))) == {
        "counted as duplicate",
        "counted as too late",
    }


def test_a_flood() -> None:
    assert not unmet_checks(expect.flood(run_of(GOOD, "c", 20.0, 30.0, sent=50_000)))
    said = [status_at("a", 9.0), status_at("a", 20.0, {"messages_received": 5000})]
    bad = run_log_of([tracks_of("a", late_s=2.0), tracks_of("b")], (), said)
    assert unmet_checks(expect.flood(run_of(bad, "c", 20.0, 30.0, sent=500))) >= {
        "rate of the flood",
        "most received by one robot",
        "others' delay, 99th percentile",
    }


def test_an_abuse() -> None:
    assert not unmet_checks(expect.abuse(run_of(GOOD, "c", 20.0, 30.0, sent=1)))
    silent = run_log_of([tracks_of("a", silent=(12.0, 12.8)), tracks_of("b", lambda s: 0.35)])
    assert unmet_checks(expect.abuse(run_of(silent, "c", 20.0, 30.0))) == {
        "what the abuse sent",
        "others' longest gap between tracks",
        "others' worst RMSE",
        "RMSE afterwards, worst robot",
    }


# Files --------------------------------------------------------------------------------------------

TABLE = "errors of position\nnavigator 1\nobserver 1\nscout 1\npatrol 1\n"
LOST = "".join(f"cpcbl-team: /d/{n}: not written: No space left\n" for n in ("r", "p"))
OUTPUT = CommandResult(
    (), 1, "", "cpcbl-team: standard output: not written: No space left on device\n"
)


def test_a_full_disk() -> None:
    assert not [
        c.what
        for c in full_disk_checks(CommandResult((), 1, TABLE, LOST), ("r", "p", "p"), OUTPUT)
        if not c.is_met
    ]
    silent = CommandResult((), 0, "", "Traceback (most recent call last)")
    assert unmet_checks(full_disk_checks(silent, ("r", "p", "p"), OUTPUT)) == {
        "robots in the report on the terminal",
        "lines that name a lost file",
        "exit code",
        "tracebacks",
    }


def test_a_read_only_disk() -> None:
    clear = CommandResult((), 2, "", "cpcbl-team: --record /d/x: Read-only file system\n")
    assert not unmet_checks(read_only_checks({"--record": clear}))
    thrown = CommandResult((), 1, "", "Traceback (most recent call last)\nOSError\n")
    assert unmet_checks(read_only_checks({"--record": thrown})) == {
        "options refused with one line of error",
        "commands that ended with exit code 2",
        "tracebacks",
    }


# The world ----------------------------------------------------------------------------------------


def test_a_kidnapped_robot() -> None:
    found = tracks_of("a", lambda s: 3.02 if s >= 13.0 else 0.02, lost=(10.5, 13.0))
    good = run_log_of([found, tracks_of("b")], jump=("a", AT_S, 3.0))
    assert not unmet_checks(expect.kidnap(run_of(good, "a", AT_S)))
    never = run_log_of([tracks_of("a"), tracks_of("b")], jump=("a", AT_S, 3.0))
    assert unmet_checks(expect.kidnap(run_of(never, "a", AT_S))) == {
        "it reported that it was lost after",
        "it was localized after",
        "RMSE afterwards, worst robot",
        "afterwards, NEES",
    }
    blamed = [status_at("b", 30.0, trust=[("a", "jumps")])]
    distrustful = run_log_of([found, tracks_of("b")], (), blamed, jump=("a", AT_S, 3.0))
    assert unmet_checks(expect.kidnap(run_of(distrustful, "a", AT_S))) == {
        "robots that trust all others at the end"
    }
    assert "distance of the kidnapping" in unmet_checks(expect.kidnap(run_of(GOOD, "a", AT_S)))


def test_hidden_landmarks() -> None:
    drifts = tracks_of("a", lambda s: 0.1 if 12.0 <= s < 74.0 else 0.02)
    good = expect.hidden_landmarks(
        run_of(run_log_of([drifts, tracks_of("b")]), "", 72.0, fault_s=12.0)
    )
    assert not unmet_checks(good)
    overconfident = tracks_of("a", lambda s: 0.6 if s >= 20.0 else 0.02)
    bad = expect.hidden_landmarks(
        run_of(run_log_of([overconfident, tracks_of("b")]), "", 72.0, fault_s=12.0)
    )
    assert unmet_checks(bad) == {
        "team's worst RMSE",
        "team's NEES",
        "all were localized after",
        "RMSE afterwards, worst robot",
        "afterwards, NEES",
    }


def test_wrong_clocks() -> None:
    found = [status_at(n, 5.0, {"clock_off": 30}, trust=[("w", "clock")]) for n in "ab"]
    tracks = [tracks_of("a"), tracks_of("b"), tracks_of("w")]
    good = run_log_of(tracks, (), found)
    assert not unmet_checks(expect.clock(run_of(good, "w", 30.0, 30.0), "r"))
    unnoticed = run_log_of(tracks, (), [status_at("a", 5.0, trust=[("r", "clock")])])
    assert unmet_checks(expect.clock(run_of(unnoticed, "w", 30.0, 30.0), "r")) == {
        "robots that report that its clock is wrong",
        "last of these reports at",
        "refused help messages from it",
        "robots that report that r's clock is wrong",
    }


def test_a_faulty_robot() -> None:
    tracks = [tracks_of("a"), tracks_of("b"), tracks_of("w")]
    said = [status_at(n, 14.0, trust=[("w", "biased")]) for n in "ab"]
    healed = [status_at(n, 40.0, trust=[("w", "")]) for n in "ab"]
    good = run_log_of(tracks, (), [*said, *healed])
    assert not unmet_checks(expect.faulty_robot(run_of(good, "w", 25.0), ["a", "b"]))
    harmed = [tracks_of("a", lambda s: 0.5), *tracks[1:]]
    bad = run_log_of(harmed, (), [said[0]])
    assert unmet_checks(expect.faulty_robot(run_of(bad, "w", 25.0), ["a", "b"])) == {
        "robots that quarantined it",
        "quarantined by two robots after",
        "worst RMSE during the fault",
        "others' worst RMSE",
        "others' NEES",
        "robots that still distrust it 20 s later",
    }


# Soak ---------------------------------------------------------------------------------------------


def samples(
    process: str, mib_a_minute: float, seconds: float = 400.0
) -> dict[tuple[str, int], list[ProcessSample]]:
    times_s = [5.0 * n for n in range(int(seconds / 5.0))]
    return {(process, 7): [ProcessSample(s, 30.0 + mib_a_minute * s / 60.0, 20) for s in times_s]}


def test_a_process_life_is_computed_from_its_samples() -> None:
    (life,) = process_lives(samples("field", 1.2))
    assert life.mib_a_minute == pytest.approx(1.2, rel=0.01)
    assert life.end_mib - life.start_mib == pytest.approx(1.2 * (395 - 40) / 60, rel=0.05)
    assert process_lives(samples("field", 1.2, seconds=60.0)) == []


def test_a_soak() -> None:
    assert not unmet_checks(soak_checks(run_of(GOOD, "", 25.0, fault_s=20.0), 0, 0))
    stuck = run_log_of([tracks_of("a"), tracks_of("b", lambda s: 2.0)])
    assert unmet_checks(soak_checks(run_of(stuck, "", 25.0, fault_s=20.0), 1, 1)) >= {
        "processes that ended without being killed",
        "tracebacks in logs",
        "from the last fault until all were localized",
    }


def test_a_robot_that_is_certain_of_a_wrong_position_between_faults_fails_a_soak() -> None:
    wrong = run_log_of([tracks_of("a"), tracks_of("b", lambda s: 0.6 if 40 < s < 50 else 0.0)])
    run = run_of(wrong, "", 65.0, fault_s=60.0)
    what = "longest claim that was false by 5 σ"
    assert unmet_checks(soak_checks(run, 0, 0)) == {what}
    elsewhere = PlannedFault("kill", "field", 39.0, 39.0)
    assert not unmet_checks(soak_checks(run, 0, 0, [elsewhere]))
    assert unmet_checks(soak_checks(run, 0, 0, [elsewhere._replace(target="a")])) == {what}


FLAT = process_lives(samples("field", 0.01) | samples("up", 0.0))


def test_memory_is_flat_in_every_process_that_is_to_be_judged() -> None:
    assert not unmet_checks(memory_checks(FLAT, ["field", "up"]))
    leaking = [*FLAT, ProcessLife("robot-a", 400.0, 30.0, 45.0, 2.0, 30, 0.6)]
    assert unmet_checks(memory_checks(leaking, ["field", "up", "router"])) == {
        "processes that ran too shortly to judge their memory",
        "largest growth of memory",
        "steepest growth in the second half of a life of 300 s",
        "largest growth of the number of open files",
    }
    assert "largest growth of memory" in unmet_checks(memory_checks([], []))


def test_buffers_that_fill_are_no_growth_of_a_long_life() -> None:
    filling = {("up", 1): [ProcessSample(at, min(at, 300.0) / 30.0, 9) for at in range(0, 1200, 5)]}
    growing = {("up", 1): [ProcessSample(at, at / 90.0, 9) for at in range(0, 1200, 5)]}
    assert not unmet_checks(memory_checks([*FLAT, *process_lives(filling)], ["up"]))
    steep = {"steepest growth in the second half of a life of 300 s"}
    assert unmet_checks(memory_checks([*FLAT, *process_lives(growing)], ["up"])) == steep


def test_a_robot_that_finds_no_place_at_the_router_while_it_is_abused() -> None:
    besieged: dict[str, Any] = {
        "victim": "a",
        "killed_s": AT_S,
        "incarnation": "1",
        "sent": 9,
        "router_mib": 60.0,
    }
    back = run_log_of([tracks_of("a", silent=(10.0, 12.0)), tracks_of("b")], KILLED)
    assert not unmet_checks(expect.rejoin(run_of(back, "", 20.0, **besieged)))
    out = run_log_of([tracks_of("a", silent=(10.0, 19.0)), tracks_of("b")], KILLED[:3])
    assert unmet_checks(expect.rejoin(run_of(out, "", 20.0, **besieged))) == {
        "a was back with a token after"
    }
    heavy = run_of(back, "", 20.0, **besieged | {"router_mib": 300.0})
    assert unmet_checks(expect.rejoin(heavy)) == {"growth of the router's memory"}


def test_an_abuse_that_silences_others_for_half_a_second_and_more() -> None:
    for until_s, unmet in ((10.4, set()), (10.7, {"others' longest gap between tracks"})):
        log = run_log_of([tracks_of("a"), tracks_of("b", silent=(10.0, until_s))])
        assert unmet_checks(expect.abuse(run_of(log, "a", 20.0, sent=9))) == unmet


def test_what_the_machine_adds_to_a_return_does_not_count() -> None:
    arrivals_s = (*(0.1 * n for n in range(100)), *(13.0 + 0.1 * n for n in range(100)))
    seldom = MachineLog(arrivals_s, (0.0,) * len(arrivals_s))
    run = run_of(GOOD._replace(machine=seldom), "a", AT_S)
    assert expect.check_back(run, "back after", 7.5, AT_S).is_met
    assert not expect.check_back(run, "back after", 9.0, AT_S).is_met
    assert not expect.check_back(run, "back after", None, AT_S).is_met
