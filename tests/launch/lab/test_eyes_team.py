"""The team `eyes`, from pixels to beliefs: in one process, and as processes over real Zenoh."""

import time
from functools import cache
from pathlib import Path

import msgspec
import pytest

from cpcbl_launch.reporting.recorder import Recorder, Report
from cpcbl_launch.run.processes import Processes
from cpcbl_launch.run.up import Run, run_team, with_listen_endpoint
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import Team

RUN_S = 8.0
ENOUGH = 40  # frames of a robot, and reports of where it is
WITHIN = pytest.mark.timeout(300)  # a machine that has other things to do


def eyes() -> Team:
    return with_listen_endpoint(load_team(builtin_path("eyes")))


def fresh(seed: int, team: Team | None = None) -> Report:
    report, _ = simulate(team or eyes(), seed, RUN_S)
    return report


simulated = cache(fresh)


def rmse_m(report: Report, name: str) -> float:
    found = report.robots[name].position_rmse_m
    assert found is not None
    return found


@pytest.mark.long
@WITHIN
def test_every_robot_is_localized_by_its_camera_with_a_consistent_covariance() -> None:
    reports = [simulated(seed) for seed in (1, 2, 3)]
    for report in reports:
        for name, robot in report.robots.items():
            assert not robot.lost_at_end
            assert robot.lost_share == 0.0
            assert rmse_m(report, name) < 0.1, name
            assert robot.counts["sightings"] == robot.counts["frame"] >= 10.0 * RUN_S - 2
    shares = [report.team.inside_3_sigma or 0.0 for report in reports]
    assert sum(shares) / len(shares) >= 0.97


@pytest.mark.long
@WITHIN
def test_the_follower_is_localized_by_its_teammates() -> None:
    """It is blind to landmarks: without the others' help it does not know nearly as well."""
    team, replace = eyes(), msgspec.structs.replace
    mute = {
        name: replace(
            robot, collaboration=replace(robot.collaboration, active=False, passive=False)
        )
        for name, robot in team.robots.items()
    }
    helped, alone = simulated(1), fresh(1, replace(team, robots=mute))
    assert rmse_m(alone, "follower") > 2.0 * rmse_m(helped, "follower")


@pytest.mark.long
@WITHIN
def test_the_same_seed_gives_the_same_run() -> None:
    assert fresh(1) == simulated(1)
    assert simulated(1) != simulated(2)


class Watching:
    """Looks on until every robot has seen and reported enough."""

    def __init__(self) -> None:
        self.frames: dict[str, int] = {}
        self.done = False

    def show(self, recorder: Recorder, processes: Processes, elapsed_s: float) -> None:
        for name, status in recorder.latest()[1].items():
            self.frames[name] = dict(status.counts).get("sightings", 0)
        self.done = (
            len(self.frames) == len(recorder.tracks) == 4
            and min(self.frames.values()) >= ENOUGH
            and all(len(track) >= ENOUGH for track in recorder.tracks.values())
        )


@pytest.mark.long
@WITHIN
def test_processes_with_cameras_are_localized_over_a_real_router(tmp_path: Path) -> None:
    watching, until = Watching(), time.monotonic() + 120.0
    run = Run(eyes(), None, seed=2, folder=tmp_path)
    report = run_team(run, watching.show, lambda: watching.done or time.monotonic() > until)
    logs = "".join(f"\n{p.name}:\n{p.read_text()}" for p in tmp_path.glob("*.log"))
    assert watching.done, f"{watching.frames}{logs}"
    for name, robot in report.robots.items():
        assert not robot.lost_at_end, name
        assert rmse_m(report, name) < 0.3, f"{name}: {rmse_m(report, name):.3f}{logs}"
        assert robot.counts["frame"] == robot.counts["sightings"]  # every frame could be used
