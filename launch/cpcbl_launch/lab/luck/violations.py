"""What holds of every history, and what did not hold of one (docs/luck.md)."""

import msgspec

INVARIANTS = {
    "no exception": "no agent raises an exception",
    "not uphill": "help is used from better tiers only, and nothing else is subscribed to",
    "in budget": "no window of time contains more than the budget, counted on the bus",
    "used once": "no input is used twice",
    "not too late": "nothing is used that is older than the horizon",
    "in order": "states are those of the inputs in the order of their times, to the bit",
    "counted": "what was delivered was used, or counted with its reason",
    "quarantined": "nothing of a teammate in quarantine is used",
    "bounded": "what a robot keeps and declares is bounded",
    "consistent": "stated uncertainties hold",
    "recorded": "a full disk ends a recording, which says so; what is recorded replays",
    "lost honestly": "a robot that is wrong says so",
    "nobody waits": "after the last event all are localized, helped and trusted again",
}


class Violation(msgspec.Struct, frozen=True):
    """An invariant that did not hold: when, of which robot, and what was wrong."""

    invariant: str
    robot: str
    at_s: float
    what: str

    def __str__(self) -> str:
        return f"{self.invariant}: at {self.at_s:.2f} s, {self.robot or 'the team'}: {self.what}"
