"""What may happen to a robot while it records: a replay is equal in all of these worlds."""

import json
import shutil
from contextlib import ExitStack
from pathlib import Path

import pytest
from msgspec.structs import replace
from support.buses import MS, SECOND, TeamOnBus, saw, standing, with_robot
from support.cameras import SIZE, jpeg, picture
from support.logs import write_log
from support.nodes import two_robots
from support.simulated import record_run

from cpcbl_agents.filtering import FilterAgent
from cpcbl_agents.flight_recorder.entries import Detected, FrameTaken, Polled
from cpcbl_agents.load import first
from cpcbl_agents.node import Node, NodeStart
from cpcbl_agents.process import tape_for
from cpcbl_agents.robot import Robot, build_robot
from cpcbl_agents.tape import Tape
from cpcbl_launch.recordings.read import read_run
from cpcbl_launch.recordings.replay import Replay, Replayed, replay_run
from cpcbl_launch.run.logged_team import load_logged_team
from cpcbl_launch.simulation.in_process import robot_nodes, run_nodes
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import CameraSettings, RecordingSettings, Team
from cpcbl_team.inputs import Input, Sighting
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Frame

IN_ODOMETRY = topics.IN_ODOMETRY.at(robot="me")


def only_me(record: Path) -> TeamOnBus:
    """The robot `me`, which records; somebody watches its tracks and status."""
    stand = TeamOnBus(two_robots(), here=["me"], record=record)
    for topic in (topics.TRACK, topics.STATUS):
        stand.ear(topic.at(robot="me"))
    return stand


def replayed(stand: TeamOnBus, folder: Path) -> Replayed:
    """What a replay of the one robot finds."""
    stand.recorders.close()
    (result,) = replay_run(read_run(folder)).processes
    assert result.damage == ()
    return result


def test_a_flood_that_no_step_can_handle(tmp_path: Path) -> None:
    """How much a step took is an input: in the run itself a clock decided."""
    stand = only_me(tmp_path)
    node = stand.nodes["me"]
    for step in range(30):
        before_ns, stand.now_ns = stand.now_ns, stand.now_ns + 100 * MS
        for number in range(40):
            odd = saw(stand.now_ns - number * MS, Sighting("oak", 4.0, 0.01 + 1e-5 * number))
            stand.sightings("me", odd)
        stand.odometry("me", standing(stand.now_ns, before_ns))
        node.step(stand.now_ns, first(5 + 7 * step % 20))
    assert node.arrivals.waiting_messages > 100
    result = replayed(stand, tmp_path)
    assert result.difference is None
    assert result.steps == 31
    assert result.messages > 25


def test_inputs_that_are_refused_come_as_json_or_of_strangers(tmp_path: Path) -> None:
    stand = only_me(tmp_path)
    for number in range(12):
        before_ns = stand.now_ns
        stand.put(IN_ODOMETRY, b"\x01garbage" * number)
        as_json = {"from_ns": before_ns, "stamp_ns": before_ns + 50 * MS, "distance_m": number}
        stand.put(IN_ODOMETRY, json.dumps(as_json).encode())
        stand.put(IN_ODOMETRY, b"{")
        stand.put(topics.FIX.at(robot="me", tier=0, observer=f"ghost{number}"), b"?" * 32)
        stand.announce("mate", number % 3).close()
        stand.bus.declare_token(topics.ALIVE.at(tier=0, robot="me", incarnation="2")).close()
        stand.stand_still(0.5)
    counts = stand.status("me").counts
    assert counts["same_name_twice"] == 12
    assert replayed(stand, tmp_path).difference is None


def test_a_robot_that_was_restarted_and_one_that_starts_late(tmp_path: Path) -> None:
    """It does not take the start of its team file, and does not know what it spent."""
    team = two_robots()
    without = replace(team.robots["me"], start=None)
    moved = replace(team, robots={**team.robots, "me": without})
    start, hub = NodeStart(3 * SECOND, "7", 2.0), MemoryHub()
    hub.session().subscribe(topics.TRACK.at(), lambda key, payload: None)
    robot = build_robot("me", moved, 2 * SECOND, restarted=True)
    with tape_for(robot, team, start, tmp_path) as tape:
        node = Node(robot, team, hub.session(), start, tape=tape)
        for step in range(30):
            node.step(3 * SECOND + step * 100 * MS)
    run = read_run(tmp_path)
    header = run.processes["me"][0].header
    assert (header.is_pose_given, header.restarted, header.speed) == (False, True, 2.0)
    result = replay_run(run)
    assert result.is_equal
    assert result.processes[0].messages > 20


@pytest.mark.thorough
def test_a_team_that_agrees_on_a_frame(tmp_path: Path) -> None:
    """From its start, and from a state in the midst of it: candidates are part of it."""
    record_run(tmp_path, load_team(builtin_path("unmapped")), 1, 6.0)
    run, begun, candidates = read_run(tmp_path), set[str](), 0
    assert replay_run(run).is_equal
    for process in run.processes_of(()):
        for until_s in (0.6, 1.7, 3.0):
            part, whole = Replay(process, until_s=until_s), Replay(process)
            part.run()
            rest = Replay(process, state=part.state)
            assert part.node is not None
            frames = part.node.robot.filter._frames
            assert frames is not None
            candidates += len(frames.candidates)
            begun.add(frames.frame)
            rest.run()
            whole.run()
            assert part.difference is rest.difference is whole.difference is None
            assert part.result.messages + rest.result.messages == whole.result.messages
    assert len(begun) == 3
    assert candidates >= 2


