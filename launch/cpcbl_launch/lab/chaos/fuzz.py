"""Payloads without sense on every key of the topic table, over real Zenoh; each must be counted."""

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

from cpcbl_launch.lab.chaos.checks import Check
from cpcbl_launch.lab.chaos.notes import all_counts
from cpcbl_launch.lab.chaos.payloads import fuzzed, hypothetical, real
from cpcbl_launch.lab.chaos.scenario import Found, Setting, all_is_well, they_go_on
from cpcbl_launch.lab.chaos.team import FIELD, ChaosError, Plan, TeamUnderTest, demo_team, running
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.views.frames.ear import LookEar
from cpcbl_launch.views.traffic.watch import StatusCollector
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
from cpcbl_transport.decoding import read
from cpcbl_transport.messages import Refusal, encode
from cpcbl_transport.topics import Topic
from cpcbl_transport.zenoh_bus import open_bus

A_KEY = 10_000
TOKENS = 300
BURST, PAUSE_S = 50, 0.012
SIGHTINGS_EVERY_S = 0.3
VICTIM, MATE = "victim", "mate"  # the mate is played by the fuzzer
DRIVEN = "patrol"  # whose commands, by their own words the mate's, it refuses all
TO_FIELD = (topics.DRIVE, topics.JOIN)
TO_PEOPLE = (topics.STATUS, topics.TRACK, topics.TRUTH, topics.LOOK)
TAKEN = ("odometry", "sightings", "position", "messages_received")
NO_FRAMES = ("frame_skipped", "no_camera")  # the latest frame counts, and the victim has no eyes
REASONS = (*Refusal, "inbox_overflow", *NO_FRAMES)


class Sent(NamedTuple):
    """What the fuzzer sent."""

    help: int
    """Fixes and beliefs for the victim."""
    inputs: int
    """For the victim's driver keys, and true sightings of the mate, so that it listens."""
    commands: int
    """For the field."""
    no_messages: int
    """For people (status, tracks, truth, looks), what is none."""
    no_statuses: int
    """Of these, what came under `status/*`."""
    no_looks: int
    """Of these, what came under `look/*`."""


class Taken(NamedTuple):
    """What became of it."""

    after_help: Mapping[str, int]
    """The victim's counts when help was all that it had been sent, but for sightings."""
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
    """The demonstration, a robot with a driver of its own as the victim, and its teammate.

    Without guards: all shall arrive.
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


def fuzz(setting: Setting, a_key: int = A_KEY) -> Found:
    """Hypothesis's payloads, random bytes and damaged messages on every key; odd tokens."""
    setting.say("hypothesis generates payloads")
    found = hypothetical(setting.seed)
    with ExitStack() as stack:
        plan = Plan(fuzz_team(), setting.seed, left_out=(MATE,))
        team = stack.enter_context(running(plan))
        bus = stack.enter_context(open_bus(plan.team.name, [team.endpoint]))
        ears = stack.enter_context(open_bus(plan.team.name, [team.endpoint]))
        recorder, watcher, looks = Recorder(ears), StatusCollector(ears), LookEar(ears)
        setting.say("starting a team")
        team.settle()
        from_s = team.now_s
        fuzzer = Fuzzer(team, bus, a_key, found, setting)
        fuzzer.help()
        team.until(lambda: _counted(fuzzer.victim()) >= fuzzer.to_victim, 15.0)
        after_help = fuzzer.victim()
        fuzzer.everything_else()
        sent = fuzzer.sent()
        team.until(lambda: _counted(fuzzer.victim()) >= fuzzer.to_victim, 15.0)
        recorded = sent.no_messages - sent.no_looks
        team.until(lambda: _refused(recorder.counts) >= recorded, 15.0)
        team.until(lambda: looks.refused.total() >= sent.no_looks, 15.0)
        team.until(lambda: watcher.refused.total() >= sent.no_statuses, 15.0)
        until_s = team.now_s
        taken = Taken(
            after_help,
            fuzzer.victim(),
            {},
            dict(recorder.counts),
            watcher.refused,
            looks.refused,
            sum(team.supervisor.restarts.values()),
            0,
            _traffic_exit(team),
        )
        taken = taken._replace(field=_field_counts(team), tracebacks=team.tracebacks())
        notes, robots = team.notes, team.robots
        checks = [
            *judged_fuzz(sent, taken),
            *they_go_on(notes, robots, from_s, until_s, most_silent_s=2.0, who="team's"),
            *all_is_well(notes, robots, from_s, until_s),
        ]
        return Found(checks, (_by_reason(taken.victim),))


def judged_fuzz(sent: Sent, taken: Taken) -> list[Check]:
    """Nobody ends, nothing is thrown, everything is counted, by reason."""
    then, victim = taken.after_help, taken.victim
    help_counted = _counted(then) - then.get("sightings", 0)
    refused_commands = sum(n for what, n in taken.field.items() if what not in ("drive", "join"))
    refused, watched = _refused(taken.recorder), sum(taken.watcher.values())
    looked = sum(taken.looks.values())
    return [
        _exactly("processes that ended", taken.restarts, 0),
        _exactly("tracebacks in logs", taken.tracebacks, 0),
        # a subscription that changes may deliver a message twice
        Check(
            what="fixes and beliefs counted",
            seen=help_counted,
            at_least=sent.help,
            at_most=sent.help + 10,
        ),
        # the filter counts what is odd inside of what was taken once more
        Check(what="inputs counted", seen=_counted(victim) - help_counted, at_least=sent.inputs),
        Check(what="malformed tokens counted", seen=victim.get("bad_token", 0), at_least=TOKENS),
        _exactly("commands refused by the field", refused_commands, sent.commands),
        _exactly("messages refused by the recorder", refused, sent.no_messages - sent.no_looks),
        _exactly("messages refused by the traffic watcher", watched, sent.no_statuses),
        _exactly("messages refused by the subscriber of annotated frames", looked, sent.no_looks),
        _exactly("exit code of `cpcbl-team traffic`", taken.traffic_exit, 0),
    ]


