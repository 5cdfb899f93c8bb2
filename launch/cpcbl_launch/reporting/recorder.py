"""Receives the tracks and status of robots, and makes a report against the truth."""

import math
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence

import msgspec
import numpy as np

from cpcbl_launch.reporting.activity import ActivityLog
from cpcbl_launch.reporting.encoded_log import BlockFile, EncodedLog
from cpcbl_launch.reporting.frames import FrameOrigins, main_frame
from cpcbl_launch.reporting.metrics import (
    ErrorFigures,
    Floats,
    Samples,
    Score,
    Trajectory,
    interpolated_truth,
    longest_lost_s,
    samples_with_truth,
    score,
    seconds,
    stated_sigma_m,
)
from cpcbl_launch.reporting.statuses import (
    FlowReport,
    InputReport,
    ProblemLog,
    ProblemReport,
    SpendingReport,
    TrustReport,
    are_limits_kept,
    input_reports,
    is_figure,
    summed_flows,
    summed_spending,
    trust_reports,
)
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import decode
from cpcbl_transport.messages import (
    Message,
    Refusal,
    Status,
    Track,
    Truth,
    Truths,
    encode,
)


class LearnedReport(msgspec.Struct, frozen=True, kw_only=True):
    """What self-calibration has found at the end, beyond the team file: its keys, its signs."""

    distance_scale: float
    turn_scale: float
    bearing_bias_deg: float


class RobotReport(Score, frozen=True, kw_only=True):
    """One robot's figures; messages and bytes are those of beliefs and fixes.

    Bytes are those on the sender's link with Zenoh's own, without those of TCP/IP.
    """

    variant: str
    lost_share: float
    longest_lost_s: float
    lost_at_end: str
    bumps: int
    messages_sent: int
    bytes_sent: int
    messages_received: int
    bytes_received: int
    counts: dict[str, int]
    learned: LearnedReport | None = None  # None where self-calibration is off
    sent: tuple[FlowReport, ...] = ()
    heard: tuple[FlowReport, ...] = ()
    spending: tuple[SpendingReport, ...] = ()  # its limits; empty where there are none
    trust: tuple[TrustReport, ...] = ()
    """Teammates whose messages it received at the end, or that were in quarantine."""
    inputs: tuple[InputReport, ...] = ()  # of its last process
    problems: tuple[ProblemReport, ...] = ()  # of its inputs
    frame: str = ""  # in which it was at the end; empty for that of the field
    inputs_taken: int | None = None
    """Odometry, sightings, positions and frames that it received; None where no status tells."""
    sigma_rms_m: float | None = None
    sigma_max_m: float | None = None
    """Of the position's standard deviation as the robot states it; None where it states none."""

    @property
    def has_data(self) -> bool:
        """Whether anything was heard of it, and it heard anything from its sensors."""
        return self.inputs_taken != 0 and self.lost_at_end != NOT_HEARD


class Phase(Score, frozen=True, kw_only=True):
    """A robot's figures in a part of a run; None for what nothing is known of."""

    position_sigma_m: float | None
    """Root mean square of what the robot itself claims; needs no truth."""


class Effect(msgspec.Struct, frozen=True, kw_only=True):
    """A robot before a guest came, while it was there, and after it was gone."""

    before: Phase
    during: Phase
    after: Phase


class GuestReport(RobotReport, frozen=True, kw_only=True):
    """A guest's own figures, when it was there, and what that did to the robots of the team."""

    present_s: tuple[tuple[float, float], ...]  # from when until when, since the start of the run
    robots: dict[str, Effect]


class MeanScore(ErrorFigures, frozen=True, kw_only=True):
    """Means over the robots that could be scored; of the largest errors the largest."""

    pooled_rmse_m: float | None = None
    """Of the positions of all robots together: a robot with more samples counts for more."""


class TeamReport(MeanScore, frozen=True, kw_only=True):
    """The same, with sums for messages and bytes."""

    messages_sent: int
    bytes_sent: int
    within_budget: bool | None = None
    """Whether every limit of every robot held; None where there is none."""


