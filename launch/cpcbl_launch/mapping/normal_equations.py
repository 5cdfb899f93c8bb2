"""The normal equations, solved by elimination of the poses.

Sorted by time, a pose is coupled to few others: those before and after, and those of robots that
see each other. Landmarks, constant errors, and poses of robots that stand, which many readings
share, are the border. Their Schur complement is small, and its inverse is their covariance.
"""

from typing import Any

import numpy as np
import scipy.linalg
from scipy import sparse
from scipy.sparse.linalg import splu

from cpcbl_launch.calibration.statistics import Integers
from cpcbl_launch.mapping.problem import Linearized, Problem
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.errors import InputError

MANY_READINGS = 300  # of one pose, from which on it belongs to the border
CHUNK = 64  # columns of the border that are eliminated at a time
UNDETERMINED = (
    "calibrate map: these runs do not determine all places and paths; record a longer drive, with"
    " landmarks in sight"
)
LEAST_INFORMATION = 1e-9  # of every unknown, in its unit^-2: a sigma of 30 km


def elimination_order(problem: Problem) -> tuple[Integers, Integers]:
    """The columns of the poses that are eliminated, in the order of time, and of the border."""
    readings = problem.readings
    number = np.bincount(readings.pose, minlength=problem.poses)
    number += np.bincount(readings.mate[readings.mate >= 0], minlength=problem.poses)
    busy = number > MANY_READINGS
    by_time = problem.in_time
    inner = (3 * by_time[~busy[by_time]][:, None] + np.arange(3)).ravel()
    standing = (3 * np.flatnonzero(busy)[:, None] + np.arange(3)).ravel()
    rest = np.arange(problem.landmark_column(), problem.size)
    return inner, np.concatenate([standing, rest])


class UndeterminedError(InputError):
    """The measurements do not determine all unknowns."""


class NormalEquations:
    """J^T J of a linearized problem, with each diagonal element times 1 + damping."""

    def __init__(
        self, linear: Linearized, order: tuple[Integers, Integers], damping: float
    ) -> None:
        """Raises UndeterminedError."""
        self._inner, self._border = order
        hessian: Any = (linear.jacobian.T @ linear.jacobian).tocsr()
        diagonal = hessian.diagonal()
        hessian = hessian + sparse.diags(damping * diagonal + LEAST_INFORMATION)
        rows = hessian[self._inner]
        poses = rows[:, self._inner].tocsc()
        try:
            self._factors = splu(
                poses, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError as error:  # singular
            raise UndeterminedError(UNDETERMINED) from error
        self._coupling = rows[:, self._border].tocsc()
        complement = hessian[self._border][:, self._border].toarray()
        for first in range(0, len(self._border), CHUNK):
            part = slice(first, first + CHUNK)
            eliminated = self._factors.solve(self._coupling[:, part].toarray())
            complement[:, part] -= self._coupling.T @ eliminated
        self.information = 0.5 * (complement + complement.T)
        """Of the border, poses being eliminated: the inverse of its covariance."""
        try:
            self._cholesky = scipy.linalg.cho_factor(self.information)
        except (np.linalg.LinAlgError, ValueError) as error:  # not positive definite, not finite
            raise UndeterminedError(UNDETERMINED) from error

    def solve(self, right: Floats) -> Floats:
        """The unknowns (n,) or (n, k) with H @ unknowns = right."""
        inner = self._factors.solve(right[self._inner])
        border = right[self._border] - self._coupling.T @ inner
        result = np.empty_like(right)
        found = scipy.linalg.cho_solve(self._cholesky, border)
        result[self._border] = found
        result[self._inner] = inner - self._factors.solve(self._coupling @ found)
        return result

    def border_covariance(self) -> Floats:
        """The covariance of the unknowns of the border, in the order of their columns."""
        return np.asarray(scipy.linalg.cho_solve(self._cholesky, np.eye(len(self._border))))
