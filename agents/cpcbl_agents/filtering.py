"""The filter agent: it takes inputs in any order and reports pose estimates."""

import math
from collections import Counter, deque
from collections.abc import Collection, Iterator, Sequence

from cpcbl_agents.agent import (
    AgentMessage,
    FrameChanged,
    FrameEstimate,
    LandmarkPlaces,
    PoseEstimate,
    Presence,
    Tick,
)
from cpcbl_agents.frame_candidates import RobotFrames
from cpcbl_team.config import CameraSettings, Field, LocalizationSettings
from cpcbl_team.fix_claims import FixClaims
from cpcbl_team.frames import FIELD
from cpcbl_team.inputs import (
    Belief,
    BeliefShared,
    Fix,
    InitialPose,
    Input,
    InputsMended,
    LandmarkBelief,
    Odometry,
    Position,
    Sightings,
)
from cpcbl_team.localizer import Localizer
from cpcbl_team.miscalibration import percentages
from cpcbl_team.misplacements import misplacements
from cpcbl_team.places import map_object
from cpcbl_team.self_calibration import SelfCalibration
from cpcbl_team.sensors import recalibrated
from cpcbl_team.timeline import OWN_SENSORS, Timeline
from cpcbl_team.trust_status import TrustStatus, trust_statuses
from cpcbl_transport.messages import Help, LandmarkEstimate, input_name

REPORT_INTERVAL_NS = 100_000_000
OFF_FIELD = "off_field"  # why a pose is not set
ODOMETRY_WAIT_NS = 200_000_000  # how long a frame waits for the odometry that covers it


