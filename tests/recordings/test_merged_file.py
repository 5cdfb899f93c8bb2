"""Programs of others read a merged run: each message by its schema, and Rerun shows the poses."""

import json
import os
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from support.simulated import simulate_recorded

from cpcbl_launch.recordings.merge import MergedRun, merge
from cpcbl_launch.reporting.recorded_file import RecordedFile
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_transport.messages import Track

pytestmark = pytest.mark.recordings
HERE = Path(__file__).parent


def run_partner(script: str, *arguments: Path) -> Any:
    """What a script prints that runs with the Python of the partners."""
    python = Path(os.environ["CPCBL_PARTNERS"]).absolute() / "bin/python"
    home = arguments[0].parent  # Rerun writes its settings there
    ran = subprocess.run(
        [python, HERE / script, *arguments],
        env={**os.environ, "HOME": str(home), "PYTHONPATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout.splitlines()[-1])


def merged(name: str, seconds: float, folder: Path) -> MergedRun:
    recorded = folder / f"{name}.mcap"
    simulate_recorded(load_team(builtin_path(name)), 1, seconds, recorded)
    return merge(recorded, folder / "run.mcap")


@pytest.mark.parametrize(("name", "seconds"), [("demo", 20.0), ("eyes", 3.0)])
def test_another_reader_finds_each_message_as_its_schema_says(
    name: str, seconds: float, tmp_path: Path
) -> None:
    ours = merged(name, seconds, tmp_path)
    read = run_partner("reader_partner.py", Path(ours.file))
    foxglove = {k: n for k, n in read["schemas"].items() if k.startswith("foxglove.")}
    assert foxglove == ours.shown
    assert sum(read["schemas"].values()) == sum(ours.shown.values()) + sum(ours.messages.values())
    assert read["covariances"] == ours.messages["track"]
    assert read["profile"] == "cpcbl"
    if name == "eyes":
        assert foxglove["foxglove.CompressedImage"] > 0


@pytest.mark.parametrize(("name", "seconds"), [("demo", 20.0), ("eyes", 3.0)])
def test_rerun_converts_it_and_has_the_poses(name: str, seconds: float, tmp_path: Path) -> None:
    ours = merged(name, seconds, tmp_path)
    rows = run_partner("rerun_partner.py", Path(ours.file), tmp_path / "run.rrd")
    tracks = Counter(
        message.robot
        for _, _, message in RecordedFile(Path(ours.file)).messages()
        if isinstance(message, Track)
    )
    poses = {
        entity.split("/")[2]: found["InstancePoses3D:translations"]
        for entity, found in rows.items()
        if entity.startswith("/robots/") and entity.endswith("/pose")
    }
    assert poses == tracks
    truths = 4 * rows["/truth/poses"]["InstancePoses3D:translations"]
    assert rows["/tf"]["Transform3D:translation"] == sum(tracks.values()) + truths
    assert rows["/log"]["TextLog:text"] == ours.shown["foxglove.Log"]
    if name == "eyes":
        images = [f["EncodedImage:blob"] for e, f in rows.items() if e.startswith("/cameras/")]
        assert sum(images) == ours.shown["foxglove.CompressedImage"]
