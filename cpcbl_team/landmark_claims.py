"""How well the robots of a team can know places of landmarks at best, by the team file.

A robot states how certain the place of a landmark is that it tells, and the most certain place is
the one that others take: who states a millimetre is asked alone. But all that a team knows of its
field is in its file. So a place of a robot that the file gives none is not taken for better than
what it can have found.
"""

from msgspec.structs import replace

from cpcbl_team.config import Team
from cpcbl_team.frames import knows_map
from cpcbl_team.inputs import LandmarkBelief


class LandmarkClaims:
    """What robots of one team say of landmarks, as far as the team file bears it out."""

    def __init__(self, team: Team, least_sigma_m: float) -> None:
        """`least_sigma_m`: of a place that is told by a robot to which the file does not give it,
        where the file gives it to another."""
        self._given = {(n, mark) for n, r in team.robots.items() for mark in r.known_landmarks}
        self._of_given = {mark for _, mark in self._given}
        self._least_m = least_sigma_m
        starts = [r.start for r in team.robots.values() if r.start is not None and r.start.known]
        is_bounded = not team.map.is_frame_agreed and not any(
            knows_map(team, n) for n in team.robots
        )
        self._start_m = min((s.sigma_m for s in starts), default=0.0) if is_bounded else 0.0

    def believed(self, told: LandmarkBelief) -> LandmarkBelief:
        """What is told of a place, no more certain than its robot can know it."""
        if (told.robot, told.landmark) in self._given:
            return told
        least_m = self._least_m if told.landmark in self._of_given else self._start_m
        xx, xy, yy = told.covariance
        more = max(0.0, least_m * least_m - min(xx, yy))
        if not more:
            return told
        return replace(told, covariance=(xx + more, xy, yy + more))
