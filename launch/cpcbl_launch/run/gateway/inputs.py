"""What the gateway does with an input: the checks of the robot itself, with words for people."""

import asyncio
import logging
import time
from typing import NamedTuple

from cpcbl_team.inputs import InitialPose, Odometry, Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Publisher
from cpcbl_transport.decoding import decode_by_key, input_problem
from cpcbl_transport.json_messages import is_json
from cpcbl_transport.messages import Refusal, SensorInput, refusal
from cpcbl_transport.units import (
    initial_pose_problem,
    odometry_problem,
    sighting_problem,
    stamp_problem,
)

log = logging.getLogger(__name__)

LATE_S = 2.0
DECLARE_S = 0.3
INPUTS = {topic.key.rpartition("/")[2]: topic for topic in topics.INPUTS}


class Problem(NamedTuple):
    """Why an input was not taken, as an answer of HTTP."""

    status: int
    reason: str  # as robots count it, or a word of the gateway
    error: str  # one line for people


class RateLimit:
    """At most so many messages a second, with one second's worth at once."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz, self._left, self._at_s = rate_hz, rate_hz, time.monotonic()

    def admits(self) -> bool:
        now_s = time.monotonic()
        self._left = min(self._rate_hz, self._left + (now_s - self._at_s) * self._rate_hz)
        self._at_s = now_s
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


class RobotInputs:
    """The inputs of one robot on the bus. What the robot would refuse is passed on too, so that it
    counts it; what it would take in a wrong unit is not."""

    def __init__(self, robot: str, bus: Bus, rate_hz: float, has_driver: bool) -> None:
        """`has_driver`: others' inputs come from the simulation or from a log."""
        self._robot, self._limit, self._has_driver = robot, RateLimit(rate_hz), has_driver
        self._bus = bus
        self._publishers: dict[str, Publisher] = {}
        self._logged: set[tuple[str, str]] = set()

    async def take(self, name: str, payload: bytes) -> Problem | None:
        """Publishes an input; why it was not taken, or None."""
        if self._has_driver and name in INPUTS and name not in self._publishers:
            await self._declare(name)
        problem = self._problem(name, payload)
        if problem is not None:
            self._say_once(name if name in INPUTS else "", problem.reason, problem.error)
        return problem

    async def _declare(self, name: str) -> None:
        """Declares the publisher of an input when it is first used: an operator sees by it who
        feeds a robot. The bus takes a moment to find who subscribes."""
        topic = INPUTS[name]
        publisher = self._bus.publisher(topic.at(robot=self._robot), topic.qos)
        self._publishers[name] = publisher
        until_s = time.monotonic() + DECLARE_S
        while not publisher.matching and time.monotonic() < until_s:
            await asyncio.sleep(0.01)

    def _say_once(self, name: str, reason: str, text: str) -> None:
        if (name, reason) not in self._logged:
            self._logged.add((name, reason))
            log.warning("%s: %s: %s", self._robot, name, text)

    def _problem(self, name: str, payload: bytes) -> Problem | None:
        topic = INPUTS.get(name)
        if topic is None:
            known = ", ".join(INPUTS)
            return Problem(404, "unknown_input", f"no input {name[:32]!r}; there are {known}")
        if not self._has_driver:
            error = f'robots.{self._robot}.source: is not "external": it takes no inputs'
            return Problem(409, "no_driver", error)
        if not self._limit.admits():
            return Problem(429, "too_fast", "too many messages a second; gateway.rate_hz limits it")
        if len(payload) > topic.largest:
            error = f"{len(payload)} bytes; at most {topic.largest}"
            return Problem(413, Refusal.TOO_LARGE.value, error)
        publisher = self._publishers[name]
        if not publisher.matching:
            error = (
                f"robot {self._robot} does not listen: it does not run, or has another team name or"
                " router"
            )
            return Problem(503, "robot_absent", error)
        found = self._payload_problem(name, payload, time.time_ns())
        if found is None or found.reason != "wrong_unit":
            publisher.put(payload)
        return found

    def _payload_problem(self, name: str, payload: bytes, now_ns: int) -> Problem | None:
        if not is_json(payload):
            return Problem(400, Refusal.VERSION.value, "write a JSON object, which begins with {")
        key = INPUTS[name].at(robot=self._robot)
        message = decode_by_key(key, payload)
        if isinstance(message, Refusal):
            return Problem(400, message.value, input_problem(key, payload))
        assert isinstance(message, SensorInput)
        found = _message_problem(message, now_ns)
        late_s = (now_ns - message.stamp_ns) * 1e-9
        if found is None and late_s > LATE_S:
            text = f"stamps are {late_s:.1f} s behind the gateway's clock; set the driver's clock"
            self._say_once(name, "late", text)
        return found


def _message_problem(message: SensorInput, now_ns: int) -> Problem | None:
    """Why the robot refuses a message, or would take it in a wrong unit."""
    reason, unit = refusal(message, now_ns), stamp_problem(message.stamp_ns, now_ns)
    if reason is not None or unit:  # the robot refuses it as too late, if for no other reason
        error = f"refused: {(reason or '').replace('_', ' ')}"
        if reason is Refusal.FUTURE:
            ahead_s = (message.stamp_ns - now_ns) * 1e-9
            error = f"stamp_ns is {ahead_s:.1f} s ahead of the gateway's clock; set the clock"
        return Problem(400, reason or "wrong_clock", unit or error)
    if isinstance(message, Odometry):
        duration_s = (message.stamp_ns - message.from_ns) * 1e-9
        unit = odometry_problem(message.distance_m, message.turn_rad, duration_s)
    elif isinstance(message, Sightings):
        unit = next(filter(None, map(sighting_problem, message.sightings)), "")
    elif isinstance(message, InitialPose):
        unit = initial_pose_problem(message)
    return Problem(400, "wrong_unit", unit) if unit else None
