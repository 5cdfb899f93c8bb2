"""Sightings without the constant errors of the camera, which a robot notices while it drives."""

import math
from collections import Counter
from collections.abc import Sequence

import msgspec

from cpcbl_agents.vision.camera_check import CENTRE, YAW, CameraCheck, Estimated
from cpcbl_team.camera_errors import NO_ERRORS, CameraErrors, reading_variances, without_errors
from cpcbl_team.common_error_filter import camera_sigmas, considers_camera
from cpcbl_team.config import RobotSettings, Team
from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import InputsMended, Odometry, Sighting, Sightings

SIGMAS = 4.0  # of an error that is believed
LIKELY_SIGMAS = 2.0  # of an error that is corrected beside it
LEAST = CameraErrors(math.radians(1.0), 0.02, 0.02)  # less may come of a map that is not exact
LEAST_CHANGE = CameraErrors(math.radians(0.2), 0.003, 0.003)  # of a correction
POSSIBLE, CLEARER = 9.0, 9.0
"""One error alone explains what is seen if it costs the fit no more than this chi-square, and the
other error alone at least so much more."""
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
            sigmas = camera_sigmas(camera)
            self._least_change = CameraErrors(*(BEYOND_SIGMAS * s for s in sigmas))
            self._leaves_to_filter = True
        self._guess: Pose2 | None = None
        self.found: Estimated | None = None
        """The errors of the camera, once one of them was clear."""
        self._applied = NO_ERRORS
        self._covariance: Sequence[Sequence[float]] = ()
        """Of the errors that are applied."""
        self._fx_px, self._roll = camera.fx_px, math.radians(camera.roll_deg)

    @property
    def counts(self) -> Counter[str]:
        """`camera_miscalibrated`: 1 since an error was found."""
        return Counter(camera_miscalibrated=1) if self.found else Counter()

    @property
    def problems(self) -> tuple[str, ...]:
        """What is wrong with the camera, as sentences."""
        if self.found is None:
            return ()
        texts = clear_errors(self.found, self._fx_px, self._roll)
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
        if self._applied == NO_ERRORS or self._leaves_to_filter:
            return s
        if s.bearing_sigma_rad is None or s.bearing_rad is None:
            return s
        off_axis = s.bearing_rad - self._axis
        of_range, of_bearing = reading_variances(self._covariance, off_axis)
        bearing_sigma = math.hypot(s.bearing_sigma_rad, math.sqrt(of_bearing))
        range_sigma = s.range_sigma_m
        if range_sigma is not None and s.range_m is not None:
            range_sigma = math.hypot(range_sigma, math.sqrt(of_range) * s.range_m)
        changed = {"bearing_sigma_rad": bearing_sigma, "range_sigma_m": range_sigma}
        return msgspec.structs.replace(s, **changed)

    def _change(self, stamp_ns: int) -> InputsMended | None:
        """The event for the filter, if the correction changes."""
        estimated = self._check.estimated
        if estimated is None:
            return None
        estimated = simplest(estimated)
        if self.found is None and not clear_errors(estimated, self._fx_px, self._roll):
            return None
        is_first = self.found is None
        self.found = estimated
        if not self._corrects:
            return InputsMended(stamp_ns) if is_first else None
        now = _likely_errors(estimated)
        changes = [a - b for a, b in zip(now, self._applied, strict=True)]
        if not any(abs(c) > least for c, least in zip(changes, self._least_change, strict=True)):
            return None
        turn, focal, centre = changes
        self._applied, self._covariance = now, estimated.covariance
        return InputsMended(stamp_ns, turn + centre, abs(focal) * USUAL_RANGE_M)


def simplest(estimated: Estimated) -> Estimated:
    """The estimate with the yaw alone or the centre alone wrong, if the one explains what is seen
    and the other does not. Both turn the middle of the image; only its edges tell them apart."""
    for error, other in ((YAW, CENTRE), (CENTRE, YAW)):
        cost = _cost(estimated, error)
        if cost <= POSSIBLE and _cost(estimated, other) > cost + CLEARER:
            return estimated.without(error)
    return estimated


def clear_errors(estimated: Estimated, fx_px: float, roll_rad: float) -> list[str]:
    """The errors that are clear, as parts of a sentence whose subject is the camera."""
    errors, sigmas = estimated.errors, estimated.sigmas
    is_either, texts = _is_one_of_both(estimated), []
    turn, turn_sigma = errors.yaw_rad, sigmas.yaw_rad
    if is_either:
        turn, turn_sigma = estimated.turn_rad, estimated.turn_sigma_rad
    if _is_clear(turn, turn_sigma, LEAST.yaw_rad):
        side = "right" if turn > 0.0 else "left"
        text = f"it looks {math.degrees(abs(turn)):.1f} ± {math.degrees(turn_sigma):.1f} deg to the"
        px = fx_px * abs(turn)
        or_centre = f"{side}: its `yaw_deg` is wrong, or its `cx_px` by {px:.0f} px"
        texts.append(f"{text} {or_centre if is_either else f'{side} of its `yaw_deg`'}")
    if _is_clear(errors.focal, sigmas.focal, LEAST.focal):
        way = "longer" if errors.focal > 0.0 else "shorter"
        percent, sigma = abs(errors.focal_percent), 100.0 * sigmas.focal
        texts.append(f"its focal length is {percent:.1f} ± {sigma:.1f} % {way} than `fx_px`")
    if not is_either and _is_clear(errors.centre, sigmas.centre, LEAST.centre):
        side = "left" if errors.centre * math.cos(roll_rad) > 0.0 else "right"
        px, sigma = fx_px * abs(errors.centre), fx_px * sigmas.centre
        texts.append(f"its principal point is {px:.0f} ± {sigma:.0f} px to the {side} of `cx_px`")
    return texts


def _is_one_of_both(estimated: Estimated) -> bool:
    """Whether the yaw alone or the centre alone explains what is seen, and nobody knows which."""
    return 0.0 < min(_cost(estimated, error) for error in (YAW, CENTRE)) <= POSSIBLE


def _cost(estimated: Estimated, error: int) -> float:
    """The chi-square of the estimate if this error is none."""
    variance = estimated.covariance[error][error]
    return estimated.errors[error] ** 2 / variance if variance > 0.0 else 0.0


def _is_clear(error: float, sigma: float, least: float) -> bool:
    return abs(error) > max(SIGMAS * sigma, least)


def _likely_errors(estimated: Estimated) -> CameraErrors:
    """The errors that are likely; none for the others."""
    is_likely = [
        abs(e) > LIKELY_SIGMAS * s for e, s in zip(estimated.errors, estimated.sigmas, strict=True)
    ]
    if _is_one_of_both(estimated):
        is_turned = abs(estimated.turn_rad) > LIKELY_SIGMAS * estimated.turn_sigma_rad
        is_likely[YAW] = is_likely[CENTRE] = is_turned
    values = [e if likely else 0.0 for e, likely in zip(estimated.errors, is_likely, strict=True)]
    return CameraErrors(*values)
