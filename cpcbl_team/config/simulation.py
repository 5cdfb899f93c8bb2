"""The simulated field: its noise, its light and the events on it."""

from typing import Annotated

import msgspec

from cpcbl_team.config.table import NotNegative, Positive, Table


class SimulationEvent(Table, frozen=True, kw_only=True):
    """Something that happens on the simulated field: a robot is carried away, or landmarks are
    hidden."""

    at_s: NotNegative
    """Robot time since the start of the field."""
    kidnap: str = ""
    """The robot that is carried away; its odometry does not notice."""
    to: tuple[float, float, float] | None = None
    """Where it is put down: x m, y m, heading deg."""
    hide_landmarks_s: NotNegative = 0.0
    """For this time no robot sees a landmark or wall."""


class Light(Table, frozen=True, kw_only=True):
    """The light in the rendered images of the simulated cameras."""

    brightness: Positive = 1.0
    gradient: Annotated[float, msgspec.Meta(ge=-2.0, le=2.0)] = 0.2
    """By how much the left of an image is brighter than its right, as a share of the middle."""
    tint: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    """The factors of blue, green and red."""
    blur_px: NotNegative = 0.6
    """The standard deviation of a Gaussian."""
    noise: NotNegative = 3.0
    """The standard deviation, in 255 grey levels."""


class SimulationSettings(Table, frozen=True, kw_only=True):
    """The simulated field."""

    step_rate_hz: Positive = 50.0
    noise: NotNegative = 1.0
    """The true noise as a multiple of what the robots assume; 0 for none."""
    bump_radius_m: NotNegative = 0.15
    light: Light = Light()
    events: tuple[SimulationEvent, ...] = ()
    clocks_ahead_s: dict[str, float] = msgspec.field(default_factory=dict)
    """By how much the clocks of these robots are ahead of the field's. What such a robot senses has
    time stamps of its own clock."""
