import math
from typing import Any

import msgspec
import pytest
from support.core import CORNERS, MIXED

from cpcbl_team.config import (
    Field,
    Landmark,
    LocalizationSettings,
    LocalizerSettings,
    RobotSettings,
    Variant,
    Wall,
)


def test_the_bounds_of_a_field_contain_its_landmarks_and_walls() -> None:
    assert CORNERS.bounds() == (-4.5, -2.5, 4.5, 2.5)
    assert MIXED.bounds() == (-5.0, -3.0, 5.0, 2.6)
    assert Field().bounds() == (0.0, 0.0, 0.0, 0.0)


def test_a_wall_has_the_direction_from_one_end_to_the_other() -> None:
    assert Wall(from_m=(1.0, 1.0), to_m=(1.0, -2.0)).direction_rad == pytest.approx(-math.pi / 2)


@pytest.mark.parametrize(
    ("variant", "alternate", "alternates"),
    [
        ("joint", None, False),
        ("oval", None, True),
        ("circular", None, True),
        ("weighted", None, True),
        ("joint", True, True),
        ("oval", False, False),
    ],
)
def test_all_variants_but_joint_alternate_by_default(
    variant: Variant, alternate: bool | None, alternates: bool
) -> None:
    assert LocalizerSettings(variant=variant, alternate=alternate).alternates is alternates


@pytest.mark.parametrize(
    "table",
    [
        {"localizer": {"varaint": "oval"}},
        {"localizer": {"variant": "square"}},
        {"localizer": {"gate_probability": 1.0}},
        {"localizer": {"weights": {"position": 1.5}}},
        {"sensor": {"range_share": -0.1}},
        {"sensor": {"field_of_view_deg": 400.0}},
        {"odometry": {"distance_scale": 0.0}},
        {"collaboration": {"tier_width": 1.0}},
        {"collaboration": {"fusion": "clever"}},
        {"start": {"x_m": 1.0}},
    ],
)
def test_invalid_settings_are_refused(table: dict[str, Any]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(table, LocalizationSettings)


def test_all_settings_have_defaults() -> None:
    assert msgspec.convert({}, RobotSettings) == RobotSettings()
    assert msgspec.convert({"x_m": 1, "y_m": 2}, Landmark).gives == "both"
