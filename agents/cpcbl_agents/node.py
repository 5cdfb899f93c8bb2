"""A robot on a bus: it takes in what arrives, refuses what must not be used, and publishes."""

import logging
from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple, Protocol

import msgspec

from cpcbl_agents import agent
from cpcbl_agents.agent import BeliefSubscribers, FrameSubscribers, LandmarkSubscribers
from cpcbl_agents.clocks import ClockMonitor
from cpcbl_agents.declarations import Declarations, LivelinessTokens
from cpcbl_agents.input_diagnosis.monitor import InputMonitor
from cpcbl_agents.landmark_sharing import landmark_tier
from cpcbl_agents.load import LoadMonitor, MayGoOn, everything
from cpcbl_agents.message_counters import MessageCounters
from cpcbl_agents.pose_output import PoseOutput
from cpcbl_agents.robot import Robot
from cpcbl_agents.tape import NO_TAPE, Tape
from cpcbl_team.config import Team
from cpcbl_team.frames import FIELD
from cpcbl_team.inputs import Belief, Fix, LandmarkBelief
from cpcbl_transport import messages, topics
from cpcbl_transport.bus import Bus, Publisher
from cpcbl_transport.compact import encode_help, received_bytes, sent_bytes
from cpcbl_transport.decoding import decode_by_key, input_problem
from cpcbl_transport.json_messages import encode_json, is_json
from cpcbl_transport.messages import (
    Help,
    Message,
    Outgoing,
    Refusal,
    SensorInput,
    Status,
    refusal,
)
from cpcbl_transport.topics import Topic, topic_of

log = logging.getLogger(__name__)

STATUS_NS = 1_000_000_000
ASK_NS = 500_000_000  # how often a guest asks the simulated field to simulate it
RETRY_NS = 50_000_000  # while no field subscribes
WARN_AFTER_NS = 3_000_000_000  # without any input


class Steppable(Protocol):
    """A robot's node, or anything else that the same loop steps."""

    @property
    def next_ns(self) -> int:
        """When there is something to do even if nothing arrives."""

    @property
    def waiting(self) -> bool:
        """Whether something has arrived."""

    def step(self, now_ns: int) -> None:
        """Does what is due and handles what has arrived."""


class BoundedSteppable(Steppable, Protocol):
    """A node whose steps can be bounded."""

    def step(self, now_ns: int, may_go_on: MayGoOn = everything) -> None:
        """Does what is due, and handles what has arrived as far as it may."""


class NodeStart(NamedTuple):
    """When a node starts, and as which process."""

    stamp_ns: int  # of the robot's time
    incarnation: str  # distinguishes its process from others with the same robot's name
    speed: float = 1.0  # robot time beside real time


class NodeCallbacks(NamedTuple):
    """What a node tells the process that runs it."""

    on_arrival: Callable[[], None] = lambda: None  # called on a thread of the bus
    on_status: Callable[[Status], None] = lambda status: None  # called once a second

    @property
    def restored_as(self) -> tuple[str]:
        """They are no part of a node's state."""
        return ("callbacks",)


NO_CALLBACKS = NodeCallbacks()


