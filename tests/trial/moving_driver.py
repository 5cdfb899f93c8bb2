"""A robot that drives to and fro, and its driver, which makes the mistake that a file names.

python moving_driver.py TEAM_FILE ROBOT MISTAKE_FILE

It publishes JSON with Zenoh alone, as a program in any language does, and prints where the robot
truly is (x, y in m). The robot sees the landmarks that are within its field of view.
"""

import json
import math
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

PERIOD_S = 0.1
SPEED_M_S, SWING_RAD, SWINGS_RAD_S = 0.1, 0.6, 0.8  # it is back after 2π / SWINGS_RAD_S seconds
HALF_VIEW_RAD = math.radians(50.0)


class Message(NamedTuple):
    """One input as it is published."""

    team: str
    robot: str
    input: str
    content: dict[str, Any]


Mistake = Callable[[Message], list[Message]]


def changed(message: Message, **values: object) -> list[Message]:
    return [message._replace(content={**message.content, **values})]


def stamped(stamp: Callable[[int], int]) -> Mistake:
    """Another time in all stamps."""

    def mistake(message: Message) -> list[Message]:
        stamps = {k: stamp(v) for k, v in message.content.items() if k.endswith("_ns")}
        return changed(message, **stamps)

    return mistake


def seen(key: str, value: Callable[[float], float]) -> Mistake:
    """Another value in all sightings."""

    def mistake(message: Message) -> list[Message]:
        if message.input != "sightings":
            return [message]
        sightings = [{**s, key: value(s[key])} for s in message.content["sightings"]]
        return changed(message, sightings=sightings)

    return mistake


def moved(key: str, value: Callable[[float], float]) -> Mistake:
    """Another value in all odometry."""

    def mistake(message: Message) -> list[Message]:
        is_odometry = message.input == "odometry"
        return changed(message, **{key: value(message.content[key])}) if is_odometry else [message]

    return mistake


def wrong_key(message: Message) -> list[Message]:
    content = message.content.copy()
    if message.input == "odometry":
        content["distance"] = content.pop("distance_m")
    return [message._replace(content=content)]


def wrong_landmark(message: Message) -> list[Message]:
    sightings = message.content.get("sightings", ())
    named = [{**s, "id": s["id"].title()} for s in sightings]
    return changed(message, sightings=named) if sightings else [message]


def lost_pieces(message: Message) -> list[Message]:
    is_kept = (
        message.input != "odometry" or message.content["stamp_ns"] % 2_000_000_000 < 150_000_000
    )
    return [message] if is_kept else []


MISTAKES: dict[str, Mistake] = {
    "none": lambda message: [message],
    "bearings in degrees": seen("bearing_rad", math.degrees),
    "ranges in mm": seen("range_m", lambda m: 1000.0 * m),
    "distances in mm": moved("distance_m", lambda m: 1000.0 * m),
    "turns in degrees": moved("turn_rad", math.degrees),
    "stamps in s": stamped(lambda ns: ns // 10**9),
    "stamps in ms": stamped(lambda ns: ns // 10**6),
    "monotonic stamps": stamped(lambda ns: ns - time.time_ns() + time.monotonic_ns()),
    "stamps 2 s ahead": stamped(lambda ns: ns + 2 * 10**9),
    "stamps 5 s old": stamped(lambda ns: ns - 5 * 10**9),
    "wrong team": lambda message: [message._replace(team=message.team + "b")],
    "wrong robot": lambda message: [message._replace(robot=message.robot + "b")],
    "mirrored bearings": seen("bearing_rad", lambda rad: -rad),
    "NaN": moved("distance_m", lambda m: math.nan),
    "duplicates": lambda message: [message, message],
    "mirrored turns": moved("turn_rad", lambda rad: -rad),
    "bearings 90° off": seen(
        "bearing_rad", lambda rad: math.remainder(rad + 0.5 * math.pi, math.tau)
    ),
    "distances backwards": moved("distance_m", lambda m: -m),
    "lost pieces": lost_pieces,
    "silence": lambda message: [],
    "wrong key": wrong_key,
    "wrong landmark": wrong_landmark,
}


class Drive:
    """Where the robot truly is: to and fro, with a swinging heading."""

    def __init__(self, start: dict[str, float], landmarks: dict[str, dict[str, float]]) -> None:
        self.x_m, self.y_m, self.heading_rad = start["x_m"], start["y_m"], 0.0
        self._landmarks, self._since_s = landmarks, 0.0

    def step(self, seconds: float) -> tuple[float, float]:
        """Distance (m) and turn (rad) of the next piece."""
        until_s = self._since_s + seconds
        phases = SWINGS_RAD_S * self._since_s, SWINGS_RAD_S * until_s
        distance_m = SPEED_M_S / SWINGS_RAD_S * (math.sin(phases[1]) - math.sin(phases[0]))
        turn_rad = SWING_RAD * (math.sin(phases[1]) - math.sin(phases[0]))
        direction = self.heading_rad + 0.5 * turn_rad
        self.x_m += distance_m * math.cos(direction)
        self.y_m += distance_m * math.sin(direction)
        self.heading_rad += turn_rad
        self._since_s = until_s
        return distance_m, turn_rad

    def sightings(self) -> list[dict[str, Any]]:
        found = []
        for name, place in self._landmarks.items():
            dx, dy = place["x_m"] - self.x_m, place["y_m"] - self.y_m
            bearing = math.remainder(math.atan2(dy, dx) - self.heading_rad, 2.0 * math.pi)
            if abs(bearing) < HALF_VIEW_RAD:
                found.append({"id": name, "range_m": math.hypot(dx, dy), "bearing_rad": bearing})
        return found


def main(team_file: str, robot: str, mistake_file: str) -> None:
    team = tomllib.loads(Path(team_file).read_text())
    drive = Drive(team["robots"][robot]["start"], team["map"]["landmarks"])
    config = {"mode": "client", "connect": {"endpoints": team["transport"]["connect"]}}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        publishers: dict[str, zenoh.Publisher] = {}
        mistake, last_ns = MISTAKES["none"], time.time_ns()
        while True:
            time.sleep(PERIOD_S)
            from_ns, last_ns = last_ns, time.time_ns()
            distance_m, turn_rad = drive.step((last_ns - from_ns) * 1e-9)
            piece: dict[str, Any] = {"from_ns": from_ns, "stamp_ns": last_ns}
            piece |= {"distance_m": distance_m, "turn_rad": turn_rad}
            frame = {"stamp_ns": last_ns, "sightings": drive.sightings()}
            # The file is empty for a moment while it is written
            mistake = MISTAKES.get(Path(mistake_file).read_text(), mistake)
            for name, content in (("odometry", piece), ("sightings", frame)):
                for message in mistake(Message(team["name"], robot, name, content)):
                    key = f"cpcbl/{message.team}/in/{message.robot}/{message.input}"
                    if key not in publishers:
                        publishers[key] = session.declare_publisher(key)
                    publishers[key].put(json.dumps(message.content))
            sys.stdout.write(f"{drive.x_m:.4f} {drive.y_m:.4f}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
