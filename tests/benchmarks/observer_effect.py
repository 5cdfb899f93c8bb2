"""What a guest is worth to three blind robots (docs/observers.md), in one process and robot time.

    PYTHONPATH=.:agents:transport:launch:tests python -m benchmarks.observer_effect --seeds 10

The guest is there from 20 s to 40 s of a minute. Printed are the mean RMSE of the robots from one
second after it came until it left, over seeds from 1 on, and when the position sigma of a robot is
first below 5 cm after it came and above 10 cm after it left, over robots and seeds.
"""

import argparse
from collections.abc import Mapping, Sequence
from statistics import mean
from typing import NamedTuple

import numpy as np
from rich.console import Console
from support.simulated import ScheduledGuest, simulate_with_guests

from cpcbl_launch.reporting.metrics import Trajectory, seconds
from cpcbl_launch.reporting.phases import Span, phase_report
from cpcbl_launch.reporting.tables import number, table
from cpcbl_launch.run.observer import (
    ObserverPose,
    ObserverRequest,
    parse_waypoints,
    team_with_observer,
)
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import Team

FROM_S, UNTIL_S, END_S = 20.0, 40.0, 60.0
SETTLED_S = 1.0
SURE_M, UNSURE_M = 0.05, 0.10
REQUESTS: Mapping[str, ObserverRequest | None] = {
    "tripod": ObserverRequest(name="tripod", at=ObserverPose(4.5, 6.0, -90.0), sensor="survey"),
    "rover": ObserverRequest(
        name="rover",
        at=ObserverPose(2.0, 2.5),
        sensor="gps",
        moves=parse_waypoints("7,2.5;2,2.5"),
    ),
    "nobody": None,
}


class Effect(NamedTuple):
    """Of one run."""

    rmse_m: float  # mean over the robots, while the guest is there
    sure_after_s: list[float]  # of each robot; infinite if never
    unsure_after_s: list[float]


def first_s(path: Trajectory, from_s: float, below_m: float = 0.0, above_m: float = 0.0) -> float:
    """Seconds from `from_s` until the position sigma is within these limits; inf if never."""
    assert path.covariance is not None
    sigma_m = np.sqrt(0.5 * (path.covariance[:, 0] + path.covariance[:, 2]))
    times_s = seconds(path.stamps_ns)
    within = sigma_m <= below_m if below_m else sigma_m > above_m
    reached_s = times_s[(times_s >= from_s) & within]
    return float(reached_s[0]) - from_s if len(reached_s) else np.inf


def effect(team: Team, request: ObserverRequest | None, seed: int) -> Effect:
    """One run. The same request and seed give the same figures."""
    guests: list[ScheduledGuest] = []
    if request is not None:
        settings = team_with_observer(team, request).robots[request.name]
        guests = [ScheduledGuest(request.name, settings, FROM_S, UNTIL_S)]
    recorder = simulate_with_guests(team, seed, END_S, guests)
    truth, span = recorder.simulated_truth(), Span(FROM_S + SETTLED_S, UNTIL_S)
    phases = [phase_report(recorder, robot, truth[robot], [span]) for robot in team.robots]
    paths = [recorder.trajectory(robot) for robot in team.robots]
    return Effect(
        mean(phase.position_rmse_m or 0.0 for phase in phases),
        [first_s(path, FROM_S, below_m=SURE_M) for path in paths],
        [first_s(path, UNTIL_S, above_m=UNSURE_M) for path in paths],
    )


def interval(values: Sequence[float], digits: int) -> str:
    """Smallest to largest; empty if it never happened to one of them."""
    if not np.isfinite(values).all():
        return ""
    return f"{number(min(values), digits)} to {number(max(values), digits)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    seeds = range(1, parser.parse_args().seeds + 1)
    team = load_team(builtin_path("blind"))
    figures = ("RMSE m", "of a seed", "σ ≤ 5 cm after s", "σ > 10 cm after s")
    shown = table(f"three blind robots and a guest, {len(seeds)} seeds", ("guest",), figures)
    for name, request in REQUESTS.items():
        runs = [effect(team, request, seed) for seed in seeds]
        rmse_m = [run.rmse_m for run in runs]
        sure_s = [time_s for run in runs for time_s in run.sure_after_s]
        unsure_s = [time_s for run in runs for time_s in run.unsure_after_s]
        cells = interval(rmse_m, 3), interval(sure_s, 1), interval(unsure_s, 1)
        shown.add_row(name, number(mean(rmse_m), 3), *cells)
    Console().print(shown)


if __name__ == "__main__":
    main()
