"""What the tests of the information gain share: covariances, tiers, and their strategies."""

import math

from hypothesis import strategies as st

from cpcbl_team.config import CollaborationSettings
from cpcbl_team.estimate import SMALLEST_VARIANCE
from cpcbl_team.gaussian import Covariance2, oriented_covariance
from cpcbl_team.tiers import LOWEST_TIER
from support.core import least_eigenvalue, matrix2

RULES = CollaborationSettings()
SECOND = 1_000_000_000
NOTHING = Covariance2(0.0, 0.0, 0.0)
sigmas = st.floats(0.005, 2.0)
covariances = st.builds(oriented_covariance, sigmas, sigmas, st.floats(-math.pi, math.pi))
fusions = st.sampled_from(["split-ci", "naive"])
tiers = st.integers(0, LOWEST_TIER)
coordinates = st.floats(-20.0, 20.0)
exact_or_not = st.just(0.0) | st.floats(1e-9, 20.0)
areas = st.builds(oriented_covariance, exact_or_not, exact_or_not, st.floats(-math.pi, math.pi))
displacements = st.just(0.0) | st.floats(-20.0, 20.0)
either_rules = CollaborationSettings(fusion="split-ci"), CollaborationSettings(fusion="naive")


def round_covariance(sigma_m: float) -> Covariance2:
    return Covariance2(sigma_m**2, 0.0, sigma_m**2)


def sigma_of(covariance: Covariance2) -> float:
    return math.sqrt(0.5 * (covariance.xx + covariance.yy))


def exactness(*covariances: Covariance2) -> float:
    """The largest share by which regularization increases the smallest determinant."""
    least = min(least_eigenvalue(matrix2(c)) for c in covariances)
    return 2.0 * SMALLEST_VARIANCE / least * (1.0 + SMALLEST_VARIANCE / least)
