"""Errors of odometry and bearings that are too large for a wrong calibration, as problems."""

from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.miscalibration import implausible_now

_IS = "are off by more than any calibration error"
TEXTS = {
    "distances": f"odometry: distances {_IS}; check their unit, sign and frame",
    "turns": f"odometry: turns {_IS}; check their unit and sign",
    "bearings": f"sightings: bearings {_IS}; ahead is 0, left is positive",
}


class ImplausibleErrors:
    """What the corrections of the pose say, until they say otherwise."""

    def __init__(self) -> None:
        self._text = ""
        self._is_named = False

    def update(self, memory: CalibrationMemory, is_named: bool) -> str:
        """The problem; empty if there is none. `is_named`: whether its cause is said already. Then
        these corrections are not judged again once it is mended."""
        errors = implausible_now(memory.check, memory.adaptation)
        self._is_named = is_named or (self._is_named and errors is not None)
        if self._is_named:
            self._text = ""
        elif errors is not None:
            self._text = TEXTS[errors[0]] if errors else ""
        return self._text