class BaselineReport(msgspec.Struct, frozen=True, kw_only=True):
    """What another filter makes of the same inputs."""

    robots: dict[str, Score]
    team: MeanScore


class Report(msgspec.Struct, frozen=True, kw_only=True):
    """What `up --report`, `up --json` and `evaluate --json` write."""

    robots: dict[str, RobotReport]
    team: TeamReport
    calibrated_on: tuple[str, ...] = ()  # the logs from which the robots' types were calibrated
    seen_before: bool = False  # whether this log is one of them, so that the figures are too good
    left_out: dict[str, str] = {}  # robots that could not take part, with the reason
    duration_s: float = 0.0
    starts: str = ""  # what robots knew of their start poses, on a log
    restarts: dict[str, int] = {}
    refused: dict[str, int] = {}  # messages that the recorder could not use, by reason
    not_written: dict[str, str] = {}  # files that could not be written, with the reason
    alone: dict[str, Phase] = {}  # before collaboration began, where it began late
    guests: dict[str, GuestReport] = {}
    """Robots that the team file does not name; no part of the team's figures."""
    yardsticks: dict[str, BaselineReport] = {}
    """dead_reckoning, solo_ekf, centralized_ekf, batch_least_squares, where they were asked for."""

    @property
    def has_data(self) -> bool:
        """Whether any robot of the team has."""
        return any(robot.has_data for robot in self.robots.values())


INPUTS = ("odometry", "sightings", "position", "frame")  # the counts of what a robot received
NOT_HEARD = "no estimate was received"
MOST_NAMES = 512  # robots and guests of which a run is recorded: names are free
MOST_PROCESSES = 256  # of one robot: the statuses of older ones are forgotten


