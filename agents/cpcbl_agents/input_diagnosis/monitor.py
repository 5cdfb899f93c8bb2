"""The messages on a robot's inputs: counted as they arrive, judged once a second.

A message costs a counter and a reference among the latest few. `problems.py` looks for causes in
those few.
"""

import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from statistics import median
from typing import NamedTuple, TypeVar

from cpcbl_agents.input_diagnosis.implausible_errors import ImplausibleErrors
from cpcbl_agents.input_diagnosis.jumps import JumpMonitor
from cpcbl_agents.input_diagnosis.motion_causes import CONTRADICTION, Step, pose_near_start
from cpcbl_agents.input_diagnosis.pose_confirmation import PoseConfirmation, rejections_text
from cpcbl_agents.input_diagnosis.problem_hysteresis import ProblemHysteresis
from cpcbl_agents.input_diagnosis.problems import (
    MOTION,
    InputFacts,
    InputWindow,
    contradicts_mistake,
    implausible_inputs,
    input_problems,
    is_often_refused,
    usable,
)
from cpcbl_agents.input_diagnosis.unusual_motion import UnusualMotion
from cpcbl_agents.robot import InputSnapshot
from cpcbl_team.config import RobotSettings, Start, Team
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import InitialPose, Odometry, Sightings
from cpcbl_transport import topics
from cpcbl_transport.messages import (
    LARGEST_FRAME,
    LARGEST_NUMBER,
    Frame,
    InputHealth,
    SensorInput,
)

WINDOW = 10  # judgements, one a second: shares are those of the last so many
SETTLED_NS = 2_000_000_000  # what was on its way when the robot started is too late
OFTEN, SELDOM = 20, 10
"""The search for implausible inputs takes some milliseconds. It runs at each of the first `OFTEN`
judgements, while it finds something and while the robot is lost, else at every tenth one."""
SECOND_NS, EMPTY_NS = 1_000_000_000, 5_000_000_000
UNSEEN = 25  # judgements: in real logs a robot saw nothing for 20 s in front of landmarks
EMPTY_CAME = "empty frames came too before"
IN_VIEW = "a landmark should be in view"
STEP_NS = 95_000_000
STEPS = 200
LONGER_NS = (
    10_000_000_000  # before the others: for what landmarks show of a robot that moves little
)
GAP_NS = 2_000_000_000
KNOWN_M, KNOWN_RAD = 0.7, 0.35  # sigmas of a pose by which it is known what is in view
SURE_M, SURE_DEG = 0.3, 10.0  # sigmas of a start by which inputs can be judged
NAMESAKE_JUDGEMENTS = 3  # the token of a process that died may stay for its lease
T = TypeVar("T")
KEPT = 60  # looks for which a cause by the start is said of a robot that has left it
MOVED_M, TURNED_RAD = 0.1, 0.15  # beyond these a robot is no longer where it started
NAMES = tuple(topic.key.rpartition("/")[2] for topic in topics.INPUTS)


class Input:
    """One input, and its latest messages."""

    def __init__(self, name: str, start_ns: int, latest: int) -> None:
        self.name, self.arrived_ns, self.messages = name, start_ns, 0
        self.decoded = 0  # sightings are counted one by one
        self.distance_m = self.turn_rad = 0.0
        self.latest_ns = 0
        self.refused: Counter[str] = Counter()
        self.recent: deque[tuple[int, SensorInput]] = deque(maxlen=latest)
        self.recent_refused: deque[tuple[int, bytes]] = deque(maxlen=4)
        self.steps: deque[Step] = deque(maxlen=STEPS)
        self.spaced: deque[tuple[int, Sightings]] = deque(maxlen=STEPS)  # usable, ten a second
        self.has_empty = False  # whether a frame came in which nothing was seen
        self.scales = 1.0, 1.0  # of distances and turns, as the team file corrects them
        self._begun: tuple[int, float, float] | None = None
        self._ended_ns = 0

    def take(self, message: SensorInput, now_ns: int) -> None:
        """A message was decoded and not refused."""
        self.arrived_ns, self.latest_ns = now_ns, message.stamp_ns
        self.messages += 1
        if isinstance(message, Sightings):
            self.decoded += len(message.sightings) or 1
            self.has_empty |= not message.sightings
            if not self.spaced or now_ns - self.spaced[-1][0] >= STEP_NS:
                self.spaced.append((now_ns, usable(message)))
        else:
            self.decoded += 1
            if isinstance(message, Odometry):
                self._add_step(message)
            elif isinstance(message, Frame):
                message = Frame(message.stamp_ns, b"")
        self.recent.append((now_ns, message))

    def _add_step(self, piece: Odometry) -> None:
        if piece.stamp_ns <= self._ended_ns and piece.from_ns < self._ended_ns:
            return  # it is late, or came before
        if self._begun is None or piece.from_ns > self._ended_ns + GAP_NS:
            self._begun = piece.from_ns, self.distance_m, self.turn_rad
        self.distance_m += piece.distance_m
        self.turn_rad += piece.turn_rad
        self._ended_ns = piece.stamp_ns
        from_ns, distance_m, turn_rad = self._begun
        if piece.stamp_ns - from_ns >= STEP_NS:
            moved_m = (self.distance_m - distance_m) * self.scales[0]
            turned_rad = (self.turn_rad - turn_rad) * self.scales[1]
            self.steps.append(Step(from_ns, piece.stamp_ns, moved_m, turned_rad, piece))
            self._begun = piece.stamp_ns, self.distance_m, self.turn_rad

    def refuse(self, reason: str, payload: bytes, now_ns: int) -> None:
        """A message was refused."""
        self.arrived_ns = now_ns
        self.messages += 1
        self.refused[reason] += 1
        self.recent_refused.append((now_ns, payload[:LARGEST_FRAME]))


