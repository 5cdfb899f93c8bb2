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

from cpcbl_launch.lab.seeds import HERE, Workers, run_seeds
from cpcbl_launch.lab.what_if.changes import SENSORS, Change, sensed, with_change
from cpcbl_launch.lab.what_if.inputs import RecordedInputs
from cpcbl_launch.lab.what_if.rerun import Rerun, run_again
from cpcbl_launch.reporting.metrics import Floats, Trajectory, interpolated_truth, seconds
from cpcbl_launch.reporting.recorder import Report, RobotReport

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
    common = again.paths if changed is None else changed.paths
    value = _rmse_m if any(map(_rmse_m, again.report.robots.values())) else _sigma_m
    return WhatIf(
        run=inputs.name,
        team=inputs.team.name,
        seconds=(inputs.end_ns - inputs.start_ns) * 1e-9,
        change=str(change or Change()),
        basis=TRUTH if value is _rmse_m else STATED,
        recorded=None if inputs.report is None else run_figures(inputs.report, common),
        again=run_figures(again.report, common, again.paths, inputs.paths),
        changed=None
        if changed is None
        else run_figures(changed.report, common, changed.paths, again.paths),
        control={} if changed is None else control(again, changed, inputs.start_ns * 1e-9),
        ledger=tuple(
            _entry(*key, value, again.report, reruns[left_out or Change()].report)
            for key, left_out in entries.items()
        ),
        remarks=inputs.remarks,
    )


# Figures ------------------------------------------------------------------------------------------


def run_figures(
    report: Report,
    robots: Collection[str],
    paths: Mapping[str, Trajectory] = {},
    other: Mapping[str, Trajectory] = {},
) -> RunFigures:
    """The figures of these robots, and how far they are from their estimates in another run."""
    found = {
        name: _robot_figures(report.robots[name], paths.get(name), other.get(name))
        for name in robots
        if name in report.robots
    }
    chosen = [report.robots[name] for name in found]
    return RunFigures(
        robots=found,
        team=TeamFigures(
            rmse_m=_mean(map(_rmse_m, chosen)),
            sigma_m=_mean(map(_sigma_m, chosen)),
            messages_sent=sum(r.messages_sent for r in chosen),
            bytes_sent=sum(r.bytes_sent for r in chosen),
        ),
    )


def _robot_figures(
    report: RobotReport, path: Trajectory | None, other: Trajectory | None
) -> RobotFigures:
    apart = np.empty(0) if path is None or other is None else distances_m(path, other)
    return RobotFigures(
        rmse_m=report.position_rmse_m,
        sigma_m=report.sigma_rms_m,
        nees=report.nees,
        lost_share=report.lost_share,
        messages_sent=report.messages_sent,
        bytes_sent=report.bytes_sent,
        apart_m=float(np.sqrt(np.mean(apart**2))) if len(apart) else None,
        apart_most_m=float(apart.max()) if len(apart) else None,
    )


def distances_m(path: Trajectory, other: Trajectory) -> Floats:
    """The distances between two trajectories of one robot, at the times of the first."""
    if not len(path.stamps_ns) or not len(other.stamps_ns):
        return np.empty(0)
    rows = np.column_stack([seconds(other.stamps_ns), other.estimate])
    at, counts = interpolated_truth(seconds(path.stamps_ns), rows)
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


def _rmse_m(report: RobotReport) -> float | None:
    return report.position_rmse_m


def _sigma_m(report: RobotReport) -> float | None:
    return report.sigma_rms_m


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
    for kind, marks in (("landmark", inputs.team.map.landmarks), ("wall", inputs.team.map.walls)):
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
    value: Callable[[RobotReport], float | None],
    with_it: Report,
    without_it: Report,
) -> Entry:
    """What something was worth to the robots that are in both runs."""
    pairs = [(value(with_it.robots[n]), value(r)) for n, r in without_it.robots.items()]
    known = [(a, b) for a, b in pairs if a is not None and b is not None]
    with_m, without_m = _mean(a for a, _ in known), _mean(b for _, b in known)
    worth_m = None if with_m is None or without_m is None else without_m - with_m
    sent = 0
    if kind == "message":
        flows = (flow for r in with_it.robots.values() for flow in r.sent)
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
