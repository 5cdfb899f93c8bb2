"""A what-if as tables and remarks, for people."""

import math
from collections.abc import Iterable, Sequence

from rich.console import RenderableType

from cpcbl_launch.lab.what_if.comparison import STATED, RobotFigures, TeamFigures, WhatIf
from cpcbl_launch.reporting.tables import cells, number, table

FAR = 0.5  # of a robot's error: a run that is made again is expected nearer to the recorded one


def tables(result: WhatIf) -> Iterable[RenderableType]:
    """The runs side by side, then the ledger, then what has to be known about them."""
    yield _runs(result)
    if result.ledger:
        yield _ledger(result)
    yield from remarks(result)


def _runs(result: WhatIf) -> RenderableType:
    columns = [("recorded", result.recorded), ("again", result.again), ("changed", result.changed)]
    runs = [(name, run) for name, run in columns if run is not None]
    value = "sigma_m" if result.basis == STATED else "rmse_m"
    unit = "σ m" if result.basis == STATED else "RMSE m"
    title = f"{result.run}, {result.seconds:.0f} s: {result.change}"
    names = [f"{name}\n{what}" for what in (unit, "sent") for name, _ in runs]
    shown = table(title, ("robot",), (*names, "apart\nm", "at most\nm"))
    last = result.changed or result.again
    for robot, figures in last.robots.items():
        shown.add_row(
            robot,
            *_cells([run.robots.get(robot) for _, run in runs], value),
            *cells(figures, "apart_m:.3f apart_most_m:.3f"),
        )
    shown.add_section()
    shown.add_row("team", *_cells([run.team for _, run in runs], value), "", "")
    return shown


def _cells(figures: Sequence[RobotFigures | TeamFigures | None], value: str) -> list[str]:
    """A value of each run, then the messages of each."""
    values = [number(None if f is None else getattr(f, value)) for f in figures]
    return values + ["-" if f is None else str(f.messages_sent) for f in figures]


def _ledger(result: WhatIf) -> RenderableType:
    what = "σ" if result.basis == STATED else "RMSE"
    columns = (f"{what} m", "without m", "worth m", "kB", "m per kB")
    shown = table(f"what each was worth ({result.basis})", ("", ""), columns)
    kind = ""
    for entry in result.ledger:
        if kind and entry.kind != kind:
            shown.add_section()
        figures = "with_m:.4f without_m:.4f worth_m:+.4f kilobytes:.2f worth_m_per_kilobyte:+.4f"
        shown.add_row("" if entry.kind == kind else entry.kind, entry.name, *cells(entry, figures))
        kind = entry.kind
    return shown


def remarks(result: WhatIf) -> Iterable[str]:
    """What has to be known about the figures, one sentence a line."""
    yield from result.remarks
    if result.recorded is None:
        yield "A log has no estimates of its own: `again` is the team on the log as it is."
    else:
        yield from _apart(result)
    yield from _control(result)


def _apart(result: WhatIf) -> Iterable[str]:
    """How well the run could be made again."""
    known = [(r.apart_m, name) for name, r in result.again.robots.items() if r.apart_m is not None]
    if not known:
        yield "The recording has no estimates, so nobody knows how well the run was made again."
        return
    apart_m, name = max(known)
    yield (
        f"Made again with nothing changed, the estimates of {name} are {apart_m:.4f} m from the"
        " recorded ones (root mean square), of the others less: the delays of the real bus are not"
        " in it."
    )
    for robot, figures in result.again.robots.items():
        own_m = figures.rmse_m if figures.rmse_m is not None else figures.sigma_m
        if figures.apart_m is not None and own_m is not None and figures.apart_m > FAR * own_m:
            share = f"more than {FAR:.0%} of its error"
            yield f"Of {robot} that is {share}: what-if says little about it."


def _control(result: WhatIf) -> Iterable[str]:
    for name, c in result.control.items():
        if c.first_s is None:
            continue
        turn = math.degrees(c.turn_rate_rad_s)
        yield (
            f"{name} drives by its estimate, and would have driven otherwise from"
            f" {c.first_s:.1f} s on: its commands differ by {c.speed_m_s:.3f} m/s and"
            f" {turn:.1f} deg/s (root mean square). Here it drove as it was recorded (open loop)."
        )
