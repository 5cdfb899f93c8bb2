"""What a frame of plain landmarks says: steps 2 to 4 of the cycle in one loop of plain numbers.

Nearly everything that a robot sees is a point of the map, with the sensor model's own errors. For
those the constraints of `constraints.py`, their gates and their sum are written out, without an
object for each: that is what a cycle costs. Everything else (walls, teammates, sightings with a
sigma of their own, faults) is handed back, for `sightings.py`. `tests/core/test_landmarks.py` holds
the two together.
"""

import math
from collections.abc import Container, Mapping, Sequence
from math import atan2, cos, remainder, sin, sqrt, tau
from typing import NamedTuple

import msgspec

from cpcbl_team.config import Field, LocalizationSettings
from cpcbl_team.constraints import NEAREST_M
from cpcbl_team.estimate import (
    POSE,
    POSITION,
    SMALLEST_VARIANCE,
    Covariance3,
    Information,
    Scope,
    new,
)
from cpcbl_team.inputs import Sighting
from cpcbl_team.sensors import LARGEST_BEARING_RAD, LARGEST_M, sighting_sigmas
from cpcbl_team.state import Evidence, State


class Said(msgspec.Struct, frozen=True, gc=False):
    """What the landmarks of a frame say."""

    evidence: Information  # about the offset from the prior
    used: list[str]
    rejected: int  # by the gate
    offered: bool  # anything of the type that was asked for, accepted or not
    pieces: list[Evidence]  # for finding the robot again
    others: list[Sighting]  # not plain


