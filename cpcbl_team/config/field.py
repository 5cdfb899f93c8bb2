"""The field: what is known of it before the robots start, and how it is simulated."""

import math
from typing import Annotated, Literal

import msgspec

from cpcbl_team.config.table import NotNegative, Positive, Table

Gives = Literal["both", "range", "bearing", "none"]
Frame = Literal["field", "agreed"]
Bands = tuple[str, str]
"""The names of two colours, the upper one first."""


class LandmarkPosition(Table, frozen=True, kw_only=True):
    """Where a landmark stands, in the field's frame."""

    x_m: float
    y_m: float
    sigma_m: NotNegative = 0.0
    """Standard deviation of its place along each axis of the field (m); 0: it is known exactly."""
    covariance_m2: tuple[float, float, float] | None = None
    """In place of `sigma_m`: the covariance (xx, xy, yy) of its place in the field's frame."""
    mapped_from: tuple[str, ...] = ()
    """The runs from which `calibrate map` estimated the place: they do not count twice."""

    @property
    def is_exact(self) -> bool:
        return self.sigma_m == 0.0 and not any(self.covariance_m2 or ())


class Landmark(LandmarkPosition, frozen=True, kw_only=True):
    """A point whose position in the field's frame is known beforehand."""

    gives: Gives = "both"
    """Which measurements of it the robots use."""
    colours: Bands | None = None
    """The colour bands of the cylinder that stands there, by which a camera recognises it."""


class Unsurveyed(Table, frozen=True, kw_only=True):
    """A point whose position nobody knows beforehand: the robots that see it find out."""

    gives: Gives = "both"
    """Which measurements of it the robots use."""
    colours: Bands | None = None
    """As of a landmark."""
    true_m: tuple[float, float] | None = None
    """Where it stands on the simulated field, in the field's frame. No robot knows it."""


class Wall(Table, frozen=True, kw_only=True):
    """A straight surface from one point of the field to another."""

    from_m: tuple[float, float]
    to_m: tuple[float, float]
    gives: Gives = "both"
    sigma_m: NotNegative = 0.0
    """Standard deviation of its middle along its normal (m)."""
    direction_sigma_deg: NotNegative = 0.0
    """Standard deviation of its direction."""
    mapped_from: tuple[str, ...] = ()
    """As of a landmark."""

    @property
    def is_exact(self) -> bool:
        return self.sigma_m == 0.0 and self.direction_sigma_deg == 0.0

    @property
    def direction_rad(self) -> float:
        """The direction from the first point to the second, in the field's frame."""
        return math.atan2(self.to_m[1] - self.from_m[1], self.to_m[0] - self.from_m[0])


class UnsurveyedWall(Table, frozen=True, kw_only=True):
    """A wall whose place nobody knows beforehand. Robots do not find it while they drive; it is
    found from their runs."""

    gives: Gives = "both"
    true_from_m: tuple[float, float] | None = None
    """Where it begins on the simulated field, in the field's frame. No robot knows it."""
    true_to_m: tuple[float, float] | None = None


class Field(Table, frozen=True, kw_only=True):
    """The map: all landmarks and walls by their names."""

    landmarks: dict[str, Landmark] = msgspec.field(default_factory=dict)
    walls: dict[str, Wall] = msgspec.field(default_factory=dict)
    unsurveyed: dict[str, Unsurveyed] = msgspec.field(default_factory=dict)
    unsurveyed_walls: dict[str, UnsurveyedWall] = msgspec.field(default_factory=dict)
    frame: Frame = "field"
    """agreed: a robot that knows neither its start nor the map begins a frame of its own, and
    robots that meet join the better one."""

    @property
    def is_frame_agreed(self) -> bool:
        """Whether the robots agree on a frame, for there is none of the map."""
        return self.frame == "agreed"

    @property
    def names(self) -> frozenset[str]:
        """The names of all that robots may see, but for robots."""
        return frozenset((*self.landmarks, *self.unsurveyed, *self.all_walls))

    @property
    def all_landmarks(self) -> dict[str, Landmark | Unsurveyed]:
        """All landmarks, those that nobody has surveyed too."""
        return {**self.landmarks, **self.unsurveyed}

    @property
    def all_walls(self) -> dict[str, Wall | UnsurveyedWall]:
        """All walls, those that nobody has surveyed too."""
        return {**self.walls, **self.unsurveyed_walls}

    @property
    def has_surveyed(self) -> bool:
        """Whether the place of any landmark or wall is known beforehand."""
        return bool(self.landmarks or self.walls)

    @property
    def gives_only_ranges(self) -> bool:
        """Whether there is something on the map, and no bearing of it is used."""
        gives = {mark.gives for mark in self.landmarks.values()}
        gives |= {wall.gives for wall in self.walls.values()}
        return "range" in gives and not gives & {"both", "bearing"}

    @property
    def is_exact(self) -> bool:
        """Whether all places of objects are known exactly."""
        if self.unsurveyed:
            return False
        points = all(landmark.is_exact for landmark in self.landmarks.values())
        return points and all(wall.is_exact for wall in self.walls.values())

    def has_exact(self, name: str) -> bool:
        """Whether the place of this object is known exactly, if any is known."""
        mark, wall = self.landmarks.get(name), self.walls.get(name)
        return (mark is None or mark.is_exact) and (wall is None or wall.is_exact)

    def bounds(self) -> tuple[float, float, float, float]:
        """(least x, least y, greatest x, greatest y) in metres of what is on the map; zeros for an
        empty map."""
        points = [(p.x_m, p.y_m) for p in self.landmarks.values()]
        points += [end for wall in self.walls.values() for end in (wall.from_m, wall.to_m)]
        if not points:
            return 0.0, 0.0, 0.0, 0.0
        xs, ys = [p[0] for p in points], [p[1] for p in points]
        return min(xs), min(ys), max(xs), max(ys)

    def distance(self, x_m: float, y_m: float) -> float:
        """How far a point is outside of the bounds; zero inside, and where the map is empty."""
        if not self.has_surveyed:
            return 0.0
        x0, y0, x1, y1 = self.bounds()
        return math.hypot(max(x0 - x_m, 0.0, x_m - x1), max(y0 - y_m, 0.0, y_m - y1))


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