class _Totals(NamedTuple):
    """All counts at the time of a judgement."""

    now_ns: int
    taken: dict[str, int]
    refused: dict[str, Counter[str]]
    messages: dict[str, int]


class InputMonitor:
    """The inputs of one robot. `by_key`: on the bus; a node notes there what arrives."""

    def __init__(self, robot: str, team: Team, start_ns: int, speed: float = 1.0) -> None:
        settings = team.robots[robot]
        lengths = {"odometry": 100, "sightings": 100, "position": 50}  # ten seconds
        self.inputs = {name: Input(name, start_ns, lengths.get(name, 10)) for name in NAMES}
        self.by_key = {f"in/{robot}/{name}": entry for name, entry in self.inputs.items()}
        self._start_ns, self._history = start_ns, deque[_Totals](maxlen=WINDOW + 1)
        self._namesake_for = self._judgements = self._judgements_away = 0
        self._in_view_for = 0
        self._sees = (
            settings.source == "external"
            and settings.sensing == "sightings"
            and settings.sensor.sees_landmarks
        )
        self._is_driven, self._rejections = settings.source == "external", ""
        self._starts_known: bool | None = None
        self._jumps = JumpMonitor(start_ns, settings.odometry.moves)
        self._errors, self._unusual = ImplausibleErrors(), UnusualMotion()
        self._confirmation = PoseConfirmation(
            is_start_known=not self._sees or _start_pose(settings.start) is not None,
            moves=settings.odometry.moves,
            now_ns=start_ns,
        )
        self._initial_pose: InitialPose | None = None
        self._hysteresis, self._implausible = ProblemHysteresis(), tuple[str, ...]()
        self.are_mended = self._are_wrong = False
        """Whether inputs were wrong before the last judgement, and are right."""
        self.wrong_since_ns = start_ns  # when it last looked and found nothing, before they were
        self.has_moved = self.is_mistake_contradicted = False
        """Whether odometry, or a pose that was found elsewhere, said so at a judgement."""
        wheels = settings.odometry
        self.inputs["odometry"].scales = wheels.distance_scale, wheels.turn_scale
        field = team.map_of(robot)
        self._facts = InputFacts(
            robot,
            {},
            tuple(_expected_inputs(settings)),
            team.map.names | frozenset(team.robots),
            field.landmarks if settings.sensor.sees_landmarks else {},
            settings.sensor,
            wheels,
            field.bounds(),
            settings.odometry.timeout_s,
            _start_pose(settings.start),
            pace=max(1.0, speed),
        )

    @property
    def unconfirmed(self) -> str:
        """What is not confirmed about the pose, and why; empty if nothing is missing."""
        return self._confirmation.reason or self._rejections or self._unusual.reason

    @property
    def may_mislead(self) -> bool:
        """Whether the pose may be so wrong that help from it would mislead teammates."""
        is_contradicted = bool(self._rejections or self._unusual.reason)
        return is_contradicted or self._confirmation.may_be_mirrored

    def judge(
        self, snapshot: InputSnapshot, now_ns: int, namesake: bool
    ) -> tuple[tuple[InputHealth, ...], tuple[str, ...]]:
        """The health of each input that anything came on or is expected on, and the problems. To
        be called once a second. `namesake`: whether another process has this robot's name."""
        odometry = self.inputs["odometry"]
        if snapshot.initial_pose is not self._initial_pose:
            self._initial_pose = snapshot.initial_pose
            self._note_initial_pose(now_ns)
        self.has_moved |= abs(odometry.distance_m) > MOVED_M or abs(odometry.turn_rad) > TURNED_RAD
        # One that was found elsewhere was carried away, or never was at its start
        self.has_moved |= snapshot.jump is not None
        totals = self._totals(snapshot.refused, now_ns)
        if now_ns - self._start_ns >= SETTLED_NS:
            self._history.append(totals)
        before = self._history[0] if self._history else totals
        self._namesake_for = self._namesake_for + 1 if namesake else 0
        shown = [n for n in NAMES if self.inputs[n].messages or n in self._facts.expected]
        facts = self._facts._replace(
            unseen=self._missing_sightings_reason(snapshot, now_ns),
            windows={name: self._window(name, totals, before) for name in shown},
            namesake=self._namesake_for >= NAMESAKE_JUDGEMENTS,
            camera_lost=snapshot.is_camera_lost,
            mistake=snapshot.mistake,
            suspected_ns=snapshot.suspected_ns,
        )
        self._rejections = rejections_text(*snapshot.rejected) if self._is_driven else ""
        if self._is_driven:
            self._unusual.judge(odometry.steps, snapshot.accepted, bool(snapshot.lost))
        problems = input_problems(facts)
        self._judgements += any(self.inputs[name].messages for name in shown)
        is_early = self._judgements < OFTEN
        is_due = bool(self._hysteresis or snapshot.lost or self._confirmation.is_awaited)
        if has_looked := is_due or is_early or self._judgements % SELDOM == 0:
            facts = self._with_latest(snapshot, facts, before.now_ns)
            self._implausible = self._find_implausible(snapshot, facts, bool(problems), now_ns)
        are_refused = any(map(is_often_refused, facts.windows.values()))
        are_wrong = bool(self._implausible or snapshot.mistake) or are_refused
        self.are_mended, self._are_wrong = self._are_wrong and not are_wrong, are_wrong
        if has_looked and not (are_wrong or self.are_mended or self._hysteresis):
            self.wrong_since_ns = now_ns
        health = tuple(self._health(name, totals, before) for name in shown)
        said = (*problems, *self._implausible)
        jumps = self._jumps.judge(snapshot.jump, self.inputs["odometry"].steps, now_ns)
        return health, said or jumps

    def _note_initial_pose(self, now_ns: int) -> None:
        """Somebody has set the pose: it is no longer that of the team file, by which nothing is
        judged any more, nor is it where a process that is started again would begin."""
        given = self._initial_pose
        assert given is not None
        self.has_moved, self._facts = True, self._facts._replace(start=None)
        if self._sees:
            xx, _, yy, _, _, hh = given.covariance
            sigmas = math.sqrt(max(xx, yy)), math.degrees(math.sqrt(hh))
            self._confirmation.restart(_is_sure(*sigmas), now_ns)

    def _with_latest(
        self, snapshot: InputSnapshot, facts: InputFacts, before_ns: int
    ) -> InputFacts:
        """The facts with the odometry and the sightings of the last seconds."""
        is_early = len(self._history) <= WINDOW
        since_ns = self._start_ns if is_early else before_ns
        if self._starts_known is None:
            self._starts_known = not snapshot.lost or bool(snapshot.mistake)
        steps = _since_stamp(self.inputs["odometry"].steps, since_ns)
        near, is_from_start = None, self._starts_known and (is_early or not self.has_moved)
        if facts.start is not None and is_from_start:
            near = pose_near_start(steps, facts.start)
        self._judgements_away = 0 if near is not None else self._judgements_away + 1
        seen, long_ns = self.inputs["sightings"], max(self._start_ns, since_ns - LONGER_NS)
        return facts._replace(
            corrections=self._errors.update(snapshot.calibration, MOTION in self._hysteresis),
            near_start=near,
            is_from_start=is_from_start,
            reported_by_start=self._reported_by_start(bool(snapshot.lost)),
            steps=steps,
            frames=[m for _, m in _since(seen.recent, since_ns) if isinstance(m, Sightings)],
            long_steps=_since_stamp(self.inputs["odometry"].steps, long_ns),
            long_frames=[frame for _, frame in _since(seen.spaced, long_ns)],
        )

    def _find_implausible(
        self, snapshot: InputSnapshot, facts: InputFacts, has_problems: bool, now_ns: int
    ) -> tuple[str, ...]:
        """Judges what is implausible about the inputs, and returns the problems to report."""
        self.is_mistake_contradicted = contradicts_mistake(facts)
        found = implausible_inputs(facts)
        if has_problems and CONTRADICTION in found.get(MOTION, ""):
            del found[MOTION]
        reported = self._hysteresis.update(found)
        is_wrong = bool(found or reported or has_problems or snapshot.lost)
        self._confirmation.judge(facts, snapshot.jump if self._sees else None, is_wrong, now_ns)
        return reported

    def _reported_by_start(self, is_lost: bool) -> dict[str, str]:
        """The problems reported because of where the robot started that still hold unless inputs
        show the contrary."""
        reported = self._hysteresis.reported_by_start
        if is_lost or self._judgements_away < WINDOW:
            return reported
        is_kept = MOTION in reported and self._judgements_away < KEPT
        return {MOTION: reported[MOTION]} if is_kept else {}

    def _totals(self, refused_later: Mapping[tuple[str, str], int], now_ns: int) -> _Totals:
        refused = {name: entry.refused.copy() for name, entry in self.inputs.items()}
        for (name, reason), number in refused_later.items():
            refused[name][reason] += number
        taken = {}
        for name, entry in self.inputs.items():
            later = refused[name].total() - entry.refused.total()
            taken[name] = max(0, entry.decoded - later)
        messages = {name: entry.messages for name, entry in self.inputs.items()}
        return _Totals(now_ns, taken, refused, messages)

    def _missing_sightings_reason(self, snapshot: InputSnapshot, now_ns: int) -> str:
        """Why sightings should come that do not: an empty frame would come too, or a landmark has
        been in view for long by the robot's own pose."""
        entry = self.inputs["sightings"]
        silent_ns = (now_ns - entry.arrived_ns) / self._facts.pace
        if entry.has_empty:
            return EMPTY_CAME if silent_ns > EMPTY_NS else ""
        due = self._sees and silent_ns > SECOND_NS and self._has_in_view(snapshot)
        self._in_view_for = self._in_view_for + 1 if due else 0
        return IN_VIEW if self._in_view_for > UNSEEN * self._facts.pace else ""

    def _has_in_view(self, snapshot: InputSnapshot) -> bool:
        """Whether a landmark is well in view, by the robot's pose."""
        sensor, c = self._facts.sensor, snapshot.estimate.covariance
        x, y, heading = snapshot.estimate.pose
        if snapshot.lost or c.xx + c.yy > KNOWN_M**2 or c.hh > KNOWN_RAD**2:
            return False
        for mark in self._facts.landmarks.values():
            bearing = wrap_angle(math.atan2(mark.y_m - y, mark.x_m - x) - heading)
            within_m = 0.3 < math.hypot(mark.x_m - x, mark.y_m - y) < 0.7 * sensor.max_range_m
            if within_m and abs(bearing) < math.radians(0.3 * sensor.field_of_view_deg):
                return True
        return False

    def _window(self, name: str, totals: _Totals, before: _Totals) -> InputWindow:
        entry, since_ns = self.inputs[name], before.now_ns
        return InputWindow(
            (totals.now_ns - entry.arrived_ns) * 1e-9,
            bool(entry.messages),
            totals.taken[name] - before.taken[name],
            +(totals.refused[name] - before.refused[name]),
            _since(entry.recent, since_ns),
            _since(entry.recent_refused, since_ns),
        )

    def _health(self, name: str, totals: _Totals, before: _Totals) -> InputHealth:
        entry = self.inputs[name]
        seconds = (totals.now_ns - before.now_ns) * 1e-9
        came = totals.messages[name] - before.messages[name]
        latest = list(entry.recent)[-20:]
        late_s = [(now_ns - m.stamp_ns) * 1e-9 for now_ns, m in latest]
        offset_s = median(late_s) if late_s else 0.0
        return InputHealth(
            name,
            came / seconds if seconds > 0.0 else 0.0,
            entry.latest_ns,
            totals.taken[name],
            {str(reason): n for reason, n in (+totals.refused[name]).items()},
            max(-LARGEST_NUMBER, min(offset_s, LARGEST_NUMBER)),
        )


