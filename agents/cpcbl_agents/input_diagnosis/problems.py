"""What is wrong with a robot's inputs, as sentences: pure functions of counts and times."""

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import NamedTuple

from cpcbl_agents.input_diagnosis import message_causes as causes
from cpcbl_agents.input_diagnosis import motion_causes as motions
from cpcbl_agents.input_diagnosis.motion_causes import Step
from cpcbl_agents.input_diagnosis.position_causes import position_cause
from cpcbl_agents.input_diagnosis.shift_causes import (
    Shift,
    contradicts_mistakes,
    is_same,
    is_sure,
    shift_cause,
    shift_of,
)
from cpcbl_agents.input_diagnosis.start_causes import turned_view_cause
from cpcbl_team import sensor_mistakes as mistakes
from cpcbl_team.config import Landmark, OdometryNoise, SensorSettings
from cpcbl_team.errors import nearest_name
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry, Position, Sightings
from cpcbl_team.trusted_pose import OR_MOVED
from cpcbl_transport.decoding import decode_by_key, input_problem
from cpcbl_transport.messages import LARGEST_NUMBER, Frame, SensorInput

SILENT_S = 3.0
ENDED_S = 5.0  # of a sensor that may pause
REFUSED_SHARE = 0.05
LEAST_REFUSED = 3  # a single message may be damaged, or late
MOST_TOLERANCE = 0.4  # of where a landmark is seen again, as a share of its range
LATEST_NS = 600_000_000
WAIT_S = 7.0  # for what landmarks show
LARGEST_ANGLE = 7.0
LEAST_COVERED = 0.8  # of the time, by odometry
OVERLAP_S = 0.001  # beyond rounded stamps: pieces overlap, as those of two drivers do

REASONS = {
    "empty_payload": "payloads are empty",
    "payload_too_large": "payloads are too large",
    "wrong_version": "the first byte is not the version of the messages",
    "garbage": "payloads cannot be decoded",
    "wrong_type": "another type of message came on this key",
    "not_finite": "numbers are infinite or NaN",
    "implausible_number": "numbers are too large; they must be in metres, radians, nanoseconds",
    "not_a_covariance": "the covariance is not valid; xx > 0, yy > 0 and xy² <= xx yy must hold",
    "from_the_future": "stamps are in the future",
    "impossible_duration": "pieces have no duration, or more than 10 s",
    "too_late": "messages come more than 2 s late, or out of order",
    "duplicate": "the same message comes twice; two drivers?",
    "unknown_object": "names that are not in the team file",
    "seen_twice": "an object comes twice in one message",
    "empty_sighting": "sightings have neither range nor bearing",
    "range_not_positive": "ranges are not positive",
    "bearing_out_of_range": "bearings are beyond π",
    "heading_out_of_range": "headings are beyond π",
    "heading_without_sigma": "headings have no sigma",
    "sigma_not_positive": "sigmas are not positive",
    "no_camera": 'frames come, but `sensing` is not "camera"',
    "frame_empty": "images are empty",
    "frame_undecodable": "images are neither JPEG nor PNG",
    "frame_truncated": "images are cut off",
    "frame_wrong_channels": "images are not in colour",
    "frame_wrong_depth": "images do not have 8 bits a colour",
    "frame_wrong_size": "images do not have the size of `camera`",
    "frame_failed": "images make the detector fail; the robot's log has the error",
    "frame_repeated": "images repeat the one before exactly; the camera or its driver hangs",
    "camera_upside_down": "the camera is upside down",
    **{f"frame_{what}": f"images are {what}" for what in ("black", "white", "blank")},
    "off_field": "a pose that somebody gave is far from the map",
}
"""What each reason of a refused input says to people; docs/refused_inputs.md has the remedies."""

STAMPS = {"from_the_future", "too_late", "impossible_duration", "implausible_number"}
SAID_BY_CAMERA = {"camera_upside_down"}  # with the numbers of what it saw
MOTION, OVERLAP, POSITION = "motion", "overlap", "position"  # what implausible inputs are about
CALIBRATION = "calibration"


