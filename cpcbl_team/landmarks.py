"""What a frame of plain landmarks says: steps 2 to 4 of the cycle in one loop of plain numbers.

Nearly everything that a robot sees is a point of the map, with the sensor model's own errors. For
those the constraints of `constraints.py`, their gates and their sum are written out, without an
object for each: that is what a cycle costs. Everything else (walls, teammates, sightings with a
sigma of their own, faults) is handed back, for `sightings.py`. `tests/core/test_landmarks.py` holds
the two together.
"""

import math
from collections.abc import Iterator
from math import atan2, cos, sin, sqrt

from msgspec.structs import astuple

from cpcbl_team.config import Field, LocalizationSettings
from cpcbl_team.constraints import NEAREST_M
from cpcbl_team.estimate import (
    HEADING,
    POSE,
    POSITION,
    SHARPEST_VARIANCE,
    SMALLEST_VARIANCE,
    Covariance3,
    Row,
    Scope,
    Sums,
)
from cpcbl_team.fusion import chi_square
from cpcbl_team.geometry import PI, wrap_angle
from cpcbl_team.inputs import Sighting
from cpcbl_team.recovery import latest
from cpcbl_team.sensors import LARGEST_BEARING_RAD, LARGEST_M, range_to_expect
from cpcbl_team.state import Evidence, Glance, Memory, State

Said = tuple[Sums, dict[str, int], int, bool, list[Sighting], list[Sighting]]
"""What the landmarks of a frame say: about the offset from the prior; the objects that count, and
when (now); how many the gate rejected; whether there was anything of the type that was asked for,
accepted or not; the sightings that are new evidence; those that are not plain."""


Numbers = tuple[
    str, float | None, float | None, float | None, float | None, float | None, float | None
]  # of a sighting, in its order
Places = dict[str, tuple[float, float, bool, bool]]  # x, y, gives ranges, gives bearings


