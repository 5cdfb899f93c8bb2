"""`simulate`: a team file in one process."""

import json
from pathlib import Path

import pytest
from support.processes import command_line

from cpcbl_launch.cli import main
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import builtin_path, load_team

PNG = b"\x89PNG\r\n\x1a\n"


def test_a_team_file_gives_the_report_of_up(tmp_path: Path) -> None:
    written, picture = tmp_path / "report.json", tmp_path / "run.png"
    options = ["--duration", 12, "--seed", 3, "--picture", picture, "--report", written]
    ran = command_line("simulate", "demo", *options)
    assert ran.returncode == 0, ran.stderr
    for word in ("before m", "navigator", "scout", "team", "NEES"):
        assert word in ran.stdout
    assert picture.read_bytes().startswith(PNG)
    report = json.loads(written.read_text())
    assert report["duration_s"] == 12.0
    demo = load_team(builtin_path("demo"))
    assert report["robots"].keys() == report["alone"].keys() == demo.robots.keys()
    _, recorder = simulate(demo, 3, 12.0)
    sent = {name: status.bytes_sent for name, status in recorder.status.items()}
    assert {name: r["bytes_sent"] for name, r in report["robots"].items()} == sent
    assert sum(sent.values()) > 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--robots", "2,x"], "make bench-scaling ARGS='--team-sizes 2,x'"),
        (["--duration", "0"], "--duration 0"),
        (["nowhere.toml"], "nowhere.toml: no such file"),
        (["mrclam"], "robots.1.source: mrclam: cannot be simulated"),
        (["--picture", "nowhere/a.png"], "no folder nowhere"),
        (["--picture", "a.txt"], "end its name in .png"),
        (["--report", "nowhere/a.json"], "no folder nowhere"),
    ],
)
def test_what_the_user_can_mend_is_one_line(
    arguments: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("sys.argv", ["cpcbl-team", "simulate", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
