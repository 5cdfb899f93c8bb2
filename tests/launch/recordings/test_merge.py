"""One file of a run: all that is in its parts, once, and what other programs show of it."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry as UncertainPose
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from msgspec.structs import replace
from support.simulated import ScheduledGuest, record_run, simulate_recorded

from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.commands.measuring import evaluate
from cpcbl_launch.recordings.gather import gather
from cpcbl_launch.recordings.merge import indexed_recording, merge
from cpcbl_launch.recordings.read import BUS
from cpcbl_launch.recordings.summary import summarize
from cpcbl_launch.reporting.metrics import ellipse_of
from cpcbl_launch.reporting.recorded_file import RecordedFile, read_recording
from cpcbl_launch.reporting.recording import Recording
from cpcbl_launch.run.observer import ObserverPose, ObserverRequest, team_with_observer
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Fix
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Status, Track

DEMO = load_team(builtin_path("demo"))
SECONDS = 3.0


def messages(path: Path) -> list[tuple[str, Any]]:
    return [(key, message) for _, key, message in RecordedFile(path).messages()]


def protobufs(path: Path, topic: str, kind: Any) -> list[Any]:
    with path.open("rb") as file:
        found = list(make_reader(file).iter_messages(topics=[topic]))
    return [kind.FromString(message.data) for _, _, message in found]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of the demo, with a guest."""
    folder = tmp_path_factory.mktemp("run")
    request = ObserverRequest("A.b_c-9", ObserverPose(4.5, 6.0, -90.0))
    settings = team_with_observer(DEMO, request).robots["A.b_c-9"]
    guest = ScheduledGuest("A.b_c-9", settings, 0.5, 2.9)
    record_run(folder, DEMO, 1, SECONDS, [guest], with_bus=True)
    return folder


def test_a_merged_recording_says_the_same(tmp_path: Path) -> None:
    recorded = tmp_path / "demo.mcap"
    simulate_recorded(DEMO, 1, SECONDS, recorded)
    merged = Path(merge(recorded).file)
    assert messages(merged) == messages(recorded)
    assert RecordedFile(merged).team == DEMO
    assert RecordedFile(merged).version
    before, after = read_recording(recorded), read_recording(merged)
    assert after.inputs == before.inputs
    assert after.truth.keys() == before.truth.keys()


def test_each_message_of_a_run_is_taken_once(run: Path) -> None:
    """The bus heard what the robots wrote down, too; fixes are in two robots' files alone."""
    heard = Counter(key for key, _ in messages(run / BUS))
    found = Counter(key for _, key, _ in gather(run).messages)
    assert {key: found[key] for key in heard} == heard
    fixes = {key: n for key, n in found.items() if key.startswith("fix/")}
    last: dict[str, Status] = {}
    for _, _, message in gather(run).messages:
        if isinstance(message, Status):
            last[message.robot] = message
    sent = sum(f.messages for s in last.values() for f in s.sent if f.topic == "fix")
    assert 0 < sent <= sum(fixes.values()) <= sent + 40  # of the second after the last status


def test_a_run_without_a_recording_of_the_bus_has_the_robots_own(run: Path, tmp_path: Path) -> None:
    """As when the launcher was killed on another machine: nobody wrote down the truth."""
    alone = tmp_path / "alone"
    for path in run.glob("*/*.cpcbl"):
        (alone / path.parent.name).mkdir(parents=True)
        (alone / path.parent.name / path.name).write_bytes(path.read_bytes())
    kinds = Counter(type(message) for _, _, message in gather(alone).messages)
    assert kinds[Track] > 100
    assert kinds[Fix] > 30
    assert not summarize(alone).truth


