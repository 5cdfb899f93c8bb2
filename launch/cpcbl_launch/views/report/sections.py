"""The sections of a report: tables as HTML, around the drawings of `charts`."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from typing import NamedTuple

import tomlkit

from cpcbl_launch.calibration.team_types import non_default_settings
from cpcbl_launch.recordings.summary import RunSummary
from cpcbl_launch.reporting.activity import REFUSALS
from cpcbl_launch.reporting.recorder import RobotReport
from cpcbl_launch.reporting.statuses import trust_remarks
from cpcbl_launch.reporting.tables import number, percent, short, times
from cpcbl_launch.views.report.charts import (
    Drawn,
    Scales,
    bar,
    field,
    help_matrix,
    lost_spans,
    over_time,
    time_text,
)

FIELD_ABOUT = (
    "Solid: where a robot believed to be; red and dotted while it was lost; grey and dashed: where"
    " it truly was. At its last pose, the 3 σ ellipse that it stated. Hollow diamonds: landmarks"
    " that a robot estimated itself, with 3 σ."
)
ROBOTS_ABOUT = (
    "Errors against the truth. Of a consistent estimate 98.9 % of the samples are inside 3 σ, and"
    " NEES has a mean of 2."
)
TIME_ABOUT = (
    "Line: position error (without truth: σ); area: 3 σ as the robot stated. Red: lost; grey:"
    " nothing was heard. Each point is the largest value of its span of time. Below, NEES (its mean"
    " over the span): a consistent estimate is within the green band in 95 % of its samples."
)
HELP_ABOUT = (
    "Help flows one way, from better to worse tiers: fixes as their senders count them, beliefs as"
    " their readers do."
)
TRAFFIC_ABOUT = (
    "What each robot sent: bytes on its link, with Zenoh's own, without those of"
    " TCP/IP. A limit's bar is the most that was spent within one window."
)
REFUSED_ABOUT = "Inputs and messages that robots could not use, by reason."
SETTINGS_ABOUT = "The team file as the robots had it, without what has its default."
HELP_KINDS = {"fix": "fixes", "belief": "beliefs", "landmark": "places of landmarks"}
MOST_CHARTS, MOST_MATRIX, MOST_EVENTS = 24, 40, 300


class RunView(NamedTuple):
    """A run, with what is drawn of its robots."""

    run: RunSummary
    robots: Sequence[Drawn]
    scales: Scales

    def is_heard(self, name: str) -> bool:
        return name in self.run.recorder.tracks

    @property
    def reports(self) -> dict[str, RobotReport]:
        return {**self.run.report.robots, **self.run.report.guests}


def field_section(shown: RunView) -> str:
    if not any(len(robot.path.times_s) for robot in shown.robots):
        return ""
    return f'<div class="card">{field(shown.run, shown.robots)}</div>'


# Figures ------------------------------------------------------------------------------------------


def robots_section(shown: RunView) -> str:
    """A row a robot; without truth what the robots state."""
    has_truth = bool(shown.run.truth)
    head = ["RMSE m", "mean", "max", "heading °", "in 3 σ", "NEES"] if has_truth else []
    head += ["σ m", "max σ", "lost", "longest", "restarts", "used", "rejected"]
    colours = {robot.path.name: robot.colour for robot in shown.robots}
    rows = [_robot_row(shown, name, colours[name], has_truth) for name in shown.reports]
    if has_truth:
        team = shown.run.report.team
        figures = (
            *(team.position_rmse_m, team.position_mean_m, team.position_max_m),
            team.heading_rmse_deg,
        )
        cells = [number(f) for f in figures[:3]] + [number(figures[3], 1)]
        cells += [percent(team.inside_3_sigma), number(team.nees, 2), *[""] * 7]
        rows.append(_row("team", cells, "team"))
    return f'<div class="card wide">{_table(["robot", *head], rows)}</div>'


def _robot_row(shown: RunView, name: str, colour: str, has_truth: bool) -> str:
    robot = shown.reports[name]
    cells = []
    if has_truth:
        cells += [number(v) for v in (robot.position_rmse_m, robot.position_mean_m)]
        cells += [number(robot.position_max_m), number(robot.heading_rmse_deg, 1)]
        cells += [percent(robot.inside_3_sigma), number(robot.nees, 2)]
    cells += [number(robot.sigma_rms_m), number(robot.sigma_max_m)]
    heard = shown.is_heard(name)
    lost = percent(robot.lost_share) if heard else "not heard"
    cells += [lost, f"{robot.longest_lost_s:.1f} s" if heard else "-"]
    cells.append(str(shown.run.report.restarts.get(name, 0)))
    cells += [short(robot.counts.get("accepted", 0)), short(robot.counts.get("gated", 0))]
    guest = " (guest)" if name in shown.run.report.guests else ""
    return _row(f"{name}{guest}", cells, "", f"dot {colour}")


def comparison(one: RunView, other: RunView) -> str:
    """The figures of both runs and their difference, of the team and of robots of both."""
    rows = []
    teams = one.run.report.team, other.run.report.team
    for label, field_name, digits in (
        ("team: RMSE m", "position_rmse_m", 3),
        ("team: largest error m", "position_max_m", 3),
        ("team: heading RMSE °", "heading_rmse_deg", 2),
        ("team: NEES", "nees", 2),
        ("team: messages sent", "messages_sent", 0),
        ("team: bytes sent", "bytes_sent", 0),
    ):
        values = [getattr(team, field_name) for team in teams]
        rows.append(_compared(label, values[0], values[1], digits))
    for name in one.reports:
        if name in other.reports:
            pair = one.reports[name], other.reports[name]
            by_truth = all(robot.position_rmse_m is not None for robot in pair)
            what, key = ("RMSE m", "position_rmse_m") if by_truth else ("σ m", "sigma_rms_m")
            values = [getattr(robot, key) for robot in pair]
            rows.append(_compared(f"{name}: {what}", values[0], values[1], 3))
    return f'<div class="card wide">{_table(["", "A", "B", "B - A", "B / A"], rows)}</div>'


def _compared(label: str, a: float | None, b: float | None, digits: int) -> str:
    cells = [number(a, digits), number(b, digits), "-", "-"]
    if a is not None and b is not None:
        cells[2] = f"{b - a:+.{digits}f}"
        cells[3] = f"{b / a:.2f}" if a else "-"
    return _row(label, cells)


def time_section(shown: RunView) -> str:
    """A drawing a robot; of very many those that were worst."""
    from cpcbl_launch.reporting.paths import worst_first

    heard = [robot for robot in shown.robots if len(robot.path.times_s)]
    chosen = heard
    if len(heard) > MOST_CHARTS:
        worst = {path.name for path in worst_first([r.path for r in heard])[:MOST_CHARTS]}
        chosen = [robot for robot in heard if robot.path.name in worst]
    cards = []
    for robot in chosen:
        chart = over_time(robot, shown.scales, shown.run.duration_s)
        name, words = escape(robot.path.name), escape(_chart_words(shown, robot))
        head = f'<h3><span>{words}</span><b class="dot">{name}</b></h3>'
        cards.append(f'<div class="card {robot.colour}">{head}{chart}</div>')
    if not cards:
        return ""
    left = len(heard) - len(chosen)
    more = f'<p class="soft">{left} robots that did better are left out.</p>' if left else ""
    return f'<div><div class="charts">{"".join(cards)}</div>{more}</div>'


def _chart_words(shown: RunView, robot: Drawn) -> str:
    report, path = shown.reports[robot.path.name], robot.path
    words = []
    if report.position_rmse_m is not None:
        words.append(f"RMSE {number(report.position_rmse_m)} m")
    if report.nees is not None:
        words.append(f"NEES {number(report.nees, 2)}")
    if not path.has_sigma:
        words.append("states no σ")
    if path.is_lost.any():
        words.append(f"lost {percent(path.lost_share)}")
    return ", ".join(words)


# Help and traffic ---------------------------------------------------------------------------------


def helps_of(shown: RunView) -> dict[tuple[str, str], Counter[str]]:
    """Fixes and beliefs by helper and helped robot."""
    found: dict[tuple[str, str], Counter[str]] = {}
    for name, robot in shown.reports.items():
        for topic, flows in (("fix", robot.sent), ("belief", robot.heard)):
            for flow in flows:
                if flow.topic == topic and flow.peer and flow.messages:
                    pair = (name, flow.peer) if topic == "fix" else (flow.peer, name)
                    found.setdefault(pair, Counter())[topic] += flow.messages
    return found


def help_section(shown: RunView) -> str:
    helps = helps_of(shown)
    if not helps:
        return '<p class="soft">nobody helped anybody</p>'
    involved = {name for pair in helps for name in pair}
    names = [name for name in shown.reports if name in involved]
    names += sorted(involved - set(names))
    if len(names) <= MOST_MATRIX:
        return f'<div class="card">{help_matrix(helps, names)}</div>'
    most = sorted(helps.items(), key=lambda item: -sum(item[1].values()))[:MOST_MATRIX]
    rows = [_row(f"{a} → {b}", [str(c["fix"]), str(c["belief"])]) for (a, b), c in most]
    more = f'<p class="soft">the {MOST_MATRIX} busiest of {len(helps)} pairs</p>'
    pairs = _table(["helper → helped", "fixes", "beliefs"], rows)
    return f'<div class="card wide">{pairs}{more}</div>'


def traffic_section(shown: RunView) -> str:
    """Messages and bytes by kind, what was not sent and why, and each robot's limits."""
    kinds: dict[str, dict[str, Counter[str]]] = {}
    for name, robot in shown.reports.items():
        for flow in robot.sent:
            counts = kinds.setdefault(name, {}).setdefault(flow.topic, Counter())
            for field_name in ("messages", "bytes", "over_budget", "worthless", "silent"):
                counts[field_name] += getattr(flow, field_name)
    most = max((shown.reports[name].bytes_sent for name in kinds), default=0) or 1
    duration_s = max(shown.run.duration_s, 1e-9)
    rows = []
    for name, robot in shown.reports.items():
        of_robot = {topic: kinds.get(name, {}).get(topic, Counter()) for topic in HELP_KINDS}
        parts = [
            (topic, float(c["bytes"]), f"{topic}: {c['messages']} messages, {c['bytes']} bytes")
            for topic, c in of_robot.items()
        ]
        left = Counter[str]()
        for counts in of_robot.values():
            left.update(counts)
        cells = [str(counts["messages"]) for counts in of_robot.values()]
        cells += [short(robot.bytes_sent), f"{robot.bytes_sent / duration_s:.1f}"]
        cells += [short(left[reason]) for reason in ("over_budget", "worthless", "silent")]
        rows.append(_row(name, cells, after=f"<td>{bar(parts, float(most))}</td>"))
    head = ["robot", *HELP_KINDS.values(), "bytes", "B/s"]
    head += ["over budget", "worthless", "silent", ""]
    colours = (f'<i class="{topic}"></i>{text}' for topic, text in HELP_KINDS.items())
    key = f'<p class="key soft">bytes of{"".join(colours)}</p>'
    limits = list(_limit_rows(shown))
    budget = _table(["robot", "limit", "most", "allowed", ""], limits) if limits else ""
    none = "" if limits else '<p class="soft">No robot has a limit.</p>'
    return f'<div class="card wide">{_table(head, rows)}{key}{budget}{none}</div>'


