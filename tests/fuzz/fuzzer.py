"""A fuzzer on a running team: meaningless payloads on every key of the topic table, over Zenoh.

The robots, the field, the recorder and the watchers must count every payload, each by its reason.
"""

import os
import random
import re
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import NamedTuple

import msgspec
from fuzz.payloads import hypothesis_payloads, mixed_payloads, valid_payload

from cpcbl_launch.lab.chaos.checks import Check, at_least, equal_to
from cpcbl_launch.lab.chaos.expectations import check_gap, checks_recovered, checks_unaffected
from cpcbl_launch.lab.chaos.machine import MachineWatch
from cpcbl_launch.lab.chaos.run_log import TRACKS_HZ, RunLog
from cpcbl_launch.lab.chaos.scenario import FaultRun, ScenarioOptions, ScenarioResult
from cpcbl_launch.lab.chaos.team import (
    FIELD,
    ChaosError,
    RunPlan,
    TeamUnderTest,
    demo_team,
    run_team,
)
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.views.traffic import StatusCollector
from cpcbl_team.config import (
    CollaborationSettings,
    GuardSettings,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
)
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import Subscriber, decode
from cpcbl_transport.messages import AnnotatedFrame, Pose, Refusal, encode
from cpcbl_transport.topics import Topic
from cpcbl_transport.zenoh_bus import open_bus

TO_EACH = 100_000
"""Payloads for each subscriber: the victim, the field, the recorder, watchers."""
TOKENS = 300
SHORT_GAP_S = 0.5
LEAST_SHARE = 0.9  # of the rate of a robot without a fault, which is 10 Hz
BURST, PAUSE_S = 50, 0.012
SIGHTINGS_EVERY_S = 0.3
VICTIM, MATE = "victim", "mate"  # the fuzzer plays the mate
DRIVEN = "patrol"  # the field refuses its commands, because they name the mate
TO_FIELD = (topics.DRIVE, topics.JOIN)
TO_PEOPLE = (topics.STATUS, topics.TRACK, topics.TRUTH, topics.LOOK, topics.POSE)
ACCEPTED = ("odometry", "sightings", "position", "initial_pose", "messages_received")
FRAME_REASONS = (
    "frame_skipped",
    "no_camera",
)  # only the latest frame counts, and the victim has no camera
REASONS = (*Refusal, "inbox_overflow", *FRAME_REASONS)


class SentCounts(NamedTuple):
    """What the fuzzer sent."""

    help: int
    """Fixes and beliefs for the victim."""
    inputs: int
    """For the victim's driver keys; correct sightings of the mate, for which it listens, too."""
    commands: int
    """For the field."""
    no_messages: int
    """Payloads that are no messages, on the keys for people (status, tracks, truth, frames)."""
    no_statuses: int
    """Those of them under `status/*`."""
    no_looks: int
    """Those of them under `look/*` and `pose/*`."""


class FinalCounts(NamedTuple):
    """What the receivers counted, and how the processes ended."""

    after_help: Mapping[str, int]
    """The victim's counts when it had been sent fixes, beliefs and correct sightings only."""
    victim: Mapping[str, int]
    """At the end."""
    field: Mapping[str, int]
    recorder: Mapping[str, int]
    watcher: Mapping[str, int]
    looks: Mapping[str, int]
    restarts: int
    tracebacks: int
    traffic_exit: int


def fuzz_team() -> Team:
    """The demonstration, a victim with a driver of its own, and a teammate of the victim.

    Without guards, so that every payload arrives.
    """
    team = demo_team()
    victim = RobotSettings(
        source="external",
        start=Start(x_m=1.0, y_m=1.0, sigma_m=0.5),
        sensor=SensorSettings(field_of_view_deg=360.0),
        collaboration=CollaborationSettings(best_tier=4, least_use=0.0),
    )
    transport = msgspec.structs.replace(team.transport, guards=GuardSettings(enabled=False))
    robots = {**team.robots, VICTIM: victim, MATE: victim}
    return msgspec.structs.replace(team, robots=robots, transport=transport)


def keys_beside(topic: Topic) -> int:
    """How many keys have the same subscriber as this one; on all of them it is sent `TO_EACH`."""
    if topic in TO_FIELD:
        return len(TO_FIELD)
    if topic is topics.STATUS:  # the traffic watcher's only one
        return 1
    return 2 if topic in TO_PEOPLE else len((topics.FIX, topics.BELIEF, *topics.INPUTS))


