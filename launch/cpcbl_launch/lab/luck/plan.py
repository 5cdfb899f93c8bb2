"""Which history a seed makes, and which one a file holds."""

from pathlib import Path
from random import Random

import msgspec

from cpcbl_launch.lab.luck.history import INSTANT, Event, History, Kind
from cpcbl_launch.lab.luck.teams import GUESTS, OBSERVER, team_of
from cpcbl_launch.team.faults import one_line
from cpcbl_team.errors import InputError

DURATION_S, QUIET_S, FIRST_S = 60.0, 25.0, 6.0
"""A history's length, the time without events at its end, and when the first event may begin."""
LONGEST_S = 86_400.0  # of a history in a file
EVERY_S = (0.5, 4.0)
LASTS_S = (1.0, 8.0)
STRENGTHS: dict[Kind, tuple[float, float]] = {
    "loss": (0.2, 0.9),
    "delay": (0.05, 3.5),
    "copies": (0.2, 1.0),
    "clock-step": (-2.0, 2.0),
    "clock-drift": (-300.0, 300.0),
    "late-inputs": (0.02, 0.4),
    "lost-inputs": (0.05, 0.3),
    "liar": (0.5, 1.5),
    "kidnap": (2.0, 4.0),
}
WEIGHTS: dict[Kind, int] = {
    "loss": 3,
    "delay": 4,
    "copies": 4,
    "cut": 2,
    "mute": 2,
    "deaf": 2,
    "hidden-tokens": 2,
    "kill": 3,
    "pause": 3,
    "clock-step": 2,
    "clock-drift": 2,
    "garbage": 2,
    "flood": 1,
    "token-flood": 1,
    "odd-sightings": 1,
    "late-inputs": 3,
    "lost-inputs": 1,
    "guest": 2,
    "liar": 1,
    "dark": 2,
    "kidnap": 1,
    "disk-full": 1,
}


def history_of(seed: int, duration_s: float = DURATION_S) -> History:
    """The history of this seed. No event begins on a robot while another of its kind lasts."""
    dice, robots = Random(f"history {seed}"), tuple(team_of(seed).robots)
    last_s = duration_s - min(QUIET_S, duration_s / 2.0)
    at_s, events = FIRST_S, list[Event]()
    while at_s < last_s - LASTS_S[0]:
        kind = dice.choices(list(WEIGHTS), list(WEIGHTS.values()))[0]
        targets = {"guest": GUESTS, "dark": ("",)}.get(kind, robots)
        lasts_s = 0.0 if kind in INSTANT else dice.uniform(*LASTS_S)
        until_s = min(at_s + lasts_s, last_s)
        robot = dice.choice(targets)
        strength = dice.uniform(*STRENGTHS.get(kind, (0.0, 0.0)))
        busy = any(e.kind == kind and e.robot == robot and e.until_s >= at_s for e in events)
        if not busy and not (kind == "liar" and any(e.kind == kind for e in events)):
            event = Event(len(events), kind, robot, at_s, until_s, round(strength, 3))
            events.append(event)
        at_s += dice.uniform(*EVERY_S)
    return History(seed, duration_s, robots, tuple(events))


def read_history(path: Path) -> History:
    """The history in a file. Raises InputError."""
    try:
        history = msgspec.json.decode(path.read_bytes(), type=History)
    except OSError as error:
        raise InputError(f"--replay {path}: {error.strerror}") from error
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"--replay {path}: not a history: {one_line(str(error))}") from error
    if problem := _problem(history):
        raise InputError(f"--replay {path}: not a history of this version: {problem}")
    return history


def _problem(history: History) -> str:
    """Why a history cannot be run; empty if it can."""
    known = tuple(team_of(history.seed).robots)
    if set(history.robots) - set(known) or len(set(history.robots)) < len(history.robots):
        return f"its robots are not those of its seed: {', '.join(known)}"
    if OBSERVER not in history.robots:
        return f"it lacks the robot {OBSERVER}"
    if not 0.0 < history.duration_s <= LONGEST_S:
        return f"duration_s must be above 0 and at most {LONGEST_S:g}"
    for event in history.events:
        lowest, highest = STRENGTHS.get(event.kind, (0.0, 0.0))
        targets = {"guest": GUESTS, "dark": ("",)}.get(event.kind, (*known, ""))
        if event.robot not in targets:
            return f"{event.kind} cannot happen to {event.robot!r:.40}"
        if not 0.0 <= event.from_s <= event.until_s <= LONGEST_S:
            return f"{event.kind} must begin after the start, and before it ends"
        if not min(lowest, 0.0) <= event.strength <= highest:
            return f"{event.kind} has a strength from {lowest:g} to {highest:g}"
    return ""