class InputWindow(NamedTuple):
    """What came on one input in the last seconds."""

    silent_s: float  # since the last message, or since the start
    came: bool = False  # whether anything has ever come
    taken: int = 0
    refused: Mapping[str, int] = {}
    recent: Sequence[tuple[int, SensorInput]] = ()  # arrival and message
    recent_refused: Sequence[tuple[int, bytes]] = ()  # arrival and payload


class InputFacts(NamedTuple):
    """Everything from which the problems of a robot's inputs are derived."""

    robot: str
    windows: Mapping[str, InputWindow]  # by input
    expected: Sequence[str] = ()  # inputs that always come
    names: frozenset[str] = frozenset()  # of landmarks, walls, robots
    landmarks: Mapping[str, Landmark] = {}
    sensor: SensorSettings = SensorSettings()
    wheels: OdometryNoise = OdometryNoise()
    bounds: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # of what is on the map
    timeout_s: float = math.inf  # of odometry
    start: Pose2 | None = None
    near_start: Pose2 | None = None  # the pose by odometry alone, while it has hardly moved
    steps: Sequence[Step] = ()  # of odometry
    frames: Sequence[Sightings] = ()  # within the same time
    long_steps: Sequence[Step] = ()  # of twice that time,
    long_frames: Sequence[Sightings] = ()  # and usable frames, at most ten a second
    corrections: str = ""  # what those of the pose say of inputs
    is_from_start: bool = False  # whether that time began at the start
    reported_by_start: Mapping[str, str] = {}  # earlier, by the start; nothing shows they are over
    pace: float = 1.0  # robot time over real time, at least 1
    namesake: bool = False  # another process has this robot's name
    camera_lost: bool = False
    unseen: str = ""  # why sightings should come that do not
    mistake: str = ""  # in sightings, that explains why the robot is lost
    suspected_ns: int = -1  # the stamp since when sightings may have this mistake


def input_problems(facts: InputFacts) -> tuple[str, ...]:
    """The problems as whole sentences, the worst first; none when all is well."""
    return tuple(dict.fromkeys(_problems(facts)))


def implausible_inputs(facts: InputFacts) -> dict[str, str]:
    """What no reason refuses, although it cannot be true, by what it is about."""
    return {about: text for about, text in _implausible(facts) if text}


def without_numbers(problem: str) -> str:
    """The text without its figures: the same problem has the same text when its figures change."""
    return re.sub(r"(?<![\w/`])\d[\d.e+]*", "#", problem)


def _problems(facts: InputFacts) -> Iterator[str]:
    if facts.namesake:
        yield f"another process is robot {facts.robot} too; stop one of them"
    for name in facts.expected:
        window = facts.windows[name]
        if window.silent_s >= (ENDED_S if name == "position" else SILENT_S) * facts.pace:
            key, ever = f"in/{facts.robot}/{name}", "" if window.came else "; is its driver there?"
            yield f"no {name} on {key} for {window.silent_s:.0f} s{ever}"
    if facts.unseen:
        key = f"in/{facts.robot}/sightings"
        yield f"no sightings on {key}, although {facts.unseen}; is its driver there?"
    if facts.camera_lost:
        yield "camera lost: it delivers no frames, and is opened again and again"
    for name, window in facts.windows.items():
        yield from _refusal_problems(name, window, facts)
    pieces = _odometry(facts)
    yield from _gaps(facts, pieces)
    if (lasts_s := causes.piece_s(pieces)) > facts.timeout_s:
        yield (
            f"odometry: pieces of {lasts_s:.1f} s are longer than odometry.timeout_s; send"
            " them more often"
        )


