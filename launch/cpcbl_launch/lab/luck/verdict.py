"""What must hold of a whole history: claims, consistency, and that nobody waits for ever."""

import math
from collections.abc import Iterator

import numpy as np

from cpcbl_launch.lab.chaos.consistency import Consistency, consistency
from cpcbl_launch.lab.chaos.history import honest, longest_false_claim_s
from cpcbl_launch.lab.chaos.run_log import TRACKS_HZ, RunLog
from cpcbl_launch.lab.luck.history import Event, History, Kind
from cpcbl_launch.lab.luck.processes import RESTART_S
from cpcbl_launch.lab.luck.spending import budget_windows
from cpcbl_launch.lab.luck.teams import is_blind
from cpcbl_launch.lab.luck.violations import Violation
from cpcbl_launch.reporting import metrics
from cpcbl_launch.reporting.metrics import Samples
from cpcbl_team.config import Team
from cpcbl_transport.messages import Trust

BACK_S = 12.0  # after the last event all robots are localized again,
HELP_S = 15.0  # are helped again where they were before,
TRUST_S = 20.0  # and trust each other,
ENOUGH_REPORTS = 30  # if a teammate in quarantine reported so often in this time
GAP_S = 0.4  # between two tracks, beside the time between two pieces of odometry
FALSE_S, FALSE_M = 4.0, 0.5
SETTLING_S = 10.0  # after an event of which no robot can know, its team is not judged
FRAMES = 20  # of the slowest camera of a team, in which robots settle and are localized again
NOTICED = 13  # measurements after which a robot that was carried away can know it (docs/luck.md)
LEAST_S = 8.0  # of tracks, for a judgement
UNKNOWABLE: tuple[Kind, ...] = ("liar", "clock-step", "kidnap", "odd-sightings", "lost-inputs")
"""What makes a robot's inputs or its help wrong in a way that its models do not have."""


def violations(log: RunLog, history: History, team: Team) -> Iterator[Violation]:
    """What did not hold."""
    yield from _waiting(log, history, team)
    judged = without_unknowable(log, history, team)
    trusted = honest(judged)
    for name in history.robots:
        false_s = longest_false_claim_s(judged, name, FALSE_M)
        if false_s > FALSE_S:
            what = f"it was wrong by 5 sigma for {false_s:.1f} s and did not say so"
            yield Violation("lost honestly", name, history.duration_s, what)
        if found := consistency_of(trusted, name, tracks_hz(team, name)):
            if found.nees > found.nees_bound:
                what = f"NEES {found.nees:.2f}, at most {found.nees_bound:.2f}"
                yield Violation("consistent", name, history.duration_s, what)
            elif found.outside > found.outside_bound:
                what = f"{found.outside:.1%} outside 3 sigma, at most {found.outside_bound:.1%}"
                yield Violation("consistent", name, history.duration_s, what)


def _waiting(log: RunLog, history: History, team: Team) -> Iterator[Violation]:
    """Robots that do not step, are not localized, are not helped or not trusted in the quiet time
    at the end."""
    healed_s, end_s = history.healed_s, history.duration_s
    quiet_s = end_s - max(healed_s, _silent_until_s(history, team))
    back_s = max(BACK_S, frames_s(team))
    for name in history.robots:
        gap_s = log.longest_track_gap_s(name, healed_s + 2.0, end_s)
        if quiet_s > 3.0 and gap_s > GAP_S + 1.0 / tracks_hz(team, name):
            yield Violation("nobody waits", name, end_s, f"no track for {gap_s:.1f} s")
        carried = [e for e in history.of_kind("kidnap") if e.robot == name]
        known_s = max([healed_s, *(noticeable_s(log, e) for e in carried)])
        after_s = log.localized_after_s(name, known_s)
        if min(quiet_s, end_s - known_s) > back_s + 1.0 and (after_s is None or after_s > back_s):
            text = "never" if after_s is None else f"only {after_s:.1f} s after the last event"
            yield Violation("nobody waits", name, end_s, f"it was localized {text}")
        help_s = help_due_s(log, team, name, end_s)
        if quiet_s > help_s and _misses_help(log, name, end_s - help_s):
            yield Violation("nobody waits", name, end_s, f"no help for {help_s:g} s")
        if quiet_s > TRUST_S:
            for trust in quarantines(log, name, end_s):
                if trust.peer in history.robots:
                    what = f"{trust.peer} is in quarantine ({trust.reason})"
                    yield Violation("nobody waits", name, end_s, what)


def quarantines(log: RunLog, robot: str, end_s: float) -> list[Trust]:
    """The quarantines of a robot's teammates that should be over. Only what a teammate reports can
    end one: ten right reports, of which those of a belief that is not fresh are not tested."""
    statuses = log.statuses.get(robot, ())
    found = [t for t in statuses[-1][1].trust if t.reason] if statuses else []
    refused = log.counts_between(robot, end_s - TRUST_S)["distrusted"]
    enough = refused >= ENOUGH_REPORTS * sum(t.reason != "clock" for t in found)
    return [t for t in found if t.reason == "clock" or enough]


