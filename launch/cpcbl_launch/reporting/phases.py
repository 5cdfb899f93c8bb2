"""What a robot was worth in parts of a run: before help began; before, during, after a guest."""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import msgspec
import numpy as np

from cpcbl_launch.reporting.metrics import Floats, samples_with_truth, score, seconds
from cpcbl_launch.reporting.recorder import Effect, GuestReport, Phase, Recorder

AWAY_S = 2.0  # who says nothing of itself for longer was away
MOST_GUESTS = 100  # as many as a team may let in; more is garbage


class Span(NamedTuple):
    """From one time on until another one, which is not in it (s)."""

    from_s: float = -math.inf
    until_s: float = math.inf


def phase_report(
    recorder: Recorder, robot: str, truth: Floats | None, spans: Sequence[Span]
) -> Phase:
    """A robot's figures in some parts of a run."""
    path = recorder.trajectory(robot)
    times_s = seconds(path.stamps_ns)
    inside = np.zeros(len(times_s), dtype=np.bool_)
    for span in spans:
        inside |= (span.from_s <= times_s) & (times_s < span.until_s)
    part = path.part(inside)
    figures, covariance = score(samples_with_truth(part, truth)[1]), part.covariance
    sigma_m = None
    if covariance is not None and len(covariance):
        sigma_m = float(np.sqrt(0.5 * np.mean(covariance[:, 0] + covariance[:, 2])))
    return Phase(**msgspec.structs.asdict(figures), position_sigma_m=sigma_m)


def presence_spans(times_s: Sequence[float]) -> list[Span]:
    """When somebody was there who spoke at these times, which are in order."""
    if not len(times_s):
        return []
    gaps = [(a, b) for a, b in pairwise(times_s) if b - a > AWAY_S]
    begins = [times_s[0], *(b for _, b in gaps)]
    ends = [*(a for a, _ in gaps), times_s[-1]]
    return [Span(*span) for span in zip(begins, ends, strict=True)]


def split_by_presence(
    present: Sequence[Span], begin_s: float
) -> tuple[list[Span], list[Span], list[Span]]:
    """The parts of a run from `begin_s` on before, during and after somebody's presence."""
    before = [Span(begin_s, present[0].from_s)]
    during = [Span(max(begin_s, p.from_s), p.until_s) for p in present]
    ends = [*(p.from_s for p in present[1:]), math.inf]
    after = [Span(max(begin_s, p.until_s), end_s) for p, end_s in zip(present, ends, strict=True)]
    return before, during, after


def guest_reports(
    recorder: Recorder,
    robots: Sequence[str],
    truth: Mapping[str, Floats],
    epoch_s: float,
    begin_s: float = -math.inf,
) -> dict[str, GuestReport]:
    """Reports of the robots that are not in the team file: of too many, those with most tracks.

    `begin_s`: the time at which figures begin; `epoch_s`: the start of the run.
    """
    reports = {}
    counts = {name: len(tracks) for name, tracks in list(recorder.tracks.items())}
    others = sorted(counts.keys() - set(robots), key=lambda name: (-counts[name], name))
    for name in sorted(others[:MOST_GUESTS]):
        present = presence_spans(seconds(recorder.trajectory(name).stamps_ns).tolist())
        spans = split_by_presence(present, begin_s)
        effects = {}
        for robot in robots:
            phases = [phase_report(recorder, robot, truth.get(robot), part) for part in spans]
            effects[robot] = Effect(before=phases[0], during=phases[1], after=phases[2])
        own = recorder.robot_report(name, "", truth.get(name))
        reports[name] = GuestReport(
            **msgspec.structs.asdict(own),
            present_s=tuple((p.from_s - epoch_s, p.until_s - epoch_s) for p in present),
            robots=effects,
        )
    return reports
