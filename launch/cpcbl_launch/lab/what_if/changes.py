"""What is to be different in a run that is made again: robots, landmarks, sensors, settings."""

import tomllib
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import replace

from cpcbl_launch.lab.what_if.inputs import (
    BUS,
    DETECTOR,
    LOG,
    RecordedInputs,
    RecordedProcess,
    Taken,
)
from cpcbl_launch.team.faults import layer_faults, one_line, table_faults
from cpcbl_launch.team.file import TeamFileError, decode_resolved
from cpcbl_launch.team.overrides import Overrides, with_overrides
from cpcbl_team.config import RobotSettings, Team
from cpcbl_team.errors import InputError, nearest_name
from cpcbl_team.inputs import Sightings
from cpcbl_transport.decoding import decode_by_key
from cpcbl_transport.messages import (
    LARGEST_FRAME,
    SensorInput,
    decode_tagged,
    encode,
    input_name,
)

SENSORS = ("sightings", "position", "initial_pose")
"""What a robot can do without; without odometry nothing is left of a run."""
SHORT = {
    "variant": "localizer.variant",
    "fusion": "collaboration.fusion",
    "direction": "collaboration.direction",
    "bytes_per_s": "collaboration.budget.bytes_per_s",
    "messages_per_minute": "collaboration.budget.messages_per_minute",
    "match_messages": "match.messages",
}
"""Keys by the names of the options that `evaluate` has for them."""
COLLABORATION = ("none", "passive", "active", "both")
RECORDED_KEYS = {
    "sensing": "the sightings are those that were recorded",
    "source": "the inputs are those that were recorded",
    "simulation": "nothing is simulated: the inputs are those that were recorded",
    "waypoints_m": "the robots drove as they were recorded",
    "speed_m_s": "the robots drove as they were recorded",
    "rate_hz": "the inputs came as often as they were recorded",
    "vision": "the sightings are those that were recorded",
    "markers": "the sightings are those that were recorded",
    "colours": "the sightings are those that were recorded",
    "pose_rate_hz": "nobody reads the poses of a run that is made again",
    "transport": "the robots share one bus in memory",
    "gateway": "the robots share one bus in memory",
    "ros2": "the robots share one bus in memory",
    "recording": "a run that is made again is not recorded",
    "data": "the inputs are those that were recorded",
    "name": "a team keeps its name",
    "robots": "name a key of a robot, or leave a robot out by --without",
}
"""Keys that cannot be changed in a recorded run, and why."""


class Change(NamedTuple):
    """What is different; by default nothing is."""

    without: tuple[str, ...] = ()  # robots and guests
    hide: tuple[str, ...] = ()  # landmarks and walls, which nobody sees
    settings: tuple[str, ...] = ()  # KEY=VALUE
    sensors: tuple[tuple[str, str], ...] = ()  # robot and input, which it does not get

    def __str__(self) -> str:
        words = [f"without {name}" for name in self.without]
        words += [f"{name} hidden" for name in self.hide]
        words += [*self.settings, *(f"{robot} without {name}" for robot, name in self.sensors)]
        return ", ".join(words) or "nothing changed"


def with_change(inputs: RecordedInputs, change: Change) -> RecordedInputs:
    """The inputs of the changed run. Raises InputError for what the run does not have, or for
    settings that change nothing in it or cannot be used."""
    _require(inputs, change)
    processes = [
        process._replace(
            team=_changed_team(process.team, change),
            taken=tuple(_changed_inputs(process, change)),
        )
        for process in inputs.processes
        if process.robot not in change.without
    ]
    return inputs._replace(team=_changed_team(inputs.team, change), processes=tuple(processes))


def _require(inputs: RecordedInputs, change: Change) -> None:
    robots = {*inputs.robots, *inputs.team.robots}
    marks = inputs.team.map.names
    for name in change.without:
        _require_known("--without", name, robots, "robot")
    for text in change.settings:
        if robot := _robot_of(text):
            _require_known(f"--set {text}:", robot, robots, "robot")
    for name in change.hide:
        _require_known("--hide", name, marks, "landmark or wall")
    if not set(inputs.robots) - set(change.without):
        raise InputError(f"--without {', '.join(change.without)}: no robot is left; keep one")


def _require_known(option: str, name: str, known: Collection[str], what: str) -> None:
    if name not in known:
        near = nearest_name(name, known)
        hint = (
            f"did you mean {near}?" if near else f"there are {', '.join(sorted(known)) or 'none'}"
        )
        raise InputError(f"{option} {name}: the run has no {what} of this name; {hint}")


# Inputs -------------------------------------------------------------------------------------------


def _changed_inputs(process: RecordedProcess, change: Change) -> Iterator[Taken]:
    hidden = {*change.without, *change.hide}
    missing = {name for robot, name in change.sensors if robot == process.robot}
    if not (hidden or missing):
        yield from process.taken
        return
    for taken in process.taken:
        message = _message(taken)
        if _input_of(taken, message) in missing:
            continue
        if isinstance(message, Sightings):
            kept = tuple(s for s in message.sightings if s.id not in hidden)
            if not kept and message.sightings and taken.way == LOG:
                continue  # a log has no frames without a sighting
            if len(kept) < len(message.sightings):
                taken = taken._replace(payload=encode(replace(message, sightings=kept)))
        yield taken


