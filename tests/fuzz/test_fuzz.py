"""Meaningless payloads on every key: no process ends, and every payload is counted by its reason.

`make fuzz` runs all of it; `make test` runs it with few payloads.
"""

import pytest
from fuzz.fuzzer import (
    TO_EACH,
    TO_FIELD,
    TO_PEOPLE,
    TOKENS,
    VICTIM,
    FinalCounts,
    SentCounts,
    fuzz,
    fuzz_checks,
    victim_checks,
)
from fuzz.payloads import valid_payload
from support.chaos import run_log_of, tracks_of, unmet_checks

from cpcbl_launch.lab.chaos.machine import MachineLog
from cpcbl_launch.lab.chaos.scenario import ScenarioOptions
from cpcbl_transport import topics


@pytest.mark.long
@pytest.mark.timeout(1200)
@pytest.mark.parametrize(
    ("seed", "to_each"),
    [pytest.param(3, 1_800, id="300-a-key-of-the-victim"), pytest.param(1, TO_EACH, id="all")],
)
def test_every_payload_is_counted_and_the_team_continues(seed: int, to_each: int) -> None:
    checks = list(fuzz(ScenarioOptions(seed=seed), to_each).checks)
    print("\n".join(map(str, checks)))  # noqa: T201
    assert [str(check) for check in checks if not check.is_met] == []


def test_a_victim_that_hardly_works_is_noticed() -> None:
    calm = MachineLog(tuple(0.1 * n for n in range(900)), (0.01,) * 900)
    works = run_log_of([tracks_of(VICTIM)])._replace(machine=calm)
    assert not unmet_checks(victim_checks(works, 10.0, 60.0))
    stalls = run_log_of([tracks_of(VICTIM, silent=(20.0, 40.0))])._replace(machine=calm)
    assert unmet_checks(victim_checks(stalls, 10.0, 60.0)) == {
        "victim's longest gap between tracks",
        "victim's rate of tracks beside a robot without a fault",
    }


def test_every_topic_with_a_payload_is_fuzzed() -> None:
    """But places of landmarks, whose keys a robot no longer subscribes to once it has taken one:
    tests/agents/test_landmark_sharing.py sends any bytes there."""
    fuzzed = {topics.FIX, topics.BELIEF, *topics.INPUTS, *TO_PEOPLE, *TO_FIELD}
    carrying = {topic for topic in topics.TOPICS if topic.carries is not None}
    assert fuzzed == carrying - {topics.LANDMARK}
    for topic in fuzzed:
        assert valid_payload(topic, "victim", "mate", 5_000_000_000)


SENT = SentCounts(
    help=100,
    inputs=60,
    commands=30,
    no_messages=80,
    no_statuses=25,
    no_looks=20,
)
COUNTED = FinalCounts(
    after_help={"garbage": 90, "messages_received": 10, "sightings": 7},
    victim={
        "garbage": 110,
        "messages_received": 10,
        "sightings": 20,
        "bad_token": TOKENS,
        "frame_skipped": 15,
        "no_camera": 5,
    },
    field={"garbage": 20, "not_its_own": 10, "drive": 500},
    recorder={"garbage": 60, "track": 10},
    watcher={"garbage": 25},
    looks={"garbage": 20},
    restarts=0,
    tracebacks=0,
    traffic_exit=0,
)


def test_fuzzed_payloads_are_all_counted() -> None:
    assert not unmet_checks(fuzz_checks(SENT, COUNTED))


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"restarts": 1}, "processes that ended"),
        ({"tracebacks": 2}, "tracebacks in logs"),
        ({"after_help": {"garbage": 80}}, "fixes and beliefs counted"),
        ({"victim": {**COUNTED.victim, "garbage": 100}}, "inputs counted"),
        ({"victim": {**COUNTED.victim, "frame_skipped": 14}}, "inputs counted"),
        ({"victim": {**COUNTED.victim, "bad_token": 3}}, "malformed tokens counted"),
        ({"field": {"drive": 500}}, "commands refused by the field"),
        ({"recorder": {"garbage": 59}}, "messages refused by the recorder"),
        ({"watcher": {}}, "messages refused by the traffic watcher"),
        ({"looks": {"garbage": 19}}, "messages refused by the subscribers of frames and poses"),
        ({"traffic_exit": 1}, "exit code of `cpcbl-team traffic`"),
    ],
)
def test_a_fuzzed_payload_that_is_missing_is_noticed(change: dict[str, object], what: str) -> None:
    assert what in unmet_checks(fuzz_checks(SENT, COUNTED._replace(**change)))  # type: ignore[arg-type]
