"""A run as one picture: where the robots went, and how far off they were. Needs extra `plot`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

from cpcbl_launch.reporting.metrics import Floats, position_errors
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_team.config import Team

mpl.use("Agg")

from matplotlib import pyplot as plt
from matplotlib.axes import Axes

BESIDE: Any = {"textcoords": "offset points", "fontsize": 8}
Spans = Sequence[tuple[float, float]]  # from when until when (s)


def draw_run(
    recorder: Recorder,
    team: Team,
    truth: Mapping[str, Floats],
    path: Path,
    begin_s: float,
    helped_from_s: float | None,
    guests_s: Mapping[str, Spans],
) -> None:
    """Paths on the field (true: black) beside position errors over time; a colour a robot.

    `begin_s`: when the run began. `guests_s`: from when until when each guest was there, since
    then: a grey band.
    """
    names = [name for name in team.robots if name in recorder.tracks and name in truth]
    figure, (field, errors) = plt.subplots(
        1, 2, figsize=(12, 4.2), width_ratios=(5, 4), layout="constrained"
    )
    for number, name in enumerate(names):
        times, samples = recorder.timed_samples(name, truth[name])
        colour = f"C{number}"
        field.plot(samples.truth[:, 0], samples.truth[:, 1], color="black", linewidth=0.7)
        field.plot(*samples.estimate[:, :2].T, ".", markersize=2.5, color=colour, label=name)
        errors.plot(times - begin_s, position_errors(samples), color=colour, label=name)
    for name, present_s in guests_s.items():
        _draw_guest(field, errors, name, truth.get(name), present_s)
    for mark, place in team.map.landmarks.items():
        field.plot(place.x_m, place.y_m, "s", color="0.3")
        field.annotate(mark, (place.x_m, place.y_m), (4, 4), textcoords="offset points", fontsize=7)
    for wall in team.map.walls.values():
        field.plot(*zip(wall.from_m, wall.to_m, strict=True), color="0.3")
    field.set(xlabel="x (m)", ylabel="y (m)", title="estimates (colour), true paths (black)")
    field.set_aspect("equal")
    errors.set(xlabel="time (s)", ylabel="position error (m)", title="error", yscale="log")
    errors.grid(True, which="both", alpha=0.3)
    if helped_from_s is not None:
        errors.axvline(helped_from_s - begin_s, color="black", linestyle="--")
        _annotate_time(errors, helped_from_s - begin_s, "teammates begin to help")
    figure.legend(*errors.get_legend_handles_labels(), loc="outside upper center", ncols=len(names))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_guest(
    field: Axes, errors: Axes, name: str, truth: Floats | None, present_s: Spans
) -> None:
    for from_s, until_s in present_s:
        errors.axvspan(from_s, until_s, color="0.85", zorder=0)
        _annotate_time(errors, from_s, f"{name} is there")
    if truth is not None:
        field.plot(truth[:, 1], truth[:, 2], color="black", linewidth=0.7)
        field.plot(truth[-1, 1], truth[-1, 2], "*", markersize=12, color="black")
        field.annotate(name, tuple(truth[-1, 1:3]), (7, -3), **BESIDE)


def _annotate_time(errors: Axes, time_s: float, text: str) -> None:
    errors.annotate(text, (time_s, 1.0), (4, -10), xycoords=("data", "axes fraction"), **BESIDE)