class Node:
    """Runs a `Robot` on a `Bus`. Call `step` when `next_ns` has come or something has arrived."""

    def __init__(
        self,
        robot: Robot,
        team: Team,
        bus: Bus,
        start: NodeStart,
        callbacks: NodeCallbacks = NO_CALLBACKS,
        tape: Tape = NO_TAPE,
    ) -> None:
        """`tape`: what notes or plays all that passes between the node and the world."""
        start_ns, incarnation, speed = start
        self.robot, self._incarnation, self._name = robot, incarnation, robot.name
        self._callbacks, self._status_ns, self._tape = callbacks, start_ns, tape
        rules = team.robots[robot.name].collaboration
        self._team, self._passive = frozenset(team.robots), rules.passive
        tape.start(self, start_ns)
        self._bus = bus = tape.wrap_bus(bus)
        named = robot.name, incarnation, self._team
        self.arrivals, self._load = tape.arrivals(*named, callbacks.on_arrival), LoadMonitor(speed)
        robot.sensing.wrap(tape)
        put_message, put_token = self.arrivals.put_message, self.arrivals.put_token
        is_agreed = team.map.is_frame_agreed
        self._declarations = Declarations(
            robot.name, incarnation, rules, bus, put_message, put_token, is_agreed
        )
        self._pose = PoseOutput(robot, bus, team.robots[robot.name].pose_rate_hz, start_ns)
        self._tokens = LivelinessTokens(self._team)
        self._subscribed: dict[object, str] = {BeliefSubscribers: "", FrameSubscribers: ""}
        self._explained: set[tuple[str, Refusal]] = set()
        self._publishers: dict[type, Publisher] = {}  # of messages whose key stays the same
        self._counts, self.received = Counter[str](), MessageCounters()
        self._clocks = ClockMonitor(rules.trust, speed) if rules.trust.enabled else None
        self._health = InputMonitor(robot.name, team, start_ns, speed)
        self._note_confirmation()
        for topic in topics.INPUTS:
            bus.subscribe(topic.at(robot=robot.name), put_message)
        own_tokens = topics.ALIVE.at(robot=robot.name)
        bus.watch_liveliness(own_tokens, self.arrivals.put_own_name)
        if is_agreed:
            bus.watch_liveliness(topics.FRAME.at(), self.arrivals.put_token)
        tape.end()

    @property
    def has_moved(self) -> bool:
        """Whether the robot is no longer where it started, by odometry or by where it was found."""
        return self._health.has_moved

    @property
    def next_ns(self) -> int:
        return min(self.robot.next_ns, self._pose.next_ns)

    @property
    def waiting(self) -> bool:
        return self.arrivals.any_wait

    @property
    def counts(self) -> Counter[str]:
        """What this node refused, and what happened as things arrived."""
        return self.arrivals.counts + self._counts

    def step(self, now_ns: int, may_go_on: MayGoOn = everything) -> None:
        """Handles what has arrived, lets the robot work, and publishes the results. What arrives
        meanwhile waits for the next step, and so does what this one may not handle any more: a
        flood must not keep it from ending."""
        self._tape.begin(now_ns)
        self._step(now_ns, may_go_on)
        self._tape.end()

    def _step(self, now_ns: int, may_go_on: MayGoOn) -> None:
        due_ns = self.robot.next_ns
        is_behind = self._handle_arrivals(now_ns, may_go_on)
        self._load.note(due_ns, now_ns, is_behind)
        if (frame := self.arrivals.take_frame()) is not None:
            self._handle_payload(*frame, now_ns)
        if self._passive and self._declarations.tier is not None:
            self._check_subscribers(topics.BELIEF, BeliefSubscribers, now_ns)
            self._check_landmark_subscribers(now_ns)
        if self.robot.sensing.has_detector:
            self._check_subscribers(topics.LOOK, FrameSubscribers, now_ns)
        outgoing = self.robot.handle(agent.Tick(), now_ns)
        for name in self._declarations.update(self.robot.collaboration.interests):
            self._tokens.forget(name)
            if name not in self._team:
                self._declarations.forget_guest(name)
            self.robot.handle(agent.Presence(name, None), now_ns)
        self._send(outgoing, now_ns)  # under the tier that these messages belong to
        self._pose.step(now_ns)
        if now_ns - self._status_ns >= STATUS_NS and self._declarations.tier is not None:
            self._status_ns = now_ns
            self._publish_status(now_ns)

    def _handle_arrivals(self, now_ns: int, may_go_on: MayGoOn) -> bool:
        """Handles tokens, then messages; at least one of each that waits. Whether messages are
        left that had waited."""
        arrivals, handled, taken = self.arrivals, 0, 0
        tokens, waiting = arrivals.waiting_tokens, arrivals.waiting_messages
        while handled < tokens and (not handled or may_go_on(handled)):
            self._handle_token(*arrivals.take_token(), now_ns)
            handled += 1
        while taken < waiting and (not taken or may_go_on(handled + taken)):
            self._handle_payload(*arrivals.take_message(), now_ns)
            taken += 1
        arrivals.note_taken(taken, waiting)
        return taken < waiting

    def _handle_payload(self, key: str, payload: bytes, now_ns: int) -> None:
        message, source = self._decode(key, payload, now_ns), self._health.by_key.get(key)
        if isinstance(message, Refusal):
            self._counts[message] += 1
            self._explain(key, payload, message)
            if source is not None:
                source.refuse(message, payload, now_ns)
            return
        if source is not None and isinstance(message, SensorInput):
            source.take(message, now_ns)
        tier, frame = topics.tier_and_frame_of(key) if isinstance(message, Help) else ("", FIELD)
        if tier == topics.ANY_TIER and frame == self._declarations.frame:  # it was in a worse one
            self._counts["other_frame"] += 1
            return
        self._send(self.robot.handle(message, now_ns, frame), now_ns)
        match message:
            case Fix(observer=name):  # by a subscription to all observers
                size = received_bytes(len(payload), name)
                self.received.of("fix", name).add(size, message.stamp_ns)
            case LandmarkBelief(robot=name):  # the same
                size = received_bytes(len(payload), name)
                self.received.of("landmark", name).add(size, message.stamp_ns)
            case Belief(robot=name):  # by one to this key
                size = sent_bytes(len(payload))
                self.received.of("belief", name).add(size, message.stamp_ns)

    def _explain(self, key: str, payload: bytes, reason: Refusal) -> None:
        """Logs, once for each key and reason, what is wrong with an input that came as JSON."""
        if (key, reason) in self._explained or not is_json(payload):
            return
        if problem := input_problem(key, payload):
            self._explained.add((key, reason))
            log.warning("%s: refused JSON on %s: %s", self._name, key, problem)

    def _decode(self, key: str, payload: bytes, now_ns: int) -> Message | Refusal:
        """The message, or why it must not be used. The order of checks: its bytes, its sender, the
        sender's clock, its numbers and its time."""
        message = decode_by_key(key, payload)
        match message:
            case Refusal():
                return message
            case Belief(robot=sender) | LandmarkBelief(robot=sender) | Fix(observer=sender):
                if sender not in self._team and not self.robot.is_guest(sender):
                    self.robot.handle(agent.UnknownRobot(sender), now_ns)
                    return Refusal.UNKNOWN_ROBOT
                if sender == self._name:
                    return Refusal.OWN
                clocks = self._clocks
                if clocks is not None and clocks.rejects(sender, message.stamp_ns, now_ns):
                    return Refusal.CLOCK
        return refusal(message, now_ns) or message

    def _handle_token(self, key: str, alive: bool, now_ns: int) -> None:
        """Tells the robot which teammates are present, and with which tier."""
        known = self._tokens.update(key, alive)
        if known is None:
            self._counts["bad_token"] += 1
            return
        name, was_guest = known.robot, self.robot.is_guest(known.robot)
        self.robot.handle(known, now_ns)
        if was_guest is not self.robot.is_guest(name):
            log.info("%s: guest %s %s", self._name, name, "left" if was_guest else "joined")

    def _check_subscribers(
        self, topic: Topic, event: type[BeliefSubscribers | FrameSubscribers], now_ns: int
    ) -> None:
        """Tells the robot when the subscribers to what it publishes under a topic come or go."""
        key = topic.at(tier=self._declarations.tier_chunk, robot=self._name)
        subscribed = key if self._declarations.publisher(topic, key).matching else ""
        if subscribed != self._subscribed[event]:  # another key may have other subscribers
            self._subscribed[event] = subscribed
            self._send(self.robot.handle(event(bool(subscribed)), now_ns), now_ns)

    def _check_landmark_subscribers(self, now_ns: int) -> None:
        """Tells the robot which landmarks' places teammates want to know."""
        sharing = self.robot.collaboration.landmarks
        asked_for = self._declarations.update_landmarks(sharing.tiers)
        if asked_for != sharing.asked_for:
            self.robot.handle(LandmarkSubscribers(asked_for), now_ns)

    def _send(self, outgoing: Iterable[Outgoing], now_ns: int) -> None:
        for message in outgoing:
            size = self._publish(message)
            if isinstance(message, Help):
                self.robot.handle(agent.HelpSent(message, sent_bytes(size) if size else 0), now_ns)

    def _publish(self, message: Outgoing | Status) -> int:
        """Publishes if there is a subscriber; returns the bytes of the payload, 0 without one."""
        publisher = self._publishers.get(type(message)) or self._publisher(message)
        if not publisher.matching:
            return 0
        payload = encode_help(message) if isinstance(message, Help) else messages.encode(message)
        publisher.put(payload)
        return len(payload)

    def _publisher(self, message: Outgoing | Status) -> Publisher:
        topic, tier, landmark = topic_of(type(message)), self._declarations.tier_chunk, ""
        match message:
            case LandmarkBelief():
                landmark = message.landmark
                tier = topics.tier_chunk(landmark_tier(message), self._declarations.frame)
            case Fix():
                tier = self.robot.collaboration.frames.fix_chunk(message.robot, tier)
        key = topic.at(tier=tier, robot=message.robot, observer=self._name, landmark=landmark)
        publisher = self._declarations.publisher(topic, key)
        if not isinstance(message, Help):
            self._publishers[type(message)] = publisher
        return publisher

    def _publish_status(self, now_ns: int) -> None:
        counts = self.counts + Counter(announced=self._declarations.announced)
        received = self.received.flows()
        status = self.robot.status(now_ns, self._incarnation, counts, received, self._clocks)
        snapshot = self.robot.input_snapshot()
        inputs, problems = self._health.judge(snapshot, now_ns, self.arrivals.has_namesake)
        is_contradicted = bool(snapshot.mistake) and self._health.is_mistake_contradicted
        if self._health.are_mended or is_contradicted:
            self.robot.forget_wrong_inputs(self._health.wrong_since_ns, now_ns)
        overload = self._load.judge(*self.arrivals.pop_overflow())
        problems = (*overload, *problems, *self.robot.sensing.problems, *self._tape.problems)
        self._note_confirmation()
        status = msgspec.structs.replace(
            status,
            inputs=inputs,
            problems=problems,
            unconfirmed="" if status.lost else self._health.unconfirmed,
        )
        self._callbacks.on_status(status)
        self._publish(status)
        key = topics.json_key(topics.STATUS.at(robot=self._name))
        as_json = self._declarations.publisher(topics.STATUS, key)
        if as_json.matching:
            as_json.put(encode_json(status))

    def _note_confirmation(self) -> None:
        """Passes on what is not confirmed about the pose."""
        self._pose.unconfirmed = self._health.unconfirmed
        self.robot.collaboration.may_mislead = self._health.may_mislead