def _gaps(facts: InputFacts, pieces: Sequence[Odometry]) -> Iterator[str]:
    """Pieces of odometry that are missing, where none is refused."""
    window = facts.windows.get("odometry")
    if window is None or is_often_refused(window):
        return
    if (share := causes.covered_share(pieces)) < LEAST_COVERED:
        yield (
            f"odometry covers only {100.0 * share:.0f} % of the time: pieces are lost, or from_ns"
            " is not where the last one ended"
        )


def is_often_refused(window: InputWindow) -> bool:
    """Whether so much of an input is refused that it is a problem."""
    number = sum(window.refused.values())
    return number >= LEAST_REFUSED and number > REFUSED_SHARE * (window.taken + number)


def _refusal_problems(name: str, window: InputWindow, facts: InputFacts) -> Iterator[str]:
    """What is refused of one input and why, or whose stamps are off although it is taken."""
    total = window.taken + sum(window.refused.values())
    if is_often_refused(window):
        by_cause = Counter[str]()
        for reason in (r for r in window.refused if r not in SAID_BY_CAMERA):
            cause = _refusal_cause(reason, f"in/{facts.robot}/{name}", window, facts)
            by_cause[cause] += window.refused[reason]
        first = by_cause.most_common(2)
        for cause, refused in first[:1] + [o for o in first[1:] if o[1] > REFUSED_SHARE * total]:
            yield f"{100.0 * refused / total:.0f} % of {name} refused: {cause}"
    elif cause := causes.arrival_cause(_times(window)):
        yield f"{name}: {cause}"
    elif len(window.recent) >= causes.LEAST_CASES:
        offset_s = median(now_ns - m.stamp_ns for now_ns, m in window.recent[-20:]) * 1e-9
        limits = 0.1 * facts.pace, 1.0 * facts.pace
        if cause := causes.offset_cause(offset_s, *limits):
            yield f"{name}: {cause}"


def _times(window: InputWindow) -> list[tuple[int, int]]:
    """When messages arrived, and their stamps."""
    return [(now_ns, m.stamp_ns) for now_ns, m in window.recent]


def _refusal_cause(reason: str, key: str, window: InputWindow, facts: InputFacts) -> str:
    """The likely cause of a refusal, or else what the reason means."""
    frames = [m for _, m in window.recent if isinstance(m, Sightings)]
    cause = ""
    if reason == "too_late" and (cause := causes.arrival_cause(_times(window))):
        return cause
    if reason in STAMPS:
        cause = _stamp_cause(reason, key, window)
    elif reason == "garbage" and window.recent_refused:
        if problem := input_problem(key, window.recent_refused[-1][1]):
            cause = f"payloads cannot be decoded: {problem[:120]}"
    elif reason == "bearing_out_of_range":
        cause = causes.bearing_cause(frames)
    elif reason == "seen_twice":
        cause = causes.twice_cause(frames)
    elif reason == "unknown_object":
        cause = _unknown_names(frames, facts)
    elif reason == "duplicate" and causes.overlap_s(_pieces(window)) > OVERLAP_S:
        cause = "pieces come twice, and overlap; are there two drivers?"
    return cause or REASONS.get(reason, reason)


def _stamp_cause(reason: str, key: str, window: InputWindow) -> str:
    """By a refused message, or by one that was taken before the timeline refused it."""
    stamps = [(now_ns, m.stamp_ns) for now_ns, m in window.recent]
    if reason != "too_late":
        found = [(now_ns, decode_by_key(key, payload)) for now_ns, payload in window.recent_refused]
        kinds = Odometry | Sightings | Position | Frame
        stamps = [(now_ns, m.stamp_ns) for now_ns, m in found if isinstance(m, kinds)] or stamps
    # Of the whole window, for a driver that was mended a moment ago sends good stamps at its end
    found_causes = (causes.stamp_cause(stamp_ns, now_ns) for now_ns, stamp_ns in reversed(stamps))
    return next(filter(None, found_causes), "")


