"""A history of bad luck: a team, a seed and events. Plain data, a small file, and sentences."""

from collections.abc import Iterable
from typing import Literal

import msgspec
from msgspec.structs import replace

Kind = Literal[
    "loss",
    "delay",
    "copies",
    "cut",
    "mute",
    "deaf",
    "hidden-tokens",
    "kill",
    "pause",
    "clock-step",
    "clock-drift",
    "garbage",
    "flood",
    "token-flood",
    "odd-sightings",
    "late-inputs",
    "lost-inputs",
    "guest",
    "liar",
    "dark",
    "kidnap",
    "disk-full",
]
SENTENCES: dict[Kind, str] = {
    "loss": "{robot} loses {strength:.0%} of the help that it sends and receives",
    "delay": "help from and to {robot} comes up to {strength:.2f} s late, in another order",
    "copies": "{strength:.0%} of the help from and to {robot} comes twice",
    "cut": "the link of {robot} is cut in both directions",
    "mute": "nobody receives what {robot} sends",
    "deaf": "{robot} receives nothing from the others",
    "hidden-tokens": "nothing that {robot} declares or takes back reaches the others",
    "kill": "the process of {robot} is killed, and starts again at the end",
    "pause": "{robot} does not step, and then handles all that has arrived",
    "clock-step": "the clock of {robot} is wrong by {strength:+.2f} s",
    "clock-drift": "the clock of {robot} gains {strength:+.0f} ppm",
    "garbage": "a member sends meaningless payloads on the keys of {robot}",
    "flood": "a member sends thousands of meaningless payloads a second to {robot}",
    "token-flood": "a member declares tokens and sends help under ever new names to {robot}",
    "odd-sightings": "the driver of {robot} also sends sightings that are no good",
    "late-inputs": "inputs of {robot} come up to {strength:.2f} s late, in another order",
    "lost-inputs": "{strength:.0%} of the inputs of {robot} are lost",
    "guest": "the guest {robot} is there",
    "liar": "the help of {robot} is wrong by {strength:.1f} m",
    "dark": "no robot sees a landmark",
    "kidnap": "{robot} is carried {strength:.1f} m away",
    "disk-full": "the disk is full on which {robot} is recorded",
}
INSTANT: tuple[Kind, ...] = ("kidnap",)


class Event(msgspec.Struct, frozen=True):
    """Something that goes wrong. Seconds of true time after the team's start."""

    number: int  # of the event in its first history: it determines the event's dice
    kind: Kind
    robot: str
    from_s: float
    until_s: float
    strength: float = 0.0

    def __str__(self) -> str:
        text = SENTENCES[self.kind].format(robot=self.robot or "the team", strength=self.strength)
        if self.kind in INSTANT:
            return f"At {self.from_s:.2f} s {text}."
        return f"From {self.from_s:.2f} s to {self.until_s:.2f} s {text}."


class History(msgspec.Struct, frozen=True):
    """All that a run depends on, beside the program."""

    seed: int
    duration_s: float
    robots: tuple[str, ...]  # those of the seed's team that take part
    events: tuple[Event, ...]

    @property
    def healed_s(self) -> float:
        """When the last event is over."""
        return max((event.until_s for event in self.events), default=0.0)

    def of_kind(self, *kinds: Kind) -> list[Event]:
        return [event for event in self.events if event.kind in kinds]

    def with_events(self, events: Iterable[Event]) -> "History":
        return replace(self, events=tuple(events))

    def sentences(self) -> list[str]:
        """What happens, for people."""
        first = f"A team of {', '.join(self.robots)} (seed {self.seed}) for {self.duration_s:g} s."
        return [first, *(str(event) for event in sorted(self.events, key=lambda e: e.from_s))]


def history_text(history: History) -> bytes:
    """The file of a history."""
    return msgspec.json.format(msgspec.json.encode(history), indent=1) + b"\n"