def test_what_was_cut_off_is_read_up_to_there(run: Path, tmp_path: Path) -> None:
    whole = (run / BUS).read_bytes()
    (tmp_path / BUS).write_bytes(whole[: len(whole) // 2])
    found = gather(tmp_path)
    assert found.remarks == [f"{tmp_path / BUS}: its last seconds are missing"]
    assert merge(tmp_path).remarks == tuple(found.remarks)


def test_poses_have_their_covariances_and_ellipses(run: Path, tmp_path: Path) -> None:
    merged = tmp_path / "run.mcap"
    report = merge(run, merged)
    assert report.shown["foxglove.Odometry"] == report.messages["track"]
    tracks = [m for key, m in messages(merged) if key == "track/scout"]
    poses = protobufs(merged, "/robots/scout/odometry", UncertainPose)
    assert len(poses) == len(tracks)
    for track, pose in zip(tracks, poses, strict=True):
        xx, xy, yy, xh, yh, hh = track.covariance
        rows = pose.pose_covariance
        assert (rows[0], rows[1], rows[7], rows[5], rows[11], rows[35]) == (xx, xy, yy, xh, yh, hh)
        assert (pose.pose.position.x, pose.pose.position.y) == (track.x_m, track.y_m)
    scene = protobufs(merged, "/robots/scout/scene", SceneUpdate)[0].entities[0]
    major, minor, _ = ellipse_of(*tracks[0].covariance[:3])
    size = scene.cylinders[0].size
    assert (size.x, size.y) == pytest.approx((6.0 * major, 6.0 * minor))
    names = [entity.id for entity in protobufs(merged, "/map", SceneUpdate)[0].entities]
    assert names == [f"landmark/{name}" for name in DEMO.map.landmarks]
    helps = protobufs(merged, "/help", SceneUpdate)
    assert any("A.b_c-9 helps scout by fix" in e.id for update in helps for e in update.entities)


def test_a_variant_without_covariance_has_no_ellipse(tmp_path: Path) -> None:
    localizer = replace(DEMO.robots["scout"].localizer, variant="weighted")
    robots = {**DEMO.robots, "scout": replace(DEMO.robots["scout"], localizer=localizer)}
    simulate_recorded(replace(DEMO, robots=robots), 1, 2.0, tmp_path / "run.mcap")
    merged = Path(merge(tmp_path / "run.mcap").file)
    scout = protobufs(merged, "/robots/scout/odometry", UncertainPose)
    assert scout
    assert not any(pose.pose_covariance for pose in scout)
    scenes = protobufs(merged, "/robots/scout/scene", SceneUpdate)
    assert scenes
    assert not any(scene.entities[0].cylinders for scene in scenes)


def empty_bus(folder: Path) -> None:
    with Recording(folder / BUS, DEMO, MemoryHub().session()):
        pass


def no_team(folder: Path) -> None:
    (folder / BUS).write_bytes(b"\x89MCAP0\r\n")


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (no_team, "holds no team"),
        (lambda folder: (folder / BUS).write_bytes(b"nothing"), "not a whole recording"),
        (lambda folder: None, "holds no recording of a robot"),
    ],
    ids=["no team", "no recording", "an empty folder"],
)
def test_what_is_no_run_is_one_line(
    make: Callable[[Path], object], said: str, tmp_path: Path
) -> None:
    make(tmp_path)
    with pytest.raises(LogError, match=said) as raised:
        merge(tmp_path)
    assert "\n" not in str(raised.value)
    assert not list(tmp_path.glob(".*"))


def test_an_empty_run_is_merged_and_has_nothing(tmp_path: Path) -> None:
    empty_bus(tmp_path)
    assert merge(tmp_path).messages == {}
    assert summarize(tmp_path).duration_s == 0.0


def test_a_file_that_is_older_than_its_parts_is_not_used(run: Path) -> None:
    made = Path(merge(run).file)
    with indexed_recording(run) as used:
        assert used.path == made
    (run / BUS).touch()
    with indexed_recording(run) as used:
        assert used.path != made
        assert used.is_whole
    made.unlink()


def test_evaluate_scores_what_was_recorded(tmp_path: Path) -> None:
    path = tmp_path / "demo.mcap"
    report, _ = simulate_recorded(DEMO, 1, SECONDS, path)
    scored = summarize(Path(merge(path).file)).report
    for name, robot in report.robots.items():
        assert scored.robots[name].position_rmse_m == pytest.approx(robot.position_rmse_m)
        assert scored.robots[name].nees == pytest.approx(robot.nees)
        assert scored.robots[name].sent == robot.sent
    assert scored.team.within_budget == report.team.within_budget


def test_without_truth_evaluate_says_so(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    alone = tmp_path / "alone" / "scout"
    alone.mkdir(parents=True)
    (part,) = (run / "scout").glob("*.cpcbl")
    (alone / part.name).write_bytes(part.read_bytes())
    evaluate([tmp_path / "alone"])
    assert "holds no true poses, so errors are not known" in capsys.readouterr().err
    with pytest.raises(InputError, match="is scored as it was"):
        evaluate([tmp_path / "alone"], blind="scout")
    with pytest.raises(InputError, match="no recorded run"):
        evaluate([tmp_path / "nothing"])