def _silent_until_s(history: History, team: Team) -> float:
    """Until when a restarted robot may have nothing to spend: it cannot know what it spent before,
    so a whole window of its budget has to pass (docs/routing.md)."""
    starts_s = [event.until_s + RESTART_S for event in history.of_kind("kill", "clock-step")]
    windows_s = [
        window.window_s
        for robot in team.robots.values()
        for window in budget_windows(robot.collaboration.budget)
    ]
    return max(starts_s) + max(windows_s) if starts_s and windows_s else 0.0


def _misses_help(log: RunLog, robot: str, from_s: float) -> bool:
    """Whether a robot that sees no landmark received no help since then."""
    return is_blind(robot) and log.counts_between(robot, from_s)["messages_received"] == 0


def help_due_s(log: RunLog, team: Team, robot: str, end_s: float) -> float:
    """After how long a blind robot should be helped again: where the budget of a teammate did not
    allow a fix for it lately, a window later, for what is spent comes back then (docs/routing.md).
    For a robot that is lost each budget has a reserve."""
    from_s, windows_s = end_s - HELP_S, [0.0]
    if any(s.lost for at_s, s in log.statuses.get(robot, ()) if at_s >= from_s):
        return HELP_S
    for name, settings in team.robots.items():
        if _over_budget(log, name, robot, end_s) > _over_budget(log, name, robot, from_s):
            windows_s += [w.window_s for w in budget_windows(settings.collaboration.budget)]
    return HELP_S + max(windows_s)


def _over_budget(log: RunLog, sender: str, receiver: str, until_s: float) -> int:
    """The fixes for one robot that the budget of another had not allowed by then."""
    statuses = [s for at_s, s in log.statuses.get(sender, ()) if at_s <= until_s]
    flows = statuses[-1].sent if statuses else ()
    return sum(f.over_budget for f in flows if f.peer == receiver)


def frames_s(team: Team) -> float:
    """The time of `FRAMES` frames of the slowest camera."""
    return FRAMES / min(robot.sensor.rate_hz for robot in team.robots.values())


def noticeable_s(log: RunLog, carried: Event) -> float:
    """From when a robot that is carried away can know it: when it has judged `NOTICED` measurements
    since; at once for other events. A camera that faces no landmark shows nothing, and budgets
    limit how often teammates report: both may take as long as the rest of the history."""
    if carried.kind != "kidnap":
        return carried.from_s
    total = before = 0
    for at_s, status in log.statuses.get(carried.robot, ()):
        now = status.counts.get("accepted", 0) + status.counts.get("gated", 0)
        if at_s >= carried.from_s + 1.0:
            total += now - before if now >= before else now  # less: a new process counts
        before = now
        if total >= NOTICED:
            return at_s
    return math.inf


def without_unknowable(log: RunLog, history: History, team: Team) -> RunLog:
    """The log without the tracks of times of which no robot can know that its inputs or its help
    are wrong."""
    settling_s = max(SETTLING_S, frames_s(team))
    step_s = 1.0 / team.simulation.step_rate_hz  # truth between two steps is no pose where it jumps
    spans = [
        (e.from_s - step_s, max(e.until_s + settling_s, noticeable_s(log, e)))
        for e in history.of_kind(*UNKNOWABLE)
    ]
    tracks = {
        name: [t for t in tracks if not any(a <= t.stamp_s < b for a, b in spans)]
        for name, tracks in log.tracks.items()
    }
    return log._replace(tracks=tracks, left_out=dict.fromkeys(tracks, spans))


def tracks_hz(team: Team, robot: str) -> float:
    """How often a robot sends a track: with each piece of odometry, but no more often than robots
    report; one that stands has none to wait for."""
    odometry = team.robots[robot].odometry
    return min(TRACKS_HZ, odometry.rate_hz) if odometry.moves else TRACKS_HZ


def consistency_of(log: RunLog, robot: str, rate_hz: float) -> Consistency | None:
    """How well the robot's stated uncertainty fits its errors; None where there is too little.
    `rate_hz`: of its tracks."""
    tracks = [t for t in log.tracks[robot] if t.track.covariance]
    if len(tracks) < LEAST_S * rate_hz:
        return None
    stamps_s = np.array([t.stamp_s for t in tracks])
    estimate = np.array([(t.track.x_m, t.track.y_m, t.track.heading_rad) for t in tracks])
    covariance = np.array([t.track.covariance for t in tracks])
    truth, known = metrics.interpolated_truth(stamps_s, log.truth[robot])
    samples = Samples(estimate[known], truth[known], covariance[known])
    return consistency(robot, samples, samples, rate_hz)