def _since(items: Iterable[tuple[int, T]], since_ns: int) -> list[tuple[int, T]]:
    return [item for item in items if item[0] >= since_ns]


def _since_stamp(steps: Iterable[Step], since_ns: int) -> list[Step]:
    """Those since a time, without what was before a gap."""
    found: list[Step] = []
    for step in steps:
        if found and step.from_ns > found[-1].stamp_ns + GAP_NS:
            found.clear()
        if step.stamp_ns >= since_ns:
            found.append(step)
    return found


def _expected_inputs(settings: RobotSettings) -> Iterator[str]:
    """The inputs that a robot's driver must always send."""
    detects = settings.sensing == "camera"
    if settings.source == "mrclam":
        return
    if settings.odometry.moves:
        yield "odometry"
    if detects and not settings.camera.frames:
        yield "frame"
    if settings.source == "external" and settings.position_sensor is not None:
        yield "position"


def _is_sure(sigma_m: float, heading_sigma_deg: float) -> bool:
    """Whether a stated pose is known well enough to judge inputs by it."""
    return sigma_m <= SURE_M and heading_sigma_deg <= SURE_DEG


def _start_pose(start: Start | None) -> Pose2 | None:
    """The start, if it is known well enough to judge inputs by it."""
    if start is None or not start.known:
        return None
    if not _is_sure(start.sigma_m, start.heading_sigma_deg):
        return None
    return Pose2(start.x_m, start.y_m, math.radians(start.heading_deg))
