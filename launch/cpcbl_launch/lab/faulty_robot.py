"""A robot of the team that sends wrong positions on purpose, for experiments and fault scenarios.

`FaultyBus` stands between a robot and its bus and changes the fixes and beliefs that the robot
sends; the robot itself works correctly. A fault is written `KIND:VALUES/ABOUT@FROM-UNTIL`, with
times in seconds after the start. Without times it lasts from the start to the end. With `/ABOUT`,
the name of a robot, it changes only what is reported about this robot: fixes of one victim, or,
with the faulty robot's own name, only its beliefs.

| fault | effect on each fix and belief |
|---|---|
| `bias:0.5,0.5` | its position is shifted by so many metres in x and y |
| `overclaim:0.1,0.0,0.005` | the same, and it states this sigma (m) |
| `frozen` | its position stays the last one from before the fault |
| `jumps:1.5` | its position is shifted by so many metres, every 2 s in another direction |
| `overconfident:0.3` | its position has an error of this sigma (m), but it states 1 mm |
| `drift:0.01,0.0,0.02` | its error grows by these m/s in x and y, and it states this sigma (m) |
| `one-axis:0.02,0.01,0.2` | its error grows by these m/s in x; it states these sigmas in x and y |
| `heading:2.0,0.5` | its heading turns by these deg/s, and it states this sigma (deg) |
| `clock:0.5` | its stamp is so many seconds too late (negative: too early) |

`python -m cpcbl_launch.lab.faulty_robot TEAM NAME --fault FAULT` runs such a robot.
"""

import logging
import math
import random
import re
import sys
from collections.abc import Sequence
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.robot import robot_parser, run_robot_command
from cpcbl_team.errors import CpcblError, InputError
from cpcbl_team.inputs import Fix, LandmarkBelief
from cpcbl_transport.bus import Bus, BusProxy, Publisher, PublisherProxy
from cpcbl_transport.compact import decode_help, encode_help
from cpcbl_transport.messages import Help, Refusal
from cpcbl_transport.topics import Qos

VALUE_COUNTS = {
    "bias": 2,
    "overclaim": 3,
    "frozen": 0,
    "jumps": 1,
    "overconfident": 1,
    "drift": 3,
    "one-axis": 3,
    "heading": 2,
    "clock": 1,
}
JUMP_NS = 2_000_000_000
STATED_SIGMA_M = 0.001
_HELP_KEYS = ("fix/", "belief/", "landmark/")
_TEXT = re.compile(
    r"(?P<kind>[a-z-]+)(:(?P<values>[^@/]*))?(/(?P<about>[^@/]+))?"
    r"(@(?P<since>[^-@]+)-(?P<until>[^-@]*))?"
)


class Fault(NamedTuple):
    """What is wrong with the messages of a robot, and when."""

    kind: str
    values: tuple[float, ...] = ()
    from_s: float = 0.0
    until_s: float = math.inf
    about: str = ""  # the robot or landmark about which it lies; empty: about all

    @staticmethod
    def parse(text: str) -> "Fault":
        """The fault that a text such as `bias:0.5,0.5@10-30` describes. Raises InputError."""
        match = _TEXT.fullmatch(text)
        kind = match["kind"] if match else ""
        if match is None or kind not in VALUE_COUNTS:
            kinds = ", ".join(VALUE_COUNTS)
            raise InputError(f"--fault {text}: write {kinds}, e.g. bias:0.5,0.5@10-30")
        try:
            values = tuple(float(v) for v in (match["values"] or "").split(",") if v)
            since, until = float(match["since"] or 0.0), float(match["until"] or math.inf)
        except ValueError:
            raise InputError(f"--fault {text}: write numbers, e.g. bias:0.5,0.5@10-30") from None
        if len(values) != VALUE_COUNTS[kind] or not all(map(math.isfinite, values)):
            raise InputError(f"--fault {text}: {kind} takes {VALUE_COUNTS[kind]} numbers")
        return Fault(kind, values, since, until, match["about"] or "")