def _unknown_names(frames: Sequence[Sightings], facts: InputFacts) -> str:
    """`dor` is no landmark, wall or robot of this team; `door`?"""
    names, seen = facts.names, {s.id for f in frames for s in f.sightings}
    unknown = seen - names
    if not unknown:
        return f"`{facts.robot}` is this robot's own name" if facts.robot in seen else ""
    listed = []
    for name in sorted(unknown)[:3]:
        near = nearest_name(name, names)
        listed.append(f"`{name}` (`{near}`?)" if near else f"`{name}`")
    verb = "are" if len(listed) > 1 else "is"
    return f"{', '.join(listed)} {verb} no landmark, wall or robot of this team"


def _odometry(facts: InputFacts) -> list[Odometry]:
    window = facts.windows.get("odometry")
    return _pieces(window) if window is not None and window.taken else []


def _pieces(window: InputWindow) -> list[Odometry]:
    """Those whose stamps are near: a speed says nothing where stamps have another unit."""
    return [
        m
        for now_ns, m in window.recent
        if isinstance(m, Odometry) and abs(now_ns - m.stamp_ns) < causes.YEAR_NS
    ]


def _implausible(facts: InputFacts) -> Iterator[tuple[str, str]]:
    odometry = facts.windows.get("odometry", InputWindow(0.0))
    positions = facts.windows.get("position", InputWindow(0.0)).recent
    pieces = _odometry(facts)
    frames = [usable(frame) for frame in facts.frames]
    overlap = causes.overlap_s(pieces) > OVERLAP_S
    if overlap and "duplicate" not in odometry.refused:
        text = "pieces overlap; two drivers, or from_ns is not where the last one ended"
        yield OVERLAP, f"odometry: {text}"
    steps = [] if overlap or not pieces else facts.steps
    motion = _motion(facts, frames, pieces, steps)
    yield MOTION, motion
    yield CALIBRATION, "" if motion else facts.corrections
    found = [p for _, p in positions if isinstance(p, Position)]
    if found and not motion:
        found = [p for p in found if all(map(math.isfinite, (p.x_m, p.y_m, *p.covariance)))]
        cause = position_cause(
            found, steps, facts.bounds, facts.near_start, facts.start, facts.is_from_start
        )
        open_text = "" if facts.near_start else facts.reported_by_start.get(POSITION, "")
        yield POSITION, f"position: {cause}" if cause else open_text


def _motion(
    facts: InputFacts,
    frames: Sequence[Sightings],
    pieces: Sequence[Odometry],
    steps: Sequence[Step],
) -> str:
    """What is wrong with sightings, or with odometry beside them."""
    sensor, marks = facts.sensor, facts.landmarks
    left, low, right, high = facts.bounds
    scale = motions.scale_of(frames[-10:], marks)
    field_m = math.hypot(right - left, high - low)
    if cause := causes.range_cause(frames[-10:], sensor.max_range_m, field_m, scale):
        return f"sightings: {cause}"
    right_order, wrong_order = motions.order_votes(frames[-5:], marks)
    if wrong_order >= causes.LEAST_CASES and wrong_order > 4 * right_order:
        return f"sightings: {mistakes.MIRRORED}; or the map is mirrored"
    sigma = math.hypot(sensor.range_share, sensor.bearing_sigma_rad)
    tolerance = min(0.15 + 3.0 * sigma, MOST_TOLERANCE)
    seen = motions.places_seen(frames, steps, marks, sensor.max_range_m)
    soon = list(motions.resightings(seen))
    is_right, cause = _shift_of_landmarks(facts, frames, steps)
    cause = cause or motions.motion_cause(soon, steps, motions.errors(soon, steps), tolerance)
    if not cause:
        late = list(motions.resightings(seen, *motions.LATER_NS))
        errors = motions.errors(late, steps)
        cause = motions.motion_cause(late, steps, errors, tolerance)
        is_contradicted = not cause and motions.contradicts(errors, 1.5 * tolerance)
        if is_contradicted and causes.covered_share(pieces, 1) >= LEAST_COVERED:
            cause = causes.odometry_cause(pieces) or motions.CONTRADICTION
    if cause:
        is_order_right = right_order >= causes.LEAST_CASES and right_order > 4 * wrong_order
        if cause == motions.MIRRORED and is_order_right:
            cause = "turns have the wrong sign; left is positive"
        about = "sightings" if cause.startswith(("ranges", "bearings")) else "odometry"
        return f"{about}: {cause}"
    reported = facts.reported_by_start.get(MOTION)
    if facts.near_start is None and not is_right and reported:
        return reported
    if cause := _view_cause(facts, frames, steps, tolerance, is_right):
        return f"sightings: {cause}"
    spans_s = (steps[-1].stamp_ns - steps[0].from_ns) * 1e-9 if steps else math.inf
    if soon or (spans_s < WAIT_S and any(s.id in marks for f in frames for s in f.sightings)):
        return ""  # what landmarks show is known better, or soon
    cause = causes.odometry_cause(pieces)
    return cause and f"odometry: {cause}"


