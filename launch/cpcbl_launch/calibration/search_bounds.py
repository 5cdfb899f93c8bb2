"""Bounds within which a calibration looks: a value that ends at one may lie beyond it."""

import math
from collections.abc import Iterator, Mapping

from cpcbl_launch.calibration import odometry, sensor
from cpcbl_launch.calibration.statistics import LAGS_S, Estimate

NEAR = 1e-3  # of the width between two bounds
_SCALE = 0.0, 10.0  # of `1 / max(1 + slope, 0.1)`
_SIGMA = 0.0, math.inf
_MOST_REFINED_S = odometry.REFINEMENTS * odometry.MOST_STEP_S
_MOST_AXIS_DEG = math.degrees(sensor.MOST_CHANGE)
BOUNDS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "odometry": {
        "delay_s": (-_MOST_REFINED_S, odometry.DELAYS_S[-1] + _MOST_REFINED_S),
        "distance_loss_m_per_rad": _SIGMA,
        "least_speed_m_s": (0.0, float(odometry.LEAST_SPEEDS_M_S[-1])),
        odometry.CRAWL_NOISE: _SIGMA,
        **dict.fromkeys(odometry.NOISE, _SIGMA),
    },
    "sensor": {
        "range_scale": _SCALE,
        "bearing_scale": _SCALE,
        "optical_axis_deg": (-_MOST_AXIS_DEG, _MOST_AXIS_DEG),
        "delay_s": (-sensor.MOST_CHANGE, sensor.MOST_CHANGE),
        "correlation_s": (0.0, LAGS_S[-1]),
        **dict.fromkeys(sensor.NOISE, _SIGMA),
    },
}
"""(least, most) of each value that has a bound, for each part of a robot."""


def bound_of(part: str, name: str, value: float) -> str:
    """`0.05 (most)`: the bound at which a value ends; empty for one between its bounds."""
    least, most = BOUNDS[part].get(name, (-math.inf, math.inf))
    near = NEAR * (most - least) if math.isfinite(most - least) else 0.0
    if value <= least + near:
        return f"{least:g} (least)"
    return f"{most:g} (most)" if value >= most - near else ""


def without_bounds(part: str, values: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """The values without those that end at a bound in whichever part of the logs, so that their
    standard error is 0: the bound determines them, not the logs."""
    return {
        name: found
        for name, found in values.items()
        if found.standard_error > 0.0 or not bound_of(part, name, found.value)
    }


def bound_notes(part: str, values: Mapping[str, Estimate]) -> Iterator[str]:
    """`odometry delay_s 1 (most)`, for each value at a bound."""
    for name, found in values.items():
        if bound := bound_of(part, name, found.value):
            yield f"{part} {name} {bound}"
