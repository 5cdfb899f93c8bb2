"""Teammates' beliefs about landmarks whose places are not on the map, as one robot uses them.

A belief is merged, as it comes and while it is better, into the place that the robot has found
itself: by covariance intersection, to which repetition tells nothing new. Of a landmark of which it
has no place the belief is kept, and the landmark is then like a teammate that stands there: as long
as the belief is much better than what the robot would find, or the robot is lost. In between it
finds the place itself, for that is known better in relation to its own pose.
"""

from collections.abc import Mapping

from cpcbl_team.common_error_filter import CommonErrorFilter
from cpcbl_team.config import Field, LocalizationSettings
from cpcbl_team.fusion import chi_square_bounds
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.inputs import LandmarkBelief
from cpcbl_team.recovery_evidence import is_in_quarantine
from cpcbl_team.state import State, with_landmark
from cpcbl_team.teammates import TeammateScreen

MUCH_BETTER = 0.25  # of the variance of the robot's own position
AGAIN_NS = 1_000_000_000  # in the first frame of each such time


class LandmarkBeliefs:
    """Takes what teammates believe of landmarks."""

    def __init__(
        self,
        settings: LocalizationSettings,
        field: Field,
        common: CommonErrorFilter | None,
        screen: TeammateScreen,
    ) -> None:
        self._unsurveyed = frozenset(field.unsurveyed)
        self._passive = settings.collaboration.passive
        self._common, self._screen = common, screen
        _, self._gate = chi_square_bounds(settings.localizer.gate_probability)

    def usable(self, state: State) -> Mapping[str, LandmarkBelief]:
        """The beliefs by which the robot takes landmarks for known."""
        beliefs = state.memory.teammates.trusted_landmarks
        if not beliefs or self._common is None or state.lost:
            return beliefs
        own = state.estimate.covariance
        most = MUCH_BETTER * (own.xx + own.yy)
        return {n: b for n, b in beliefs.items() if b.covariance[0] + b.covariance[2] <= most}

    def add(self, state: State, belief: LandmarkBelief) -> State:
        """The state after a teammate's belief. Pure, and at the state's own time: a landmark stands
        still."""
        if belief.landmark not in self._unsurveyed or not self._passive:
            return state
        if not is_in_quarantine(state, belief.robot):  # else it would silence the others
            state = with_landmark(state, belief)
        found = self._compared(state, belief)
        if found is None:
            return state
        covariance, nis = found
        state, is_trusted = self._screen.screen_landmark_belief(state, belief, nis)
        if not is_trusted:
            return state
        if nis > self._gate:
            return state.counted("landmark_gated")
        return self._merged(state, belief, covariance)

    def after_sighting(self, state: State, name: str) -> State:
        """The state when it sees this landmark: a belief about it is merged again now and then."""
        belief = state.memory.teammates.landmarks.get(name)
        if belief is None or state.stamp_ns // AGAIN_NS == state.updates.accepted_ns // AGAIN_NS:
            return state
        if name not in state.memory.teammates.trusted_landmarks:
            return state
        found = self._compared(state, belief)
        if found is None:
            return state
        covariance, nis = found
        return state if nis > self._gate else self._merged(state, belief, covariance)

    def _compared(self, state: State, belief: LandmarkBelief) -> tuple[Covariance2, float] | None:
        """The covariance of a belief (m^2) and its normalized innovation squared beside the place
        that the robot has found; None where it has none, or is lost."""
        common = self._common
        if common is None or state.lost or not common.has_found(state, belief.landmark):
            return None
        covariance = self._screen.cautious(state, belief.robot, Covariance2(*belief.covariance))
        return covariance, common.landmark_belief_nis(state, belief, covariance)

    def _merged(self, state: State, belief: LandmarkBelief, covariance: Covariance2) -> State:
        assert self._common is not None
        return self._common.with_landmark_belief(state, belief, covariance)
