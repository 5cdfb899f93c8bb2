"""Which history a seed makes. Pure functions of the seed."""

from random import Random

from cpcbl_launch.lab.luck.history import INSTANT, Event, History, Kind
from cpcbl_launch.lab.luck.teams import GUESTS, team_of

DURATION_S, QUIET_S, FIRST_S = 60.0, 25.0, 6.0
"""A history's length, the time without events at its end, and when the first event may begin."""
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
}


def history_of(seed: int, duration_s: float = DURATION_S) -> History:
    """The history of this seed. No event begins on a robot while another of its kind lasts."""
    dice, robots = Random(f"history {seed}"), tuple(team_of(seed).robots)
    last_s = duration_s - min(QUIET_S, duration_s / 2.0)
    guides = tuple(name for name in robots if name.startswith("guide"))
    at_s, events = FIRST_S, list[Event]()
    while at_s < last_s - LASTS_S[0]:
        kind = dice.choices(list(WEIGHTS), list(WEIGHTS.values()))[0]
        targets = {"guest": GUESTS, "dark": ("",), "kidnap": guides or ("",)}.get(kind, robots)
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