class Landmarks:
    """The plain landmarks of a map, as one robot's sensor and rules use them."""

    def __init__(
        self, field: Field, settings: LocalizationSettings, gates: tuple[float, float]
    ) -> None:
        """`gates`: chi-square bounds of one and of two constraints. No landmark is plain where the
        rules ask for more than `read` does."""
        rules, s = settings.localizer, settings.sensor
        plain = rules.variant != "weighted" and not (
            rules.paper_uncertainty or rules.learns or s.correlation_s > 0.0
        )
        self._places: Places = {
            name: (p.x_m, p.y_m, p.gives in ("both", "range"), p.gives in ("both", "bearing"))
            for name, p in (field.landmarks if plain else {}).items()
        }
        self._as_rays = rules.bearing_for_position
        self._gates = gates
        self._range_model = s.range_share**2, s.range_floor_m**2, s.max_range_for_range_m
        self._heading_weight = 1.0 / max(s.bearing_sigma_rad**2, SHARPEST_VARIANCE)
        self._sine_squared = math.sin(min(s.bearing_sigma_rad, 0.5 * math.pi)) ** 2
        self._bearing_sigma_rad = s.bearing_sigma_rad

    def read(
        self,
        state: State,
        sightings: tuple[Sighting, ...],
        turn: Scope | None,
        resting: frozenset[str],
        noted: frozenset[str],
    ) -> Said:
        """What the landmarks among `sightings` say about position or heading, or about both.

        All is linearized at the state's estimate. An object that is `resting` is not plain; one
        that is `noted` is no new evidence. A range gives the row (u, v, 0), a bearing the row
        (m, n, 1): about the heading as it is, about the position as a ray over the way ahead.
        """
        places, as_ray = self._places, turn is POSITION
        ranges = as_ray or turn is POSE
        bearings = turn is HEADING or turn is POSE or (as_ray and self._as_rays)
        share, floor, farthest = self._range_model
        sharp, sine_squared, gate = self._heading_weight, self._sine_squared, self._gates[0]
        now, estimate, _, _, _, _, _ = state
        pose, covariance, _ = estimate
        x, y, h = pose
        axx = axy = ayy = axh = ayh = ahh = bx = by = bh = 0.0
        rejected, offered = 0, False
        used: dict[str, int] = {}
        fresh: list[Sighting] = []
        others: list[Sighting] = []
        for seen in sightings:
            numbers: Numbers = astuple(seen)
            name, range_m, bearing, range_sigma, bearing_sigma, heading, heading_sigma = numbers
            place = places.get(name)
            if (
                place is None
                or range_sigma is not None
                or bearing_sigma is not None
                or heading is not None
                or heading_sigma is not None
                or name in resting
                or not (range_m is None or 0.0 < range_m <= LARGEST_M)
                or not (bearing is None or -LARGEST_BEARING_RAD <= bearing <= LARGEST_BEARING_RAD)
                or (range_m is None and bearing is None)
            ):
                others.append(seen)
                continue
            px, py, gives_range, gives_bearing = place
            dx, dy = px - x, py - y
            q = dx * dx + dy * dy
            d = sqrt(q)
            if not gives_range or (range_m is not None and range_m > farthest):
                range_m = None
            if not gives_bearing:
                bearing = None
            if range_m is None and bearing is None:
                continue
            if name not in noted:
                fresh.append(seen)
            if not ranges:
                range_m = None
            if not bearings:
                bearing = None
            if range_m is None and bearing is None:
                continue
            offered = True
            if d < NEAREST_M:
                continue
            # the constraints: rows, residuals and weights, which are zero for none
            e = f = u = v = m = n = w = k = 0.0
            if range_m is not None:  # a circle
                u, v, e = -dx / d, -dy / d, range_m - d
                due = d if 0.5 * range_m <= d <= 2.0 * range_m else range_to_expect(d, range_m)
                w = share * due * due + floor
                w = 1.0 / (w if w > SHARPEST_VARIANCE else SHARPEST_VARIANCE)
            if bearing is None:
                pass
            elif not as_ray:  # a heading
                m, n, k = -dy / q, dx / q, sharp
                f = atan2(dy, dx) - bearing - h
                if not -PI <= f <= PI:
                    f = wrap_angle(f)
            else:  # a ray
                direction = h + bearing
                c, s = cos(direction), sin(direction)
                ahead = c * dx + s * dy
                if ahead >= NEAREST_M:
                    m, n, f = -s / ahead, c / ahead, (c * dy - s * dx) / ahead
                    k = q * sine_squared  # the ray's width, squared
                    k = ahead * ahead / (k if k > SHARPEST_VARIANCE else SHARPEST_VARIANCE)
                elif range_m is None:
                    continue
            # the gate, which all pass that the sensor's noise alone explains
            if w * e * e + k * f * f > gate and self._refuses(
                covariance, ((u, v, 0.0), e, w), ((m, n, 1.0), f, k)
            ):
                rejected += 1
                continue
            used[name] = now
            # the sum
            if range_m is not None:
                wu, wv = w * u, w * v
                axx += wu * u
                axy += wu * v
                ayy += wv * v
                bx += wu * e
                by += wv * e
            if k:
                km, kn = k * m, k * n
                axx += km * m
                axy += km * n
                ayy += kn * n
                axh += km
                ayh += kn
                ahh += k
                bx += km * f
                by += kn * f
                bh += k * f
        sums = (axx, axy, ayy, axh, ayh, ahh), (bx, by, bh)
        return sums, used, rejected, offered, fresh, others

    def _refuses(self, prior: Covariance3, *constraints: tuple[Row, float, float]) -> bool:
        """Whether the chi-square bound refuses an object's (row, residual, weight)."""
        rows, residuals, weights = zip(*(c for c in constraints if c[2]), strict=True)
        first, last = (1.0 / weights[i] + SMALLEST_VARIANCE for i in (0, -1))
        surprise = chi_square(prior, (first, 0.0, last), rows, residuals)
        return surprise > self._gates[len(rows) - 1]

    def evidence(self, memory: Memory) -> tuple[Evidence, ...]:
        """All the evidence in a memory, the latest last."""
        pieces = [piece for glance in memory.glances for piece in self._pieces(glance)]
        return latest(tuple(sorted((*pieces, *memory.evidence), key=_stamp)))

    def _pieces(self, glance: Glance) -> Iterator[Evidence]:
        """The evidence of a glance, one piece a landmark."""
        share, floor, farthest = self._range_model
        now, reckoned, pose, sightings = glance
        first: dict[str, Sighting] = {}
        for seen in sightings:
            first.setdefault(seen.id, seen)
        for name, seen in first.items():
            x, y, gives_range, gives_bearing = self._places[name]
            range_m, sigma_m = seen.range_m, 0.0
            if not gives_range or range_m is None or range_m > farthest:
                range_m = None
            else:
                due_m = range_to_expect(math.hypot(x - pose.x, y - pose.y), range_m)
                sigma_m = sqrt(share * due_m * due_m + floor)
            bearing = seen.bearing_rad if gives_bearing else None
            sigmas = sigma_m, self._bearing_sigma_rad, 0.0
            yield Evidence(now, reckoned, name, x, y, range_m, bearing, *sigmas, False)


def _stamp(piece: Evidence) -> int:
    return piece.stamp_ns
