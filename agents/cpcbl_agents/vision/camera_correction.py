"""Sightings without the constant errors of the camera, which a robot notices while it drives."""

import math
from collections import Counter

import msgspec

from cpcbl_agents.vision.camera_check import CameraCheck, Estimated
from cpcbl_team.camera_errors import NO_ERRORS, CameraErrors, without_errors
from cpcbl_team.common_error_filter import considers_camera
from cpcbl_team.config import RobotSettings, Team
from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import InputsMended, Odometry, Sighting, Sightings

SIGMAS = 4.0  # of an error that is believed
LEAST = CameraErrors(math.radians(1.0), 0.02)  # less may come of a map that is not exact
LEAST_CHANGE = CameraErrors(math.radians(0.2), 0.003)  # of a correction
BEYOND_SIGMAS = 3.0  # an error that is larger is none that the filter reckons with
USUAL_RANGE_M = 2.0  # at which a wrong focal length has moved the robot


class CameraCorrection:
    """Watches the camera of one robot of a team, and corrects what it sees."""

    def __init__(self, robot: str, team: Team) -> None:
        settings: RobotSettings = team.robots[robot]
        exact = {name: mark for name, mark in team.map.landmarks.items() if mark.is_exact}
        places = {name: (mark.x_m, mark.y_m) for name, mark in exact.items()}
        self._axis = math.radians(settings.camera.yaw_deg)
        start = settings.start
        if settings.odometry.moves or start is None or not start.known:
            start = None
        self._check = CameraCheck(places, settings.odometry, self._axis, start)
        camera = settings.camera
        self._corrects = camera.self_calibration
        self._least_change, self._leaves_to_filter = LEAST_CHANGE, False
        if considers_camera(settings, camera):
            sigmas = math.radians(camera.yaw_sigma_deg), camera.focal_share
            self._least_change = CameraErrors(*(BEYOND_SIGMAS * s for s in sigmas))
            self._leaves_to_filter = True
        self._guess: Pose2 | None = None
        self.found: Estimated | None = None
        """The errors of the camera, once one of them was clear."""
        self._applied = NO_ERRORS
        self._sigmas = NO_ERRORS

    @property
    def counts(self) -> Counter[str]:
        """`camera_miscalibrated`: 1 since an error was found."""
        return Counter(camera_miscalibrated=1) if self.found else Counter()

    @property
    def problems(self) -> tuple[str, ...]:
        """What is wrong with the camera, as sentences."""
        if self.found is None:
            return ()
        errors, sigmas = self.found
        texts = []
        if _is_clear(errors.yaw_rad, sigmas.yaw_rad, LEAST.yaw_rad):
            side = "right" if errors.yaw_rad > 0.0 else "left"
            degrees, sigma = (math.degrees(abs(a)) for a in (errors.yaw_rad, sigmas.yaw_rad))
            texts.append(f"it looks {degrees:.1f} ± {sigma:.1f} deg to the {side} of its `yaw_deg`")
        if _is_clear(errors.focal, sigmas.focal, LEAST.focal):
            way = "longer" if errors.focal > 0.0 else "shorter"
            percent, sigma = abs(errors.focal_percent), 100.0 * sigmas.focal
            texts.append(f"its focal length is {percent:.1f} ± {sigma:.1f} % {way} than `fx_px`")
        end = "; this is corrected" if self._corrects else "; `camera.self_calibration` is false"
        return (f"camera_miscalibrated: {' and '.join(texts)}{end}",) if texts else ()

    def set_estimate(self, estimate: Estimate, lost: str) -> None:
        """Where the robot is, nearly."""
        self._guess = None if lost else estimate.pose

    def add_odometry(self, piece: Odometry) -> None:
        """The robot moved."""
        self._check.add_odometry(piece)
        if self._guess is not None:
            self._guess = step(self._guess, piece.distance_m, piece.turn_rad)

    def correct(self, frame: Sightings) -> tuple[Sightings, InputsMended | None]:
        """The frame without the errors that are known, and what changes from the next one on."""
        sightings = tuple(self._corrected(s) for s in frame.sightings)
        change = None
        if self._guess is not None and self._check.add_frame(
            frame.stamp_ns, frame.sightings, self._guess
        ):
            change = self._change(frame.stamp_ns)
        return Sightings(frame.stamp_ns, sightings), change

    def _corrected(self, s: Sighting) -> Sighting:
        s = without_errors(s, self._applied, self._axis)
        if self._sigmas == NO_ERRORS or self._leaves_to_filter or s.bearing_sigma_rad is None:
            return s
        bearing_sigma = math.hypot(s.bearing_sigma_rad, self._sigmas.yaw_rad)
        range_sigma = s.range_sigma_m
        if range_sigma is not None and s.range_m is not None:
            range_sigma = math.hypot(range_sigma, self._sigmas.focal * s.range_m)
        changed = {"bearing_sigma_rad": bearing_sigma, "range_sigma_m": range_sigma}
        return msgspec.structs.replace(s, **changed)

    def _change(self, stamp_ns: int) -> InputsMended | None:
        """The event for the filter, if the correction changes."""
        estimated = self._check.estimated
        if estimated is None:
            return None
        errors, sigmas = estimated
        is_clear = any(map(_is_clear, errors, sigmas, LEAST))
        if self.found is None and not is_clear:
            return None
        is_first = self.found is None
        self.found = estimated
        if not self._corrects:
            return InputsMended(stamp_ns) if is_first else None
        now = CameraErrors(*map(_believed, errors, sigmas))
        changes = [a - b for a, b in zip(now, self._applied, strict=True)]
        if not any(abs(c) > least for c, least in zip(changes, self._least_change, strict=True)):
            return None
        turn, focal = changes
        self._applied = now
        self._sigmas = CameraErrors(*(s if e else 0.0 for e, s in zip(now, sigmas, strict=True)))
        return InputsMended(stamp_ns, turn, abs(focal) * USUAL_RANGE_M)


def _is_clear(error: float, sigma: float, least: float) -> bool:
    return abs(error) > max(SIGMAS * sigma, least)


def _believed(error: float, sigma: float) -> float:
    """An error that is likely, or else none."""
    return error if abs(error) > 2.0 * sigma else 0.0
