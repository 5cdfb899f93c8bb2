"""The figures of teams of different sizes: a table, and a picture (extra `plot`)."""

from pathlib import Path

from rich.console import Console

from cpcbl_launch.lab.scaling.measure import ScalingReport
from cpcbl_launch.reporting.tables import number, percent, table

COLUMNS = (
    "robots",
    "in sight",
    "out/s",
    "B/s",
    "in/s",
    "B/s",
    "CPU ms/s",
    "x real",
    "RMSE m",
    "in 3 σ",
)
_LEGEND = (
    "Means over the robots. in sight: teammates in a frame; out, in: fixes and beliefs,\n"
    "and their bytes on the link; CPU: of a robot's own steps, per second of its time."
)


def print_scaling(scale: ScalingReport, console: Console) -> None:
    """Prints a row for each size."""
    shown = table(
        f"generated teams in one process, {scale.duration_s:g} s of robot time, seed {scale.seed}",
        (),
        COLUMNS,
    )
    for s in scale.sizes:
        shown.add_row(
            str(s.robots),
            f"{s.in_sight:.1f}",
            f"{s.messages_sent_per_s:.1f}",
            f"{s.bytes_sent_per_s:.0f}",
            f"{s.messages_received_per_s:.1f}",
            f"{s.bytes_received_per_s:.0f}",
            f"{s.cpu_ms_per_s:.1f}",
            f"{s.times_real_time:.3g}",
            number(s.position_rmse_m),
            percent(s.inside_3_sigma),
        )
    console.print(shown)
    console.print(_LEGEND, style="yellow", highlight=False)


def draw_scaling(scale: ScalingReport, path: Path) -> None:
    """Draws two panels: the bytes per second that a robot sends and receives, and the CPU of its
    steps."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (traffic, cpu) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    sizes = [s.robots for s in scale.sizes]
    for label, rates in (
        ("sent", [s.bytes_sent_per_s for s in scale.sizes]),
        ("received", [s.bytes_received_per_s for s in scale.sizes]),
    ):
        traffic.plot(sizes, rates, "o-", label=label)
    cpu.plot(sizes, [s.cpu_ms_per_s for s in scale.sizes], "o-", color="C2")
    traffic.set(title="fixes and beliefs of a robot", ylabel="bytes a second on their link")
    traffic.legend()
    cpu.set(title="CPU of a robot", ylabel="ms in a second of robot time")
    for axes in (traffic, cpu):
        axes.set(xlabel="robots in the team", xscale="log", ylim=(0, None))
        axes.set_xticks(sizes, labels=[str(size) for size in sizes], minor=False)
        axes.minorticks_off()
        axes.grid(True, alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)
