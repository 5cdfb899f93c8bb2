"""Traffic on a terminal: what a run spent, and live who helps whom. Fits 80 columns."""

from collections.abc import Iterator, Sequence

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from cpcbl_launch.reporting.recorder import Report, RobotReport
from cpcbl_launch.reporting.statuses import (
    CURRENT_HELP_NS,
    FlowReport,
    SpendingReport,
    are_limits_kept,
)
from cpcbl_launch.reporting.tables import number, short, table
from cpcbl_launch.views.live import LiveView
from cpcbl_launch.views.traffic import RATES_NS, HelpLink, LiveRobot, Traffic

COLOURS = {"fix": "cyan", "belief": "magenta", "landmark": "green"}
HEADS = {"fix": "fixes", "belief": "beliefs", "landmark": "places"}
NOT_SENT = {"budget": "over_budget", "value": "worthless", "silence": "silent"}
COLUMNS_EXPLAINED = (
    "Messages were not sent because the budget was spent (column budget), they were\n"
    "worth too little (value), or receivers can extrapolate the last one (silence).\n"
    "Bytes are those on the sender's link, with Zenoh's overhead, without TCP/IP's."
)
_LIVE_EXPLAINED = (
    "A robot announces itself (alive) at its start and at each change of its tier.\n"
    "Counts begin at the start of a robot's process;"
    f" rates are of the last {RATES_NS // 10**9} s.\n"
    "This command receives status/* only: watching causes no fixes and no beliefs."
)


# The report of a run ----------------------------------------------------------------------------


def help_traffic_table(report: Report) -> Table:
    """What each robot sent, what it did not send and why, and how near it came to its limits."""
    robots = list(report.robots.values())
    topics = _topics(report)
    title, heads = f"{kinds_text(report)} sent, and not sent", [HEADS[topic] for topic in topics]
    shown = table(title, ("robot",), (*heads, "B/s", *NOT_SENT))
    if any(robot.spending for robot in robots):
        shown.add_column("most", no_wrap=True)
    for name, robot in report.robots.items():
        _add_traffic_row(shown, name, robot, report.duration_s, topics)
    shown.add_section()
    shown.add_row("team", *_traffic_cells(robots, report.duration_s, topics), style="bold")
    if report.guests:
        shown.add_section()
    for name, guest in report.guests.items():
        _add_traffic_row(shown, f"{name}, guest", guest, report.duration_s, topics)
    return shown


def kinds_text(report: Report) -> str:
    """The kinds of help in words, those of landmarks only where any was sent."""
    *first, last = (HEADS[topic] for topic in _topics(report))
    return f"{', '.join(first)} and {last}"


def _topics(report: Report) -> list[str]:
    """The topics of help to tell of: places of landmarks only where any was sent."""
    sent = {flow.topic for robot in report.robots.values() for flow in robot.sent}
    return [topic for topic in HEADS if topic != "landmark" or topic in sent]


def _add_traffic_row(
    shown: Table, name: str, robot: RobotReport, duration_s: float, topics: Sequence[str]
) -> None:
    limits = [Text("\n").join(map(limit_text, robot.spending))] if robot.spending else []
    shown.add_row(name, *_traffic_cells([robot], duration_s, topics), *limits)


def _traffic_cells(
    robots: Sequence[RobotReport], duration_s: float, topics: Sequence[str]
) -> list[str]:
    flows = [flow for robot in robots for flow in robot.sent]
    per_s = sum(f.bytes for f in flows) / duration_s if duration_s else None
    return [
        *(short(sum(f.messages for f in flows if f.topic == topic)) for topic in topics),
        "-" if per_s is None else short(per_s),
        *_not_sent(flows),
    ]


def _not_sent(flows: Sequence[FlowReport]) -> list[str]:
    """The cells below NOT_SENT."""
    return [short(sum(getattr(flow, name) for flow in flows)) for name in NOT_SENT.values()]


def limit_text(s: SpendingReport) -> Text:
    """`412 of 500 B in 10 s`, green while within."""
    unit = "B" if s.unit == "bytes" else "msg"
    within = f" in {s.window_s:.3g} s" if s.window_s else " so far"
    most, allowed = (f"{n:.1f}".removesuffix(".0") for n in (s.most, s.allowed))
    return Text(f"{most} of {allowed} {unit}{within}", "green" if s.is_kept else "bold red")


