"""Where the frames that robots begin are on a simulated field: so their poses have a truth.

A frame's origin is the pose of its robot when it began. The first track of that robot in its frame
and the truth of that time tell where it is. Without truth nobody knows how two frames lie to each
other, and nothing may be drawn as if it were known.
"""

import math
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np
from msgspec.structs import replace

from cpcbl_launch.reporting.metrics import Floats, interpolated_truth
from cpcbl_team.estimate import Covariance3
from cpcbl_team.frames import FIELD, frame_text, origin_robot
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_transport.messages import LandmarkEstimate, Track, Truths

BEGUN_M: Final = 0.5  # farther from its origin a robot has been in its frame for some time,
BEGUN_SIGMA_M: Final = 0.1  # and is less certain
KEPT: Final = 100  # truths that wait for a first track
MOST_FRAMES: Final = 1000


class FrameOrigins:
    """The origins of frames as far as they are known."""

    def __init__(self) -> None:
        self.field_from_frame: dict[str, Pose2] = {FIELD: Pose2(0.0, 0.0, 0.0)}
        self._first: dict[str, Track] = {}  # tracks whose truth is not known yet
        self._truths: deque[Truths] = deque(maxlen=KEPT)
        self._seen: set[str] = {FIELD}
        self.has_truth = False
        """Whether any true pose has come."""

    def note_track(self, track: Track) -> None:
        """A track has come."""
        if track.frame in self._seen or len(self._seen) > MOST_FRAMES:
            return
        if origin_robot(track.frame) != track.robot:
            return
        self._seen.add(track.frame)
        c, is_near = track.covariance, math.hypot(track.x_m, track.y_m) < BEGUN_M
        if is_near and (c is None or c[0] + c[2] < 2.0 * BEGUN_SIGMA_M**2):
            self._first[track.frame] = track
            self._locate()

    def note_truths(self, truths: Truths) -> None:
        """The truth of a time has come."""
        self._truths.append(truths)
        self.has_truth = True
        if self._first:
            self._locate()

    def locate(self, truth: Mapping[str, Floats]) -> None:
        """The whole truth is known: rows of seconds, x, y, heading for each robot."""
        self.has_truth |= bool(truth)
        for frame, track in list(self._first.items()):
            if track.robot in truth:
                at, counts = interpolated_truth(
                    np.array([track.stamp_ns * 1e-9]), truth[track.robot]
                )
                if counts[0]:
                    self._set_origin(frame, track, Pose2(*at[0].tolist()))

    def _locate(self) -> None:
        for frame, track in list(self._first.items()):
            field_from_robot = _true_pose(self._truths, track)
            if field_from_robot is not None:
                self._set_origin(frame, track, field_from_robot)

    def _set_origin(self, frame: str, track: Track, field_from_robot: Pose2) -> None:
        del self._first[frame]
        frame_from_robot = Pose2(track.x_m, track.y_m, track.heading_rad)
        self.field_from_frame[frame] = field_from_robot @ frame_from_robot.inverse()

    def in_field(self, track: Track) -> Track:
        """The track in the field's frame, where its own is known there; else as it is."""
        field_from_frame = self.field_from_frame.get(track.frame)
        if field_from_frame is None or not track.frame:
            return track
        x, y, heading = field_from_frame @ Pose2(track.x_m, track.y_m, track.heading_rad)
        found = replace(track, x_m=x, y_m=y, heading_rad=heading, frame=FIELD)
        if track.covariance is None:
            return found
        c, s = math.cos(field_from_frame.heading), math.sin(field_from_frame.heading)
        turn = c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0
        return replace(found, covariance=Covariance3(*track.covariance).transformed(turn))

    def places_in_field(
        self, places: Sequence[LandmarkEstimate], frame: str
    ) -> tuple[tuple[LandmarkEstimate, ...], str]:
        """The same of places of landmarks in this frame, and the frame in which they then are."""
        field_from_frame = self.field_from_frame.get(frame)
        if field_from_frame is None or not frame:
            return tuple(places), frame
        found = []
        for place in places:
            x, y = field_from_frame.transform(place.x_m, place.y_m)
            covariance = Covariance2(*place.covariance).rotated(field_from_frame.heading)
            found.append(LandmarkEstimate(place.landmark, x, y, covariance))
        return tuple(found), FIELD


def _true_pose(truths: Iterable[Truths], track: Track) -> Pose2 | None:
    """Where the robot of a track truly was at its time; None where that is not known."""
    before: tuple[int, Pose2] | None = None
    for at in truths:
        found = [t for t in at.robots if t.robot == track.robot]
        if not found:
            continue
        pose = Pose2(found[0].x_m, found[0].y_m, found[0].heading_rad)
        if at.stamp_ns >= track.stamp_ns:
            if before is None:
                return pose if at.stamp_ns == track.stamp_ns else None
            return _between(before, (at.stamp_ns, pose), track.stamp_ns)
        before = at.stamp_ns, pose
    return None


def _between(before: tuple[int, Pose2], after: tuple[int, Pose2], stamp_ns: int) -> Pose2:
    (from_ns, (x, y, heading)), (until_ns, end) = before, after
    share = (stamp_ns - from_ns) / (until_ns - from_ns)
    turned = share * wrap_angle(end.heading - heading)
    return Pose2(x + share * (end.x - x), y + share * (end.y - y), wrap_angle(heading + turned))


def main_frame(frames: Mapping[str, str]) -> str:
    """The frame in which most robots are (robot -> frame); of equally many that of the field, or
    the first by name. What is in others cannot be drawn beside it."""
    counts = Counter(frames.values())
    return min(counts, key=lambda frame: (-counts[frame], frame), default=FIELD)


def frames_text(frames: Mapping[str, str]) -> str:
    """`in frame r1.00k3x9a: r1, r2; in frame field: r3`; empty where all are in the field's."""
    robots: dict[str, list[str]] = {}
    for robot, frame in frames.items():
        robots.setdefault(frame_text(frame), []).append(robot)
    if robots.keys() <= {frame_text(FIELD)}:
        return ""
    groups = sorted(robots.items(), key=lambda group: (-len(group[1]), group[0]))
    return "; ".join(f"in frame {frame}: {', '.join(own)}" for frame, own in groups)
