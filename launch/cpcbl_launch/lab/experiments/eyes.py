"""What cameras see: rendered frames over poses, light, clutter and what stands in the way.

`rendered_frames.py` renders each frame and compares it with what was detected;
`detection_figures.py` computes the figures.
"""

from collections import Counter
from collections.abc import Callable, Iterable

from rich.console import RenderableType

from cpcbl_launch.lab.experiments.detection_figures import (
    ERRORS_WITHIN_M,
    WITHIN_M,
    DetectionReport,
    Figures,
    summarize,
)
from cpcbl_launch.lab.experiments.runs import map_in_processes
from cpcbl_launch.reporting.tables import number, table

CHUNK = 25


def measure(count: int, seed: int, jobs: int | None, done: Callable[[], None]) -> DetectionReport:
    """So many frames, `jobs` processes at a time; `done` is called after each `CHUNK` of them."""
    from cpcbl_launch.lab.experiments.rendered_frames import evaluate_frames  # needs OpenCV

    starts = range(0, count, CHUNK)
    tasks = [(seed, start, min(CHUNK, count - start)) for start in starts]
    batches = map_in_processes(evaluate_frames, tasks, jobs, done)
    return summarize(count, seed, batches)


def tables(result: DetectionReport) -> Iterable[RenderableType]:
    """Detections by range, wrong and rejected ones, and the targets."""
    shown = table(
        f"rendered frames: {result.frames}, seed {result.seed}",
        ("", "m"),
        ("due", "recall", "seen", "prec.", "r %", "b °", "h °", "3σ r", "3σ b", "3σ h"),
    )
    for kind, bins in result.bins.items():
        for f in bins:
            if f.due or f.reported:
                shown.add_row(kind, f"{f.from_m:g}-{f.to_m:g}", *_cells(f))
        shown.add_row(kind, f"< {WITHIN_M[kind]:g}", *_cells(result.within[kind]))
        if WITHIN_M[kind] != ERRORS_WITHIN_M:
            shown.add_row(kind, f"< {ERRORS_WITHIN_M:g}", *_cells(result.accuracy[kind]))
    yield shown
    yield (
        "due: objects completely visible; seen: reported sightings; r, b, h: σ of the\n"
        "errors of range, bearing, heading; 3σ: share of errors within 3 stated σ"
    )
    yield f"rejected: {_listed(result.doubts)}"
    if result.refused:
        yield f"unusable images: {_listed(result.refused)}"
    yield f"wrong: {_listed(Counter(f'{m.kind}, {m.why}' for m in result.mistakes))}"
    yield (
        f"cost: {result.cost['see_ms']:.1f} ms per image to detect,"
        f" {result.cost['render_ms']:.1f} ms to render"
    )
    for target, ok in result.pattern.items():
        yield f"target: {'held  ' if ok else 'missed'} {target}"


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items()) or "nothing"


def _cells(f: Figures) -> tuple[str, ...]:
    return (
        str(f.due),
        number(f.recall),
        str(f.reported),
        number(f.precision),
        number(None if f.range_sigma_share is None else 100.0 * f.range_sigma_share, 1),
        number(f.bearing_sigma_deg, 2),
        number(f.heading_sigma_deg, 1),
        number(f.range_inside),
        number(f.bearing_inside),
        number(f.heading_inside),
    )
