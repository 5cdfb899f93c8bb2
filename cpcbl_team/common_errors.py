"""Errors that a robot's sightings have in common, as states beside its pose.

All sightings of a camera have the errors of its yaw, its focal length and its principal point in
common; all sightings of an object have the error of its place on the map in common. So these do not
average away. The filter keeps them as parameters beside the pose (`parameters.py`), and so knows
how uncertain they make the pose from the first frame on. The places are estimated with the pose,
and the camera's errors where the camera may calibrate itself; else those are only considered.
"""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from cpcbl_team.camera_errors import (
    CameraErrors,
    bearing_sensitivity,
    heading_sensitivity,
    range_sensitivity,
    reading_variances,
    sigmas_of,
    without_errors,
)
from cpcbl_team.estimate import ZERO3, Estimate, Matrix3, Row, dot
from cpcbl_team.gaussian import Covariance2, Gaussian2
from cpcbl_team.inputs import Sighting
from cpcbl_team.motion import motion_jacobian
from cpcbl_team.parameters import (
    NO_COVARIANCE,
    Numbers,
    Parameters,
    Sensitivity,
    sensitivity_dot,
)

DRIFT: Final = (1e-7, 1e-7, 0.0)
"""Variances that a second adds: a camera is knocked now and then."""
PRECISE_BEARING, PRECISE_SHARE = math.radians(0.5) ** 2, 0.01**2  # variances of readings
USUAL_VIEW_RAD: Final = (-0.5, 0.0, 0.5)  # from the optical axis
PRECISE_PLACE: Final = 0.02**2  # m^2
CAMERA: Final = 3  # the parameters of the camera come first
_NONE: Final[Mapping[str, int]] = MappingProxyType({})


