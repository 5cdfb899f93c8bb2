"""Step 3 of the cycle, the general path: the constraints of each object, accepted or rejected."""

from collections.abc import Iterable, Sequence

from cpcbl_team.config import LocalizationSettings
from cpcbl_team.constraints import Constraint
from cpcbl_team.estimate import POSE, Estimate, Scope
from cpcbl_team.measurements import (
    GatedObjects,
    Measurement,
    constraints_of,
    curved,
    gated_object,
)
from cpcbl_team.relinearization import Linearization, Relinearization
from cpcbl_team.state import State

AMBIGUOUS = "ambiguous"
"""Counted when two poses agree with what a robot with an uncertain heading measures."""


class Gate:
    """The constraints of what one robot measures, and which of them are used."""

    def __init__(
        self,
        settings: LocalizationSettings,
        gates: tuple[float, float],
        relinearization: Relinearization,
    ) -> None:
        """`gates`: chi-square bounds of one and of two constraints."""
        self._rules = rules = settings.localizer
        self._gates, self._relinearization = gates, relinearization
        self._widens = rules.variant != "weighted" and not rules.paper_uncertainty

    def constrain(
        self, state: State, measurements: Iterable[Measurement], scope: Scope
    ) -> tuple[State, GatedObjects]:
        """The constraints of each object, accepted or rejected by the chi-square bound of their
        innovation, and the state at whose estimate they are linearized. If two poses agree with
        what a robot with an uncertain heading measures, no object of the map is used. Where no
        Gaussian contains the pose, a mixture decides."""
        measured = sorted(measurements, key=lambda m: m.source)
        state, accepted = self._relinearization.as_mixture(state, measured)
        if accepted is not None:
            return state, self._of_mixture(state, measured, accepted, scope)
        found = self._relinearization.about_best_pose(state, measured)
        if found is None:
            of_teammates = [m for m in measured if m.sender]
            return state.counted(AMBIGUOUS), self._gated(state, of_teammates, scope, None)
        after, about = found
        gated = self._gated(after, measured, scope, about)
        if about is None or gated.accepted:
            return after, gated
        return state, self._gated(state, measured, scope, None)

    def _of_mixture(
        self,
        state: State,
        measured: Sequence[Measurement],
        accepted: frozenset[str],
        scope: Scope,
    ) -> GatedObjects:
        """The objects that have updated a mixture, as they are about the estimate before, and which
        of them it accepts; and the dependent ones that agree with its estimate. (The others tell
        nothing: a mixture is not where its mean is.)"""
        objects = self._gated(state, [m for m in measured if not m.is_dependent], POSE, None)
        mixture, gated = state.memory.mixture, GatedObjects([], [])
        for found in (*objects.accepted, *objects.rejected):
            is_accepted = found.measurement.source in accepted
            (gated.accepted if is_accepted else gated.rejected).append(found)
        if mixture is not None:
            state = state._replace(estimate=mixture.estimate)
        others = self._gated(state, [m for m in measured if m.is_dependent], scope, None)
        return gated._replace(accepted=gated.accepted + others.accepted)

    def _gated(
        self,
        state: State,
        measured: Iterable[Measurement],
        scope: Scope,
        about: Linearization | None,
    ) -> GatedObjects:
        prior, gated = state.estimate, GatedObjects([], [])
        there = prior if about is None else prior._replace(pose=about.pose)
        for m in measured:
            constraints = self._constraints(prior, m, scope, about)
            if constraints:
                result = gated_object(there, m, constraints, state.common_errors)
                is_accepted = result.nis <= self._gates[len(constraints) - 1]
                (gated.accepted if is_accepted else gated.rejected).append(result)
        return gated

    def _constraints(
        self, prior: Estimate, m: Measurement, scope: Scope, about: Linearization | None
    ) -> list[Constraint]:
        if about is not None:
            return about.constraints_of(prior, m, self._rules)
        constraints = constraints_of(prior.pose, m, scope, self._rules)
        if constraints and self._widens and not m.is_dependent:
            return curved(prior, m, constraints)
        return constraints
