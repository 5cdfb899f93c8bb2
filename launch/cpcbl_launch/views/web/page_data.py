"""What the page draws, as plain data: pure functions of what was received, and of the time."""

import math
from collections.abc import Collection, Mapping
from typing import Any

import msgspec

from cpcbl_agents.robot_state import RobotState, Severity, Word, robot_state
from cpcbl_launch.reporting.frames import main_frame
from cpcbl_launch.reporting.metrics import degrees, ellipse_of
from cpcbl_launch.reporting.statuses import SpendingReport, TrustReport
from cpcbl_launch.views.traffic import LiveFlow, Traffic
from cpcbl_launch.views.web.feed import LatestMessages, Snapshot, position_sigma_m
from cpcbl_team.config import Field, Team
from cpcbl_team.frames import FIELD, frame_text
from cpcbl_team.inputs import Sighting, SightingFault
from cpcbl_transport.messages import LandmarkEstimate, Refusal, Truth

SEEN_S = 1.0  # sightings older than this are not drawn
MOST_SEEN, LONGEST_TEXT = 50, 200
LEFT_S = 30.0  # a guest that left is shown for so long
UNHEARD_S = 3.0  # so long after the connection the team should have been heard
REFUSALS = frozenset([*Refusal, *SightingFault])

Triple = tuple[float, float, float]
LandmarkPicture = tuple[str, float, float, float, float, float]
"""Name, x, y, semi-axes of one sigma, and the direction of the first."""
Arrow = tuple[str, str, str, int, float | None]
"""Helper, helped, topic, tier of the helper, messages/s."""


class RobotPicture(msgspec.Struct, frozen=True, omit_defaults=True):
    """One robot as it is drawn. Metres and radians in the frame that is shown; times are seconds
    since the start of the view."""

    state: Word
    why: str = ""  # in words, unless the state is ok
    severity: Severity = "good"
    is_guest: bool = False
    at_s: float | None = None  # when its latest pose arrived
    pose: Triple | None = None  # x, y, heading
    ellipse: Triple | None = None  # semi-axes of one sigma, and the direction of the first
    sigma_m: float | None = None
    error_m: float | None = None
    tier: int | None = None
    truth: Triple | None = None
    sees: tuple[tuple[str, float | None, float | None], ...] = ()  # what, range, bearing
    places: tuple[LandmarkPicture, ...] = ()  # of the landmarks that it finds itself
    frame: str = ""  # in which its pose is; empty for that of the field


class Frame(msgspec.Struct, frozen=True, tag="frame"):
    """What has changed since the frame before that the same page was sent."""

    number: int
    at_s: float
    notice: str
    robots: dict[str, RobotPicture]
    removed: list[str]
    help: tuple[Arrow, ...] | None  # all of it at present; None while it is as before
    skipped: int  # cycles for which this page was too slow, since it was opened
    play: tuple[float, bool] | None = None  # of a recording: its speed, and whether it plays


class RecordingPicture(msgspec.Struct, frozen=True):
    """What a page must know of a recording."""

    duration_s: float
    begin_s: float  # by the stamps; a simulation may begin at 0


class TeamPicture(msgspec.Struct, frozen=True, tag="team"):
    """What a page is told first."""

    team: str
    landmarks: list[tuple[str, float, float]]
    walls: list[tuple[str, float, float, float, float]]
    cameras: tuple[str, ...] | None  # robots with one; None where the team file is not at hand
    history: dict[str, list[tuple[float | None, ...]]]  # rows of `feed.TrailPoint`
    recording: RecordingPicture | None = None  # None: live


class InputPicture(msgspec.Struct, frozen=True):
    """The health of one of a robot's inputs."""

    input: str
    rate_hz: float
    age_s: float | None  # of the newest stamp, when the robot reported it
    taken: int
    refused: dict[str, int]
    offset_s: float