class Landmarks(NamedTuple):
    """The plain landmarks of a map, as one robot's sensor and rules use them."""

    places: Mapping[str, tuple[float, float, bool, bool]]  # x, y, gives range, gives bearing
    settings: LocalizationSettings
    gates: tuple[float, float]  # chi-square bounds, of one and of two constraints
    range_share_squared: float
    range_floor_squared: float
    bearing_variance: float
    bearing_sine_squared: float
    farthest_range_m: float

    @staticmethod
    def of(field: Field, settings: LocalizationSettings, gates: tuple[float, float]) -> "Landmarks":
        """None are plain where the rules ask for more than `read` does."""
        rules, sensor = settings.localizer, settings.sensor
        plain = not (
            rules.variant == "weighted"
            or rules.paper_uncertainty
            or rules.self_calibration
            or sensor.correlation_s > 0.0
        )
        places = {
            name: (p.x_m, p.y_m, p.gives in ("both", "range"), p.gives in ("both", "bearing"))
            for name, p in field.landmarks.items()
            if plain and name not in field.walls
        }
        return Landmarks(
            places,
            settings,
            gates,
            sensor.range_share**2,
            sensor.range_floor_m**2,
            sensor.bearing_sigma_rad**2,
            math.sin(min(sensor.bearing_sigma_rad, 0.5 * math.pi)) ** 2,
            min(sensor.max_range_for_range_m, LARGEST_M),
        )

    def read(
        self,
        state: State,
        sightings: Sequence[Sighting],
        turn: Scope | None,
        resting: Container[str],
        noted: Container[str],
    ) -> Said:
        """What the landmarks among `sightings` say about position or heading, or about both.

        All is linearized at the state's estimate. An object that is `resting` is not plain; one
        that is `noted` is no new evidence. A range gives the row (u, v, 0), a bearing the row
        (m, n, 1): about the heading as it is, about the position as a ray, over the way ahead.
        """
        places, settings, (gate, gate2), share, floor, narrow, sine2, farthest = self
        (x, y, h), (xx, xy, yy, xh, yh, hh), _ = state.estimate
        as_ray = turn is POSITION
        by_range = as_ray or turn is POSE
        by_bearing = settings.localizer.bearing_for_position if as_ray else turn is not None
        axx = axy = ayy = axh = ayh = ahh = bx = by = bh = 0.0
        rejected, offered = 0, False
        used: list[str] = []
        pieces: list[Evidence] = []
        others: list[Sighting] = []
        for seen in sightings:
            name, range_m, bearing = seen.id, seen.range_m, seen.bearing_rad
            place = places.get(name)
            if (
                place is None
                or name in resting
                or seen.range_sigma_m is not None
                or seen.bearing_sigma_rad is not None
                or not (range_m is None or 0.0 < range_m <= LARGEST_M)
                or not (bearing is None or -LARGEST_BEARING_RAD <= bearing <= LARGEST_BEARING_RAD)
                or (range_m is None and bearing is None)
            ):
                others.append(seen)
                continue
            px, py, gives_range, gives_bearing = place
            if not gives_range or (range_m is not None and range_m > farthest):
                range_m = None
            if not gives_bearing:
                bearing = None
            dx, dy = px - x, py - y
            q = dx * dx + dy * dy
            d = sqrt(q)
            if name not in noted and (range_m is not None or bearing is not None):
                sigmas = sighting_sigmas(seen, settings.sensor, d)
                now_ns, reckoned = state.stamp_ns, state.odometry_from_robot
                pieces.append(
                    Evidence(now_ns, reckoned, name, px, py, range_m, bearing, *sigmas, 0.0, False)
                )
            if not by_range:
                range_m = None
            if not by_bearing:
                bearing = None
            if range_m is None and bearing is None:
                continue
            offered = True
            if d < NEAREST_M:
                continue
            # the constraints, linearized at the prior
            if range_m is not None:
                u, v, e = -dx / d, -dy / d, range_m - d
                due = d
                if not 0.5 * range_m <= d <= 2.0 * range_m:
                    due = 0.5 * range_m if d < range_m else 2.0 * range_m
                r = share * due * due + floor
                s = u * (u * xx + 2.0 * v * xy) + v * v * yy + r + SMALLEST_VARIANCE
            if bearing is not None:
                least = SMALLEST_VARIANCE
                if as_ray:
                    c, g = cos(h + bearing), sin(h + bearing)
                    ahead = c * dx + g * dy
                    if ahead < NEAREST_M:
                        if range_m is None:
                            continue
                        bearing = None
                    else:
                        m, n, f = -g / ahead, c / ahead, (c * dy - g * dx) / ahead
                        k = 1.0 / (ahead * ahead)
                        z, least = q * sine2 * k, least * k
                else:
                    m, n, f, z = (
                        -dy / q,
                        dx / q,
                        remainder(atan2(dy, dx) - bearing - h, tau),
                        narrow,
                    )
            # their gate
            if bearing is None:
                surprise, bound = e * e, gate * s
            else:
                tx, ty = xx * m + xy * n + xh, xy * m + yy * n + yh
                w = m * (tx + xh) + n * (ty + yh) + hh + z + least
                if range_m is None:
                    surprise, bound = f * f, gate * w
                else:
                    t = u * tx + v * ty
                    surprise = w * e * e - 2.0 * t * e * f + s * f * f
                    bound = gate2 * (s * w - t * t)
            if surprise > bound:
                rejected += 1
                continue
            used.append(name)
            # their sum
            if range_m is not None:
                w = 1.0 / (r if r > SMALLEST_VARIANCE else SMALLEST_VARIANCE)
                wu, wv = w * u, w * v
                axx += wu * u
                axy += wu * v
                ayy += wv * v
                bx += wu * e
                by += wv * e
            if bearing is not None:
                w = 1.0 / (z if z > least else least)
                wm, wn = w * m, w * n
                axx += wm * m
                axy += wm * n
                ayy += wn * n
                axh += wm
                ayh += wn
                ahh += w
                bx += wm * f
                by += wn * f
                bh += w * f
        matrix = new(Covariance3, (axx, axy, ayy, axh, ayh, ahh))
        return Said(Information(matrix, (bx, by, bh)), used, rejected, offered, pieces, others)
