"""A recorded run as figures: what `evaluate` prints, and what a report draws."""

import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import msgspec

from cpcbl_agents.sources import mrclam
from cpcbl_launch.recordings.gather import gather
from cpcbl_launch.reporting.events import Event, EventLog
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.phases import guest_reports
from cpcbl_launch.reporting.recorder import Recorder, Report, variants_of
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.messages import Status, Track, Truths

MOST_EVENTS = 2000
FAR_NS = 86_400 * 10**9  # a robot whose clock is so far off is not of the time of the run


class RunSummary(NamedTuple):
    """What is known of a run."""

    name: str  # of its file or folder
    team: Team
    version: str
    recorder: Recorder
    truth: Mapping[str, Floats]  # rows of s, x, y, heading by robot; empty where it is not known
    report: Report
    begin_s: float  # in the time of stamps
    duration_s: float
    events: tuple[Event, ...]
    remarks: tuple[str, ...]
    """What is missing in the run, one line each."""

    @property
    def names(self) -> list[str]:
        """The robots of the team, then its guests."""
        return [*self.team.robots, *self.report.guests]

    @property
    def is_dated(self) -> bool:
        """Whether its time is that of clocks; a simulation may begin at 0."""
        return self.begin_s > 1e9


def summarize(path: Path) -> RunSummary:
    """The figures of a recorded run. Raises LogError, TeamFileError."""
    found = gather(path, _is_figured)
    recorder, log, events = Recorder(), EventLog(), list[Event]()
    spans: dict[str, list[int]] = {}  # by robot, the first and the last stamp
    for at_ns, key, message in found.messages:
        if isinstance(message, Track | Status | Truths):
            recorder.store(key, message)
        if isinstance(message, Track | Status):
            span = spans.setdefault(message.robot, [at_ns, at_ns])
            span[0], span[1] = min(span[0], at_ns), max(span[1], at_ns)
            if len(events) < MOST_EVENTS:
                events += log.events(at_ns, message)
    remarks = list(found.remarks)
    if len(events) >= MOST_EVENTS:
        remarks.append(f"Of its events the first {MOST_EVENTS} are kept.")
    begin_s, end_s = _span_s(spans)
    truth = recorder.simulated_truth() or _truth_of_log(found.team)
    report = msgspec.structs.replace(
        recorder.report(variants_of(found.team), truth),
        duration_s=end_s - begin_s,
        restarts=recorder.restarts(),
        guests=guest_reports(recorder, list(found.team.robots), truth, begin_s),
    )
    return RunSummary(
        name=path.name or str(path),
        team=found.team,
        version=found.version,
        recorder=recorder,
        truth=truth,
        report=report,
        begin_s=begin_s,
        duration_s=end_s - begin_s,
        events=tuple(events),
        remarks=tuple(remarks),
    )


def _is_figured(key: str) -> bool:
    return key.startswith(("track/", "status/", topics.TRUTH.key))


def _span_s(spans: Mapping[str, list[int]]) -> tuple[float, float]:
    """When the run began and ended, by the robots whose clocks agree roughly."""
    if not spans:
        return 0.0, 0.0
    usual = statistics.median(first for first, _ in spans.values())
    near = [span for span in spans.values() if abs(span[0] - usual) < FAR_NS]
    return min(first for first, _ in near) * 1e-9, max(last for _, last in near) * 1e-9


def _truth_of_log(team: Team) -> dict[str, Floats]:
    """The truth of a team that replayed a log which is still there."""
    folder = Path(team.data)
    names = [name for name, robot in team.robots.items() if robot.source == "mrclam"]
    if not team.data or not names or not folder.is_dir():
        return {}
    there = set(mrclam.robots_in(folder))
    return {name: mrclam.read_truth(folder, name) for name in names if name in there}