class Recorder:
    """Subscribes to tracks, status and simulated truth on a bus."""

    def __init__(self, bus: Bus | None = None) -> None:
        """`bus`: None for a recorded run, whose messages are given by `store`."""
        self._lock = threading.Lock()
        self.tracks: dict[str, EncodedLog[Track]] = {}
        self.status: dict[str, Status] = {}
        self._file = BlockFile()
        self.truths: EncodedLog[Truths] = EncodedLog(self._file)
        self.activity: dict[str, ActivityLog] = {}
        self.counts: Counter[str] = Counter()
        """Accepted messages by topic, and refused ones by reason."""
        self.origins = FrameOrigins()
        self._problems: dict[str, ProblemLog] = {}
        self._processes: dict[str, dict[str, Status]] = {}  # the last status by incarnation
        if bus is not None:
            for topic in (topics.TRACK, topics.STATUS, topics.TRUTH):
                bus.subscribe(topic.at(), self._receive)

    def _receive(self, key: str, payload: bytes) -> None:
        self._store(key, decode(key, payload), payload)

    def store(self, key: str, message: Track | Status | Truths) -> None:
        """Takes a message of a recorded run."""
        self._store(key, message, encode(message))

    def _store(self, key: str, message: Message | Refusal, payload: bytes) -> None:
        with self._lock:
            if isinstance(message, Track | Status) and not self._has_room(message.robot):
                self.counts["too_many_names"] += 1
                return
            is_accepted = not isinstance(message, Refusal)
            self.counts[key.partition("/")[0] if is_accepted else str(message)] += 1
            match message:
                case Track():
                    self.origins.note_track(message)
                    self.tracks.setdefault(message.robot, EncodedLog(self._file)).append(payload)
                case Status():
                    self.status[message.robot] = message
                    self._problems.setdefault(message.robot, ProblemLog()).add(message)
                    self.activity.setdefault(message.robot, ActivityLog()).add(message)
                    processes = self._processes.setdefault(message.robot, {})
                    processes[message.incarnation] = message
                    if len(processes) > MOST_PROCESSES:
                        del processes[next(iter(processes))]
                case Truths():
                    self.origins.note_truths(message)
                    self.truths.append(payload)

    def _has_room(self, name: str) -> bool:
        """Whether a robot of this name is recorded, or may be."""
        is_known = name in self.tracks or name in self.status
        return is_known or max(len(self.tracks), len(self.status)) < MOST_NAMES

    @property
    def refused(self) -> dict[str, int]:
        """Messages that could not be used, by reason."""
        with self._lock:
            return {r: self.counts[r] for r in sorted(Refusal) if self.counts[r]}

    def restarts(self) -> dict[str, int]:
        """How often a robot was started again, by its statuses; without those that never were."""
        return {name: len(own) - 1 for name, own in self._processes.items() if len(own) > 1}

    def latest(self) -> tuple[dict[str, Track], dict[str, Status], dict[str, Truth]]:
        """The newest track, status and simulated truth of every robot."""
        with self._lock:
            truth = {t.robot: t for t in self.truths.last.robots} if self.truths else {}
            tracks = {name: t.last for name, t in self.tracks.items()}
            return tracks, dict(self.status), truth

    def latest_errors_m(self) -> dict[str, float]:
        """The position error of every robot's newest estimate for whose time truth is known."""
        with self._lock:
            truth = truth_rows(self.truths.recent())
            tracks = {
                name: [t for track in log.recent() if not (t := self.origins.in_field(track)).frame]
                for name, log in self.tracks.items()
                if name in truth
            }
        errors_m = {}
        for name, recent in tracks.items():
            rows = truth[name]
            for track in recent:
                at_s = track.stamp_ns * 1e-9
                at, counts = interpolated_truth(np.array([at_s]), rows)
                if counts[0] and rows[0, 0] <= at_s <= rows[-1, 0]:
                    errors_m[name] = math.hypot(track.x_m - at[0, 0], track.y_m - at[0, 1])
        return errors_m

    def simulated_truth(self) -> dict[str, Floats]:
        """Rows of seconds, x, y, heading for every robot of the simulated field."""
        return truth_rows(self.truths)

    def tracks_in_field(self, robot: str) -> Iterator[Track]:
        """A robot's tracks, in the field's frame where their own is known there."""
        return map(self.origins.in_field, self.tracks.get(robot, ()))

    @property
    def shown_frame(self) -> str:
        """The frame in which robots are drawn: the field's, or else that in which most are."""
        last = {name: self.origins.in_field(log.last).frame for name, log in self.tracks.items()}
        return main_frame(last)

    def trajectory(self, robot: str, from_s: float = -np.inf) -> Trajectory:
        """A robot's estimates from `from_s` on. Where there is a truth, those in frames that are
        unknown beside it are left out."""
        own = (t for t in self.tracks_in_field(robot) if from_s <= t.stamp_ns * 1e-9)
        tracks = [t for t in own if not (t.frame and self.origins.has_truth)]
        covariance = None
        if all(t.covariance is not None for t in tracks):
            covariance = np.array([t.covariance for t in tracks]).reshape(-1, 6)
        return Trajectory(
            np.array([t.stamp_ns for t in tracks], dtype=np.int64),
            np.array([(t.x_m, t.y_m, t.heading_rad) for t in tracks]).reshape(-1, 3),
            covariance,
        )

    def samples(self, robot: str, truth: Floats | None, from_s: float = -np.inf) -> Samples:
        """A robot's estimates from `from_s` on, beside the truth, where there is one."""
        return samples_with_truth(self.trajectory(robot, from_s), truth)[1]

    def timed_samples(self, robot: str, truth: Floats) -> tuple[Floats, Samples]:
        """A robot's estimates beside the truth, and their times (s)."""
        stamps_ns, samples = samples_with_truth(self.trajectory(robot), truth)
        return seconds(stamps_ns), samples

    def report(
        self, variants: Mapping[str, str], truth: Mapping[str, Floats], from_s: float = -np.inf
    ) -> Report:
        """The figures of all robots from `from_s` on."""
        self.origins.locate(truth)
        robots = {
            name: self.robot_report(name, variant, truth.get(name), from_s)
            for name, variant in variants.items()
        }
        team = TeamReport(
            **msgspec.structs.asdict(mean_score(robots.values())),
            messages_sent=sum(r.messages_sent for r in robots.values()),
            bytes_sent=sum(r.bytes_sent for r in robots.values()),
            within_budget=are_limits_kept(s for r in robots.values() for s in r.spending),
        )
        return Report(robots=robots, team=team, refused=self.refused)

    def robot_report(
        self, name: str, variant: str, truth: Floats | None, from_s: float = -np.inf
    ) -> RobotReport:
        """One robot's figures from `from_s` on."""
        _, _, last_truth = self.latest()
        path = self.trajectory(name, from_s)
        figures, sigma_m = score(samples_with_truth(path, truth)[1]), stated_sigma_m(path)
        tracks = list(self.tracks.get(name, ()))
        statuses = list(self._processes.get(name, {}).values())
        counts = Counter[str]()
        for status in statuses:
            counts.update(status.counts)
        latest = statuses[-1].counts if statuses else {}
        percentages = {name: n for name, n in latest.items() if is_figure(name)}
        return RobotReport(
            **msgspec.structs.asdict(figures),
            variant=variant,
            lost_share=float(np.mean([bool(t.lost) for t in tracks])) if tracks else 1.0,
            longest_lost_s=longest_lost_s(tracks),
            lost_at_end=tracks[-1].lost if tracks else NOT_HEARD,
            frame=tracks[-1].frame if tracks else "",
            bumps=last_truth[name].bumps if name in last_truth else 0,
            messages_sent=sum(s.messages_sent for s in statuses),
            bytes_sent=sum(s.bytes_sent for s in statuses),
            messages_received=sum(s.messages_received for s in statuses),
            bytes_received=sum(s.bytes_received for s in statuses),
            counts=dict(sorted({**counts, **percentages}.items())),
            learned=_learned_report(statuses),
            sent=summed_flows(s.sent for s in statuses),
            heard=summed_flows(s.heard for s in statuses),
            spending=summed_spending(s.spending for s in statuses),
            trust=trust_reports(statuses),
            inputs=input_reports(statuses[-1]) if statuses else (),
            problems=self._problems[name].reports if name in self._problems else (),
            sigma_rms_m=float(np.sqrt(np.mean(sigma_m**2))) if len(sigma_m) else None,
            sigma_max_m=float(sigma_m.max()) if len(sigma_m) else None,
            inputs_taken=sum(counts[name] for name in INPUTS) if statuses else None,
        )