def limits_text(report: Report) -> Text | None:
    """In words, whether every limit held; None without any."""
    spendings = [(name, s) for name, r in report.robots.items() for s in r.spending]
    held = are_limits_kept(s for _, s in spendings)
    if held is None:
        return None
    if held:
        return Text("Every robot kept every limit in every window.", "green")
    broken = (f"{name}: {limit_text(s)}" for name, s in spendings if not s.is_kept)
    return Text(f"Limits were exceeded: {'; '.join(broken)}", "bold red")


# Live -------------------------------------------------------------------------------------------


class TrafficView(LiveView):
    """The traffic of a team while it runs."""

    def __init__(self, where: str, console: Console, quiet: bool = False) -> None:
        super().__init__(console, quiet)
        self._where = where

    def show(self, now: Traffic) -> None:
        """Called several times a second."""
        self.draw(lambda: traffic_view(now, self._where), bool(now.robots))


def traffic_view(now: Traffic, where: str) -> Group:
    """Who helps whom, how near each came to its limits, what it sent, and what that means."""
    title = f"team {now.team} at {where}, watched for {now.watched_s:.0f} s"
    if now.refused:
        reasons = ", ".join(f"{reason} {n}" for reason, n in now.refused.items())
        title += f"\nrefused, by reason: {reasons}"
    if not now.robots:
        hint = "No robot of this team sends its status. Is the name of the team right?"
        return Group(Text(f"{title}\n{hint}", "yellow"))
    limits = [
        Text(f"{name}: most ").append_text(Text(", ").join(map(limit_text, robot.spending)))
        for name, robot in now.robots.items()
        if robot.spending
    ]
    problems = [
        Text(f"{name}: {text}", "yellow") for name, r in now.robots.items() for text in r.problems
    ]
    return Group(
        Text(title, "bold"),
        help_table(now),
        *problems,
        *limits,
        "",
        flow_table(now),
        Text(f"{COLUMNS_EXPLAINED}\n{_LIVE_EXPLAINED}\n", "yellow"),
    )


def help_table(now: Traffic) -> Table:
    """The drawing: the best informed robot first, an arrow to each teammate that it helps."""
    shown = table("", ("robot",), ("tier", "σ m"))
    shown.add_column(f"helps (in the last {CURRENT_HELP_NS // 10**9} s)", overflow="fold")
    for name, robot in now.robots.items():
        style = "dim" if robot.away else "bold red" if robot.lost else ""
        shown.add_row(
            Text(f"{name}, guest" if name in now.guests else name, style),
            Text(str(robot.tier), style),
            Text(number(robot.position_sigma_m), style),
            _activity(robot, [h for h in now.help if h.helper == name]),
        )
    for name in now.never_heard:
        shown.add_row(Text(name, "dim"), "", "", Text("no status yet", "yellow"))
    return shown


def _activity(robot: LiveRobot, given: Sequence[HelpLink]) -> Text:
    if robot.away:
        return Text(f"away: silent for {robot.silent_s:.0f} s", "yellow")
    if robot.lost:
        return Text(f"lost: {robot.lost}", "bold red")
    return Text("\n").join(_arrows(given)) if given else Text("nobody", "dim")


def _arrows(given: Sequence[HelpLink]) -> Iterator[Text]:
    """A line for each teammate: `──▶ scout  fix 9.5/s, belief 2.0/s`."""
    width = max(len(h.helped) for h in given)
    for helped in dict.fromkeys(h.helped for h in given):
        kinds = [
            Text(h.topic + (f" {h.messages_per_s:.1f}/s" if h.messages_per_s else ""))
            for h in given
            if h.helped == helped
        ]
        for kind in kinds:
            kind.stylize(COLOURS[kind.plain.split()[0]])
        yield Text(f"──▶ {helped:<{width}}  ").append_text(Text(", ").join(kinds))


def flow_table(now: Traffic) -> Table:
    """A row for each robot and key."""
    shown = table("", ("robot", "key"), ("messages", "B", "/s", "B/s", *NOT_SENT))
    for name, robot in now.robots.items():
        style = "dim" if robot.away else ""
        shown.add_row(name, "alive", str(robot.announced), style=style)
        for flow in robot.sent:
            key = f"{flow.topic} → {flow.peer}" if flow.peer else flow.topic
            counts = short(flow.messages), short(flow.bytes)
            rates = (None, None) if robot.away else (flow.messages_per_s, flow.bytes_per_s)
            figures = *counts, number(rates[0], 1), number(rates[1], 0), *_not_sent([flow])
            shown.add_row("", Text(key, COLOURS[flow.topic]), *figures, style=style)
    return shown
