"""What cameras see: rendered frames over poses, light, clutter and what stands in the way.

`rendered_frames.py` renders each frame and compares it with what was detected; here are the
figures: detections, misses, mistakes, errors and their stated sigmas. Ranges are from the centre of
the viewer to the centre of the object. Spreads are about zero, not about the mean, so that they
contain a bias.

`make bench-detection ARGS='--frames 10000'`
"""

import argparse
import math
import platform
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple

from benchmarks.report import counted_progress, show_and_write, user_errors
from msgspec import Struct
from msgspec.structs import replace
from rich.console import RenderableType

from cpcbl_launch.lab.experiments.runs import ExperimentResult
from cpcbl_launch.lab.seeds import Workers, run_seeds
from cpcbl_launch.reporting.metrics import degrees
from cpcbl_launch.reporting.tables import cells, number, table
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError

CHUNK = 25  # frames of one task
Kind = Literal["landmark", "marker", "mast"]
Wrong = Literal["wrong id", "wrong range"]
KINDS: tuple[Kind, ...] = ("landmark", "marker", "mast")
WITHIN_M: dict[Kind, float] = {"landmark": 5.0, "marker": 3.0, "mast": 5.0}
"""The ranges for which recall and precision have a target; masts have none."""
ERRORS_WITHIN_M = 4.0
EDGES_M = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 12.0)
CALIBRATED, CALIBRATED_SPOTTER = (0.1, 0.005), (0.05, 0.003)
"""Sigmas of the yaw (deg) and of the focal length of the cameras."""
DRAWN = 1500  # errors of each kind that the picture shows

LEAST_PRECISION = 0.99
LEAST_RECALL = 0.95
MOST_RANGE_SHARE = 0.03
MOST_BEARING_DEG = 0.5
LEAST_INSIDE = 0.98


class Record(NamedTuple):
    """An object that was due to be detected, or was reported correctly, or both."""

    due: tuple[Kind, ...]
    seen_by: Kind | None  # a marker if the sighting has a heading, else a mast
    range_m: float
    range_error_m: float | None = None
    range_sigma_m: float | None = None
    bearing_error_rad: float | None = None
    bearing_sigma_rad: float | None = None
    heading_error_rad: float | None = None
    heading_sigma_rad: float | None = None


class Mistake(Struct, frozen=True, kw_only=True):
    """A wrong sighting."""

    frame: int
    kind: Kind
    id: str
    why: Wrong
    range_m: float | None
    bearing_deg: float | None


class Batch(NamedTuple):
    """The results of some frames."""

    records: list[Record]
    mistakes: list[Mistake]
    doubts: Mapping[str, int]
    refused: Mapping[str, int]  # frames that could not be used
    see_s: float  # in all, from JPEG to sightings
    render_s: float


class Figures(Struct, frozen=True, kw_only=True):
    """The figures of one kind of feature between two ranges; None if there is nothing."""

    from_m: float
    to_m: float
    due: int  # objects that were completely visible
    found: int  # those of them that were reported correctly, by any feature, even without a range
    recall: float | None
    reported: int  # sightings by this kind of feature, due or not, correct or not
    right: int
    precision: float | None
    ranged: int  # correct ones with a range
    range_sigma_share: float | None
    range_bias_share: float | None
    bearing_sigma_deg: float | None
    heading_sigma_deg: float | None
    range_inside: float | None  # share inside three stated sigmas
    bearing_inside: float | None
    heading_inside: float | None


class Error(Struct, frozen=True, kw_only=True, array_like=True):
    """One sighting, for the picture: its errors and its stated sigmas."""

    range_m: float
    range_share: float | None
    range_sigma_share: float | None
    bearing_deg: float | None
    bearing_sigma_deg: float | None


class DetectionReport(ExperimentResult, frozen=True, kw_only=True):
    seed: int
    frames: int
    team: Team
    within: dict[Kind, Figures]  # up to the range that recall and precision are about
    accuracy: dict[Kind, Figures]  # up to the range that errors are about
    bins: dict[Kind, tuple[Figures, ...]]
    mistakes: tuple[Mistake, ...]
    doubts: dict[str, int]
    refused: dict[str, int]
    errors: dict[Kind, tuple[Error, ...]]
    pattern: dict[str, bool]
    cost: dict[str, float | str]  # measured times, of this machine