def fuzz(options: ScenarioOptions, to_each: int = TO_EACH) -> ScenarioResult:
    """Sends payloads on every key, and malformed tokens, to a running team; checks its counts.
    `to_each`: how many to each subscriber, at least."""
    options.report_progress("hypothesis generates payloads")
    examples = hypothesis_payloads(options.seed)
    with ExitStack() as stack:
        plan = RunPlan(fuzz_team(), options.seed, left_out=(MATE,))
        machine = stack.enter_context(MachineWatch())
        team = stack.enter_context(run_team(plan, machine))
        bus = stack.enter_context(open_bus(plan.team.name, [team.endpoint]))
        ears = stack.enter_context(open_bus(plan.team.name, [team.endpoint]))
        recorder, watcher = Recorder(ears), StatusCollector(ears)
        looks = Subscriber(ears, AnnotatedFrame, lambda frame: None)
        poses = Subscriber(ears, Pose, lambda pose: None)
        options.report_progress("starting a team")
        team.settle()
        from_s = team.now_s
        fuzzer = Fuzzer(team, bus, to_each, examples, options)
        fuzzer.send_help()
        team.wait_until(lambda: _total(fuzzer.victim_counts()) >= fuzzer.to_victim, 15.0)
        after_help = fuzzer.victim_counts()
        fuzzer.send_everything_else()
        sent = fuzzer.sent()
        team.wait_until(lambda: _total(fuzzer.victim_counts()) >= fuzzer.to_victim, 15.0)
        recorded = sent.no_messages - sent.no_looks
        team.wait_until(lambda: _refusals(recorder.counts) >= recorded, 15.0)
        team.wait_until(lambda: (looks.refused + poses.refused).total() >= sent.no_looks, 15.0)
        team.wait_until(lambda: watcher.refused.total() >= sent.no_statuses, 15.0)
        until_s = team.now_s
        final = FinalCounts(
            after_help,
            fuzzer.victim_counts(),
            {},
            dict(recorder.counts),
            watcher.refused,
            looks.refused + poses.refused,
            sum(team.supervisor.restarts.values()),
            0,
            _traffic_exit(team),
        )
        final = final._replace(field=_field_counts(team), tracebacks=team.tracebacks())
        run = FaultRun(team.run_log, team.robots, "", from_s, until_s, until_s)
        window = run.log, run.robots, from_s, until_s
        checks = [
            *fuzz_checks(sent, final),
            *checks_unaffected(*window, most_silent_s=2.0, who="team's"),
            *victim_checks(run.log, from_s, until_s),
            *checks_recovered(run, from_s),
        ]
        return ScenarioResult(checks, (_by_reason(final.victim),))


def fuzz_checks(sent: SentCounts, final: FinalCounts) -> list[Check]:
    """No process ends, no exception is raised, and every payload is counted by its reason."""
    after_help, victim = final.after_help, final.victim
    help_counted = _total(after_help) - after_help.get("sightings", 0)
    refused_commands = sum(n for what, n in final.field.items() if what not in ("drive", "join"))
    refused, by_watcher = _refusals(final.recorder), sum(final.watcher.values())
    by_frames = sum(final.looks.values())
    return [
        _equal("processes that ended", final.restarts, 0),
        _equal("tracebacks in logs", final.tracebacks, 0),
        # a subscription that changes may deliver a message twice
        Check(
            what="fixes and beliefs counted",
            seen=help_counted,
            at_least=sent.help,
            at_most=sent.help + 10,
        ),
        # the filter counts the odd parts of an accepted message a second time
        at_least("inputs counted", _total(victim) - help_counted, sent.inputs),
        at_least("malformed tokens counted", victim.get("bad_token", 0), TOKENS),
        _equal("commands refused by the field", refused_commands, sent.commands),
        _equal("messages refused by the recorder", refused, sent.no_messages - sent.no_looks),
        _equal("messages refused by the traffic watcher", by_watcher, sent.no_statuses),
        _equal("messages refused by the subscribers of frames and poses", by_frames, sent.no_looks),
        _equal("exit code of `cpcbl-team traffic`", final.traffic_exit, 0),
    ]


def victim_checks(log: RunLog, from_s: float, until_s: float) -> list[Check]:
    """The victim itself goes on working: the control robot's rate is what the machine allows. One
    short gap does not count, which a busy machine causes in a window of any length."""
    count = sum(from_s <= track.at_s < until_s for track in log.tracks.get(VICTIM, ()))
    possible = min(log.machine.rate_hz(from_s, until_s), TRACKS_HZ)
    share = count / (until_s - from_s - SHORT_GAP_S) / max(possible, 1.0)
    return [
        check_gap(log, [VICTIM], from_s, until_s, "victim's longest gap between tracks", 2.0),
        at_least("victim's rate of tracks beside a robot without a fault", share, LEAST_SHARE, "%"),
    ]


def _equal(what: str, seen: int, due: int) -> Check:
    return equal_to(what, seen, due)


def _total(counts: Mapping[str, int]) -> int:
    """The messages that a robot accepted and those that it refused."""
    return sum(counts.get(name, 0) for name in (*ACCEPTED, *REASONS))


def _refusals(counts: Mapping[str, int]) -> int:
    return sum(counts.get(reason, 0) for reason in REASONS)


def _by_reason(counts: Mapping[str, int]) -> str:
    shown = ", ".join(f"{reason} {counts[reason]}" for reason in REASONS if counts.get(reason))
    return f"refused by the victim: {shown}"


