"""Messages of help with their keys, and covariances of every shape."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from hypothesis import strategies as st
from msgspec.structs import replace

from cpcbl_team.inputs import Belief, Fix, LandmarkBelief
from cpcbl_transport.compact import (
    decode_help,
    encode_help,
)
from cpcbl_transport.messages import (
    Help,
)
from support.buses import SECOND

NOW = 1_700_000_000 * SECOND
PLANE = (0.04, 0.01, 0.09)
FIX = Fix("r2", "r1", NOW, 1.0, -2.0, PLANE, (0.01, 0.0, 0.01))
HEADED = replace(
    FIX, heading_rad=-2.5, heading_sensor_variance=0.01, heading_observer_variance=0.0004
)
BELIEF = Belief("r1", NOW, 1.0, -2.0, 0.5, (*PLANE, 0.002, -0.003, 0.01), 0.3, -0.1)
LANDMARK = LandmarkBelief("r1", "oak", NOW, 1.0, -2.0, PLANE)
FIX_KEY, BELIEF_KEY, LANDMARK_KEY = "fix/r2/3/r1", "belief/3/r1", "landmark/oak/3/r1"
RATIO = 200.0
ANGLES = st.floats(-math.pi, math.pi)
SIGMAS = st.floats(math.log(1e-3), math.log(10.0)).map(math.exp)
SHARES = st.floats(math.log(1.0 / RATIO), 0.0).map(math.exp)
PLACES = st.floats(-1e6, 1e6)
STAMPS = st.integers(-(10**18), 4 * 10**18)


def key_of(message: Help) -> str:
    if isinstance(message, LandmarkBelief):
        return LANDMARK_KEY
    return FIX_KEY if isinstance(message, Fix) else BELIEF_KEY


def there_and_back(message: Help) -> Any:
    again = decode_help(key_of(message), encode_help(message))
    assert type(again) is type(message)
    return again


def matrix(covariance: Sequence[float]) -> np.ndarray:
    """The matrix whose lower triangle is given row by row."""
    size = 2 if len(covariance) == 3 else 3
    lower = np.zeros((size, size))
    lower[np.tril_indices(size)] = covariance
    return lower + np.tril(lower, -1).T


def triangle(c: np.ndarray) -> Any:
    return tuple(map(float, c[np.tril_indices(len(c))]))


def turned(size: int, *angles: float) -> np.ndarray:
    """A rotation, about one axis after the other."""
    whole = np.eye(size)
    for (i, j), angle in zip([(0, 1), (0, 2), (1, 2)], angles, strict=False):
        one = np.eye(size)
        one[[i, j], [i, j]] = math.cos(angle)
        one[i, j], one[j, i] = -math.sin(angle), math.sin(angle)
        whole = whole @ one
    return whole


def thick(major: float, *shares: float) -> list[float]:
    """The sigmas of the axes: none below 1 mm, none thinner than RATIO."""
    return [major] + [max(major * share, 1e-3) for share in shares]


PLANES = st.builds(
    lambda major, share, angle: (
        turned(2, angle) * np.square(thick(major, share)) @ turned(2, angle).T
    ),
    SIGMAS,
    SHARES,
    ANGLES,
)
VOLUMES = st.builds(
    lambda major, a, b, *angles: (
        turned(3, *angles) * np.square(thick(major, a, b)) @ turned(3, *angles).T
    ),
    SIGMAS,
    SHARES,
    SHARES,
    *[ANGLES] * 3,
)
VARIANCES = SIGMAS.map(lambda sigma: sigma**2)
FIXES = st.builds(
    lambda stamp, x, y, own, its, heading: Fix(
        "r2", "r1", stamp, x, y, triangle(own), triangle(its), *heading
    ),
    STAMPS,
    PLACES,
    PLACES,
    PLANES,
    PLANES,
    st.just(()) | st.tuples(ANGLES, VARIANCES, VARIANCES),
)
LANDMARKS = st.builds(
    lambda stamp, x, y, c: LandmarkBelief("r1", "oak", stamp, x, y, triangle(c)),
    STAMPS,
    PLACES,
    PLACES,
    PLANES,
)
BELIEFS = st.builds(
    lambda stamp, x, y, heading, c, *rates: Belief("r1", stamp, x, y, heading, triangle(c), *rates),
    STAMPS,
    PLACES,
    PLACES,
    ANGLES,
    VOLUMES,
    st.floats(-30.0, 30.0),
    st.floats(-30.0, 30.0),
)
