"""A robot that is let in and says what is not so: for experiments and for trying faults out.

`LyingBus` stands between an honest robot and its bus and changes the fixes and beliefs that leave
it; the robot itself does not know. A lie is written `KIND:VALUES@FROM-UNTIL`, seconds after the
start, from its own start to the end where the times are left out:

| `bias:0.5,0.5` | everything so many metres away, x and y |
| `frozen` | each teammate, and itself, where it saw it last |
| `jumps:1.5` | everything so far away, every 2 s in another direction |
| `overconfident:0.3` | with an error of this sigma in metres, and a claim of 1 mm |
| `clock:0.5` | stamped so many seconds later (below zero: earlier) |
"""

import math
import random
import re
from collections.abc import Callable
from typing import NamedTuple

import msgspec

from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Belief, Fix
from cpcbl_transport.bus import Bus, Publisher
from cpcbl_transport.bus_proxy import PassingBus, PassingPublisher
from cpcbl_transport.compact import decode_help, encode_help
from cpcbl_transport.messages import Refusal
from cpcbl_transport.topics import Qos

Help = Belief | Fix
ARGUMENTS = {"bias": 2, "frozen": 0, "jumps": 1, "overconfident": 1, "clock": 1}
JUMP_NS = 2_000_000_000
CLAIM_M = 0.001
_HELP = ("fix/", "belief/")
_TEXT = re.compile(r"(?P<kind>[a-z]+)(:(?P<values>[^@]*))?(@(?P<since>[^-@]+)-(?P<until>[^-@]*))?")


class Lie(NamedTuple):
    """What is said, and when."""

    kind: str
    values: tuple[float, ...] = ()
    from_s: float = 0.0
    until_s: float = math.inf

    @staticmethod
    def parse(text: str) -> "Lie":
        """Raises InputError."""
        match = _TEXT.fullmatch(text)
        kind = match["kind"] if match else ""
        if match is None or kind not in ARGUMENTS:
            raise InputError(f"--lie {text}: write {', '.join(ARGUMENTS)}, e.g. bias:0.5,0.5@10-30")
        try:
            values = tuple(float(v) for v in (match["values"] or "").split(",") if v)
            since, until = float(match["since"] or 0.0), float(match["until"] or math.inf)
        except ValueError:
            raise InputError(f"--lie {text}: numbers, e.g. bias:0.5,0.5@10-30") from None
        if len(values) != ARGUMENTS[kind] or not all(map(math.isfinite, values)):
            raise InputError(f"--lie {text}: {kind} takes {ARGUMENTS[kind]} numbers")
        return Lie(kind, values, since, until)


class Liar:
    """Changes what a robot says. The same words and the same name give the same lies."""

    def __init__(self, lie: Lie, name: str, start_ns: int) -> None:
        self._lie, self._start_ns = lie, start_ns
        self._name = name
        self._random = random.Random(name)
        self._last: dict[tuple[type, str], tuple[float, float]] = {}

    def said(self, message: Help) -> Help:
        """What leaves the robot in place of its message."""
        since_s = (message.stamp_ns - self._start_ns) * 1e-9
        lies = self._lie.from_s <= since_s < self._lie.until_s
        if self._lie.kind == "frozen":
            return self._frozen(message, lies)
        if not lies:
            return message
        replace = msgspec.structs.replace
        if self._lie.kind == "clock":
            return replace(message, stamp_ns=message.stamp_ns + int(self._lie.values[0] * 1e9))
        dx, dy = self._offset(message.stamp_ns)
        message = replace(message, x_m=message.x_m + dx, y_m=message.y_m + dy)
        return _certain(message) if self._lie.kind == "overconfident" else message

    def _offset(self, stamp_ns: int) -> tuple[float, float]:
        first, *_ = self._lie.values
        if self._lie.kind == "bias":
            return first, self._lie.values[1]
        if self._lie.kind == "overconfident":
            return self._random.gauss(0.0, first), self._random.gauss(0.0, first)
        turn = (stamp_ns - self._start_ns) // JUMP_NS
        direction = random.Random(f"{self._name} {turn}").uniform(0.0, math.tau)
        return first * math.cos(direction), first * math.sin(direction)

    def _frozen(self, message: Help, lies: bool) -> Help:
        key = type(message), message.robot
        if not lies or key not in self._last:
            self._last[key] = message.x_m, message.y_m
        x, y = self._last[key]
        return msgspec.structs.replace(message, x_m=x, y_m=y)


def _certain(message: Help) -> Help:
    """With next to no covariance."""
    tiny, replace = CLAIM_M * CLAIM_M, msgspec.structs.replace
    if isinstance(message, Fix):
        claim = (tiny, 0.0, tiny)
        return replace(message, sensor_covariance=claim, observer_covariance=claim)
    return replace(message, covariance=(tiny, 0.0, tiny, 0.0, 0.0, tiny))


class _LyingPublisher(PassingPublisher):
    def __init__(self, key: str, publisher: Publisher, liar: Liar) -> None:
        super().__init__(publisher)
        self._key, self._liar = key, liar

    def put(self, payload: bytes) -> None:
        message = decode_help(self._key, payload)
        assert not isinstance(message, Refusal)  # the robot itself is honest
        super().put(encode_help(self._liar.said(message)))


class LyingBus(PassingBus):
    """A bus on which fixes and beliefs are changed on their way out."""

    def __init__(self, bus: Bus, liar: Liar) -> None:
        super().__init__(bus)
        self._liar = liar

    def publisher(self, key: str, qos: Qos) -> Publisher:
        publisher = super().publisher(key, qos)
        return _LyingPublisher(key, publisher, self._liar) if key.startswith(_HELP) else publisher


def lying(lie: Lie | None, name: str, start_ns: int) -> Callable[[Bus], Bus]:
    """What makes a liar of the robot whose bus it is given; nothing does without a lie."""
    return lambda bus: bus if lie is None else LyingBus(bus, Liar(lie, name, start_ns))