def test_a_team_that_replays_logs_needs_them_no_more(tmp_path: Path) -> None:
    log, folder = write_log(tmp_path / "log", seconds=3.0), tmp_path / "run"
    logged = load_logged_team(load_team(builtin_path("mrclam")), log.folder)
    team = replace(logged.team, recording=RecordingSettings(folder=str(folder)))
    hub = MemoryHub()
    hub.session().subscribe("track/*", lambda key, payload: None)
    with ExitStack() as stack:

        def record(robot: Robot, team: Team, start: NodeStart) -> Tape:
            return stack.enter_context(tape_for(robot, team, start, None))

        nodes = robot_nodes(team, hub, logged.start_ns, tape_for=record)
        run_nodes(nodes, logged.start_ns, logged.end_ns)
    shutil.rmtree(log.folder)
    run = read_run(folder)
    result = replay_run(run)
    assert result.is_equal
    assert [p.robot for p in result.processes] == ["1", "2"]
    assert all(p.messages > 20 for p in result.processes)
    steps = run.processes["1"][0].steps()
    assert any(isinstance(e, Polled) and e.payloads for step in steps for e in step.entries)


def test_an_exception_of_a_robot_is_had_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The step that it ended is in the recording; a mended program gets beyond it."""
    stand = only_me(tmp_path)
    stand.stand_still(1.0)
    with monkeypatch.context() as broken:
        broken.setattr("cpcbl_agents.filtering.FilterAgent._add", _raise_after_a_second)
        with pytest.raises(ZeroDivisionError):
            stand.stand_still(0.2)
        result = replayed(stand, tmp_path)
        assert result.difference is None
        assert result.exception.startswith("ZeroDivisionError: a bug (test_recorded_worlds.py:")
    mended = replay_run(read_run(tmp_path)).processes[0]
    assert mended.difference is not None
    assert mended.difference.step == result.steps - 1
    assert mended.exception == ""


def test_a_program_that_raises_where_it_did_not_differs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand = only_me(tmp_path)
    stand.stand_still(1.0)
    stand.recorders.close()
    monkeypatch.setattr("cpcbl_agents.filtering.FilterAgent._add", _raise)
    (result,) = replay_run(read_run(tmp_path)).processes
    assert result.difference is not None
    assert result.difference.what == "an exception"
    assert result.difference.after.startswith(f"the message {IN_ODOMETRY} ")
    assert result.difference.new.startswith("ZeroDivisionError: a bug")


def _raise(*given: object) -> bool:
    raise ZeroDivisionError("a bug")


_add = FilterAgent._add


def _raise_after_a_second(agent: FilterAgent, item: Input) -> bool:
    return _add(agent, item) if item.stamp_ns <= SECOND else _raise()


def test_a_recorder_that_ended_is_said_in_the_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cpcbl_agents.flight_recorder.segments.LARGEST_BACKLOG", 20_000)
    monkeypatch.setattr("cpcbl_agents.flight_recorder.segments.WRITE_S", 1000.0)
    stand = only_me(tmp_path)
    stand.stand_still(8.0)
    said = [p for p in stand.status("me").problems if "recorded" in p]
    assert said == [f"no longer recorded: the disk is too slow ({tmp_path / 'me'})"]
    assert replayed(stand, tmp_path).difference is None


@pytest.mark.parametrize("keeps_images", [False, True])
def test_frames_of_a_driver_are_kept_only_where_that_is_asked_for(
    tmp_path: Path, keeps_images: bool
) -> None:
    """They are not needed: what was found in them is in the recording."""
    camera = CameraSettings(width_px=SIZE[0], height_px=SIZE[1], fx_px=50.0, fy_px=50.0)
    team = with_robot(two_robots(), "me", sensing="camera", camera=camera)
    team = replace(team, recording=RecordingSettings(images=keeps_images))
    stand = TeamOnBus(team, here=["me"], record=tmp_path)
    looked = stand.ear(topics.LOOK.at(robot="me"))
    for number in range(10):
        stand.stand_still(0.2)
        image = jpeg(picture(number)) if number != 5 else b"no picture"
        stand.put(topics.IN_FRAME.at(robot="me"), Frame(stand.now_ns, image))
        stand.step()
    assert len(looked.samples) > 2
    assert replayed(stand, tmp_path).difference is None
    process = read_run(tmp_path).processes["me"][0]
    found = [e for step in process.steps() for e in step.entries]
    frames = [e for e in found if isinstance(e, FrameTaken)]
    assert len(frames) == 10
    assert (max(len(frame.payload) for frame in frames) > 100) is keeps_images
    assert sum(isinstance(e, Detected) for e in found) == 10


@pytest.mark.long
def test_cameras_that_look_and_are_looked_at(tmp_path: Path) -> None:
    """Images are not kept, and not needed."""
    team = load_team(builtin_path("eyes"))
    robots = {name: team.robots[name] for name in ("spotter", "rover1")}
    record_run(tmp_path, replace(team, robots=robots), 1, 1.3)
    run = read_run(tmp_path)
    result = replay_run(run)
    assert result.is_equal
    assert sum(p.path.stat().st_size for of in run.processes.values() for p in of[0].segments) < 1e5
    process = run.processes["spotter"][0]
    part = Replay(process, until_s=0.6)
    part.run()
    rest = Replay(process, state=part.state)
    rest.run()
    assert rest.difference is None
    assert rest.result.steps > 5
