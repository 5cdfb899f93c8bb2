"""A run as it was recorded, made again, and made again with something changed; and the ledger.

The ledger leaves out each robot, landmark, sensor and kind of message in turn, and says what it was
worth: the team's RMSE without it minus that with it. Where the truth is not known, it is what the
robots state (sigma) that is compared.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from itertools import count
from statistics import fmean

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from cpcbl_launch.lab.seeds import HERE, Workers, run_seeds
from cpcbl_launch.lab.what_if.changes import SENSORS, Change, sensed, with_change
from cpcbl_launch.lab.what_if.inputs import RecordedInputs
from cpcbl_launch.lab.what_if.rerun import Rerun, run_again
from cpcbl_launch.reporting.metrics import (
    Floats,
    Trajectory,
    interpolated_truth,
    samples_with_truth,
    score,
    seconds,
    stated_sigma_m,
)
from cpcbl_launch.reporting.recorder import Report

KINDS = {"fix": "collaboration.active=false", "belief": "collaboration.passive=false"}
"""The kinds of messages between robots, and what leaves each out."""
DIFFERENT_M_S, DIFFERENT_RAD_S = 0.01, 0.01  # from which on two commands differ
TRUTH, STATED = "truth", "stated sigma"


class RobotFigures(msgspec.Struct, frozen=True, kw_only=True):
    """One robot in one run; None for what is not known."""

    rmse_m: float | None
    sigma_m: float | None  # root mean square of what it states
    nees: float | None
    lost_share: float
    messages_sent: int
    bytes_sent: int
    apart_m: float | None = None
    """Root mean square of the distances to its estimates in the run that this one is compared
    with."""
    apart_most_m: float | None = None


class TeamFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Means over the robots of both runs that are compared."""

    rmse_m: float | None
    sigma_m: float | None
    messages_sent: int
    bytes_sent: int


class RunFigures(msgspec.Struct, frozen=True, kw_only=True):
    """One run."""

    robots: dict[str, RobotFigures]
    team: TeamFigures


class Control(msgspec.Struct, frozen=True, kw_only=True):
    """How far the commands of a robot that drives by its estimate would have differed: root mean
    squares. It drove as it was recorded all the same."""

    speed_m_s: float
    turn_rate_rad_s: float
    first_s: float | None  # since the start of the run, when they differ for the first time


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """What something was worth to the others; None where there is nothing to compare."""

    kind: str  # robot, landmark, sensor or message
    name: str
    with_m: float | None
    without_m: float | None
    worth_m: float | None
    kilobytes: float | None = None  # of messages: what this kind cost on the senders' links
    worth_m_per_kilobyte: float | None = None


class WhatIf(msgspec.Struct, frozen=True, kw_only=True):
    """What `what-if` writes."""

    run: str
    team: str
    seconds: float
    change: str
    basis: str  # of the ledger: truth, or stated sigma where it is not known
    recorded: RunFigures | None  # None: the recording has no estimates, as a log
    again: RunFigures  # with nothing changed; apart: from the recorded one
    changed: RunFigures | None  # apart: from the one with nothing changed
    control: dict[str, Control] = {}
    ledger: tuple[Entry, ...] = ()
    remarks: tuple[str, ...] = ()


def what_if(
    inputs: RecordedInputs,
    change: Change | None,
    with_ledger: bool = False,
    where: Workers = HERE,
    progress: Callable[[float], None] = lambda done: None,
) -> WhatIf:
    """Makes a run again, then with this change (None: there is none), and with each thing left out
    that the ledger names. Raises InputError for a change that cannot be made."""
    entries = ledger_changes(inputs) if with_ledger else {}
    wanted = [Change(), change, *entries.values()]
    changes = list(dict.fromkeys(c for c in wanted if c is not None))
    alone = inputs._replace(
        truth=dict(inputs.truth), paths={}, report=None, remarks=()
    )  # what a run needs
    finished = count(1)
    every = run_seeds(
        run_again,
        [(with_change(alone, c),) for c in changes],
        where,
        lambda: progress(next(finished) / len(changes)),
    )
    reruns = dict(zip(changes, every, strict=True))
    again = reruns[Change()]
    changed = None if change is None else reruns[change]
    common = tuple(again.paths if changed is None else changed.paths)
    scored = {c: _scored(r, inputs.truth, inputs.paths) for c, r in reruns.items()}
    known = any(figures.rmse_m is not None for figures in scored[Change()].values())
    recorded = None
    if inputs.report is not None:
        as_recorded = Rerun(inputs.report, dict(inputs.paths), {})
        recorded = _scored(as_recorded, inputs.truth, again.paths)
    return WhatIf(
        run=inputs.name,
        team=inputs.team.name,
        seconds=(inputs.end_ns - inputs.start_ns) * 1e-9,
        change=str(change or Change()),
        basis=TRUTH if known else STATED,
        recorded=None if recorded is None else _run_figures(recorded, common, {}, {}),
        again=_run_figures(scored[Change()], common, again.paths, inputs.paths),
        changed=None
        if changed is None or change is None
        else _run_figures(scored[change], common, changed.paths, again.paths),
        control={} if changed is None else control(again, changed, inputs.start_ns * 1e-9),
        ledger=tuple(
            _entry(*key, known, again.report, scored[Change()], scored[left_out or Change()])
            for key, left_out in entries.items()
        ),
        remarks=inputs.remarks,
    )


# Figures ------------------------------------------------------------------------------------------