class CommonErrors(NamedTuple):
    """What a robot knows of the errors that its sightings have in common. They are corrected by
    `values`; the parameters are what is left of them."""

    axis_rad: float  # the stated direction of the optical axis, left of the robot's front
    values: Numbers  # of the camera: as in `CameraErrors`; of each object: two
    parameters: Parameters
    objects: Mapping[str, int] = _NONE  # the number of the first parameter of each
    found: tuple[int, ...] = ()  # those of objects whose places nobody has surveyed

    @staticmethod
    def of_camera(axis_rad: float, sigmas: CameraErrors) -> "CommonErrors":
        """Of a camera of which nothing but its settings is known."""
        yaw, focal, centre = sigmas
        covariance = (yaw * yaw, 0.0, 0.0), (0.0, focal * focal, 0.0), (0.0, 0.0, centre * centre)
        parameters = Parameters(covariance, (NO_COVARIANCE,) * CAMERA)
        return CommonErrors(axis_rad, (0.0,) * CAMERA, parameters)

    @property
    def errors(self) -> CameraErrors:
        """The errors of the camera that are known."""
        return CameraErrors(*self.values[:CAMERA])

    @property
    def camera_sigmas(self) -> CameraErrors:
        """Of what is left of the errors of the camera."""
        return sigmas_of(self.parameters.covariance)

    def reading_variances(self, bearing_rad: float) -> tuple[float, float]:
        """What the camera adds to the variance of a reading at this bearing: of the range, as a
        share of it, and of the bearing (rad^2)."""
        return reading_variances(self.parameters.covariance, bearing_rad - self.axis_rad)

    @property
    def is_of_bearings(self) -> bool:
        """Whether nothing but a bias of bearings may be wrong."""
        yaw, focal, centre = self.camera_sigmas
        return yaw > 0.0 == focal == centre and not self.objects

    @property
    def is_precise(self) -> bool:
        """Whether they are known well enough not to matter beside other errors."""
        places = (max(self.place_covariance(name)[::2]) for name in self.objects)
        if any(variance >= PRECISE_PLACE for variance in places):
            return False
        readings = [self.reading_variances(self.axis_rad + a) for a in USUAL_VIEW_RAD]
        return all(r < PRECISE_SHARE and b < PRECISE_BEARING for r, b in readings)

    def place_error(self, name: str) -> tuple[float, float]:
        """What is known of the error of an object's place: x, y (m) of a point; offset (m) and
        direction (rad) of a wall."""
        i = self.objects.get(name)
        return (0.0, 0.0) if i is None else (self.values[i], self.values[i + 1])

    def place_covariance(self, name: str) -> Covariance2:
        """The covariance of what is left of that error. Raises KeyError without such an object."""
        i, covariance = self.objects[name], self.parameters.covariance
        return Covariance2(covariance[i][i], covariance[i][i + 1], covariance[i + 1][i + 1])

    def with_object(self, name: str, covariance: Covariance2) -> "CommonErrors":
        """With an object of the map whose place has this covariance."""
        xx, xy, yy = covariance
        objects = {**self.objects, name: len(self.values)}
        parameters = self.parameters.with_more(((xx, xy), (xy, yy)))
        return CommonErrors(
            self.axis_rad, (*self.values, 0.0, 0.0), parameters, objects, self.found
        )

    def with_place(self, name: str, own: Estimate, place: Gaussian2) -> "CommonErrors":
        """With an object that the robot has seen at this place in its own frame (m). Its parameters
        are its position in the field's frame."""
        heading = own.pose.heading
        x, y = own.pose.transform(place.x, place.y)
        dx, dy = x - own.pose.x, y - own.pose.y
        rows = (1.0, 0.0, -dy), (0.0, 1.0, dx)
        sensitivities = self._of_point(dx, dy, math.atan2(place.y, place.x))
        covariance = place.covariance.rotated(heading) + own.covariance.projected(rows)
        covariance += self.innovation(rows, sensitivities)
        of_pose, of_others = [], []
        for h, c in zip(rows, sensitivities, strict=True):
            (ax, ay, ah), numbers = self.parameters.times(h, c)
            px, py, ph = own.covariance.times(h)
            of_pose.append((px + ax, py + ay, ph + ah))
            of_others.append(numbers)
        xx, xy, yy = covariance
        parameters = self.parameters.with_derived(
            ((xx, xy), (xy, yy)), tuple(of_pose), tuple(of_others)
        )
        number = len(self.values)
        objects, found = {**self.objects, name: number}, (*self.found, number)
        return CommonErrors(self.axis_rad, (*self.values, x, y), parameters, objects, found)

    def without_object(self, name: str) -> "CommonErrors":
        """Without what is known of one object. Raises KeyError without such an object."""
        gone = self.objects[name]
        numbers = {n: i - 2 * (i > gone) for n, i in self.objects.items() if n != name}
        found = tuple(i - 2 * (i > gone) for i in self.found if i != gone)
        values = self.values[:gone] + self.values[gone + 2 :]
        return CommonErrors(self.axis_rad, values, self.parameters.without(gone, 2), numbers, found)

    def without_objects(self) -> "CommonErrors":
        """With what is known of the camera alone."""
        covariance, with_pose = self.parameters
        rows = tuple(row[:CAMERA] for row in covariance[:CAMERA])
        return CommonErrors(
            self.axis_rad, self.values[:CAMERA], Parameters(rows, with_pose[:CAMERA])
        )

    def corrected(self, sighting: Sighting) -> Sighting:
        """The sighting without the errors of the camera that are known."""
        return without_errors(sighting, self.errors, self.axis_rad)

    def with_bearing_bias(self, bias_rad: float, variance: float, with_pose: Row) -> "CommonErrors":
        """With a bias of bearings that was found together with the pose. `with_pose`: its
        covariance with (x, y, heading)."""
        (_, *rows), (_, *others) = self.parameters
        first = (variance, *[0.0 for _ in rows])
        rest = [(0.0, *row[1:]) for row in rows]
        parameters = Parameters((first, *rest), (with_pose, *others))
        return self._replace(values=(bias_rad, *self.values[1:]), parameters=parameters)

    def with_bias_below(self, most_rad: float) -> "CommonErrors":
        """With a bias of bearings that is at most so large."""
        bias_rad, *others = self.values
        if -most_rad <= bias_rad <= most_rad:
            return self
        return self._replace(values=(math.copysign(most_rad, bias_rad), *others))

    def uncorrelated(self) -> "CommonErrors":
        """For a robot that has found its pose anew."""
        return self._replace(parameters=self.parameters.uncorrelated())

    def after_motion(self, heading: float, distance: float, turn: float) -> "CommonErrors":
        """After a motion from this heading (rad): the pose's error is led on (m, rad)."""
        _, _, to_x, _, _, to_y, _, _, _ = motion_jacobian(heading, distance, turn)
        return self._replace(parameters=self.parameters.after_motion(to_x, to_y))

    def with_pose_mapped(self, m: Matrix3) -> "CommonErrors":
        """With a pose whose error is led on by this matrix."""
        return self._replace(parameters=self.parameters.with_pose_mapped(m))

    def after_time(self, seconds: float) -> "CommonErrors":
        """After this time, in which the camera may have been knocked."""
        covariance, with_pose = self.parameters
        if not any(covariance[i][i] for i in range(CAMERA)):  # there is no camera
            return self
        rows = list(covariance)
        for i, drift in enumerate(DRIFT):
            row = rows[i]
            if row[i] == 0.0:  # stated to be exact
                continue
            rows[i] = (*row[:i], row[i] + drift * seconds, *row[i + 1 :])
        return self._replace(parameters=Parameters(tuple(rows), with_pose))

    def sensitivity(
        self,
        name: str,
        place_row: tuple[float, float],
        is_bearing: bool,
        lever: float,
        range_m: float | None,
        bearing_rad: float | None,
    ) -> Sensitivity:
        """How the residual of a constraint follows the common errors. `lever`: by what its unit
        differs from that of a bearing (1, or m)."""
        off_axis = 0.0 if bearing_rad is None else bearing_rad - self.axis_rad
        if is_bearing:  # its residual falls when the bearing grows
            yaw, focal, centre = bearing_sensitivity(off_axis)
            of_camera = (0, -lever * yaw), (1, -lever * focal), (2, -lever * centre)
        else:
            yaw, focal, centre = range_sensitivity(range_m or 0.0, off_axis)
            of_camera = (0, yaw), (1, focal), (2, centre)
        i = self.objects.get(name)
        if i is None:
            return of_camera
        return (*of_camera, (i, -place_row[0]), (i + 1, -place_row[1]))

    def innovation(
        self, rows: tuple[Row, ...], sensitivities: tuple[Sensitivity, ...]
    ) -> Covariance2:
        """What the common errors add to the covariance of one or two innovations with these `rows`,
        beside the covariance of the pose. It may be negative: they explain errors of the pose."""
        added = [self.parameters.times(h, c) for h, c in zip(rows, sensitivities, strict=True)]

        def between(i: int, j: int) -> float:
            of_pose, of_errors = added[j]
            return dot(rows[i], of_pose) + sensitivity_dot(sensitivities[i], of_errors)

        return Covariance2(between(0, 0), between(0, -1), between(-1, -1))

    def of_heading(self, sighting: Sighting) -> float:
        """What they add to the variance (rad^2) of the heading of a sighted teammate in the field.
        It may be negative: they explain errors of the pose."""
        errors = heading_sensitivity(sighting, self.axis_rad)
        sensitivity = tuple([(i, -factor) for i, factor in enumerate(errors)])
        return self.innovation(((0.0, 0.0, 1.0),), (sensitivity,)).xx

    def of_point(self, dx: float, dy: float, bearing_rad: float) -> Covariance2:
        """What they add to the covariance (m^2) of a point that is seen at this bearing, (dx, dy)
        away in the field's frame. It may be negative: they explain errors of the pose."""
        rows = (1.0, 0.0, -dy), (0.0, 1.0, dx)
        return self.innovation(rows, self._of_point(dx, dy, bearing_rad))

    def _of_point(
        self, dx: float, dy: float, bearing_rad: float
    ) -> tuple[Sensitivity, Sensitivity]:
        """How the place of such a point follows the errors of the camera."""
        off_axis = bearing_rad - self.axis_rad
        ways = list(
            zip(range_sensitivity(1.0, off_axis), bearing_sensitivity(off_axis), strict=True)
        )
        # a reading that is too large puts the point too far
        of_x = tuple([(i, -along * dx + across * dy) for i, (along, across) in enumerate(ways)])
        of_y = tuple([(i, -along * dy - across * dx) for i, (along, across) in enumerate(ways)])
        return of_x, of_y


def inflated(
    estimate: Estimate, common: CommonErrors, factor: float
) -> tuple[Estimate, CommonErrors]:
    """Both with their joint covariance times this factor."""
    pose, covariance, shared = estimate
    shared = shared if shared is ZERO3 else shared.scaled(factor)
    wider = Estimate(pose, covariance.scaled(factor), shared)
    return wider, common._replace(parameters=common.parameters.inflated(factor))
