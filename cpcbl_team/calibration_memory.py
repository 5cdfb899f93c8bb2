"""What a robot remembers of its calibration and of its map, between two updates of its pose."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from cpcbl_team.calibration_filter import CalibrationFilter
from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.landmark_readings import LandmarkReading
from cpcbl_team.map_rejections import MapRejections
from cpcbl_team.map_residuals import MapResiduals
from cpcbl_team.miscalibration import AS_CONFIGURED, Adaptation, ModelCheck
from cpcbl_team.moved_landmarks import Innovations, Moves
from cpcbl_team.scale_errors import EXACT, ScaleErrors
from cpcbl_team.self_calibration import ReferencePoses, SelfCalibration
from cpcbl_team.stationary_pose import StationaryRecord

_NONE: Mapping[str, Any] = MappingProxyType({})


class CalibrationMemory(NamedTuple):
    """What a robot has learned and noticed of its calibration, and what it compares next."""

    learned: SelfCalibration = SelfCalibration()
    references: ReferencePoses | None = None
    total_turn_rad: float = 0.0  # of the odometry since the start
    check: ModelCheck = ModelCheck()
    adaptation: Adaptation = AS_CONFIGURED
    rejections: MapRejections = MapRejections()
    filters: tuple[CalibrationFilter, ...] = ()  # of its errors; empty before they begin
    common: CommonErrors | None = None  # of a camera whose constant errors the filter considers
    residuals: MapResiduals = MapResiduals()
    unplaced: Mapping[str, tuple[LandmarkReading, ...]] = _NONE
    """What was read of landmarks whose places are not known yet."""
    innovations: Innovations = _NONE  # of landmarks whose places the robot has found itself,
    moved: Moves = _NONE  # and those of them that moved since then
    rough_ns: int = 0  # when a lost robot last looked for a pose with which `filters` may begin
    scales: ScaleErrors = EXACT  # of its odometry, as far as they are not known
    stationary: StationaryRecord | None = None  # None while it drives

    @property
    def corrected(self) -> SelfCalibration:
        """All that the robot knows of the scales of its odometry and the bias of its bearings."""
        known, adapted = self.learned, self.adaptation
        by_distance, by_turn = self.scales.factors
        return known._replace(
            distance_scale=known.distance_scale * adapted.distance_scale * by_distance,
            turn_scale=known.turn_scale * adapted.turn_scale * by_turn,
            bearing_bias_rad=self.bearing_bias_rad + self._estimated_bias_rad,
        )

    @property
    def _estimated_bias_rad(self) -> float:
        """What the robot estimates with its pose of the bias of its bearings."""
        common = self.common
        return common.errors.yaw_rad if common is not None and common.is_of_bearings else 0.0

    def misplaced(self, stamp_ns: int) -> str:
        """The object that must stand elsewhere than on the map; empty if there is none."""
        return self.rejections.misplaced(stamp_ns) or self.residuals.misplaced

    @property
    def bearing_bias_rad(self) -> float:
        """What bearings are too large by, as far as the robot knows."""
        return self.learned.bearing_bias_rad + self.adaptation.bearing_bias_rad