class GuestNode(Node):
    """Runs a guest, which `team` holds beside its own robots, from `start_ns` until `leave`. On a
    simulated field it also asks, again and again, to be simulated."""

    def __init__(
        self,
        robot: Robot,
        team: Team,
        bus: Bus,
        start: NodeStart,
        callbacks: NodeCallbacks = NO_CALLBACKS,
        tape: Tape = NO_TAPE,
    ) -> None:
        super().__init__(robot, team, bus, start, callbacks, tape)
        self._ask_ns = start.stamp_ns
        self._warn_ns: int | None = start.stamp_ns + WARN_AFTER_NS
        self._model = messages.model_from_settings(team.robots[robot.name])
        self._join = self._bus.publisher(topics.JOIN.at(robot=robot.name), topics.JOIN.qos)

    @property
    def next_ns(self) -> int:
        return super().next_ns if self._model is None else min(super().next_ns, self._ask_ns)

    @property
    def missing_input(self) -> str:
        """Why nothing has been sensed so far; empty if something has been sensed."""
        if self.robot.sensing.counts:
            return ""
        if self._model is None:
            keys = topics.IN_SIGHTINGS.at(robot=self.robot.name)
            return f"senses nothing: nothing came on {keys}; is its driver there?"
        return (
            "senses nothing: no simulated field simulates it; is the team simulated in real time,"
            " and does its file let guests in?"
        )

    def _step(self, now_ns: int, may_go_on: MayGoOn) -> None:
        """Asks the field when that is due, and steps the node."""
        if self._warn_ns is not None and now_ns >= self._warn_ns:
            self._warn_ns = None
            if self.missing_input:
                log.warning("%s %s", self.robot.name, self.missing_input)
        if self._model is not None and now_ns >= self._ask_ns:
            self._ask_ns = now_ns + (ASK_NS if self._ask(now_ns, self._model) else RETRY_NS)
        super()._step(now_ns, may_go_on)

    def leave(self, now_ns: int) -> None:
        """Tells the field that the guest leaves. All else ends with the session."""
        self._tape.begin(now_ns, leaves=True)
        if self._model is not None:
            self._ask(now_ns, None)
        self._tape.end()

    def _ask(self, now_ns: int, model: messages.SimulatedRobotModel | None) -> bool:
        """Asks the field; whether a field subscribes."""
        if not self._join.matching:
            return False
        join = messages.Join(self.robot.name, self._incarnation, now_ns, model)
        self._join.put(messages.encode(join))
        return True
