"""Team sizes side by side on a terminal."""

from rich.console import Console

from cpcbl_launch.lab.scaling.measure import ScalingReport
from cpcbl_launch.reporting.tables import number, percent, table

_EXPLAINED = (
    "means over the robots; in sight: teammates in a frame; out, in: fixes and",
    "beliefs, bytes on their link; CPU ms/s: of a robot's own steps, a second of its time",
)


def print_scaling(scale: ScalingReport, console: Console) -> None:
    """A row for each size."""
    shown = table(
        f"generated teams in one process, {scale.duration_s:g} s of robot time, seed {scale.seed}",
        (),
        (
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
        ),
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
    for line in _EXPLAINED:
        console.print(line, style="yellow", highlight=False)