class FaultInjector:
    """Changes the messages of one robot. The same messages and name give the same changes."""

    def __init__(self, fault: Fault, name: str, start_ns: int) -> None:
        self._fault, self._name, self._start_ns = fault, name, start_ns
        self._random = random.Random(name)
        self._last_xy_m: dict[tuple[type, str], tuple[float, float]] = {}

    def alter(self, message: Help) -> Help:
        """What the robot sends in place of the message."""
        since_s = (message.stamp_ns - self._start_ns) * 1e-9
        is_active = self._fault.from_s <= since_s < self._fault.until_s
        is_active = is_active and self._fault.about in ("", _subject(message))
        if self._fault.kind == "frozen":
            return self._freeze(message, is_active)
        if not is_active:
            return message
        if self._fault.kind == "clock":
            return replace(message, stamp_ns=message.stamp_ns + int(self._fault.values[0] * 1e9))
        if self._fault.kind == "heading":
            return _with_heading(message, since_s - self._fault.from_s, *self._fault.values)
        dx, dy = self._offset(message.stamp_ns)
        message = replace(message, x_m=message.x_m + dx, y_m=message.y_m + dy)
        if self._fault.kind in ("drift", "overclaim"):
            return _with_stated_sigma(message, self._fault.values[2])
        if self._fault.kind == "one-axis":
            return _with_stated_sigma(message, *self._fault.values[1:])
        is_tiny = self._fault.kind == "overconfident"
        return _with_stated_sigma(message, STATED_SIGMA_M) if is_tiny else message

    def _offset(self, stamp_ns: int) -> tuple[float, float]:
        """Metres in x and y."""
        first, *others = self._fault.values
        if self._fault.kind in ("bias", "overclaim"):
            return first, others[0]
        if self._fault.kind in ("drift", "one-axis"):
            since_s = (stamp_ns - self._start_ns) * 1e-9 - self._fault.from_s
            return first * since_s, others[0] * since_s if self._fault.kind == "drift" else 0.0
        if self._fault.kind == "overconfident":
            return self._random.gauss(0.0, first), self._random.gauss(0.0, first)
        jump = (stamp_ns - self._start_ns) // JUMP_NS
        direction = random.Random(f"{self._name} {jump}").uniform(0.0, math.tau)
        return first * math.cos(direction), first * math.sin(direction)

    def _freeze(self, message: Help, is_active: bool) -> Help:
        key = type(message), _subject(message)
        if not is_active or key not in self._last_xy_m:
            self._last_xy_m[key] = message.x_m, message.y_m
        x, y = self._last_xy_m[key]
        return replace(message, x_m=x, y_m=y)


def _subject(message: Help) -> str:
    """The robot or landmark that a message is about."""
    return message.landmark if isinstance(message, LandmarkBelief) else message.robot


def _with_stated_sigma(message: Help, sigma_m: float, vague_m: float | None = None) -> Help:
    """With this sigma along both axes, or with another one along y. Of a fix the larger one is the
    observer's own, for the mean of many fixes is as vague as that."""
    variance = sigma_m**2
    along_y = variance if vague_m is None else vague_m**2
    position = (variance, 0.0, along_y)
    if isinstance(message, Fix):
        sensor = (variance, 0.0, variance)
        return replace(message, sensor_covariance=sensor, observer_covariance=position)
    if isinstance(message, LandmarkBelief):
        return replace(message, covariance=position)
    return replace(message, covariance=(*position, 0.0, 0.0, variance))


def _with_heading(message: Help, for_s: float, turn_deg_s: float, sigma_deg: float) -> Help:
    """A belief, or a fix with a heading, whose heading has turned for so long."""
    if isinstance(message, LandmarkBelief) or message.heading_rad is None:
        return message
    heading = math.remainder(message.heading_rad + math.radians(turn_deg_s * for_s), math.tau)
    message, variance = replace(message, heading_rad=heading), math.radians(sigma_deg) ** 2
    if isinstance(message, Fix):
        return replace(
            message, heading_sensor_variance=variance, heading_observer_variance=variance
        )
    xx, xy, yy, *_ = message.covariance
    return replace(message, covariance=(xx, xy, yy, 0.0, 0.0, variance))


class _FaultyPublisher(PublisherProxy):
    def __init__(self, key: str, publisher: Publisher, injector: FaultInjector) -> None:
        super().__init__(publisher)
        self._key, self._injector = key, injector

    def put(self, payload: bytes) -> None:
        message = decode_help(self._key, payload)
        assert not isinstance(message, Refusal)  # the robot itself works correctly
        super().put(encode_help(self._injector.alter(message)))


class FaultyBus(BusProxy):
    """A bus that changes the help of the robot `name` when they are sent."""

    def __init__(self, bus: Bus, fault: Fault, name: str, start_ns: int) -> None:
        super().__init__(bus)
        self._injector = FaultInjector(fault, name, start_ns)

    def publisher(self, key: str, qos: Qos) -> Publisher:
        publisher = super().publisher(key, qos)
        if not key.startswith(_HELP_KEYS):
            return publisher
        return _FaultyPublisher(key, publisher, self._injector)


def faulty_command(command: Sequence[str], fault: str) -> tuple[str, ...]:
    """The command of a faulty robot, made from that of the robot (`cpcbl-team robot ...`)."""
    after = len(PROGRAM)
    assert tuple(command[: after + 1]) == (*PROGRAM, "robot")
    program = (sys.executable, "-m", "cpcbl_launch.lab.faulty_robot")
    return (*program, *command[after + 1 :], "--fault", fault)


def main() -> None:
    """Runs one faulty robot until SIGINT, SIGTERM or SIGHUP."""
    parser = robot_parser("faulty_robot")
    parser.add_argument("--fault", required=True, help="For example bias:0.5,0.5@10-30.")
    arguments = parser.parse_args()
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.INFO)
    try:
        fault = Fault.parse(arguments.fault)
        run_robot_command(
            arguments, lambda name, clock, bus: FaultyBus(bus, fault, name, clock.epoch_ns)
        )
    except CpcblError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
