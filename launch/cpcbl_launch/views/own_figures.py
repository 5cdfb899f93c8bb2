"""The figures of a run whose true poses are not known: what the robots state of themselves."""

from rich.table import Table

from cpcbl_launch.reporting.recorder import Report, RobotReport
from cpcbl_launch.reporting.tables import number, percent, short, table

COLUMNS = ("σ m", "largest", "lost", "longest s", "used", "rejected", "help in", "out")


def own_figures_table(report: Report) -> Table:
    """σ of the position (its RMS, and its largest value), time lost, measurements used and
    rejected, fixes and beliefs received and sent. At most 80 columns wide."""
    title = "what the robots state; without true poses there are no errors"
    shown = table(title, ("robot",), COLUMNS)
    for name, robot in report.robots.items():
        shown.add_row(name, *_cells(robot))
    if report.guests:
        shown.add_section()
    for name, guest in report.guests.items():
        shown.add_row(f"{name}, guest", *_cells(guest))
    return shown


def _cells(robot: RobotReport) -> list[str]:
    used, rejected = robot.counts.get("accepted", 0), robot.counts.get("gated", 0)
    share = rejected / (used + rejected) if used + rejected else None
    return [
        number(robot.sigma_rms_m),
        number(robot.sigma_max_m),
        percent(robot.lost_share) if robot.has_data else "-",
        number(robot.longest_lost_s, 1),
        short(used),
        percent(share),
        short(robot.messages_received),
        short(robot.messages_sent),
    ]