def _view_cause(
    facts: InputFacts,
    frames: Sequence[Sightings],
    steps: Sequence[Step],
    tolerance: float,
    is_right: bool,
) -> str:
    """What is wrong with sightings, by the map and a pose: the start, or that of the filter."""
    marks = facts.landmarks
    if facts.near_start is not None and frames:
        latest = [f for f in frames[-10:] if frames[-1].stamp_ns - f.stamp_ns < LATEST_NS]
        if cause := motions.view_cause(latest, facts.near_start, marks, tolerance):
            return cause
    if is_right:
        return ""
    start = facts.start if facts.is_from_start else None
    if start is not None and (cause := turned_view_cause(frames, steps, start, marks)):
        return cause
    is_named = facts.mistake not in ("", mistakes.FIXED)  # what does not turn, motion tells better
    return f"{facts.mistake}; {OR_MOVED}" if is_named else ""


def contradicts_mistake(facts: InputFacts) -> bool:
    """Whether landmarks have moved since then as no mistake in sightings lets them move."""
    if not facts.mistake or not _odometry(facts):
        return False
    shift = shift_of_frames(facts, facts.suspected_ns)
    return shift is not None and contradicts_mistakes(shift)


def shift_of_frames(facts: InputFacts, since_ns: int = 0) -> Shift | None:
    """How landmarks shift in the long window, or since a time."""
    frames = [frame for frame in facts.long_frames if frame.stamp_ns > since_ns]
    steps = [step for step in facts.long_steps if step.from_ns >= since_ns]
    return shift_of(frames, steps, facts.landmarks, facts.sensor, facts.wheels)


def _shift_of_landmarks(
    facts: InputFacts, frames: Sequence[Sightings], steps: Sequence[Step]
) -> tuple[bool, str]:
    """Whether landmarks surely move as odometry says, and else the cause that explains how they
    move, if one does."""
    of_robot = facts.landmarks, facts.sensor, facts.wheels
    long_steps = facts.long_steps if steps else []
    shift = shift_of(facts.long_frames, long_steps, *of_robot)
    cause = shift_cause(shift, long_steps) if shift else ""
    if shift and cause and not is_same(shift, shift_of(frames, steps, *of_robot)):
        cause = ""  # the driver was mended meanwhile
    return shift is not None and is_sure(shift), cause


def usable(frame: Sightings) -> Sightings:
    """The frame without sightings whose numbers cannot be used."""
    kept = [
        s
        for s in frame.sightings
        if -LARGEST_ANGLE <= (s.bearing_rad or 0.0) <= LARGEST_ANGLE
        and -LARGEST_NUMBER <= (s.range_m or 0.0) <= LARGEST_NUMBER
    ]
    is_whole = len(kept) == len(frame.sightings)
    return frame if is_whole else Sightings(frame.stamp_ns, tuple(kept))