class Fuzzer:
    """Plays the mate on a session of its own, and counts what it sends."""

    def __init__(
        self,
        team: TeamUnderTest,
        bus: Bus,
        to_each: int,
        examples: Sequence[bytes],
        options: ScenarioOptions,
    ) -> None:
        self._team, self._bus, self._to_each = team, bus, to_each
        self._report = options.report_progress
        self._random, self._examples = random.Random(options.seed), examples
        self._token = bus.declare_token(topics.ALIVE.at(tier=0, robot=MATE, incarnation="1"))
        key = topics.IN_SIGHTINGS.at(robot=VICTIM)
        self._sightings = bus.publisher(key, topics.IN_SIGHTINGS.qos)
        self._sighted_s = 0.0
        self._count: Counter[str] = Counter()
        self.correct_sightings = 0

    def send_help(self) -> None:
        """Sends fixes and beliefs to the victim, then malformed tokens of the mate."""
        for topic in (topics.FIX, topics.BELIEF):
            self._send(topic, self._key(topic))
        for n in range(TOKENS):
            chunk = f"{n}.{self._random.randrange(2**32):x}"
            self._bus.declare_token(
                topics.ALIVE.at(tier=chunk, robot=MATE, incarnation=chunk)
            ).close()

    def send_everything_else(self) -> None:
        for topic in (*topics.INPUTS, *TO_PEOPLE, *TO_FIELD):
            self._send(topic, self._key(topic))

    @property
    def to_victim(self) -> int:
        """How many messages the victim should have counted by now."""
        keys = (topics.FIX, topics.BELIEF, *topics.INPUTS)
        return sum(self._count[t.key] for t in keys) + self.correct_sightings

    def sent(self) -> SentCounts:
        count = self._count
        return SentCounts(
            help=count[topics.FIX.key] + count[topics.BELIEF.key],
            inputs=sum(count[t.key] for t in topics.INPUTS) + self.correct_sightings,
            commands=sum(count[t.key] for t in TO_FIELD),
            no_messages=sum(count[f"bad {t.key}"] for t in TO_PEOPLE),
            no_statuses=count[f"bad {topics.STATUS.key}"],
            no_looks=sum(count[f"bad {t.key}"] for t in (topics.LOOK, topics.POSE)),
        )

    def victim_counts(self) -> Counter[str]:
        """The victim's counts."""
        return self._team.run_log.latest_counts(VICTIM)

    def _key(self, topic: Topic) -> str:
        robot = VICTIM if topic in (topics.FIX, *topics.INPUTS) else MATE
        robot = DRIVEN if topic in TO_FIELD else robot
        return topic.at(robot=robot, tier=0, observer=MATE)

    def _send(self, topic: Topic, key: str) -> None:
        count = -(-self._to_each // keys_beside(topic))
        self._report(f"{count} payloads on {key}")
        publisher = self._bus.publisher(
            key, topics.Qos.INPUT
        )  # reliable, so that every payload arrives
        if not self._wait(lambda: publisher.matching):
            raise ChaosError(f"nobody listens to {key}")

        def original() -> bytes:
            return valid_payload(topic, VICTIM, MATE, self._team.clock.now_ns())

        payloads = mixed_payloads(count, original, self._examples, self._random)
        for n, payload in enumerate(payloads):
            if n % BURST == 0:
                self._wait(lambda: publisher.matching)
                time.sleep(PAUSE_S)
            if topic in TO_PEOPLE and isinstance(decode(key, payload), Refusal):
                self._count[f"bad {topic.key}"] += 1
            publisher.put(payload)
            self._count[topic.key] += 1

    def _wait(self, condition: Callable[[], bool]) -> bool:
        """Waits for a condition, and keeps the mate in the victim's view; whether it was met."""

        def met() -> bool:
            self._send_sighting()
            return condition()

        self._team.watch()
        return met() or self._team.wait_until(met, 15.0)

    def _send_sighting(self) -> None:
        now_s = time.monotonic()
        if now_s - self._sighted_s >= SIGHTINGS_EVERY_S:
            self._sighted_s = now_s
            frame = Sightings(self._team.clock.now_ns(), (Sighting(MATE, 2.0, 0.1),))
            self._sightings.put(encode(frame))
            self.correct_sightings += 1


def _traffic_exit(team: TeamUnderTest) -> int:
    """The exit code of `cpcbl-team traffic` that watches this team."""
    where = ("--team-name", team.plan.team.name, "--connect", team.endpoint)
    words = (*PROGRAM, "traffic", *where, "--duration", "2", "--json")
    return subprocess.run(words, capture_output=True, timeout=60.0, check=False).returncode


def _field_counts(team: TeamUnderTest) -> Counter[str]:
    """The counts of commands that the field logs when it ends."""
    pid = team.pid(FIELD)
    os.kill(pid, signal.SIGINT)
    team.wait_until(lambda: "what became of them" in team.process_log(FIELD), 10.0)
    line = next((s for s in team.process_log(FIELD).splitlines() if "what became of them" in s), "")
    return Counter({name: int(n) for name, n in re.findall(r"(\w+) (\d+)(?:,|$)", line)})
