"""The state of a robot in one word, and why: decided here for tables, the page and logs."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Literal, NamedTuple, Protocol

from cpcbl_team.fix_claims import OVERCLAIMED
from cpcbl_team.miscalibration import LEAST_BIAS_RAD, LEAST_SCALE
from cpcbl_team.misplacements import MISPLACED, MOVES, REJECTED
from cpcbl_team.moved_landmarks import MOST_MOVES
from cpcbl_transport.messages import Status, Track

SILENT_S = 2.0  # so long, and three of its pauses, a robot is silent before it is gone
LEAST_OVERCLAIMED = 20  # fixes of one robot that are no chance
TOKEN_LOST_S = 0.5  # a robot that changes its tier may have no token for a moment

Word = Literal["ok", "unconfirmed", "problem", "lost", "gone", "waiting"]
Severity = Literal["good", "warning", "error"]
SEVERITIES: Mapping[Word, Severity] = {
    "ok": "good",
    "unconfirmed": "warning",
    "problem": "warning",
    "waiting": "warning",
    "lost": "error",
    "gone": "error",
}


class RobotState(NamedTuple):
    """One word for a robot, the worst that is known, and all that is behind it."""

    word: Word
    why: str = ""  # the first reason, for whoever has one line; empty if all is well
    problems: tuple[str, ...] = ()  # also while it is lost
    unconfirmed: str = ""

    @property
    def severity(self) -> Severity:
        return SEVERITIES[self.word]

    @property
    def shortcomings(self) -> tuple[str, ...]:
        """The problems, and what is not confirmed about the pose."""
        return (*self.problems, *filter(None, [self.unconfirmed]))

    @property
    def reasons(self) -> tuple[str, ...]:
        """All that is wrong, the worst first."""
        of_word = (f"{self.word}: {self.why}",) if self.word in ("lost", "gone", "waiting") else ()
        return (*of_word, *self.shortcomings)


def robot_state(
    status: Status | None,
    track: Track | None = None,
    *,
    is_alive: bool = True,
    silent_s: float = 0.0,
    pause_s: float = 0.0,
    ended_s: float | None = None,
    observed: Sequence[str] = (),
) -> RobotState:
    """The state by the latest status and, where it is newer, the latest track.

    `is_alive`: its process is known to run. `silent_s`: the age of the latest message, after a
    usual pause of `pause_s`. `ended_s`: so long ago its process or its link ended, infinite where
    nobody saw when. `observed`: problems that an observer finds and the robot does not report.
    """
    problems = (*observed, *(_problems(status) if status is not None else ()))
    if ended_s is not None and ended_s > TOKEN_LOST_S:
        when = f" {ended_s:.0f} s ago" if math.isfinite(ended_s) else ""
        return RobotState("gone", f"its process or its link ended{when}", problems)
    if silent_s > max(SILENT_S, 3.0 * pause_s):
        return RobotState("gone", f"silent for {silent_s:.0f} s", problems)
    newest = status if track is None or (status and status.stamp_ns > track.stamp_ns) else track
    if newest is None:
        heard = "its process runs, but has sent nothing yet" if is_alive else "nothing was heard"
        return RobotState("waiting", heard, problems)
    if newest.lost:
        return RobotState("lost", newest.lost, problems)
    unconfirmed = status.unconfirmed if status is not None else ""
    if problems:
        return RobotState("problem", problems[0], problems, unconfirmed)
    return RobotState("unconfirmed" if unconfirmed else "ok", unconfirmed, (), unconfirmed)


def _problems(status: Status) -> Iterator[str]:
    """With its inputs, its teammates, its calibration and its map."""
    yield from status.problems
    if text := distrust_text(status.trust):
        yield text
    yield from _overclaims(status.counts)
    if text := miscalibration_text(status.counts, status.learned):
        if status.learned is not None:
            distance, turn, bias_rad = status.learned
            text = f"{learned_text(distance, turn, math.degrees(bias_rad))}, {text}"
        yield f"miscalibrated: {text}"
    for place, text in misplaced_objects(status.counts).items():
        yield f"finds {place} elsewhere than {text}"


def _overclaims(counts: Mapping[str, int]) -> Iterator[str]:
    """`25 fixes of west state less noise than its sensor has by the team file`."""
    for count, number in counts.items():
        if count.startswith(OVERCLAIMED) and number >= LEAST_OVERCLAIMED:
            name = count.removeprefix(OVERCLAIMED)
            yield f"{number} fixes of {name} state less noise than its sensor has by the team file"


class Judged(Protocol):
    """What a robot makes of a teammate (`messages.Trust`)."""

    @property
    def peer(self) -> str: ...
    @property
    def reason(self) -> str: ...
    @property
    def late_s(self) -> float: ...
    @property
    def contested(self) -> bool: ...


def distrust_text(trust: Iterable[Judged]) -> str:
    """`distrusts west (biased), r4 (clock 0.45 s ahead)`, or `contested: north, south`; empty where
    all are believed."""
    all_of_it = tuple(trust)
    named = [f"{t.peer} ({distrust_reason(t)})" for t in all_of_it if t.reason]
    contested = [t.peer for t in all_of_it if t.contested and not t.reason]
    texts = [f"distrusts {', '.join(named)}"] if named else []
    texts += [f"contested: {', '.join(contested)}"] if contested else []
    return "; ".join(texts)


def miscalibration_text(
    counts: Mapping[str, int], learned: tuple[float, float, float] | None
) -> str:
    """`σ of its odometry × 2.1, 13.0% of observations rejected`: why a robot is called
    miscalibrated; empty if it is not, or no longer. `learned`: the scales of distances and turns
    and the bias of bearings (rad) by which it corrects its readings now; they are not in the text.
    """
    texts = [
        f"σ of its {what} × {counts[name] / 100.0:.1f}"
        for what in ("odometry", "sensor")
        if (name := f"{what}_sigma_percent") in counts
    ]
    if (percent := counts.get("range_percent")) is not None:
        texts.append(f"ranges × {percent / 100.0:.2f}")
    texts += [
        f"ranges {sign} {counts[name] / 1000.0:.2f} m"
        for sign, word in (("+", "plus"), ("-", "minus"))
        if (name := f"range_{word}_mm") in counts
    ]
    if not counts.get("miscalibrated") or not (texts or _is_worth_saying(learned)):
        return ""
    used, rejected = counts.get("accepted", 0), counts.get("gated", 0)
    texts.append(f"{rejected / max(used + rejected, 1):.1%} of observations rejected")
    return ", ".join(texts)


def _is_worth_saying(learned: tuple[float, float, float] | None) -> bool:
    """Whether somebody should calibrate the robot because of these corrections."""
    if learned is None:
        return False
    *scales, bias_rad = learned
    is_off = any(abs(scale - 1.0) >= LEAST_SCALE for scale in scales)
    return is_off or abs(bias_rad) >= LEAST_BIAS_RAD


def learned_text(distance_scale: float, turn_scale: float, bearing_bias_deg: float) -> str:
    """`distance × 0.98, turn × 0.96, bearings -0.6°`: what a robot does to its readings."""
    turned = f"bearings {-bearing_bias_deg:+z.1f}°"
    return f"distance × {distance_scale:.2f}, turn × {turn_scale:.2f}, {turned}"


def misplaced_objects(counts: Mapping[str, int]) -> dict[str, str]:
    """The objects that a robot finds elsewhere, and elsewhere than what (docs/team_file.md): `on
    the map: 0.52 m from there, not used`."""
    texts = {}
    for name in (n.removeprefix(MISPLACED) for n in counts if n.startswith(MISPLACED)):
        distance_mm, moves = counts[MISPLACED + name], counts.get(MOVES + name, 0)
        rejected, facts = counts.get(REJECTED + name, 0), []
        if distance_mm > 1:
            facts.append(f"{distance_mm / 1000.0:.2f} m from there")
        if rejected:
            facts.append(f"rejected {rejected} times of late")
        if moves >= MOST_MOVES:
            facts.append(f"{moves} times: it moves, or two have this name; not used")
        elif not moves:
            facts.append("not used")
        elif distance_mm == 1:
            facts.append("looked for")
        texts[name] = f"{'before' if moves else 'on the map'}: {', '.join(facts)}"
    return texts


def distrust_reason(t: Judged) -> str:
    if t.reason != "clock":
        return t.reason
    return f"clock {-t.late_s:.2f} s ahead" if t.late_s < 0.0 else f"{t.late_s:.2f} s late"
