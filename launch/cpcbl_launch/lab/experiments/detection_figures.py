"""The figures of rendered frames: detections, misses, mistakes, errors and their stated sigmas.

Ranges are from the centre of the viewer to the centre of the object. Spreads are about zero, not
about the mean, so that they contain a bias.
"""

import math
import platform
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import lru_cache
from importlib.metadata import version
from itertools import pairwise
from typing import Literal, NamedTuple

import msgspec

from cpcbl_launch.team_file import builtin_path, load_team
from cpcbl_team.config import Team

Kind = Literal["landmark", "marker", "mast"]
Wrong = Literal["wrong id", "wrong range"]
KINDS: tuple[Kind, ...] = ("landmark", "marker", "mast")
WITHIN_M: dict[Kind, float] = {"landmark": 5.0, "marker": 3.0, "mast": 5.0}
"""The ranges for which recall and precision have a target; masts have none."""
ERRORS_WITHIN_M = 4.0
EDGES_M = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 12.0)
DRAWN = 1500  # errors of each kind that the picture shows

LEAST_PRECISION = 0.99
LEAST_RECALL = 0.95
MOST_RANGE_SHARE = 0.03
MOST_BEARING_DEG = 0.5
LEAST_INSIDE = 0.98


class Record(NamedTuple):
    """An object that was due to be detected, or was reported correctly, or both."""

    due: tuple[Kind, ...]
    seen_by: Kind | None
    """A marker if the sighting has a heading, else a mast."""
    range_m: float
    range_error_m: float | None = None
    range_sigma_m: float | None = None
    bearing_error_rad: float | None = None
    bearing_sigma_rad: float | None = None
    heading_error_rad: float | None = None
    heading_sigma_rad: float | None = None


class Mistake(msgspec.Struct, frozen=True, kw_only=True):
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
    doubts: dict[str, int]
    refused: dict[str, int]
    """Frames that could not be used."""
    see_s: float
    """In all, from JPEG to sightings."""
    render_s: float


class Figures(msgspec.Struct, frozen=True, kw_only=True):
    """The figures of one kind of feature between two ranges; None if there is nothing."""

    from_m: float
    to_m: float
    due: int
    """Objects that were completely visible."""
    found: int
    """Those of them that were reported correctly, by any feature, with or without a range."""
    recall: float | None
    reported: int
    """Sightings by this kind of feature, due or not, correct or not."""
    right: int
    precision: float | None
    ranged: int
    """Correct ones with a range."""
    range_sigma_share: float | None
    range_bias_share: float | None
    bearing_sigma_deg: float | None
    heading_sigma_deg: float | None
    range_inside: float | None
    """Share inside three stated sigmas."""
    bearing_inside: float | None
    heading_inside: float | None


