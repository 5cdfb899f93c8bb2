"""The page of a report: what was figured out of one or two runs, as HTML without any script."""

import datetime
import importlib.metadata
from collections.abc import Callable, Iterator, Sequence
from html import escape
from importlib.resources import files
from typing import NamedTuple

from cpcbl_launch.recordings.summary import RunSummary
from cpcbl_launch.reporting.tables import number, percent, plural, short
from cpcbl_launch.views.report import sections
from cpcbl_launch.views.report.charts import common_scales, drawn_robots, time_text

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


class Section(NamedTuple):
    """A part of the page, with what each run has there; empty text: it has nothing."""

    name: str
    title: str
    about: str
    make: Callable[[sections.RunView], str]


SECTIONS = (
    Section("field", "On the field", sections.FIELD_ABOUT, sections.field_section),
    Section("robots", "Robots", sections.ROBOTS_ABOUT, sections.robots_section),
    Section("time", "Over time", sections.TIME_ABOUT, sections.time_section),
    Section("help", "Who helped whom", sections.HELP_ABOUT, sections.help_section),
    Section("traffic", "Traffic", sections.TRAFFIC_ABOUT, sections.traffic_section),
    Section("events", "Faults, problems and restarts", "", sections.events_section),
    Section("refused", "Refused and rejected", sections.REFUSED_ABOUT, sections.refused_section),
    Section("settings", "Settings", sections.SETTINGS_ABOUT, sections.settings_section),
)


def report_page(runs: Sequence[RunSummary]) -> str:
    """The page of one run, or of two side by side."""
    robots = [drawn_robots(run) for run in runs]
    scales = common_scales(list(zip(runs, robots, strict=True)))
    shown = [sections.RunView(run, own, scales) for run, own in zip(runs, robots, strict=True)]
    title = " and ".join(dict.fromkeys(run.team.name for run in runs))
    body = "".join(_body(shown))
    kind = ' class="two"' if len(runs) > 1 else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        f"<title>{escape(title)} · cpcbl-team report</title><style>{_style()}</style></head>"
        f"<body{kind}>{body}</body></html>\n"
    )


def _style() -> str:
    """The colours of the live page, and the report's own rules."""
    colours = (files("cpcbl_launch.views.web") / "page" / "page.css").read_text(encoding="utf-8")
    own = (files(__package__) / "report.css").read_text(encoding="utf-8")
    return colours[: colours.index("* {")] + own


def _body(shown: Sequence[sections.RunView]) -> Iterator[str]:
    yield "<header>"
    runs = [one.run for one in shown]
    teams = " and ".join(dict.fromkeys(run.team.name for run in runs))
    yield f"<h1>Team {escape(teams)}</h1>"
    for run in runs:
        yield f'<p class="about">{escape(_line_of(run))}</p>'
        yield from (f'<p class="remark">{escape(remark)}</p>' for remark in _remarks(run))
    links = [f'<a href="#{s.name}">{s.title}</a>' for s in SECTIONS]
    yield f"</header><nav>{''.join(links)}</nav>"
    yield _runs(shown, [_tiles(one) for one in shown])
    if len(shown) == 2:
        yield f'<h2 id="compared">Compared</h2>{sections.comparison(*shown)}'
    for section in SECTIONS:
        contents = [section.make(one) for one in shown]
        about = f'<p class="about">{section.about}</p>' if section.about else ""
        yield f'<h2 id="{section.name}">{section.title}</h2>{about}{_runs(shown, contents)}'
    version = importlib.metadata.version("cpcbl-team")
    yield f"<footer>Made by cpcbl-team {version} report.</footer>"


def _runs(shown: Sequence[sections.RunView], contents: Sequence[str]) -> str:
    nothing = '<p class="soft">nothing</p>'
    if len(shown) == 1:
        return f'<div class="runs">{contents[0] or nothing}</div>'
    cells = [
        f'<div class="run"><h3>{letter}: {escape(one.run.name)}</h3>{content or nothing}</div>'
        for letter, one, content in zip("AB", shown, contents, strict=True)
    ]
    return f'<div class="runs">{"".join(cells)}</div>'


def _line_of(run: RunSummary) -> str:
    parts = [f"{run.name}: {time_text(round(run.duration_s))}"]
    if run.is_dated:
        began = datetime.datetime.fromtimestamp(run.begin_s, datetime.UTC)
        parts.append(f"from {began:%Y-%m-%d %H:%M:%S} UTC")
    guests = f" and {plural(len(run.report.guests), 'guest')}" if run.report.guests else ""
    parts.append(f"{plural(len(run.team.robots), 'robot')}{guests}")
    parts.append(f"recorded by cpcbl-team {run.version}" if run.version else "version not recorded")
    return ", ".join(parts)


def _remarks(run: RunSummary) -> Iterator[str]:
    silent = [name for name in run.team.robots if name not in run.recorder.tracks]
    if len(silent) == len(run.team.robots):
        yield "No pose of any robot of the team is in this recording."
    elif silent:
        yield f"Nothing was heard of {', '.join(silent)}."
    if not run.truth:
        yield (
            "True poses are not known: this report shows what the robots themselves state. It"
            " cannot say whether that is right."
        )
    yield from run.remarks


def _tiles(shown: sections.RunView) -> str:
    report, team = shown.run.report, shown.run.report.team
    lost = [robot.lost_share for name, robot in report.robots.items() if shown.is_heard(name)]
    tiles: list[tuple[str, str, str]] = []
    if team.position_rmse_m is not None:
        tiles.append(("RMSE, mean of the robots", f"{number(team.position_rmse_m)} m", ""))
        tiles.append(("inside 3 σ (98.9 % due)", percent(team.inside_3_sigma), ""))
        tiles.append(("NEES (2 is consistent)", number(team.nees, 2), ""))
    else:
        stated = [r.sigma_rms_m for r in report.robots.values() if r.sigma_rms_m is not None]
        mean_m = sum(stated) / len(stated) if stated else None
        tiles.append(("σ that robots state", f"{number(mean_m)} m" if stated else "none", ""))
    if lost:
        share = sum(lost) / len(lost)
        tiles.append(("of the time lost", percent(share), "bad" if share > 0.02 else "good"))
    tiles.append(("fixes and beliefs sent", short(team.messages_sent), ""))
    rate = team.bytes_sent / max(shown.run.duration_s, 1e-9) / max(len(report.robots), 1)
    tiles.append(("a robot and second", f"{short(rate)} B", ""))
    if team.within_budget is not None:
        kept = "kept" if team.within_budget else "exceeded"
        tiles.append(("budgets", kept, "good" if team.within_budget else "bad"))
    inside = "".join(
        f'<div class="{css}"><b>{escape(value)}</b><span class="soft">{escape(what)}</span></div>'
        for what, value, css in tiles
    )
    return f'<div class="tiles">{inside}</div>'
