"""The motion of one robot between any two times, from its odometry alone."""

from collections import deque
from collections.abc import Iterable

from msgspec.structs import replace

from cpcbl_team.config import Field, LocalizationSettings
from cpcbl_team.estimate import ZERO3, Estimate
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry
from cpcbl_team.localizer import Localizer


class OdometryTrack:
    """One robot's odometry, read once from the start to the end.

    The team's localizer moves along it: gaps are bridged as the team does it.
    """

    def __init__(
        self, settings: LocalizationSettings, start_ns: int, odometry: Iterable[Odometry]
    ) -> None:
        """`odometry` is that of the true motion: its systematic errors are corrected."""
        rules = replace(settings.localizer, variant="joint", self_calibration=False)
        self._localizer = Localizer(replace(settings, localizer=rules), Field())
        self._state = self._localizer.start(start_ns)
        self._pieces = deque(sorted(odometry, key=lambda piece: piece.from_ns))

    def until(self, until_ns: int) -> Estimate:
        """The motion since the last call: the new pose in the frame of the old one (m, rad)."""
        state = self._state._replace(estimate=Estimate(Pose2(0.0, 0.0, 0.0), ZERO3))
        while self._pieces and self._pieces[0].from_ns < until_ns:
            state = self._localizer.add_odometry(state, self._pieces.popleft())
        self._state = self._localizer.predict(state, until_ns)
        return self._state.estimate
