"""A robot that drives rounds and receives fixes of observers, correct and faulty ones."""

import math
from collections.abc import Callable, Mapping

import numpy as np

from cpcbl_team.config import (
    CollaborationSettings,
    OdometrySettings,
    SensorSettings,
    Start,
    TrustSettings,
    Variant,
)
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Fix, Input, Odometry, Sightings
from cpcbl_team.state import State
from support.core import (
    LOOP_START,
    SECOND,
    driven,
    frame,
    localizer,
    loop,
    position_error,
    sensor_noise,
)
from support.trust import RULES

NOISE = OdometrySettings(distance_sigma_m_per_sqrt_m=0.05)
Observed = Callable[[int, Pose2, np.random.Generator], tuple[float, float] | None]


def correct(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float]:
    return truth.x + 0.05 * rng.normal(), truth.y + 0.05 * rng.normal()


def faulty(kind: str, from_s: float = 5.0, until_s: float = 15.0) -> Observed:
    """An observer with this fault, that is correct before and after."""
    last: list[tuple[float, float]] = []

    def position(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float]:
        x, y = correct(ns, truth, rng)
        if not from_s * SECOND <= ns < until_s * SECOND:
            last[:] = [(x, y)]
            return x, y
        if kind == "frozen":
            return last[0]
        if kind == "overconfident":
            return x + 0.4 * rng.normal(), y + 0.4 * rng.normal()
        if kind == "jumps":
            turn = 2.4 * (ns // (2 * SECOND))
            return x + 1.5 * math.cos(turn), y + 1.5 * math.sin(turn)
        return x + 0.6, y

    return position


class Drive:
    """A robot that drives rounds and receives fixes, and its errors."""

    def __init__(
        self,
        observers: Mapping[str, Observed],
        *,
        seed: int = 1,
        sees_landmarks: bool = False,
        variant: Variant = "joint",
        rules: TrustSettings = RULES,
        rounds: int = 2,
        claimed_m: float = 0.05,
        hidden_s: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """`hidden_s`: from when to when it sees no landmarks."""
        rng = np.random.default_rng(seed)
        self.robot = localizer(
            variant,
            sensor=SensorSettings(sees_landmarks=sees_landmarks),
            odometry=NOISE,
            collaboration=CollaborationSettings(trust=rules),
            start=Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.05),
        )
        self.state = self.robot.start(0)
        self.inputs: list[Input] = []
        self.errors: list[float] = []
        self.nees: list[float] = []  # of the position
        noise = sensor_noise(rng, self.robot.settings.sensor)
        for piece, truth in driven(LOOP_START, loop() * rounds):
            distance = piece.distance_m * (1.0 + 0.05 * rng.normal())
            inputs: list[Input] = [
                Odometry(piece.from_ns, piece.stamp_ns, distance, piece.turn_rad)
            ]
            is_hidden = hidden_s[0] * SECOND <= piece.stamp_ns < hidden_s[1] * SECOND
            if sees_landmarks and not is_hidden:
                inputs.append(frame(truth, piece.stamp_ns, noise=noise))
            for name, observed in observers.items():
                position = observed(piece.stamp_ns, truth, rng)
                if position is not None:
                    c = (claimed_m**2, 0.0, claimed_m**2)
                    inputs.append(Fix("me", name, piece.stamp_ns, *position, c, (1e-4, 0.0, 1e-4)))
            for item in inputs:
                self.take(item)
            estimate = self.state.estimate
            self.errors.append(position_error(estimate, truth))
            dx, dy, (xx, xy, yy, *_) = (
                truth.x - estimate.pose.x,
                truth.y - estimate.pose.y,
                estimate.covariance,
            )
            self.nees.append(Covariance2(xx, xy, yy).mahalanobis_squared(dx, dy))

    def take(self, item: Input) -> None:
        self.inputs.append(item)
        steps: dict[type, Callable[..., State]] = {
            Odometry: self.robot.add_odometry,
            Sightings: self.robot.cycle,
            Fix: self.robot.add_fix,
        }
        self.state = steps[type(item)](self.state, item)

    @property
    def rmse_m(self) -> float:
        return math.sqrt(sum(e * e for e in self.errors) / len(self.errors))

    @property
    def inside_3_sigma(self) -> float:
        """The share of its estimates."""
        return sum(nees <= 9.0 for nees in self.nees) / len(self.nees)

    @property
    def quarantines(self) -> dict[str, int]:
        senders = self.state.memory.teammates.senders
        return {name: r.quarantines for name, r in senders.items() if r.quarantines}
