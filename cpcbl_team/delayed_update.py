"""The pose of a robot that knew so little that what it measures was not used (`delayed_prior.py`).

The prior is fitted to all evidence since then. A pose is taken for the robot's own if no other one
fits nearly as well, wherever the prior allows it, and if it passes the tests of a pose that is
found by evidence alone (`relocalization.py`). Until then the robot moves by odometry, and is as
uncertain as it was.
"""

from cpcbl_team.arc_fit import Scalar, fits_anywhere, unrivalled
from cpcbl_team.config import Field, OdometryNoise
from cpcbl_team.delayed_prior import DelayedPrior, PropagatedPrior
from cpcbl_team.estimate import Estimate
from cpcbl_team.fusion import chi_square_bound
from cpcbl_team.geometry import Pose2
from cpcbl_team.propagated_evidence import propagated, readings_of
from cpcbl_team.relinearization import WIDE_VARIANCE, is_wide
from cpcbl_team.relocalization import UNKNOWNS, Fit, checked_estimate
from cpcbl_team.state import Evidence, RecoveryMemory, State, with_recovery


def with_delay(state: State) -> State:
    """The state that keeps its estimate as the prior of what it measures from now on, if its
    heading is hardly known."""
    memory = state.memory.recovery
    if memory.delayed is not None or not is_wide(state):
        return state
    prior = DelayedPrior(state.stamp_ns, state.estimate, state.odometry_from_robot)
    return with_recovery(state, memory._replace(delayed=prior))


def without_delay(state: State) -> State:
    """The state whose prior waits for nothing."""
    memory = state.memory.recovery
    if memory.delayed is None:
        return state
    return with_recovery(state, memory._replace(delayed=None))


def is_due(memory: RecoveryMemory, prior: DelayedPrior) -> bool:
    """Whether there is new evidence since the last attempt."""
    return any(
        records and records[-1].stamp_ns > prior.tried_ns
        for records in (memory.snapshots, memory.evidence)
    )


def attempt(
    state: State, evidence: tuple[Evidence, ...], field: Field, noise: OdometryNoise
) -> tuple[State, Estimate | None]:
    """The state after an attempt with the evidence since its prior, and the estimate if there is
    one. A robot whose heading is known better, and one that may have been carried away, waits for
    nothing; nor does one whose evidence contradicts the prior."""
    memory = state.memory.recovery
    prior = memory.delayed
    is_doubt = memory.suspected_ns >= 0 or memory.kidnapped_ns >= 0
    if prior is None or is_doubt or not is_wide(state):
        return without_delay(state), None
    readings = sum(map(readings_of, evidence))
    if readings > UNKNOWNS:
        fit = DelayedFit(prior, evidence, state.odometry_from_robot, field)
        found = fit.estimate(noise)
        if found is not None or fit.least_cost > chi_square_bound(readings):
            return without_delay(state), found
    prior = prior._replace(tried_ns=state.stamp_ns)
    return with_recovery(state, memory._replace(delayed=prior)), None


class DelayedFit:
    """A prior and the evidence since then, fitted together."""

    def __init__(
        self,
        prior: DelayedPrior,
        evidence: tuple[Evidence, ...],
        odometry_from_robot: Pose2,
        field: Field,
    ) -> None:
        self._prior = PropagatedPrior(prior, odometry_from_robot)
        self._pieces = propagated(evidence, odometry_from_robot, field)
        of_then = propagated(evidence, prior.odometry_from_robot, field)

        def measure(then: Pose2) -> list[Scalar]:
            return [scalar for piece in of_then for scalar in piece.rows(then)]

        self._fits = fits_anywhere(self._prior.arc, measure)

    @property
    def least_cost(self) -> float:
        """The chi-square of the best pose."""
        return min(fit.cost for fit in self._fits)

    def estimate(self, noise: OdometryNoise) -> Estimate | None:
        """The present estimate; None where prior and evidence determine none that is certain."""
        found = unrivalled(self._fits)
        if found is None:
            return None
        pose = self._prior.arc.at(found.offset) @ self._prior.now_from_then.inverse()
        best = Fit(found.cost, pose, self._pieces, self._prior)
        estimate = checked_estimate(best, noise)
        return None if estimate is None or estimate.covariance.hh > WIDE_VARIANCE else estimate