class RobotDetail(msgspec.Struct, frozen=True, tag="detail"):
    """All that a robot says of itself. Counts are those of its present process."""

    robot: str
    process: str = ""
    heading_sigma_deg: float | None = None
    problems: tuple[str, ...] = ()
    inputs: tuple[InputPicture, ...] = ()
    refused: dict[str, int] = {}  # messages and sightings, by reason
    counts: dict[str, int] = {}
    sent: tuple[LiveFlow, ...] = ()
    heard: tuple[LiveFlow, ...] = ()
    spending: tuple[SpendingReport, ...] = ()
    trust: tuple[TrustReport, ...] = ()


def team_picture(
    team: Team | None,
    name: str,
    history: Mapping[str, Any],
    recording: RecordingPicture | None = None,
) -> TeamPicture:
    """`team`: None where its file is not at hand."""
    field = Field() if team is None else team.map
    rows = {
        robot: [tuple(_round(value) for value in sample) for sample in samples]
        for robot, samples in history.items()
    }
    return TeamPicture(
        team=name,
        landmarks=[(mark, p.x_m, p.y_m) for mark, p in field.landmarks.items()],
        walls=[(wall, *w.from_m, *w.to_m) for wall, w in field.walls.items()],
        cameras=None if team is None else team.cameras,
        history=rows,
        recording=recording,
    )


def robot_pictures(
    now: Snapshot, named: Collection[str], now_s: float, began_s: float, team: Team | None = None
) -> dict[str, RobotPicture]:
    """All robots; `named` are those of the `team` file, all others are guests."""
    own = {} if team is None else team.robots
    unused = {name for name, robot in own.items() if not robot.sensor.sees_landmarks}
    marks = frozenset[str]() if team is None else team.map.names
    shown = shown_frame(now)
    return {
        name: picture
        for name, latest in now.robots.items()
        if (
            picture := _picture(
                latest,
                marks if name in unused else frozenset(),
                now.truths.get(name),
                bool(named) and name not in named,
                now_s,
                began_s,
                shown,
            )
        )
    }


def shown_frame(now: Snapshot) -> str:
    """The frame that is drawn: the field's, or else that in which most robots are."""
    tracks = {name: latest.track for name, latest in now.robots.items()}
    return main_frame({name: track.frame for name, track in tracks.items() if track is not None})


def _used(latest: LatestMessages, unused: Collection[str]) -> tuple[Sighting, ...]:
    """What a robot saw, without objects that it does not use."""
    seen = latest.sightings.sightings if latest.sightings is not None else ()
    return tuple(s for s in seen if s.id not in unused)[:MOST_SEEN]


def _picture(
    latest: LatestMessages,
    unused: Collection[str],
    truth: Truth | None,
    is_guest: bool,
    now_s: float,
    began_s: float,
    shown: str,
) -> RobotPicture | None:
    """None for a guest that left. What is in another frame than the one that is `shown` has no
    place in it."""
    found = state_of(latest, now_s)
    state = found.word
    since_s = now_s - max(latest.latest_s, latest.token_lost_s or 0.0)
    if is_guest and state in ("gone", "waiting") and since_s > LEFT_S:
        return None
    status, track = latest.status, latest.track
    is_fresh = state != "gone" and now_s - latest.sightings_s <= SEEN_S
    seen = tuple((s.id, _round(s.range_m), _round(s.bearing_rad)) for s in _used(latest, unused))
    is_known = truth is not None and shown == FIELD
    there = (truth.x_m, truth.y_m, truth.heading_rad) if truth is not None and is_known else None
    places = latest.places if latest.places_frame == shown and state != "gone" else ()
    common = RobotPicture(
        state=state,
        severity=found.severity,
        why=found.why[:LONGEST_TEXT],
        is_guest=is_guest,
        sigma_m=None if status is None else _round(status.position_sigma_m, 4),
        tier=None if status is None else status.tier,
        truth=None if there is None else _triple(*there),
        sees=seen if is_fresh else (),
        places=tuple(map(_place, places)),
        frame="" if status is None else status.frame,
    )
    if track is None:
        return common
    if track.frame != shown:
        return msgspec.structs.replace(common, at_s=_round(latest.track_s - began_s))
    ellipse = None if track.covariance is None else ellipse_of(*track.covariance[:3])
    return msgspec.structs.replace(
        common,
        at_s=_round(latest.track_s - began_s),
        pose=_triple(track.x_m, track.y_m, track.heading_rad),
        ellipse=None if ellipse is None else _triple(*ellipse),
        sigma_m=_round(position_sigma_m(track), 4) or common.sigma_m,
        error_m=_round(latest.error_m, 4),
        tier=track.tier,
    )