def _message(taken: Taken) -> object:
    """What was taken; no message if it could not be read."""
    if taken.way == BUS:
        return decode_by_key(taken.key, taken.payload)
    return decode_tagged(taken.payload, LARGEST_FRAME)


def _input_of(taken: Taken, message: object) -> str:
    """The name of the input; sightings, whoever found them."""
    if taken.way == DETECTOR:
        return "sightings"
    return input_name(message) if isinstance(message, SensorInput) else ""


def sensed(process: RecordedProcess) -> tuple[set[str], set[str]]:
    """The inputs that the robot got and can do without, and what it had sightings of."""
    messages = [(taken, _message(taken)) for taken in process.taken]
    inputs = {_input_of(taken, message) for taken, message in messages}
    seen = [m.sightings for _, m in messages if isinstance(m, Sightings)]
    return inputs.intersection(SENSORS), {s.id for sightings in seen for s in sightings}


# Settings -----------------------------------------------------------------------------------------


def _changed_team(team: Team, change: Change) -> Team:
    for text in change.settings:
        robot = _robot_of(text)
        if not robot or robot in team.robots:  # the team of another process may not know a guest
            team = with_setting(team, text)
    kept = {name: robot for name, robot in team.robots.items() if name not in change.without}
    return replace(team, robots=kept)


def _robot_of(text: str) -> str:
    """The one robot that a setting is of; empty if it is of all."""
    parts = text.partition("=")[0].split(".")
    return parts[1] if parts[0] == "robots" and len(parts) > 2 else ""


def with_setting(team: Team, text: str) -> Team:
    """The team with one key set, of all robots or of one: `fusion=naive`,
    `sensor.range_share=0.1`, `robots.r3.localizer.variant=oval`, `match.messages=100`. Raises
    InputError."""
    key, equals, word = (part.strip() for part in text.partition("="))
    if not equals:
        raise InputError(f"--set {text}: not KEY=VALUE; write e.g. --set fusion=naive")
    value = _value(word)
    if key == "collaboration":
        if value not in COLLABORATION:
            raise InputError(f"--set {text}: unknown; write one of {', '.join(COLLABORATION)}")
        return with_overrides(team, Overrides(collaboration=value))
    robot, parts = _robot_of(text), SHORT.get(key, key).removeprefix("defaults.").split(".")
    if robot:
        parts = parts[2:]
    is_of_robots = bool(robot) or parts[0] in RobotSettings.__struct_fields__
    _refuse_faults(text, parts, value, is_of_robots)
    raw: dict[str, Any] = msgspec.to_builtins(team)
    tables: list[dict[str, Any]] = [raw]
    if is_of_robots:
        tables = [raw["robots"][robot]] if robot else [*raw["robots"].values(), raw["defaults"]]
    for table in tables:
        _set(table, parts, value, text)
    try:
        return decode_resolved(msgspec.json.encode(raw), f"--set {text}")
    except TeamFileError as error:
        raise InputError(one_line(str(error).splitlines()[0])) from error


def _refuse_faults(text: str, parts: list[str], value: object, is_of_robots: bool) -> None:
    """Raises InputError for a key or a value that no team file has, or that a recorded run has
    already used."""
    if not is_of_robots and parts[0] not in Team.__struct_fields__:
        known = {*SHORT, "collaboration", *RobotSettings.__struct_fields__}
        near = nearest_name(parts[0], known | {*Team.__struct_fields__})
        hint = f"did you mean {near}?" if near else "see the keys of team files"
        raise InputError(f"--set {text}: no such key; {hint}")
    for part in {parts[0], parts[-1]}:
        if part in RECORDED_KEYS:
            why = RECORDED_KEYS[part]
            raise InputError(f"--set {text}: changes nothing in a recorded run: {why}")
    table: Any = value
    for part in reversed(parts):
        table = {part: table}
    whole = {"name": "x", "robots": {"x": {}}, **table}
    path = ".".join(parts)  # what else is missing in its table is in the run
    for fault in layer_faults(table) if is_of_robots else table_faults(whole):
        if f"{path}.".startswith(f"{fault.key}."):
            raise InputError(f"--set {text}: {one_line(str(fault))}")


def _set(table: dict[str, Any], parts: list[str], value: object, text: str) -> None:
    for part in parts[:-1]:
        if not isinstance(table.get(part), dict):
            raise InputError(f"--set {text}: there is no {part} in this run")
        table = table[part]
    table[parts[-1]] = value


def _value(word: str) -> Any:
    """A value as in a team file; a word that is none is a text."""
    try:
        return tomllib.loads(f"value = {word}")["value"]
    except tomllib.TOMLDecodeError:
        return word
