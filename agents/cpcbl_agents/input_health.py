"""What came on a robot's inputs: counted as it comes, judged once a second.

To note a message costs next to nothing: a counter, and a reference among the latest few. Causes are
looked for in those, by `input_problems`.
"""

from collections import Counter, deque
from collections.abc import Iterable
from statistics import median
from typing import NamedTuple, TypeVar

from cpcbl_agents.input_problems import Facts, InputWindow, implausible_inputs, input_problems
from cpcbl_agents.robot import Robot
from cpcbl_team.config import Team
from cpcbl_team.inputs import Odometry, SightingFault, Sightings
from cpcbl_transport import topics
from cpcbl_transport.messages import LARGEST_NUMBER, Frame, InputHealth, SensorInput

WINDOW = 10  # judgements, one a second: shares are those of the last so many
SETTLED_NS = 2_000_000_000  # what was on its way when the robot started is too late
IMPLAUSIBLE_EVERY = 10  # judgements: to look for what is implausible takes a third of a millisecond
NAMESAKE_JUDGEMENTS = 3  # the token of a process that died may stay for its lease
T = TypeVar("T")
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

    def take(self, message: SensorInput, now_ns: int) -> None:
        """A message was decoded and not refused."""
        self.arrived_ns, self.latest_ns = now_ns, message.stamp_ns
        self.messages += 1
        if isinstance(message, Sightings):
            self.decoded += len(message.sightings) or 1
        else:
            self.decoded += 1
            if isinstance(message, Odometry):
                self.distance_m += message.distance_m
                self.turn_rad += message.turn_rad
            elif isinstance(message, Frame):
                message = Frame(message.stamp_ns, b"")
        self.recent.append((now_ns, message))

    def refuse(self, reason: str, payload: bytes, now_ns: int) -> None:
        """A message was refused."""
        self.arrived_ns = now_ns
        self.messages += 1
        self.refused[reason] += 1
        self.recent_refused.append((now_ns, payload[:4096]))


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
        lengths = {"odometry": 100, "sightings": 100}  # of ten seconds at 10 Hz
        self.inputs = {name: Input(name, start_ns, lengths.get(name, 10)) for name in NAMES}
        self.by_key = {f"in/{robot}/{name}": entry for name, entry in self.inputs.items()}
        self._start_ns, self._history = start_ns, deque[_Totals](maxlen=WINDOW + 1)
        self._namesake_for = self._judgements = 0
        self._implausible: tuple[str, ...] = ()
        self.has_moved = False
        """Whether odometry said so, at a judgement."""
        detects = settings.sensing == "camera"
        self._of_sightings = "frame" if detects else "sightings"
        by_message = {
            "odometry": settings.odometry.moves,
            "frame": detects and not settings.camera.frames,
        }
        is_logged = settings.source == "mrclam"
        left, low, right, high = team.map.bounds()
        self._facts = Facts(
            robot,
            {},
            () if is_logged else tuple(name for name, due in by_message.items() if due),
            frozenset(team.map.landmarks) | frozenset(team.map.walls) | frozenset(team.robots),
            team.map.landmarks,
            settings.sensor.max_range_m,
            ((right - left) ** 2 + (high - low) ** 2) ** 0.5,
            max(1.0, speed),
        )

    def judge(
        self, robot: Robot, now_ns: int, namesake: bool
    ) -> tuple[tuple[InputHealth, ...], tuple[str, ...]]:
        """The health of each input that anything came on or is expected on, and the problems. To
        be called once a second. `namesake`: whether another process has this robot's name."""
        odometry = self.inputs["odometry"]
        self.has_moved |= abs(odometry.distance_m) > MOVED_M or abs(odometry.turn_rad) > TURNED_RAD
        totals = self._totals(robot, now_ns)
        if now_ns - self._start_ns >= SETTLED_NS:
            self._history.append(totals)
        before = self._history[0] if self._history else totals
        self._namesake_for = self._namesake_for + 1 if namesake else 0
        shown = [n for n in NAMES if self.inputs[n].messages or n in self._facts.expected]
        camera = robot.sensing.counts
        facts = self._facts._replace(
            windows={name: self._window(name, totals, before) for name in shown},
            namesake=self._namesake_for >= NAMESAKE_JUDGEMENTS,
            camera_lost=camera["camera_lost"] > camera["camera_back"],
        )
        health = tuple(self._health(name, totals, before) for name in shown)
        self._judgements += 1
        if self._judgements % IMPLAUSIBLE_EVERY == 0:
            self._implausible = implausible_inputs(facts)
        return health, (*input_problems(facts), *self._implausible)

    def _totals(self, robot: Robot, now_ns: int) -> _Totals:
        refused = {name: entry.refused.copy() for name, entry in self.inputs.items()}
        state = robot.filter.timeline.state.counts
        for (name, reason), number in robot.filter.refused.items():
            refused[name][reason] += number
        for reason in SightingFault:
            refused[self._of_sightings][reason] += state.get(reason, 0)
        for reason, number in robot.sensing.refused.items():
            name = "sightings" if reason == "seen_twice" else "frame"
            refused[name][reason] += number
        taken = {}
        for name, entry in self.inputs.items():
            later = refused[name].total() - entry.refused.total()
            taken[name] = max(0, entry.decoded - later)
        messages = {name: entry.messages for name, entry in self.inputs.items()}
        return _Totals(now_ns, taken, refused, messages)

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