def state_of(latest: LatestMessages, now_s: float) -> RobotState:
    """The state of a robot by what was received of it."""
    lost_s = latest.token_lost_s
    return robot_state(
        latest.status,
        latest.track,
        is_alive=bool(latest.tokens),
        silent_s=now_s - latest.latest_s if latest.latest_s else 0.0,
        pause_s=latest.pause_s,
        ended_s=None if lost_s is None else now_s - lost_s,
    )


def notice_text(now: Snapshot, team: str, where: str, now_s: float) -> str:
    """What is wrong with the connection or with the whole team, and what to do; empty otherwise."""
    if now.connected_s is None:
        return f"{now.problem}. The page goes on by itself as soon as there is a router."
    is_silent = not any(latest.is_present for latest in now.robots.values())
    if is_silent and now_s - now.connected_s > UNHEARD_S:
        return (
            f"No robot of team `{team}` is heard at {where}. Compare the team's name with that in"
            " the robots' team file, and their --connect with this address."
        )
    shown = shown_frame(now)
    tracks = {name: latest.track for name, latest in now.robots.items()}
    elsewhere = sorted(n for n, track in tracks.items() if track and track.frame != shown)
    if elsewhere:
        return (
            f"Drawn is frame {frame_text(shown)}. Not drawn, because nobody knows yet where their"
            f" frames are: {', '.join(elsewhere)}."
        )
    return ""


def help_arrows(traffic: Traffic, pictures: Mapping[str, RobotPicture]) -> tuple[Arrow, ...]:
    """Who helps whom: only between robots that are there."""
    present = {name for name, p in pictures.items() if p.state not in ("gone", "waiting")}
    return tuple(
        (h.helper, h.helped, h.topic, traffic.robots[h.helper].tier, _round(h.messages_per_s, 1))
        for h in traffic.help
        if h.helper in present and h.helped in present
    )


def difference(
    before: Mapping[str, RobotPicture], now: Mapping[str, RobotPicture]
) -> tuple[dict[str, RobotPicture], list[str]]:
    """The robots that differ from those before, and the names of those that are no longer there."""
    differing = {name: picture for name, picture in now.items() if before.get(name) != picture}
    return differing, [name for name in before if name not in now]


def robot_detail(name: str, latest: LatestMessages, traffic: Traffic) -> RobotDetail:
    """What the page shows of the robot that a person has chosen."""
    status, live = latest.status, traffic.robots.get(name)
    if status is None or live is None:
        return RobotDetail(name)
    inputs = tuple(
        InputPicture(
            health.input,
            round(health.rate_hz, 1),
            _round((status.stamp_ns - health.latest_ns) * 1e-9) if health.latest_ns else None,
            health.taken,
            health.refused,
            round(health.offset_s, 3),
        )
        for health in getattr(status, "inputs", ())
    )
    return RobotDetail(
        robot=name,
        process=status.incarnation,
        heading_sigma_deg=_round(degrees(status.heading_sigma_rad), 2),
        problems=robot_state(status).problems,
        inputs=inputs,
        refused={reason: n for reason, n in status.counts.items() if reason in REFUSALS and n},
        counts={what: n for what, n in status.counts.items() if what not in REFUSALS},
        sent=live.sent,
        heard=live.heard,
        spending=live.spending,
        trust=live.trust,
    )


def _place(place: LandmarkEstimate) -> LandmarkPicture:
    x, y, _ = _triple(place.x_m, place.y_m, 0.0)
    return place.landmark, x, y, *_triple(*ellipse_of(*place.covariance))


def _round(value: float | None, digits: int = 3) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)


def _triple(a: float, b: float, c: float) -> Triple:
    return round(a, 4), round(b, 4), round(c, 4)
