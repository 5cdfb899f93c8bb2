"""A what-if as tables and remarks, for people."""

import math
from collections.abc import Iterable

from rich.console import RenderableType

from cpcbl_launch.lab.what_if.comparison import STATED, WhatIf
from cpcbl_launch.reporting.tables import cells, number, table

FAR_M = 0.05  # a run that is made again is expected within this distance of the recorded one


def tables(result: WhatIf) -> Iterable[RenderableType]:
    """The runs side by side, then the ledger, then what has to be known about them."""
    yield _runs(result)
    if result.ledger:
        yield _ledger(result)
    yield from remarks(result)


def _runs(result: WhatIf) -> RenderableType:
    columns = [("recorded", result.recorded), ("again", result.again), ("changed", result.changed)]
    runs = [(name, run) for name, run in columns if run is not None]
    title = f"{result.run}, {result.seconds:.0f} s: {result.change}"
    names = [f"{name} {unit}" for unit in ("RMSE m", "σ m", "sent") for name, _ in runs]
    shown = table(title, ("robot",), (*names, "apart m", "most m"))
    last = result.changed or result.again
    for robot, figures in last.robots.items():
        of_robot = [run.robots.get(robot) for _, run in runs]
        rmse = [number(None if r is None else r.rmse_m) for r in of_robot]
        sigma = [number(None if r is None else r.sigma_m) for r in of_robot]
        sent = [str(r.messages_sent) if r else "-" for r in of_robot]
        shown.add_row(robot, *rmse, *sigma, *sent, *cells(figures, "apart_m:.3f apart_most_m:.3f"))
    shown.add_section()
    teams = [run.team for _, run in runs]
    rmse, sigma = [number(t.rmse_m, 3) for t in teams], [number(t.sigma_m, 3) for t in teams]
    shown.add_row("team", *rmse, *sigma, *(str(t.messages_sent) for t in teams), "", "")
    return shown


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
        apart = [r.apart_m for r in result.again.robots.values() if r.apart_m is not None]
        if apart:
            yield (
                f"Made again with nothing changed, the estimates are {max(apart):.4f} m from the"
                " recorded ones (the robot that is farthest, root mean square): the delays of the"
                " real bus are not in it."
            )
            if max(apart) > FAR_M:
                yield f"That is more than {FAR_M:g} m: what-if says little about this run."
    yield from _control(result)


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
