"""`calibrate map` beside an independent batch (GTSAM), and the team on the mapped landmarks.

`python -m benchmarks.mapping FOLDER... --known 6,20 --team`: for each MRCLAM folder the landmarks
that are not known are estimated and compared with the surveyed ones. GTSAM gets the same motions,
readings, noise, priors and first estimate; it has no constant errors of drives, as it has no factor
for them, and its own robust loss. `--team` also runs the team on the map, and on the surveyed one.
"""

import argparse
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import msgspec
import numpy as np

from cpcbl_launch.lab.evaluation import evaluate_log
from cpcbl_launch.mapping.first_estimate import Request
from cpcbl_launch.mapping.mapper import Mapped, build_map
from cpcbl_launch.mapping.problem import Problem
from cpcbl_launch.mapping.runs import read_runs, surveyed_landmarks
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.run.logged_team import LoggedTeam, builtin_for, load_logged_team
from cpcbl_launch.team.file import find_team
from cpcbl_team.config import Field, Landmark, Team

CAUCHY_SIGMAS = 3.0
OURS, GTSAM = "calibrate map", "GTSAM"


class MapFigures(NamedTuple):
    """A map beside the surveyed one."""

    mean_m: float
    worst_m: float
    nees: float  # of a degree of freedom; NaN: no covariance
    cpu_s: float


def figures(
    mapped: Mapped, places: Floats, survey: Mapping[str, Landmark], cpu_s: float, is_ours: bool
) -> MapFigures:
    """The figures of places (landmarks, 2), without the known ones."""
    new = [i for i, name in enumerate(mapped.names) if name not in mapped.frame.known]
    truth = np.array([(survey[n].x_m, survey[n].y_m) for n in mapped.names])
    errors = (places - truth)[new]
    distance = np.hypot(*errors.T)
    columns = np.array([(2 * i, 2 * i + 1) for i in new]).ravel()
    own = mapped.covariance[np.ix_(columns, columns)]
    nees = float(errors.ravel() @ np.linalg.solve(own, errors.ravel())) / len(columns)
    mean, worst = float(distance.mean()), float(distance.max())
    return MapFigures(mean, worst, nees if is_ours else float("nan"), cpu_s)


def gtsam_places(problem: Problem, x: Floats) -> Floats:
    """The landmarks (landmarks, 2) by GTSAM's Levenberg-Marquardt, from these unknowns."""
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    poses, landmarks, _ = problem.parts(x)
    mark = gtsam.symbol_shorthand.L
    for i, pose in enumerate(poses):
        values.insert(i, gtsam.Pose2(*pose))
    for i, place in enumerate(landmarks):
        values.insert(mark(i), place)
    motions = problem.motions
    for pose, read, whitening in zip(motions.pose, motions.read, motions.whitening, strict=True):
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(whitening)
        graph.add(gtsam.BetweenFactorPose2(pose, pose + 1, gtsam.Pose2(*read), noise))
    for row in zip(*problem.readings, strict=True):
        _add_reading(gtsam, graph, mark, row)
    priors = problem.priors
    column, first = priors.columns[:, 0] - problem.landmark_column(), 2 * problem.landmarks
    known = np.flatnonzero((column >= 0) & (column < first))[::2]
    for i in known:
        at, sigma = priors.values[i], 1.0 / priors.factors[i, 0]
        noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
        graph.add(gtsam.PriorFactorPoint2(mark(int(column[i]) // 2), at, noise))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.array([found.atPoint2(mark(i)) for i in range(problem.landmarks)])


def _add_reading(gtsam: Any, graph: Any, mark: Any, row: tuple[Any, ...]) -> None:
    pose, landmark, _, mate, _, range_m, bearing, *sigmas, of_range, of_bearing, _ = row
    if not np.isfinite([range_m, bearing]).all():
        return
    each = np.array([sigmas[1] * np.sqrt(of_bearing), sigmas[0] * np.sqrt(of_range)])
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY_SIGMAS),
        gtsam.noiseModel.Diagonal.Sigmas(each),
    )
    if mate < 0:
        factor = gtsam.BearingRangeFactor2D
        graph.add(factor(pose, mark(int(landmark)), gtsam.Rot2(bearing), range_m, noise))
    else:
        factor = gtsam.BearingRangeFactorPose2
        graph.add(factor(pose, int(mate), gtsam.Rot2(bearing), range_m, noise))


def compare(folder: Path, known: Sequence[str], team: Team) -> tuple[Mapped, dict[str, MapFigures]]:
    """The map of one log, and the figures of both; of GTSAM where it is installed."""
    survey, runs = surveyed_landmarks([folder]), read_runs([folder], [folder.name])
    begin = process_time()
    mapped = build_map(team, runs, Request({name: survey[name] for name in known}))
    ours_s = process_time() - begin
    places = mapped.problem.parts(mapped.solution.x)[1]
    found = {OURS: figures(mapped, places, survey, ours_s, True)}
    if importlib.util.find_spec("gtsam") is not None:
        begin = process_time()
        theirs = gtsam_places(mapped.problem, mapped.first_x)
        found[GTSAM] = figures(mapped, theirs, survey, process_time() - begin, False)
    return mapped, found


def team_rmse_m(logged: LoggedTeam, landmarks: Mapping[str, Landmark]) -> float:
    """The team's mean position RMSE on this map."""
    field = Field(landmarks=dict(landmarks))
    on_map = logged._replace(team=msgspec.structs.replace(logged.team, map=field))
    robots = evaluate_log(on_map).report.robots.values()
    return float(np.mean([r.position_rmse_m for r in robots if r.position_rmse_m is not None]))


def mapped_landmarks(mapped: Mapped, survey: Mapping[str, Landmark]) -> dict[str, Landmark]:
    """The surveyed map with the estimated places of those that were not known."""
    new = [name for name in mapped.names if name not in mapped.frame.known]
    places = {name: mapped.landmark(name)[0].tolist() for name in new}
    return {**survey, **{name: Landmark(x_m=x, y_m=y) for name, (x, y) in places.items()}}


def show(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> None:
    """Prints a line for each folder and each way."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--known", default="6,20")
    parser.add_argument("--team", action="store_true")
    arguments = parser.parse_args()
    for folder in arguments.folders:
        team = find_team(builtin_for(folder))
        mapped, found = compare(folder, arguments.known.split(","), team)
        for name, f in found.items():
            show(
                f"{folder.name} {name:14} mean {f.mean_m:.4f} m, worst {f.worst_m:.4f} m,"
                f" NEES {f.nees:.2f}, {f.cpu_s:.1f} s of CPU time"
            )
        if arguments.team:
            logged = load_logged_team(team, folder)
            survey = logged.team.map.landmarks
            on_survey = team_rmse_m(logged, survey)
            on_map = team_rmse_m(logged, mapped_landmarks(mapped, survey))
            show(
                f"{folder.name} team RMSE {on_map:.4f} m on the map, {on_survey:.4f} m on the"
                f" surveyed one: x {on_map / on_survey:.3f}"
            )


if __name__ == "__main__":
    main()