def variants_of(team: Team) -> dict[str, str]:
    """The variant of the localizer of each robot."""
    return {name: robot.localizer.variant for name, robot in team.robots.items()}


def truth_rows(truths: Iterable[Truths]) -> dict[str, Floats]:
    """Rows of seconds, x, y, heading by robot."""
    rows: dict[str, list[tuple[float, float, float, float]]] = {}
    for at in truths:
        for t in at.robots:
            rows.setdefault(t.robot, []).append((at.stamp_ns * 1e-9, t.x_m, t.y_m, t.heading_rad))
    return {name: np.array(r) for name, r in rows.items()}


def _learned_report(statuses: Sequence[Status]) -> LearnedReport | None:
    if not statuses or statuses[-1].learned is None:
        return None
    distance, turn, bias = statuses[-1].learned
    return LearnedReport(
        distance_scale=distance, turn_scale=turn, bearing_bias_deg=math.degrees(bias)
    )


def mean_score(scores: Iterable[Score]) -> MeanScore:
    """Figures of a team: the mean of those of its robots, their maximum, the pooled RMSE."""
    known = [s for s in scores if s.position_rmse_m is not None]

    def mean(name: str) -> float | None:
        values = [value for s in known if (value := getattr(s, name)) is not None]
        return float(np.mean(values)) if values else None

    if not known:
        return MeanScore()
    means = {name: mean(name) for name in ErrorFigures.__struct_fields__}
    means["position_max_m"] = max(s.position_max_m or 0.0 for s in known)
    squares = [(s.position_rmse_m or 0.0) ** 2 for s in known]
    pooled = float(np.average(squares, weights=[s.samples for s in known]))
    return MeanScore(**means, pooled_rmse_m=math.sqrt(pooled))
