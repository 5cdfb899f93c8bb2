"""What drivers get wrong: changes of the messages that a good driver sends."""

import math
from collections.abc import Callable, Sequence
from typing import Any

from msgspec.structs import replace

from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Odometry, Position, Sighting, Sightings
from cpcbl_transport.messages import SensorInput
from support.buses import SECOND
from support.drivers import EPOCH, Change, Sent

FOOT_M = 0.3048
Kind = type[Odometry] | type[Sightings] | type[Position]


def of(kind: Kind, **fields: Callable[[Any], Any]) -> Change:
    """These fields of all messages of a kind; of frames, of each sighting."""

    def change(message: SensorInput, now_ns: int) -> Sequence[Sent]:
        if not isinstance(message, kind):
            return [message]
        if isinstance(message, Sightings):
            seen = (replace(s, **_changed(s, fields)) for s in message.sightings)
            return [Sightings(message.stamp_ns, tuple(seen))]
        return [replace(message, **_changed(message, fields))]

    return change


def _changed(of_whom: Any, fields: dict[str, Callable[[Any], Any]]) -> dict[str, Any]:
    return {name: new(of_whom) for name, new in fields.items()}


def bearings(new: Callable[[float], float]) -> Change:
    """Each bearing, of -π to π again."""

    def turned(s: Sighting) -> float:
        assert s.bearing_rad is not None
        return wrap_angle(new(s.bearing_rad))

    return of(Sightings, bearing_rad=turned)


def stamps(kind: Kind, new: Callable[[int], int]) -> Change:
    """All stamps of one kind."""

    def change(message: SensorInput, now_ns: int) -> Sequence[Sent]:
        if not isinstance(message, kind):
            return [message]
        more = {"from_ns": new(message.from_ns)} if isinstance(message, Odometry) else {}
        return [replace(message, stamp_ns=new(message.stamp_ns), **more)]

    return change


def sent(kind: Kind, send: Callable[[SensorInput], Sequence[Sent]]) -> Change:
    """What is sent in the place of a message of this kind."""
    return lambda message, now_ns: send(message) if isinstance(message, kind) else [message]


def silent(kind: Kind, after_s: float) -> Change:
    def change(message: SensorInput, now_ns: int) -> Sequence[Sent]:
        return [] if isinstance(message, kind) and now_ns - EPOCH > after_s * SECOND else [message]

    return change


class HeldBack:
    """So many messages at a time, in order or not."""

    def __init__(self, kind: Kind, number: int, order: int = 1) -> None:
        self._kind, self._number, self._order = kind, number, order
        self._held: list[SensorInput] = []

    def __call__(self, message: SensorInput, now_ns: int) -> Sequence[Sent]:
        if not isinstance(message, self._kind):
            return [message]
        self._held.append(message)
        if len(self._held) < self._number:
            return []
        held, self._held = self._held, []
        return held[:: self._order]


class Totals:
    """Poses in the place of differences: distances since the start, headings."""

    def __init__(self, heading: float, *, distances: bool = True, unit: float = 1.0) -> None:
        self._distance_m, self._heading, self._unit = 0.0, heading, unit
        self._distances = distances

    def __call__(self, message: SensorInput, now_ns: int) -> Sequence[Sent]:
        if not isinstance(message, Odometry):
            return [message]
        self._distance_m += message.distance_m
        self._heading += message.turn_rad
        moved_m = self._distance_m if self._distances else message.distance_m
        return [replace(message, distance_m=moved_m, turn_rad=self._unit * self._heading)]


class FromField:
    """Bearings that count from a direction of the field: x to the left, or north to the right."""

    def __init__(self, heading: float, north: bool) -> None:
        self._heading, self._north = heading, north

    def __call__(self, message: SensorInput, now_ns: int) -> Sequence[Sent]:
        if isinstance(message, Odometry):
            self._heading += message.turn_rad

        def new(bearing: float) -> float:
            absolute = bearing + self._heading
            return 0.5 * math.pi - absolute if self._north else absolute

        return bearings(new)(message, now_ns)
