"""The filter of one robot."""

from typing import Annotated, Literal

import msgspec

from cpcbl_team.config.field import Field
from cpcbl_team.config.table import NotNegative, Positive, Share, Table

Variant = Literal["joint", "oval", "circular", "weighted"]


class Weights(Table, frozen=True, kw_only=True):
    """Static weights of the sensor against the estimate, for `weighted` (paper, section 3)."""

    position: Share = 0.1
    heading: Share = 0.5
    nominal_sigma_m: Positive = 0.15
    """The position sigma that a `weighted` robot announces just after an update, because it has no
    estimate of it."""
    nominal_heading_sigma_deg: Positive = 4.0


class LocalizerSettings(Table, frozen=True, kw_only=True):
    """The variant of the filter, its timers, its gate and the limits of being lost."""

    variant: Variant = "joint"
    alternate: bool | None = None
    """One update a cycle, heading or position in turn. Default: true for all variants but
    `joint`."""
    minimum_interval_s: NotNegative = 0.0
    """The least time between two updates of the same type (paper, section 3)."""
    object_interval_s: NotNegative = 0.0
    """The least time between two uses of the same object, whose errors are correlated."""
    bearing_for_position: bool = True
    self_calibration: bool = False
    """Estimate the scales of odometry and the bias of bearings while driving. `weighted` does
    not, because it does not know the accuracy of its pose."""
    paper_uncertainty: bool = False
    """As printed in the paper, the uncertainty of a position constraint does not contain that of
    the heading (docs/paper.md, resolution a)."""
    weights: Weights = Weights()
    gate_probability: Annotated[float, msgspec.Meta(gt=0.5, lt=1.0)] = 0.999
    """The share of correct measurements that the gate accepts."""
    lost_position_sigma_m: Positive = 2.0
    lost_heading_sigma_deg: Positive = 60.0
    lost_window: Annotated[int, msgspec.Meta(ge=4)] = 20
    """The robot is lost if more than `lost_share` of its last `lost_window` innovations were
    rejected."""
    lost_share: Share = 0.6

    @property
    def learns(self) -> bool:
        """Whether the robot calibrates itself."""
        return self.self_calibration and self.variant != "weighted"

    @property
    def alternates(self) -> bool:
        """Whether heading and position are updated in separate cycles."""
        return self.variant != "joint" if self.alternate is None else self.alternate

    @property
    def estimates_whole_pose(self) -> bool:
        """Whether heading and position are one estimate, with the uncertainty of both."""
        return self.variant == "joint" and not (self.alternates or self.paper_uncertainty)

    def estimates_whole_pose_on(self, field: Field) -> bool:
        """The same on a field: where its map gives only ranges, `oval` corrects its heading by
        them."""
        is_oval = self.variant == "oval" and not self.paper_uncertainty
        return self.estimates_whole_pose or (is_oval and field.gives_only_ranges)