class FilterAgent:
    """Runs one localizer on its timeline. It reports its estimate at 10 Hz and for each frame."""

    def __init__(
        self,
        settings: LocalizationSettings,
        field: Field,
        teammates: frozenset[str],
        start_ns: int,
        camera: CameraSettings | None = None,
        robot: str = "",
        shared: frozenset[str] = frozenset(),
        frames: RobotFrames | None = None,
        claims: FixClaims | None = None,
    ) -> None:
        """`camera`: of a robot whose sightings are its camera's. `shared`: the landmarks whose
        places `robot` may tell its teammates, and they it. `frames`: of a team whose frame is
        agreed. `claims`: how certain fixes of the team can be."""
        localizer = Localizer(settings, field, teammates, camera, claims)
        self.timeline = Timeline(localizer, localizer.start(start_ns))
        self.counts: Counter[str] = Counter()
        self.refused: Counter[tuple[str, str]] = Counter()
        """The same of inputs: by the name of the input, and the reason."""
        self.initial_pose: InitialPose | None = None
        """The newest that somebody has set."""
        self._field, self._robot, self._shared = field, robot, sorted(shared)
        has_own = settings.position_sensor is not None  # which may lead it anywhere
        self._farthest_m = math.inf if has_own else 2.0 * settings.sensor.max_range_m
        self._known = field.names | teammates
        self._guests: set[str] = set()
        self._moves = settings.odometry.moves
        self._learns = settings.localizer.learns
        self._waiting: deque[Sightings] = deque()
        self._reported_ns = start_ns
        self._odometry: Odometry | None = None
        self._covered_ns = start_ns
        self._frames = frames

    @property
    def frame(self) -> str:
        """The frame of its poses and places."""
        return FIELD if self._frames is None else self._frames.frame

    @property
    def next_ns(self) -> int:
        """When the next regular report is due."""
        return self._reported_ns + REPORT_INTERVAL_NS

    @property
    def all_counts(self) -> Counter[str]:
        """What this agent refused, what the localizer used and gated, and what is wrong with the
        settings and the map as the robot finds them."""
        state = self.timeline.state
        factors = percentages(state.memory.calibration.adaptation)
        factors |= misplacements(state.memory, state.stamp_ns)
        return self.counts + Counter(self.timeline.state.counts) + Counter(factors)

    @property
    def self_calibration(self) -> SelfCalibration | None:
        """What the robot has learned of its odometry and bearings; None where there is nothing."""
        known = self.timeline.state.memory.calibration.corrected
        return known if self._learns or known != SelfCalibration() else None

    @property
    def places(self) -> tuple[LandmarkEstimate, ...]:
        """The landmarks whose places the robot estimates beside its pose, or knows from
        teammates."""
        state = self.timeline.state
        common, beliefs = state.common_errors, state.memory.teammates.trusted_landmarks
        names = [] if common is None else [*common.objects]
        names += [name for name in beliefs if name not in names]
        found = ((name, map_object(self._field, name, common, beliefs)) for name in names)
        return tuple(
            LandmarkEstimate(name, p.position.x, p.position.y, p.position.covariance)
            for name, p in found
            if p is not None and p.wall is None
        )

    def trust_statuses(self, now_ns: int) -> tuple[TrustStatus, ...]:
        """How far this robot trusts each teammate from which it receives help."""
        return trust_statuses(self.timeline.state.senders, now_ns)

    def handle(self, message: AgentMessage, now_ns: int) -> Sequence[AgentMessage]:
        match message:
            case Tick():  # first, for it comes most often
                return self._handle_tick(now_ns)
            case Odometry():
                if self._add(message) and message.stamp_ns > self._covered_ns:
                    self._odometry, self._covered_ns = message, message.stamp_ns
                return self._frame_estimates(now_ns)
            case Sightings():
                for sighting in message.sightings:
                    if sighting.id not in self._known and sighting.id not in self._guests:
                        self.counts["unknown_object"] += 1
                        self.refused["sightings", "unknown_object"] += 1
                if self._add(message):
                    self._waiting.append(message)
                return self._frame_estimates(now_ns)
            case Position() | Belief() | Fix() | BeliefShared() | InputsMended():
                self._add(message)
            case LandmarkBelief(landmark=name):
                if name in self._field.unsurveyed:
                    self._add(message)
                else:
                    self.counts["unknown_object"] += 1
            case InitialPose():
                self._set_pose(message)
            case Presence(name, None):
                self._guests.discard(name)
            case Presence(name) if name not in self._known:
                self._guests.add(name)
        return ()

    def _handle_tick(self, now_ns: int) -> Sequence[AgentMessage]:
        if now_ns < self.next_ns:
            return ()
        changes = self._change_frame(now_ns)
        frames, regular = self._frame_estimates(now_ns), self._regular_estimate(now_ns)
        return [*changes, *frames, regular, *self._landmark_places(now_ns)]

    def _add(self, item: Input) -> bool:
        """Adds an input to the timeline; whether the timeline could use it."""
        refusal = self.timeline.add(item)
        if self._frames is not None and isinstance(item, OWN_SENSORS):
            self._frames.add(item)
        if refusal:
            self.counts[refusal] += 1
            if isinstance(item, Odometry | Sightings | Position | InitialPose):
                number = len(item.sightings) or 1 if isinstance(item, Sightings) else 1
                self.refused[input_name(item), refusal] += number
        return not refusal

    def handle_from_elsewhere(
        self, help_: Help, team: Collection[str], frame: str, now_ns: int
    ) -> None:
        """Takes help in another frame. If that frame is better, the robot may find its pose there,
        but only by the help of its `team`: no guest may draw it into another frame."""
        frames, sender = self._frames, help_.observer if isinstance(help_, Fix) else help_.robot
        is_of_use = frames is not None and sender in team
        if not (is_of_use and frames and frames.add_help(help_, frame, self.timeline, now_ns)):
            self.counts["other_frame"] += 1

    def _change_frame(self, now_ns: int) -> list[FrameChanged]:
        """The change to another frame, if the robot uses another one from now on."""
        if self._frames is None:
            return []
        changed = self._frames.next_change(self.timeline, now_ns)
        if changed is None:
            return []
        self.timeline, event, change = changed
        self.counts[event] += 1
        return [change]

    def _set_pose(self, given: InitialPose) -> None:
        """Sets the pose, unless it is so far off the map that no landmark, nor a teammate that sees
        one, could be seen from there: then it belongs to another map, or is in another unit."""
        if self._field.distance(given.x_m, given.y_m) > self._farthest_m:
            self.counts[OFF_FIELD] += 1
            self.refused[input_name(given), OFF_FIELD] += 1
            return
        latest = self.initial_pose
        if self._add(given) and (latest is None or given.stamp_ns >= latest.stamp_ns):
            self.initial_pose = given

    def _regular_estimate(self, now_ns: int) -> PoseEstimate:
        self._reported_ns = now_ns
        state = self.timeline.latest(now_ns)
        speed = turn_rate = 0.0
        o = self._odometry
        if o is not None and state.stamp_ns - o.stamp_ns < ODOMETRY_WAIT_NS:
            seconds = (o.stamp_ns - o.from_ns) * 1e-9
            speed, turn_rate = o.distance_m / seconds, o.turn_rad / seconds
        return PoseEstimate(state.stamp_ns, state.reported, state.lost, speed, turn_rate)

    def _landmark_places(self, now_ns: int) -> list[LandmarkPlaces]:
        """Where the shared landmarks are, according to this robot and to others; nothing without
        shared landmarks."""
        if not self._shared:
            return []
        state = self.timeline.state
        common, beliefs = state.common_errors, state.memory.teammates.trusted_landmarks
        places = list(beliefs.values())
        for name in self._shared:
            found = map_object(self._field, name, common)
            if found is not None:
                x, y, (xx, xy, yy) = found.position
                places.append(LandmarkBelief(self._robot, name, now_ns, x, y, (xx, xy, yy)))
        return [LandmarkPlaces(tuple(places), self.frame), *self._places_elsewhere()]

    def _places_elsewhere(self) -> Iterator[LandmarkPlaces]:
        """Where the shared landmarks are in better frames, as far as teammates have said so."""
        candidates = {} if self._frames is None else self._frames.candidates
        for frame, candidate in candidates.items():
            beliefs = candidate.timeline.state.memory.teammates.trusted_landmarks
            yield LandmarkPlaces(tuple(beliefs.values()), frame)

    def _frame_estimates(self, now_ns: int) -> list[FrameEstimate]:
        """The estimates at the times of frames, for each frame that odometry covers by now or that
        has waited long enough."""
        ready = []
        while self._waiting:
            stamp_ns = self._waiting[0].stamp_ns
            is_covered = not self._moves or self._covered_ns >= stamp_ns
            if not is_covered and now_ns - stamp_ns < ODOMETRY_WAIT_NS:
                break
            frame = self._waiting.popleft()
            state = self.timeline.at(stamp_ns)
            if state is None:
                continue
            calibration = state.memory.calibration
            adaptation = calibration.adaptation
            factor, scale = adaptation.sensor_factor, adaptation.ranges.scale
            frame = recalibrated(frame, calibration.bearing_bias_rad, scale)
            common = state.common_errors
            if common is not None:
                corrected = tuple(map(common.corrected, frame.sightings))
                frame = Sightings(frame.stamp_ns, corrected)
            ready.append(FrameEstimate(frame, state.reported, state.lost, factor, common))
        return ready