@lru_cache(maxsize=1)
def team() -> Team:
    """The team of the demonstration with cameras, whose yaw and focal length are known well, and
    whose principal points are exact in these images."""
    team = load_team(builtin_path("eyes"))
    robots = {}
    for name, robot in team.robots.items():
        sigma_deg, share = CALIBRATED_SPOTTER if name == "spotter" else CALIBRATED
        camera = replace(robot.camera, yaw_sigma_deg=sigma_deg, focal_share=share, centre_share=0.0)
        robots[name] = replace(robot, camera=camera)
    return replace(team, robots=robots)


def measure(count: int, seed: int, jobs: int | None, done: Callable[[], None]) -> DetectionReport:
    """So many frames, `jobs` processes at a time; `done` is called after each `CHUNK` of them."""
    from benchmarks.rendered_frames import evaluate_frames  # needs OpenCV

    starts = range(0, count, CHUNK)
    tasks = [(seed, start, min(CHUNK, count - start)) for start in starts]
    return summarize(count, seed, run_seeds(evaluate_frames, tasks, Workers(jobs), done))


def summarize(count: int, seed: int, batches: Sequence[Batch]) -> DetectionReport:
    """The figures of all frames."""
    records = [record for batch in batches for record in batch.records]
    mistakes = tuple(mistake for batch in batches for mistake in batch.mistakes)
    doubts = sum((Counter(batch.doubts) for batch in batches), Counter[str]())
    refused = sum((Counter(batch.refused) for batch in batches), Counter[str]())

    def between(kind: Kind, low_m: float, high_m: float) -> Figures:
        return figures(kind, records, mistakes, low_m, high_m)

    within = {k: between(k, 0.0, WITHIN_M[k]) for k in KINDS}
    accuracy = {k: between(k, 0.0, ERRORS_WITHIN_M) for k in KINDS}
    return DetectionReport(
        experiment="eyes",
        seed=seed,
        frames=count,
        team=team(),
        within=within,
        accuracy=accuracy,
        bins={k: tuple(between(k, *edges) for edges in pairwise(EDGES_M)) for k in KINDS},
        mistakes=mistakes,
        doubts=dict(doubts.most_common()),
        refused=dict(refused.most_common()),
        errors={k: tuple(_errors(k, records)) for k in KINDS},
        pattern=pattern(within, accuracy, mistakes, refused.total()),
        cost={
            "see_ms": 1e3 * sum(b.see_s for b in batches) / count,
            "render_ms": 1e3 * sum(b.render_s for b in batches) / count,
            "machine": platform.machine(),
        },
    )


def pattern(
    within: Mapping[Kind, Figures],
    accuracy: Mapping[Kind, Figures],
    mistakes: Sequence[Mistake],
    refused: int,
) -> dict[str, bool]:
    """The targets, and whether they were met; a target without figures is not met."""

    def most(sigma: float | None, bound: float) -> bool:
        return sigma is not None and sigma <= bound

    targets = {}
    for kind in KINDS[:2]:
        seen, of = within[kind], f"{kind}s within {WITHIN_M[kind]:g} m"
        precision, recall = seen.precision or 0.0, seen.recall or 0.0
        targets[f"{of}: precision at least {LEAST_PRECISION:g}"] = precision >= LEAST_PRECISION
        targets[f"{of}: recall at least {LEAST_RECALL:g}"] = recall >= LEAST_RECALL
    for kind in KINDS[:2]:
        known, of = accuracy[kind], f"{kind}s within {ERRORS_WITHIN_M:g} m"
        targets[f"{of}: range σ at most 3 %"] = most(known.range_sigma_share, MOST_RANGE_SHARE)
        targets[f"{of}: bearing σ at most 0.5°"] = most(known.bearing_sigma_deg, MOST_BEARING_DEG)
    for kind in KINDS:
        for what in ("range", "bearing", *(("heading",) if kind == "marker" else ())):
            inside = getattr(accuracy[kind], f"{what}_inside") or 0.0
            targets[f"{kind}s: {what} inside 3 stated σ at least 98 %"] = inside >= LEAST_INSIDE
    targets["no wrong id"] = not any(m.why == "wrong id" for m in mistakes)
    targets["no frame refused"] = not refused
    return targets