def _limit_rows(shown: RunView) -> Iterator[str]:
    for name, robot in shown.reports.items():
        for spent in robot.spending:
            window = f"in {spent.window_s:g} s" if spent.window_s else "in the match"
            css = "used" if spent.is_kept else "over"
            size = bar([(css, min(spent.most, spent.allowed), "")], max(spent.allowed, 1e-9))
            cells = [f"{spent.unit} {window}", short(spent.most), short(spent.allowed)]
            yield _row(name, cells, after=f"<td>{size}</td>")


# What went wrong ----------------------------------------------------------------------------------


def events_section(shown: RunView) -> str:
    """Problems with how long they lasted, then all changes of states in their order."""
    run, rows = shown.run, []
    for name, robot in shown.reports.items():
        rows += [(name, f"{p.seconds:.0f} s", p.text, "warn") for p in robot.problems]
        rows += [(name, "at the end", words, "bad") for words in trust_remarks(name, robot.trust)]
    for drawn in shown.robots:
        for spans, what in (
            (lost_spans(drawn.path), f"lost: {', '.join(drawn.path.reasons[:2])}"),
            (drawn.path.silent_spans(run.duration_s), "nothing was heard of it"),
        ):
            longest = max((b - a for a, b in spans), default=0.0)
            if spans:
                words = f"{what} ({times(len(spans))}, {longest:.1f} s at most)"
                total = f"{sum(b - a for a, b in spans):.1f} s"
                rows.append((drawn.path.name, total, words, "bad"))
        if drawn.path.outside:
            words = f"{drawn.path.outside} estimates have stamps outside of the run"
            rows.append((drawn.path.name, "", words, "warn"))
    rows += [
        (name, "", f"was started again, {times(n)}", "warn")
        for name, n in run.report.restarts.items()
    ]
    summary = [_row(r, [d], after=_words(words, css)) for r, d, words, css in rows]
    head = '<tr><th>robot</th><th>for</th><th class="words">what</th></tr>'
    parts = [f'<div class="card wide">{_raw_table(head, summary)}</div>'] if summary else []
    if run.events:
        parts.append(_event_list(run))
    if not summary:
        parts.insert(0, '<p class="good">No fault, no problem and no restart.</p>')
    return f"<div>{''.join(parts)}</div>"


