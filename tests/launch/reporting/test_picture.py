"""Pictures of runs: what is drawn of a run with or without truth, and of unusual ones."""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import pytest
from support.buses import SECOND

pytest.importorskip("matplotlib")

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from cpcbl_launch.reporting.activity import ActivityLog
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.paths import MOST_POINTS, places, robot_path, thin
from cpcbl_launch.reporting.picture import MOST_STRIPS, Times, run_figure
from cpcbl_launch.reporting.picture_field import visible_box
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_team.config import Team
from cpcbl_team.config.field import Field, Landmark
from cpcbl_team.config.team import RobotSettings
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Status, Track, encode

BEGIN_S = 1_790_000_000
DURATION_S = 20.0
LANDMARKS = {"a": Landmark(x_m=0.0, y_m=0.0), "b": Landmark(x_m=6.0, y_m=4.0)}


def team(robots: int = 1, landmarks: Mapping[str, Landmark] = LANDMARKS) -> Team:
    names = [f"r{i + 1}" for i in range(robots)]
    settings = RobotSettings(source="external")
    return Team(
        name="real", map=Field(landmarks=dict(landmarks)), robots=dict.fromkeys(names, settings)
    )


def status(robot: str, stamp_ns: int, used: int, received: int = 0, process: str = "0") -> Status:
    counts = {"accepted": used, "gated": used // 10, "too_late": used // 5}
    return Status(robot, process, stamp_ns, 0.1, 0.1, 3, "", counts, 0, 0, received, 0)


class Drive(NamedTuple):
    """How a robot drives along x, by the time since the start."""

    lost: Callable[[float], str] = lambda _: ""
    sigma_m: float | None = 0.1
    from_s: float = 0.0
    until_s: float = DURATION_S
    jump_s: float = 0.0  # of the stamps, from half time on
    speed_m_s: float = 0.2


class World:
    """A recorder of what is said to have happened."""

    def __init__(self, **drives: Drive) -> None:
        hub = MemoryHub()
        self.recorder, bus = Recorder(hub.session()), hub.session()
        for name, drive in drives.items():
            tracks = bus.publisher(topics.TRACK.at(robot=name), topics.TRACK.qos)
            statuses = bus.publisher(topics.STATUS.at(robot=name), topics.STATUS.qos)
            for tenth in range(round(10 * drive.from_s), round(10 * drive.until_s)):
                at_s = 0.1 * tenth
                jump_ns = round(drive.jump_s * 1e9) if at_s > 0.5 * drive.until_s else 0
                stamp_ns = BEGIN_S * SECOND + tenth * SECOND // 10 + jump_ns
                tracks.put(encode(_track(name, stamp_ns, at_s, drive)))
                if tenth % 10 == 9:
                    statuses.put(encode(status(name, stamp_ns, 10 * tenth, tenth)))

    def figure(
        self,
        team: Team,
        truth: Mapping[str, Floats] | None = None,
        guests_s: Mapping[str, list[tuple[float, float]]] | None = None,
        duration_s: float = DURATION_S,
    ) -> Figure:
        """Laid out and drawn, so that what only drawing shows is shown."""
        times = Times(BEGIN_S, duration_s, None, guests_s or {})
        figure = run_figure(self.recorder, team, truth or {}, times)
        figure.draw_without_rendering()
        return figure


def _track(name: str, stamp_ns: int, at_s: float, drive: Drive) -> Track:
    var = None if drive.sigma_m is None else drive.sigma_m**2
    covariance = None if var is None else (var, 0.0, var, 0.0, 0.0, 0.01)
    x_m = 1.0 + drive.speed_m_s * at_s
    return Track(name, stamp_ns, x_m, 2.0, 0.0, covariance, 3, drive.lost(at_s))


def truth_at_rest() -> Floats:
    return np.array([(BEGIN_S + 0.1 * i, 1.0, 2.0, 0.0) for i in range(201)])


def texts(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(Text))


def drawn(axes: Axes) -> int:
    """Points of lines that are inside of what the axes show."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    count = 0
    for line in axes.lines:
        x, y = (np.asarray(data, dtype=np.float64) for data in line.get_data())
        if line.get_transform() == axes.transData:
            count += int(((x >= left) & (x <= right) & (y >= low) & (y <= high)).sum())
    return count


def test_a_run_without_truth_is_drawn() -> None:
    figure = World(r1=Drive(), r2=Drive(lost=lambda t: "no_input" if t > 10 else "")).figure(
        team(2)
    )
    field, used, received, first, second = figure.axes
    assert drawn(field) > 400
    assert drawn(first) > 190
    assert drawn(second) > 190
    assert drawn(used) > 40
    assert drawn(received) > 20
    said = texts(figure)
    assert "true poses are not known" in said
    assert "lost 49.5%: no_input" in said
    assert "σ of the position" in said
    assert "position error" not in said


def test_with_truth_errors_are_drawn_within_three_sigma() -> None:
    figure = World(r1=Drive()).figure(team(), {"r1": truth_at_rest()})
    (line,) = figure.axes[3].lines
    assert np.nanmax(line.get_ydata()) == pytest.approx(0.2 * 19.9)
    assert "RMSE 2.3 m" in texts(figure)
    assert "true poses" not in texts(figure)


def test_start_and_end_are_marked() -> None:
    field = World(r1=Drive()).figure(team(1, {})).axes[0]
    marks = {str(line.get_marker()): line.get_xydata() for line in field.lines}
    assert marks["o"] == pytest.approx(np.array([(1.0, 2.0)]))
    assert marks["(3, 0, -90.0)"] == pytest.approx(np.array([(1.0 + 0.2 * 19.9, 2.0)]))


def test_who_was_not_heard_is_named() -> None:
    figure = World(r2=Drive(sigma_m=None)).figure(team(2))
    assert "Nothing was heard of r1." in texts(figure)
    assert "No σ is stated by r2." in texts(figure)


def test_nobody_at_all_is_drawn_too() -> None:
    assert "Nothing was heard of r1, r2." in texts(World().figure(team(2, {})))


def test_stamps_out_of_the_run_do_not_stretch_time() -> None:
    figure = World(r1=Drive(jump_s=1e8), r2=Drive(jump_s=-1e9)).figure(team(2))
    assert figure.axes[3].get_xlim() == (0.0, DURATION_S)
    assert "r1: 99 estimates have stamps outside of the run." in texts(figure)


def test_a_robot_that_is_lost_far_away_does_not_shrink_the_field() -> None:
    world = World(r1=Drive(), r2=Drive(lost=lambda _: "unknown start", speed_m_s=1e4))
    figure = world.figure(team(2))
    left, right = figure.axes[0].get_xlim()
    assert right - left < 15.0
    assert "r2: 99." in texts(figure)
    assert "outside of the field shown" in texts(figure)


def test_of_many_robots_the_worst_have_a_strip() -> None:
    drives = {f"r{i + 1}": Drive() for i in range(24)}
    drives["r13"] = Drive(lost=lambda t: "inconsistent" if t > 15 else "")
    drives["r14"] = Drive(sigma_m=0.5)
    figure = World(**drives).figure(team(24))
    assert len(figure.axes) == 3 + MOST_STRIPS
    said = [axes.texts[0].get_text() for axes in figure.axes[3:]]
    assert said[:2] == ["r13", "r14"]
    assert said[-1] == "all 24 robots"


def test_a_guest_is_drawn_while_it_is_there() -> None:
    world = World(r1=Drive(), tripod=Drive(from_s=5.0, until_s=12.0))
    figure = world.figure(team(), guests_s={"tripod": [(5.0, 12.0)]})
    said = texts(figure)
    assert "1 robot and a guest" in said
    assert "tripod joins" in said
    assert "tripod leaves" in said
    assert "nothing heard" in said


def test_a_run_of_two_seconds_has_its_points() -> None:
    figure = World(r1=Drive(until_s=2.0)).figure(team(), duration_s=2.0)
    assert all(drawn(axes) for axes in figure.axes[:4])


def test_a_long_line_keeps_its_peak_and_its_gap() -> None:
    times_s = np.concatenate([np.arange(0.0, 3000.0, 0.1), np.arange(4000.0, 7200.0, 0.1)])
    values = np.ones(len(times_s))
    values[12_345] = 9.0
    at_s, largest = thin(times_s, values)
    assert len(at_s) <= MOST_POINTS + 1
    assert np.nanmax(largest) == 9.0
    assert np.isnan(largest).sum() == 1


def test_a_map_does_not_join_what_a_silence_divides() -> None:
    world = World(r1=Drive(until_s=5.0))
    path = robot_path(world.recorder, "r1", None, BEGIN_S, DURATION_S)
    late = path._replace(times_s=np.where(path.times_s > 2.0, path.times_s + 9.0, path.times_s))
    assert np.isnan(places(late, ~late.is_lost)).any(axis=1).sum() == 1


def test_a_covariance_that_is_none_has_a_sigma_of_zero() -> None:
    world = World(r1=Drive())
    path = robot_path(world.recorder, "r1", None, BEGIN_S, DURATION_S)
    path.covariance[:] = -1.0
    assert path.sigma_m.max() == 0.0
    assert all(map(math.isfinite, visible_box(team(1, {}), [path])))


def test_rates_are_those_of_one_process() -> None:
    log = ActivityLog()
    for second, used, process in ((1, 10, "a"), (2, 40, "a"), (3, 10, "b"), (4, 30, "b")):
        log.add(status("r1", (BEGIN_S + second) * SECOND, used, 2 * used, process))
    rates = log.rates(BEGIN_S)
    assert rates.times_s == pytest.approx([0.5, 1.5, 3.5])
    assert rates.used == pytest.approx([10.0, 30.0, 20.0])
    assert rates.help == pytest.approx([20.0, 60.0, 40.0])
    assert rates.rejected == pytest.approx([1.0, 3.0, 2.0])
    assert rates.refused == pytest.approx([2.0, 6.0, 4.0])


def test_a_robot_that_ran_before_has_no_rate_from_zero() -> None:
    log = ActivityLog()
    log.add(status("r1", (BEGIN_S + 100) * SECOND, 10_000))
    assert not len(log.rates(BEGIN_S).used)
