"""What is wrong with a robot's inputs, as sentences: decided by counts and times, no clock."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import median
from typing import NamedTuple

from cpcbl_agents import input_causes as causes
from cpcbl_team.config import Landmark
from cpcbl_team.inputs import Odometry, Position, Sightings
from cpcbl_transport.decoding import decode_by_key, input_problem
from cpcbl_transport.messages import Frame, SensorInput

SILENT_S = 3.0
REFUSED_SHARE = 0.05
LEAST_REFUSED = 3  # a single message may be damaged, or late
OVERLAP_S = 0.001  # rounded stamps

REASONS = {
    "empty_payload": "payloads are empty",
    "payload_too_large": "payloads are too large",
    "wrong_version": "the first byte is not the version of the messages",
    "garbage": "payloads cannot be decoded",
    "wrong_type": "another type of message came on this key",
    "not_finite": "numbers are infinite or NaN",
    "implausible_number": "numbers are too large; metres, radians, nanoseconds are due",
    "not_a_covariance": "the covariance is none; xx > 0, yy > 0, xy² <= xx yy are due",
    "from_the_future": "stamps are in the future",
    "impossible_duration": "pieces last no time, or more than 10 s",
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
    "frame_black": "images are black",
    "frame_white": "images are white",
    "frame_blank": "images are blank",
}
"""What each reason of a refused input says to people; docs/refused_inputs.md has the remedies."""

STAMPS = {"from_the_future", "too_late", "impossible_duration", "implausible_number"}


class InputWindow(NamedTuple):
    """What came on one input in the last seconds."""

    silent_s: float  # since the last message, or since the start
    came: bool = False  # whether anything has ever come
    taken: int = 0
    refused: Mapping[str, int] = {}
    recent: Sequence[tuple[int, SensorInput]] = ()  # arrival and message
    recent_refused: Sequence[tuple[int, bytes]] = ()  # arrival and payload


class Facts(NamedTuple):
    """All that the problems of a robot's inputs are decided by."""

    robot: str
    windows: Mapping[str, InputWindow]  # by input
    expected: Sequence[str] = ()  # inputs that always come
    names: frozenset[str] = frozenset()  # of landmarks, walls, robots
    landmarks: Mapping[str, Landmark] = {}
    max_range_m: float = 8.0
    field_m: float = 0.0  # the diagonal of what is on the map
    pace: float = 1.0  # robot time over real time, at least 1
    namesake: bool = False  # another process has this robot's name
    camera_lost: bool = False


def input_problems(facts: Facts) -> tuple[str, ...]:
    """The problems as whole sentences, the worst first; none when all is well."""
    return tuple(dict.fromkeys(_problems(facts)))


def implausible_inputs(facts: Facts) -> tuple[str, ...]:
    """What no reason refuses, although it cannot be true. It takes ten times as long."""
    return tuple(_implausible(facts))


def without_numbers(problem: str) -> str:
    """By what a problem is the same one as before, although its figures changed."""
    return re.sub(r"(?<![\w/`])[\d.e+]+", "#", problem)


def _problems(facts: Facts) -> Iterator[str]:
    if facts.namesake:
        yield f"another process is robot {facts.robot} too; stop one of them"
    for name in facts.expected:
        window = facts.windows[name]
        if window.silent_s >= SILENT_S * facts.pace:
            key, ever = f"in/{facts.robot}/{name}", "" if window.came else "; is its driver there?"
            yield f"no {name} on {key} for {window.silent_s:.0f} s{ever}"
    if facts.camera_lost:
        yield "camera lost: it delivers no frames, and is opened again and again"
    for name, window in facts.windows.items():
        yield from _refused(name, window, facts)