def figures(
    kind: Kind, records: Sequence[Record], mistakes: Sequence[Mistake], from_m: float, to_m: float
) -> Figures:
    """Of one kind, between two ranges. A mistake is as far away as it says; without a range it
    counts wherever it may be: from 0 up."""
    near = [r for r in records if from_m <= r.range_m < to_m]
    due = [r for r in near if kind in r.due]
    found = sum(r.seen_by is not None for r in due)
    right = [r for r in near if r.seen_by == kind]
    reported = len(right) + sum(
        m.kind == kind and from_m <= (m.range_m or 0.0) < to_m for m in mistakes
    )
    shares = [r.range_error_m / r.range_m for r in right if r.range_error_m is not None]
    bearings = [(r.bearing_error_rad, r.bearing_sigma_rad) for r in right]
    headings = [(r.heading_error_rad, r.heading_sigma_rad) for r in right]
    return Figures(
        from_m=from_m,
        to_m=to_m,
        due=len(due),
        found=found,
        recall=found / len(due) if due else None,
        reported=reported,
        right=len(right),
        precision=len(right) / reported if reported else None,
        ranged=len(shares),
        range_sigma_share=_rms(shares),
        range_bias_share=math.fsum(shares) / len(shares) if shares else None,
        bearing_sigma_deg=degrees(_rms([e for e, _ in bearings if e is not None])),
        heading_sigma_deg=degrees(_rms([e for e, _ in headings if e is not None])),
        range_inside=_inside([(r.range_error_m, r.range_sigma_m) for r in right]),
        bearing_inside=_inside(bearings),
        heading_inside=_inside(headings),
    )


def _rms(values: Sequence[float]) -> float | None:
    return math.sqrt(math.fsum(v * v for v in values) / len(values)) if values else None


def within_3_sigma(pairs: Iterable[tuple[float | None, float | None]]) -> list[bool]:
    """Which of the known errors are within three of their sigmas; one whose sigma is not stated
    is outside."""
    return [abs(error) <= 3.0 * (sigma or 0.0) for error, sigma in pairs if error is not None]


def _inside(pairs: Sequence[tuple[float | None, float | None]]) -> float | None:
    within = within_3_sigma(pairs)
    return sum(within) / len(within) if within else None


def _errors(kind: Kind, records: Sequence[Record]) -> Iterator[Error]:
    for r in [r for r in records if r.seen_by == kind][:DRAWN]:
        ranged = r.range_error_m is not None and r.range_sigma_m is not None
        yield Error(
            range_m=r.range_m,
            range_share=(r.range_error_m or 0.0) / r.range_m if ranged else None,
            range_sigma_share=(r.range_sigma_m or 0.0) / r.range_m if ranged else None,
            bearing_deg=degrees(r.bearing_error_rad),
            bearing_sigma_deg=degrees(r.bearing_sigma_rad),
        )


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
    see_ms, render_ms = result.cost["see_ms"], result.cost["render_ms"]
    yield f"cost: {see_ms:.1f} ms per image to detect, {render_ms:.1f} ms to render"
    for target, ok in result.pattern.items():
        yield f"target: {'held  ' if ok else 'missed'} {target}"


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items()) or "nothing"


def _cells(f: Figures) -> list[str]:
    share = f.range_sigma_share
    return [
        *cells(f, "due recall:.3f reported precision:.3f"),
        number(None if share is None else 100.0 * share, 1),
        *cells(f, "bearing_sigma_deg:.2f heading_sigma_deg:.1f"),
        *cells(f, "range_inside:.3f bearing_inside:.3f heading_inside:.3f"),
    ]


def main() -> None:
    """Renders frames, compares what is detected in them, and writes `eyes.json` and `eyes.png`."""
    parser = argparse.ArgumentParser(prog="bench-detection", description=main.__doc__)
    parser.add_argument("--frames", type=int, default=2000, help="Rendered frames.")
    parser.add_argument("--seed", type=int, default=1, help="Of poses, light and noise.")
    parser.add_argument("--jobs", type=int, help="Processes at a time; default: all cores.")
    parser.add_argument("--output", type=Path, default=Path("build"), help="Folder for the files.")
    given = parser.parse_args()
    with user_errors(parser):
        if given.frames < 1 or given.seed < 0 or (given.jobs is not None and given.jobs < 1):
            raise InputError("--frames and --jobs: at least 1; --seed: at least 0")
    with counted_progress("detection", -(-given.frames // CHUNK)) as done:
        result = measure(given.frames, given.seed, given.jobs, done)
    show_and_write(result, tables(result), given.output / "eyes.json")
    from benchmarks.detection_picture import draw

    draw(result, given.output / "eyes.png")


if __name__ == "__main__":
    main()