def _scored(
    run: Rerun, truth: Mapping[str, Floats], others: Mapping[str, Trajectory]
) -> dict[str, RobotFigures]:
    """The figures of each robot, at the times at which it has an estimate in another run, too: of
    a process that was killed the last second is lost, and the first of the next is not recorded."""
    found = {}
    for name, report in run.report.robots.items():
        path = run.paths.get(name)
        if path is None:
            continue
        if name in others:
            path = path.part(_near(path, others[name])[1])
        figures, sigma_m = score(samples_with_truth(path, truth.get(name))[1]), stated_sigma_m(path)
        found[name] = RobotFigures(
            rmse_m=figures.position_rmse_m,
            sigma_m=float(np.sqrt(np.mean(sigma_m**2))) if len(sigma_m) else None,
            nees=figures.nees,
            lost_share=report.lost_share,
            messages_sent=report.messages_sent,
            bytes_sent=report.bytes_sent,
        )
    return found


def _run_figures(
    scored: Mapping[str, RobotFigures],
    common: Collection[str],
    paths: Mapping[str, Trajectory],
    others: Mapping[str, Trajectory],
) -> RunFigures:
    """The figures of these robots, with how far they are from their estimates in another run."""
    robots = {
        name: _with_distance(scored[name], paths.get(name), others.get(name))
        for name in common
        if name in scored
    }
    return RunFigures(
        robots=robots,
        team=TeamFigures(
            rmse_m=_mean(r.rmse_m for r in robots.values()),
            sigma_m=_mean(r.sigma_m for r in robots.values()),
            messages_sent=sum(r.messages_sent for r in robots.values()),
            bytes_sent=sum(r.bytes_sent for r in robots.values()),
        ),
    )


def _with_distance(
    figures: RobotFigures, path: Trajectory | None, other: Trajectory | None
) -> RobotFigures:
    apart = np.empty(0) if path is None or other is None else distances_m(path, other)
    if not len(apart):
        return figures
    root_mean_square = float(np.sqrt(np.mean(apart**2)))
    return replace(figures, apart_m=root_mean_square, apart_most_m=float(apart.max()))


def _near(path: Trajectory, other: Trajectory) -> tuple[Floats, NDArray[np.bool_]]:
    """Where another trajectory is at the times of the first, and where that counts."""
    rows = np.column_stack([seconds(other.stamps_ns), other.estimate])
    if not len(rows):
        return np.zeros_like(path.estimate), np.zeros(len(path.stamps_ns), dtype=bool)
    return interpolated_truth(seconds(path.stamps_ns), rows)


def distances_m(path: Trajectory, other: Trajectory) -> Floats:
    """The distances between two trajectories of one robot, at the times of the first."""
    at, counts = _near(path, other)
    offset = path.estimate[counts, :2] - at[counts, :2]
    return np.asarray(np.hypot(*offset.T))


def control(again: Rerun, changed: Rerun, start_s: float) -> dict[str, Control]:
    """How far the robots' commands differ between two runs, of those that drive by their
    estimates."""
    found = {}
    for name, before in again.commands.items():
        after = changed.commands.get(name)
        if after is None:
            continue
        at = np.maximum(np.searchsorted(before[:, 0], after[:, 0], side="right") - 1, 0)
        speed, turn_rate = (after[:, 1:] - before[at, 1:]).T
        different = (np.abs(speed) > DIFFERENT_M_S) | (np.abs(turn_rate) > DIFFERENT_RAD_S)
        found[name] = Control(
            speed_m_s=float(np.sqrt(np.mean(speed**2))),
            turn_rate_rad_s=float(np.sqrt(np.mean(turn_rate**2))),
            first_s=float(after[np.argmax(different), 0]) - start_s if different.any() else None,
        )
    return found


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if known else None


# The ledger ---------------------------------------------------------------------------------------


def ledger_changes(inputs: RecordedInputs) -> dict[tuple[str, str], Change | None]:
    """What the ledger leaves out, by kind and name; None for what nobody saw or may send."""
    inputs_of: dict[str, set[str]] = {}
    seen: set[str] = set()
    for process in inputs.processes:
        names, objects = sensed(process)
        inputs_of.setdefault(process.robot, set()).update(names)
        seen |= objects
    found: dict[tuple[str, str], Change | None] = {}
    if len(inputs.robots) > 1:
        found |= {("robot", name): Change(without=(name,)) for name in inputs.robots}
    for kind, marks in (
        ("landmark", inputs.team.map.all_landmarks),
        ("wall", inputs.team.map.walls),
    ):
        found |= {(kind, m): Change(hide=(m,)) if m in seen else None for m in marks}
    for robot, names in inputs_of.items():
        for name in SENSORS:
            if name in names:
                found["sensor", f"{robot} {name}"] = Change(sensors=((robot, name),))
    found |= {("message", kind): Change(settings=(off,)) for kind, off in KINDS.items()}
    return found


def _entry(
    kind: str,
    name: str,
    by_truth: bool,
    report: Report,
    with_it: Mapping[str, RobotFigures],
    without_it: Mapping[str, RobotFigures],
) -> Entry:
    """What something was worth to the robots that are in both runs."""

    def value(figures: RobotFigures) -> float | None:
        return figures.rmse_m if by_truth else figures.sigma_m

    pairs = [(value(with_it[n]), value(r)) for n, r in without_it.items() if n in with_it]
    known = [(a, b) for a, b in pairs if a is not None and b is not None]
    with_m, without_m = _mean(a for a, _ in known), _mean(b for _, b in known)
    worth_m = None if with_m is None or without_m is None else without_m - with_m
    sent = 0
    if kind == "message":
        flows = (flow for r in report.robots.values() for flow in r.sent)
        sent = sum(flow.bytes for flow in flows if flow.topic == name)
    return Entry(
        kind=kind,
        name=name,
        with_m=with_m,
        without_m=without_m,
        worth_m=worth_m,
        kilobytes=sent * 1e-3 if kind == "message" else None,
        worth_m_per_kilobyte=worth_m / (sent * 1e-3) if sent and worth_m is not None else None,
    )