class Error(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """One sighting, for the picture: its errors and its stated sigmas."""

    range_m: float
    range_share: float | None
    range_sigma_share: float | None
    bearing_deg: float | None
    bearing_sigma_deg: float | None


class DetectionReport(msgspec.Struct, frozen=True, kw_only=True):
    """The result of the experiment."""

    experiment: str
    version: str
    seed: int
    frames: int
    team: Team
    within: dict[Kind, Figures]
    """Up to the range that recall and precision are about."""
    accuracy: dict[Kind, Figures]
    """Up to the range that errors are about."""
    bins: dict[Kind, tuple[Figures, ...]]
    mistakes: tuple[Mistake, ...]
    doubts: dict[str, int]
    refused: dict[str, int]
    errors: dict[Kind, tuple[Error, ...]]
    pattern: dict[str, bool]
    cost: dict[str, float | str]
    """Measured times, of this machine."""


@lru_cache(maxsize=1)
def team() -> Team:
    """The team of the demonstration with cameras."""
    return load_team(builtin_path("eyes"))


def summarize(count: int, seed: int, batches: Sequence[Batch]) -> DetectionReport:
    """The figures of all frames."""
    records = [record for batch in batches for record in batch.records]
    mistakes = tuple(mistake for batch in batches for mistake in batch.mistakes)
    doubts = sum((Counter(batch.doubts) for batch in batches), Counter[str]())
    refused = sum((Counter(batch.refused) for batch in batches), Counter[str]())
    within = {k: figures(k, records, mistakes, 0.0, WITHIN_M[k]) for k in KINDS}
    accuracy = {k: figures(k, records, mistakes, 0.0, ERRORS_WITHIN_M) for k in KINDS}
    return DetectionReport(
        experiment="eyes",
        version=version("cpcbl-team"),
        seed=seed,
        frames=count,
        team=team(),
        within=within,
        accuracy=accuracy,
        bins={
            k: tuple(figures(k, records, mistakes, low, high) for low, high in pairwise(EDGES_M))
            for k in KINDS
        },
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
    within: dict[Kind, Figures],
    accuracy: dict[Kind, Figures],
    mistakes: Sequence[Mistake],
    refused: int,
) -> dict[str, bool]:
    """The targets, and whether they were met; a target without figures is not met."""
    targets = {}
    for kind in KINDS[:2]:
        seen, of = within[kind], f"{kind}s within {WITHIN_M[kind]:g} m"
        targets[f"{of}: precision at least {LEAST_PRECISION:g}"] = _least(
            seen.precision, LEAST_PRECISION
        )
        targets[f"{of}: recall at least {LEAST_RECALL:g}"] = _least(seen.recall, LEAST_RECALL)
    for kind in KINDS[:2]:
        known, of = accuracy[kind], f"{kind}s within {ERRORS_WITHIN_M:g} m"
        share, bearing = known.range_sigma_share, known.bearing_sigma_deg
        targets[f"{of}: range σ at most 3 %"] = share is not None and share <= MOST_RANGE_SHARE
        targets[f"{of}: bearing σ at most 0.5°"] = (
            bearing is not None and bearing <= MOST_BEARING_DEG
        )
    for kind in KINDS:
        known = accuracy[kind]
        inside = {"range": known.range_inside, "bearing": known.bearing_inside}
        if kind == "marker":
            inside["heading"] = known.heading_inside
        for what, share in inside.items():
            targets[f"{kind}s: {what} inside 3 stated σ at least 98 %"] = _least(
                share, LEAST_INSIDE
            )
    targets["no wrong id"] = not any(m.why == "wrong id" for m in mistakes)
    targets["no frame refused"] = not refused
    return targets


def _least(share: float | None, bound: float) -> bool:
    return share is not None and share >= bound


def figures(
    kind: Kind, records: Sequence[Record], mistakes: Sequence[Mistake], from_m: float, to_m: float
) -> Figures:
    """Of one kind, between two ranges. A mistake is as far away as it says; without a range it
    counts wherever it may be: from 0 up."""
    near = [r for r in records if from_m <= r.range_m < to_m]
    due = [r for r in near if kind in r.due]
    found = sum(r.seen_by is not None for r in due)
    right = [r for r in near if r.seen_by == kind]
    wrong = sum(m.kind == kind and from_m <= (m.range_m or 0.0) < to_m for m in mistakes)
    ranged = [r for r in right if r.range_error_m is not None]
    shares = [(r.range_error_m or 0.0) / r.range_m for r in ranged]
    bearings = [(r.bearing_error_rad, r.bearing_sigma_rad) for r in right]
    headings = [(r.heading_error_rad, r.heading_sigma_rad) for r in right]
    return Figures(
        from_m=from_m,
        to_m=to_m,
        due=len(due),
        found=found,
        recall=_share(found, len(due)),
        reported=len(right) + wrong,
        right=len(right),
        precision=_share(len(right), len(right) + wrong),
        ranged=len(ranged),
        range_sigma_share=_rms(shares),
        range_bias_share=math.fsum(shares) / len(shares) if shares else None,
        bearing_sigma_deg=_degrees(_rms([e for e, _ in bearings if e is not None])),
        heading_sigma_deg=_degrees(_rms([e for e, _ in headings if e is not None])),
        range_inside=_inside([(r.range_error_m, r.range_sigma_m) for r in ranged]),
        bearing_inside=_inside(bearings),
        heading_inside=_inside(headings),
    )


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _rms(values: Sequence[float]) -> float | None:
    return math.sqrt(math.fsum(v * v for v in values) / len(values)) if values else None


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else math.degrees(angle)


def _inside(pairs: Sequence[tuple[float | None, float | None]]) -> float | None:
    """The share of errors within three of their sigmas; an error whose sigma is not stated is
    outside."""
    known = [(e, s or 0.0) for e, s in pairs if e is not None]
    return _share(sum(abs(e) <= 3.0 * s for e, s in known), len(known))


def _errors(kind: Kind, records: Sequence[Record]) -> Iterator[Error]:
    for r in [r for r in records if r.seen_by == kind][:DRAWN]:
        ranged = r.range_error_m is not None and r.range_sigma_m is not None
        yield Error(
            range_m=r.range_m,
            range_share=(r.range_error_m or 0.0) / r.range_m if ranged else None,
            range_sigma_share=(r.range_sigma_m or 0.0) / r.range_m if ranged else None,
            bearing_deg=_degrees(r.bearing_error_rad),
            bearing_sigma_deg=_degrees(r.bearing_sigma_rad),
        )