def _refused(name: str, window: InputWindow, facts: Facts) -> Iterator[str]:
    """What is refused of one input and why, or whose stamps are off although it is taken."""
    number = sum(window.refused.values())
    total = window.taken + number
    if number >= LEAST_REFUSED and number > REFUSED_SHARE * total:
        by_cause = Counter[str]()
        for reason, refused in window.refused.items():
            by_cause[_cause(reason, f"in/{facts.robot}/{name}", window, facts)] += refused
        worst, *others = by_cause.most_common(2)
        for cause, refused in (worst, *(o for o in others if o[1] > REFUSED_SHARE * total)):
            yield f"{100.0 * refused / total:.0f} % of {name} refused: {cause}"
    elif len(window.recent) >= causes.LEAST_CASES:
        offset_s = median(now_ns - m.stamp_ns for now_ns, m in window.recent[-20:]) * 1e-9
        limits = 0.1 * facts.pace, 1.0 * facts.pace
        if cause := causes.offset_cause(offset_s, *limits):
            yield f"{name}: {cause}"


def _cause(reason: str, key: str, window: InputWindow, facts: Facts) -> str:
    """The likely cause of a refusal, or else what the reason means."""
    frames = [m for _, m in window.recent if isinstance(m, Sightings)]
    cause = ""
    if reason in STAMPS:
        cause = _stamp_cause(reason, key, window)
    elif reason == "garbage" and window.recent_refused:
        if problem := input_problem(key, window.recent_refused[-1][1]):
            cause = f"payloads cannot be decoded: {problem[:120]}"
    elif reason == "bearing_out_of_range":
        cause = causes.bearing_cause(frames)
    elif reason == "unknown_object":
        cause = _unknown_names(frames, facts.names)
    elif reason == "duplicate" and overlapping(window):
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
    said = (causes.stamp_cause(stamp_ns, now_ns) for now_ns, stamp_ns in reversed(stamps))
    return next(filter(None, said), "")


def _unknown_names(frames: Sequence[Sightings], names: frozenset[str]) -> str:
    """`dor` is no landmark, wall or robot of this team; `door`?"""
    unknown = {s.id for f in frames for s in f.sightings} - names
    if not unknown:
        return ""
    listed = []
    for name in sorted(unknown)[:3]:
        near = nearest_name(name, names)
        listed.append(f"`{name}` (`{near}`?)" if near else f"`{name}`")
    verb = "are" if len(listed) > 1 else "is"
    return f"{', '.join(listed)} {verb} no landmark, wall or robot of this team"


def nearest_name(name: str, names: Iterable[str]) -> str:
    """The name that somebody may have meant; empty if none is alike."""
    from difflib import get_close_matches  # for a robot with a problem only

    lower = {known.lower(): known for known in sorted(names)}
    return next((lower[found] for found in get_close_matches(name.lower(), lower, 1)), "")


def overlapping(window: InputWindow) -> bool:
    """Whether pieces of odometry overlap, as those of two drivers do."""
    return causes.overlap_s(_pieces(window)) > OVERLAP_S


def _pieces(window: InputWindow) -> list[Odometry]:
    """Those whose stamps are near: a speed says nothing where stamps have another unit."""
    near = [m for now_ns, m in window.recent if abs(now_ns - m.stamp_ns) < causes.YEAR_NS]
    return [m for m in near if isinstance(m, Odometry)]


def _implausible(facts: Facts) -> Iterator[str]:
    nothing = InputWindow(0.0)
    odometry = facts.windows.get("odometry", nothing)
    pieces = _pieces(odometry) if odometry.taken else []
    seen = facts.windows.get("sightings", nothing).recent
    frames = [m for _, m in seen if isinstance(m, Sightings)]
    if speed := causes.odometry_cause(pieces[-20:]):
        yield f"odometry: {speed}"
    elif pieces and overlapping(odometry) and "duplicate" not in odometry.refused:
        yield "odometry: pieces overlap; two drivers, or from_ns is not where the last one ended"
    if cause := causes.range_cause(frames[-10:], facts.max_range_m, facts.field_m):
        yield f"sightings: {cause}"
    if not speed and (cause := causes.sign_cause(frames[-60:], pieces, facts.landmarks)):
        yield f"sightings: {cause}"
