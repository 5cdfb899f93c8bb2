"""Figure 7 of the paper with cameras: pixels in place of simulated sightings.

The field, its circuit, the odometry and what helps whom are those of `figure7`; landmarks are
cylinders of two colours, robots carry markers and masts. The navigator's camera is a cheap one of a
wide angle that shakes, its focal length not well known; the observer's is a sharper one. Both
are as badly known as their settings say (`simulation/camera/cameras.py`).
"""

from collections.abc import Iterable, Mapping

import msgspec
from rich.console import RenderableType

from cpcbl_launch.lab.experiments import figure7
from cpcbl_launch.lab.experiments.figure7 import CONFIGURATIONS
from cpcbl_launch.lab.experiments.results import Experiment, Outcome, Results, accuracy, new_outcome
from cpcbl_launch.lab.experiments.runs import Case
from cpcbl_team.config import Bands, CameraSettings, Side, Team

NAVIGATOR = CameraSettings(
    width_px=320,
    height_px=240,
    fx_px=135.0,
    fy_px=135.0,
    cx_px=159.5,
    cy_px=119.5,
    edge_sigma_px=1.0,
    tilt_sigma_deg=2.0,
    yaw_sigma_deg=4.0,
    focal_share=0.03,
)
OBSERVER = CameraSettings(
    fx_px=600.0, fy_px=600.0, tilt_sigma_deg=0.2, yaw_sigma_deg=0.3, focal_share=0.003
)
LANDMARKS: Mapping[str, Bands] = {
    "southwest": ("yellow", "blue"),
    "southeast": ("blue", "yellow"),
    "northeast": ("green", "pink"),
    "northwest": ("pink", "green"),
}
MARKERS: Mapping[str, dict[Side, int]] = {
    "navigator": {"front": 0, "left": 1, "back": 2, "right": 3},
    "observer": {"front": 4, "left": 5, "back": 6, "right": 7},
}
MASTS: Mapping[str, Bands] = {"navigator": ("pink", "yellow"), "observer": ("yellow", "green")}
MOST_SHARE = 0.5  # of C's error that E may have
CAMERAS: Mapping[str, CameraSettings] = {"navigator": NAVIGATOR, "observer": OBSERVER}


def team_case(configuration: str) -> Case:
    """One of the six configurations. Odometry alone needs no camera."""
    case = figure7.team_case(configuration)
    return case if configuration == "A" else case._replace(team=with_cameras(case.team))


def with_cameras(team: Team) -> Team:
    """The team with cameras, and with what they know landmarks and robots by."""
    replace = msgspec.structs.replace
    marks = {
        name: replace(mark, colours=LANDMARKS[name]) for name, mark in team.map.landmarks.items()
    }
    robots = {
        name: replace(
            robot,
            sensing="camera",
            camera=CAMERAS[name],
            markers=MARKERS[name],
            colours=MASTS[name],
        )
        for name, robot in team.robots.items()
    }
    return replace(team, robots=robots, map=replace(team.map, landmarks=marks))


def cases() -> Mapping[str, Case]:
    return {c: team_case(c) for c in CONFIGURATIONS}


def outcome(results: Results) -> Outcome:
    figures = {c: accuracy(runs) for c, runs in results.items()}
    found = figure7.pattern(figures, MOST_SHARE)
    return new_outcome("figure7-cameras", results, cases(), figures=figures, pattern=found)


def tables(result: Outcome) -> Iterable[RenderableType]:
    return figure7.tables(result, "navigator with a camera")


EXPERIMENT = Experiment("figure7-cameras", cases, outcome, tables)
