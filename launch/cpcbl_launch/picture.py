"""A run as one picture: where the robots went, and how far off they were. Needs extra `plot`."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib as mpl

from cpcbl_launch.recorder import Recorder
from cpcbl_team.config import Team
from cpcbl_team.metrics import Floats, position_errors

mpl.use("Agg")

from matplotlib import pyplot as plt


def draw_run(
    recorder: Recorder,
    team: Team,
    truth: Mapping[str, Floats],
    path: Path,
    helped_from_s: float | None = None,
) -> None:
    """Paths on the field (true: black) beside position errors over time; a colour a robot."""
    names = [name for name in team.robots if name in recorder.tracks and name in truth]
    figure, (field, errors) = plt.subplots(
        1, 2, figsize=(12, 4.2), width_ratios=(5, 4), layout="constrained"
    )
    begin_s = min((recorder.tracks[n][0].stamp_ns * 1e-9 for n in names), default=0.0)
    for number, name in enumerate(names):
        times, samples = recorder.timed_samples(name, truth[name])
        colour = f"C{number}"
        field.plot(samples.truth[:, 0], samples.truth[:, 1], color="black", linewidth=0.7)
        field.plot(*samples.estimate[:, :2].T, ".", markersize=2.5, color=colour, label=name)
        errors.plot(times - begin_s, position_errors(samples), color=colour, label=name)
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
        errors.annotate(
            "teammates begin to help",
            (helped_from_s - begin_s, 1.0),
            (4, -10),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            fontsize=8,
        )
    figure.legend(*errors.get_legend_handles_labels(), loc="outside upper center", ncols=len(names))
    figure.savefig(path, dpi=110)
    plt.close(figure)