def _event_list(run: RunSummary) -> str:
    css = {"good": "", "warning": "warn", "error": "bad"}
    rows = [
        _row(
            time_text(round(event.at_ns * 1e-9 - run.begin_s, 1)),
            [event.robot],
            after=_words(event.words, css[event.severity]),
        )
        for event in run.events[:MOST_EVENTS]
    ]
    left = len(run.events) - len(rows)
    more = (
        f'<p class="soft">and {left} more; they are in the log of the merged file</p>'
        if left
        else ""
    )
    head = '<tr><th>at</th><th>robot</th><th class="words">state</th></tr>'
    return (
        f"<details><summary>All {len(run.events)} changes in their order</summary>"
        f'<div class="card wide">{_raw_table(head, rows)}{more}</div></details>'
    )


def refused_section(shown: RunView) -> str:
    """A row a reason, a column a robot that refused anything; measurements out of their gate."""
    counts = {
        name: {reason: n for reason, n in robot.counts.items() if reason in REFUSALS and n}
        for name, robot in shown.reports.items()
    }
    of_robots = {name: own for name, own in counts.items() if own}
    rejected = [
        f"{name} {short(robot.counts['gated'])}"
        for name, robot in shown.reports.items()
        if robot.counts.get("gated")
    ]
    outside = escape(", ".join(rejected) or "none")
    gate = f'<p class="soft">Measurements outside of their gate: {outside}.</p>'
    if not of_robots:
        return f'<div><p class="good">Nothing was refused.</p>{gate}</div>'
    reasons = sorted({reason for own in of_robots.values() for reason in own})
    rows = [
        _row(reason.replace("_", " "), [str(own.get(reason, "")) for own in of_robots.values()])
        for reason in reasons
    ]
    return f'<div class="card wide">{_table(["reason", *of_robots], rows)}{gate}</div>'


def settings_section(shown: RunView) -> str:
    text = tomlkit.dumps(non_default_settings(shown.run.team))
    lines = text.count("\n")
    return (
        f'<details class="card"><summary>Team file, {lines} lines</summary>'
        f"<pre>{escape(text)}</pre></details>"
    )


def _table(head: Sequence[str], rows: Iterable[str]) -> str:
    cells = "".join(f'<th scope="col">{escape(name)}</th>' for name in head)
    return _raw_table(f"<tr>{cells}</tr>", rows)


def _raw_table(head: str, rows: Iterable[str]) -> str:
    return f"<table><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>"


def _row(first: str, cells: Iterable[str], css: str = "", dot: str = "", after: str = "") -> str:
    """`after`: cells that are HTML already."""
    kind, name = f' class="{css}"' if css else "", escape(first)
    inside = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
    name = f'<span class="{dot}">{name}</span>' if dot else name
    return f'<tr{kind}><th scope="row">{name}</th>{inside}{after}</tr>'


def _words(words: str, css: str) -> str:
    return f'<td class="words {css}">{escape(words)}</td>'
