"""Where robots record: by options, the team file, in containers; what is wrong gets one line."""

from pathlib import Path

import pytest
import yaml
from msgspec.structs import replace
from support.processes import command_line

from cpcbl_agents.flight_recorder import header_of
from cpcbl_agents.node import NodeStart
from cpcbl_agents.robot import build_robot
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_launch.reporting.recording import Recording
from cpcbl_launch.run.containers.compose import Deployment, Mount, compose_text
from cpcbl_launch.run.processes import tasks
from cpcbl_launch.run.up import Run
from cpcbl_launch.team.file import builtin_path, decode_resolved, load_team, parse_team
from cpcbl_team.errors import InputError
from cpcbl_transport.memory_bus import MemoryHub

DEMO = load_team(builtin_path("demo"))
TEAM = 'name = "lab"\n[robots.r1]\nsource = "external"\n'


def test_a_file_is_a_file_and_anything_else_a_folder() -> None:
    assert Run(DEMO, None, record=Path("run.mcap")).record_folder is None
    assert Run(DEMO, None, record=Path("run")).record_folder == Path("run")
    assert Run(DEMO, None).record_folder is None
    rows = tasks(DEMO, "team.json", (), 1, ["scout"], "run")
    assert [row.arguments[-2:] == ("--record", "run") for row in rows] == [False, True]


def test_a_folder_of_the_team_file_is_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "team.toml"
    path.write_text(TEAM + '[recording]\nfolder = "runs"\nkeep_bytes = 1000000\n')
    assert load_team(path).recording.folder == str(tmp_path / "runs")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("folders = 1", "recording.folders"),
        ("segment_bytes = 1", "recording.segment_bytes"),
        ("segment_s = 0.0", "recording.segment_s"),
        ("keep_bytes = -1", "recording.keep_bytes"),
        ('images = "no"', "recording.images"),
    ],
)
def test_wrong_keys_and_values_get_one_line(line: str, said: str) -> None:
    with pytest.raises(InputError, match=said) as caught:
        parse_team(TEAM + f"[recording]\n{line}\n")
    assert "\n" not in str(caught.value)


def test_a_run_does_not_get_into_another_one(tmp_path: Path) -> None:
    (tmp_path / "bus.mcap").write_bytes(b"")
    ended = command_line("simulate", "demo", "--duration", "1", "--record", tmp_path)
    assert ended.returncode == 2
    assert ended.stderr == (
        f"cpcbl-team: --record {tmp_path}: holds a run already; name another folder\n"
    )


def test_in_containers_robots_alone_may_write_into_the_folder() -> None:
    record = Mount("/home/me/run", "/team/recording", is_writable=True)
    how = Deployment("demo", "cpcbl-team:1", record=record, user="1000:1000")
    text = compose_text(DEMO, how)
    assert "# whose the folder of recordings is" in text
    services = yaml.safe_load(text)["services"]
    for name, service in services.items():
        assert service["user"] == "1000:1000"
        volumes = service.get("volumes", [])
        is_robot = name.startswith("robot-")
        assert [v["target"] for v in volumes if not v["read_only"]] == (
            ["/team/recording"] if is_robot else []
        )
        assert (service["command"][-2:] == ["--record", "/team/recording"]) is is_robot


def test_replay_says_in_one_line_what_it_cannot_use(tmp_path: Path) -> None:
    for words in (
        ("replay", tmp_path),
        ("replay", tmp_path / "none"),
        ("replay", tmp_path, "--speed", "0"),
        ("replay", tmp_path, "--from", tmp_path / "no.state"),
    ):
        ended = command_line(*words)
        assert ended.returncode == 2
        assert ended.stderr.startswith("cpcbl-team: ")
        assert ended.stderr.count("\n") == 1


def test_no_recording_has_the_password_of_a_camera(tmp_path: Path) -> None:
    team, url = load_team(builtin_path("eyes")), "rtsp://me:secret@10.0.0.7/stream"
    camera = replace(team.robots["rover1"].camera, frames=url)
    rover = replace(team.robots["rover1"], source="external", camera=camera)
    team = replace(team, robots={**team.robots, "rover1": rover})
    header = header_of(build_robot("rover1", team, 0), team, NodeStart(0, "1"))
    with Recording(tmp_path / "run.mcap", team, MemoryHub().session()):
        pass
    recorded = read_recording(tmp_path / "run.mcap").team
    for found in (recorded, decode_resolved(header.team, "team")):
        assert found.robots["rover1"].camera.frames == "rtsp://10.0.0.7/stream"