def _exactly(what: str, seen: int, due: int) -> Check:
    return Check(what=what, seen=seen, at_least=due, at_most=due)


def _counted(counts: Mapping[str, int]) -> int:
    """What a robot took and what it refused."""
    return sum(counts.get(name, 0) for name in (*TAKEN, *REASONS))


def _refused(counts: Mapping[str, int]) -> int:
    return sum(counts.get(reason, 0) for reason in REASONS)


def _by_reason(counts: Mapping[str, int]) -> str:
    shown = ", ".join(f"{reason} {counts[reason]}" for reason in REASONS if counts.get(reason))
    return f"refused by the victim: {shown}"


class Fuzzer:
    """Plays the mate on a session of its own."""

    def __init__(
        self,
        team: TeamUnderTest,
        bus: Bus,
        a_key: int,
        found: Sequence[bytes],
        setting: Setting,
    ) -> None:
        self._team, self._bus, self._a_key, self._say = team, bus, a_key, setting.say
        self._dice, self._found = random.Random(setting.seed), found
        self._token = bus.announce(topics.ALIVE.at(tier=0, robot=MATE, incarnation="1"))
        key = topics.IN_SIGHTINGS.at(robot=VICTIM)
        self._sightings = bus.publisher(key, topics.IN_SIGHTINGS.qos)
        self._shown_s = 0.0
        self._count: Counter[str] = Counter()
        self.true_sightings = 0

    def help(self) -> None:
        """Fixes and beliefs for the victim; then, as it watches the mate, odd tokens of it."""
        for topic in (topics.FIX, topics.BELIEF):
            self._fuzz(topic, self._key(topic))
        for n in range(TOKENS):
            chunk = f"{n}.{self._dice.randrange(2**32):x}"
            self._bus.announce(topics.ALIVE.at(tier=chunk, robot=MATE, incarnation=chunk)).close()

    def everything_else(self) -> None:
        for topic in (*topics.INPUTS, *TO_PEOPLE, *TO_FIELD):
            self._fuzz(topic, self._key(topic))

    @property
    def to_victim(self) -> int:
        """What it should have counted by now."""
        keys = (topics.FIX, topics.BELIEF, *topics.INPUTS)
        return sum(self._count[t.key] for t in keys) + self.true_sightings

    def sent(self) -> Sent:
        count = self._count
        return Sent(
            help=count[topics.FIX.key] + count[topics.BELIEF.key],
            inputs=sum(count[t.key] for t in topics.INPUTS) + self.true_sightings,
            commands=sum(count[t.key] for t in TO_FIELD),
            no_messages=sum(count[f"bad {t.key}"] for t in TO_PEOPLE),
            no_statuses=count[f"bad {topics.STATUS.key}"],
            no_looks=count[f"bad {topics.LOOK.key}"],
        )

    def victim(self) -> Counter[str]:
        """What the victim has counted."""
        return all_counts(self._team.notes, VICTIM)

    def _key(self, topic: Topic) -> str:
        robot = VICTIM if topic in (topics.FIX, *topics.INPUTS) else MATE
        robot = DRIVEN if topic in TO_FIELD else robot
        return topic.at(robot=robot, tier=0, observer=MATE)

    def _fuzz(self, topic: Topic, key: str) -> None:
        self._say(f"{self._a_key} payloads on {key}")
        publisher = self._bus.publisher(key, topics.Qos.INPUT)  # reliable: all shall arrive
        if not self._until(lambda: publisher.matching):
            raise ChaosError(f"nobody listens to {key}")

        def original() -> bytes:
            return real(topic, VICTIM, MATE, self._team.clock.now_ns())

        for n, payload in enumerate(fuzzed(self._a_key, original, self._found, self._dice)):
            if n % BURST == 0:
                self._until(lambda: publisher.matching)
                time.sleep(PAUSE_S)
            if topic in TO_PEOPLE and isinstance(read(key, payload), Refusal):
                self._count[f"bad {topic.key}"] += 1
            publisher.put(payload)
            self._count[topic.key] += 1

    def _until(self, condition: Callable[[], bool]) -> bool:
        """Waits, and keeps the mate in the victim's sight."""

        def met() -> bool:
            self._show_mate()
            return condition()

        self._team.watch()
        return met() or self._team.until(met, 15.0)

    def _show_mate(self) -> None:
        now_s = time.monotonic()
        if now_s - self._shown_s >= SIGHTINGS_EVERY_S:
            self._shown_s = now_s
            frame = Sightings(self._team.clock.now_ns(), (Sighting(MATE, 2.0, 0.1),))
            self._sightings.put(encode(frame))
            self.true_sightings += 1


def _traffic_exit(team: TeamUnderTest) -> int:
    """What `cpcbl-team traffic` exits with that has watched this team."""
    where = ("--team-name", team.plan.team.name, "--connect", team.endpoint)
    words = (*PROGRAM, "traffic", *where, "--for", "2", "--json")
    return subprocess.run(words, capture_output=True, timeout=60.0, check=False).returncode


def _field_counts(team: TeamUnderTest) -> Counter[str]:
    """What the field says at its end of the commands that it got."""
    pid = team.pid(FIELD)
    os.kill(pid, signal.SIGINT)
    team.until(lambda: "what became of them" in team.log(FIELD), 10.0)
    line = next((s for s in team.log(FIELD).splitlines() if "what became of them" in s), "")
    return Counter({name: int(n) for name, n in re.findall(r"(\w+) (\d+)(?:,|$)", line)})
