"""The command line as a user types it: real processes, real output, real exit codes."""

import json
import shlex
import signal
import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest
from support.logs import write_log
from support.processes import command_line, cpcbl_team, eventually, patient_up, pids_of

from cpcbl_launch.commands.old_forms import present_form
from cpcbl_launch.commands.options import team_and_files
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint

FIGURES = {
    "position_rmse_m",
    "position_mean_m",
    "position_max_m",
    "heading_rmse_deg",
    "inside_3_sigma",
    "nees",
    "messages_sent",
    "bytes_sent",
}
PLAIN = "mrclam-uncalibrated"
PAIR = """
name = "pair"
[map.landmarks]
a = { x_m = 0.0, y_m = 0.0 }
b = { x_m = 6.0, y_m = 0.0 }
c = { x_m = 3.0, y_m = 4.0 }
[robots.driver]
start = { x_m = 1.0, y_m = 1.0 }
waypoints_m = [[5.0, 1.0], [3.0, 3.0], [1.0, 1.0]]
[robots.watcher]
start = { x_m = 3.0, y_m = 3.5, heading_deg = -90.0 }
sensor = { range_share = 0.005, bearing_sigma_deg = 0.5, field_of_view_deg = 180.0 }
odometry = { moves = false }
"""


@pytest.mark.parametrize(
    "command",
    [
        [],
        ["up"],
        ["robot"],
        ["field"],
        ["check"],
        ["evaluate"],
        ["calibrate"],
        ["view"],
        ["traffic"],
        ["look"],
        ["observer"],
        ["gateway"],
        ["calibrate", "camera"],
    ],
)
@pytest.mark.parametrize("option", ["--help", "-h"])
def test_every_command_explains_itself(command: list[str], option: str) -> None:
    shown = command_line(*command, option)
    assert shown.returncode == 0
    assert "Usage" in shown.stdout


def test_the_version_is_that_of_the_package() -> None:
    assert command_line("--version").stdout == f"cpcbl-team {version('cpcbl-team')}\n"


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("tra", ["traffic"]),
        ("status de", ["demo"]),
        ("robot demo s", ["scout"]),
        ("status nowhere.toml ", []),
    ],
)
def test_a_shell_completes_commands_teams_and_robots(
    words: str, offered: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("_CPCBL_TEAM_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", f"cpcbl-team {words}")
    monkeypatch.setenv("COMP_CWORD", str(len(f"cpcbl-team {words}x".split()) - 1))
    assert command_line().stdout.split() == offered


OLD_FORMS = {
    "robot r1 --team t.toml --restarted": "robot t.toml r1 --restarted",
    "robot --team=t.toml r1": "robot t.toml r1",
    "field --seed 3 --team t.toml": "field t.toml --seed 3",
    "look --pictures shots --team t.toml r1": "look t.toml --pictures shots r1",
    "observer x --team blind --at 1,2 --for 3": "observer blind x --at 1,2 --duration 3",
    "traffic demo --for=4": "traffic demo --duration=4",
    "evaluate mrclam LOG --team t.toml --blind 3": "evaluate t.toml LOG --blind 3",
    "evaluate mrclam --team=t.toml LOG": "evaluate t.toml LOG",
    "calibrate LOG --team t.toml": "calibrate t.toml LOG",
    "calibrate log --team t.toml LOG": "calibrate log t.toml LOG",
    "calibrate camera shots --team t.toml --type eye": "calibrate camera t.toml shots --type eye",
    "calibrate colours --team t.toml --samples s.csv": "calibrate colours t.toml --samples s.csv",
    "calibrate sensor run.mcap --team t.toml": "calibrate sensor t.toml run.mcap",
    "chaos soak --soak-s 1800": "chaos soak --duration 1800",
    "look t.toml r1 --save seen": "look t.toml r1 --output seen",
    "init lab --name lab2": "init lab --team-name lab2",
    "gateway t.toml --port 80 --host ::1": "gateway t.toml --listen '[::1]:80'",
    "gateway t.toml --host=0.0.0.0": "gateway t.toml --listen 0.0.0.0",
    "experiment one-way-vs-both --robots 2,5": "experiment one-way-vs-both --team-sizes 2,5",
    "experiment budget --robots 5": "experiment budget --team-size 5",
}


@pytest.mark.parametrize("old", OLD_FORMS)
def test_a_replaced_form_is_one_line_that_names_the_present_one(old: str) -> None:
    ran = command_line(*old.split())
    said = f"cpcbl-team: this is now written: cpcbl-team {OLD_FORMS[old]}\n"
    assert (ran.returncode, ran.stdout, ran.stderr) == (2, "", said)
    assert present_form(new := shlex.split(OLD_FORMS[old])) == new


@pytest.mark.parametrize(
    "words",
    [
        "",
        "--version",
        "calibrate log t.toml LOG",
        "calibrate LOG",
        "evaluate mrclam LOG",
        "up --robots r1",
        "init lab --robots r1",
        "robot --team",
    ],
)
def test_other_words_stay_as_they_are(words: str) -> None:
    assert present_form(words.split()) == words.split()


def test_the_first_word_is_a_team_where_it_can_be_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo").mkdir()  # a log of this name
    for words, team, files in (
        ([], None, []),
        (["MRCLAM2", "MRCLAM4"], None, ["MRCLAM2", "MRCLAM4"]),
        (["t.toml", "a.png"], Path("t.toml"), ["a.png"]),
        (["blind", "run.mcap"], Path("blind"), ["run.mcap"]),
        (["demo"], None, ["demo"]),
    ):
        assert team_and_files([*map(Path, words)]) == (team, [*map(Path, files)])


def test_check_accepts_the_built_in_teams() -> None:
    for name in ("demo", "mrclam", PLAIN):
        checked = command_line("check", name)
        assert checked.returncode == 0, checked.stderr
        assert f"team '{name.removesuffix('-uncalibrated')}'" in checked.stdout


def test_check_names_file_key_and_fix_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "team.toml"
    path.write_text(PAIR.replace("range_share", "range_shar"))
    checked = command_line("check", path)
    assert checked.returncode == 2
    assert checked.stdout == ""
    (line,) = checked.stderr.splitlines()
    for part in (str(path), "robots.watcher.sensor.range_shar", "did you mean 'range_share'"):
        assert part in line


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["up", "nowhere.toml"], "nowhere.toml: no such file"),
        (["up", "mrclam", "--data", "nowhere"], "asrl.utias.utoronto.ca"),
        (["up", "demo", "--blind", "nobody"], "has no robot nobody"),
        (["evaluate", "mrclam", "nowhere"], "asrl.utias.utoronto.ca"),
        (["robot", "demo", "nobody"], "has no robot nobody"),
        (["view", "nowhere.toml"], "nowhere.toml: no such file"),
        (["view", "--listen", "8700"], "--listen 8700: write ADDRESS:PORT"),
        (["up", "--view", "--view-listen", "a:b"], "--view-listen a:b: write ADDRESS:PORT"),
        (["up", "--picture", "run.xyz"], "--picture run.xyz: not a picture"),
        (["calibrate", "nowhere", "--picture", "run.xyz"], "--picture run.xyz: not a picture"),
        (["up", "--robots", "scout,nobody"], "nobody; there are navigator, observer, scout"),
        (["up", "--robots", ","], "names no robot; there are"),
        *((["up", "--duration", s], f"--duration {s}: at least 1") for s in ("inf", "nan", "-1")),
        *((["up", "--speed", s], f"--speed {s}: from 0.05 to") for s in ("inf", "nan", "0")),
        (["robot", "demo", "scout", "--connect", "base:7447"], "--connect base:7447: no"),
        (["router", "demo", "--listen", "7447"], "--listen 7447: no endpoint; write it as tcp/"),
        (["field", "demo", "--site", "base=scout"], "--site base=scout: no endpoint"),
    ],
)
def test_what_the_user_can_mend_is_one_line(arguments: list[str], said: str) -> None:
    ended = command_line(*arguments)
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert said in line


def test_up_reports_to_file_and_standard_output(tmp_path: Path) -> None:
    team, written = tmp_path / "team.toml", tmp_path / "report.json"
    team.write_text(PAIR)
    ran = patient_up(
        *(team, "--duration", 20, "--speed", 4, "--seed", 5, "--json", "--report", written)
    )
    assert ran.returncode == 0, ran.stderr
    report = json.loads(ran.stdout)
    assert report == json.loads(written.read_text())
    assert report["robots"].keys() == {"driver", "watcher"}
    for robot in report["robots"].values():
        assert robot.keys() >= FIGURES
        assert robot["samples"] > 100
        assert robot["position_rmse_m"] < 0.3
    assert report["robots"]["watcher"]["messages_sent"] > 0
    assert report["robots"]["driver"]["messages_sent"] == 0
    assert not pids_of(["cpcbl_launch", str(tmp_path)])


def test_ctrl_c_ends_a_run_with_its_report_and_leaves_no_process(tmp_path: Path) -> None:
    team = tmp_path / "team.toml"
    team.write_text(PAIR.replace('"pair"', '"ctrl-c"'))
    command = [*PROGRAM, "up", str(team), "--logs", str(tmp_path / "logs"), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert eventually(lambda: len(pids_of([str(tmp_path / "logs")])) >= 4)
        process.send_signal(signal.SIGINT)
        shown, _ = process.communicate(timeout=10.0)
        assert process.returncode == 130
    assert json.loads(shown)["robots"].keys() == {"driver", "watcher"}
    assert not pids_of([str(tmp_path / "logs")])


@pytest.mark.thorough
def test_up_on_a_log_agrees_with_evaluate(tmp_path: Path) -> None:
    write_log(tmp_path, ("1", "2"), seconds=40.0)
    evaluated = command_line("evaluate", PLAIN, tmp_path, "--blind", "2", "--json")
    assert evaluated.returncode == 0, evaluated.stderr
    ran = patient_up(PLAIN, "--data", tmp_path, "--blind", "2", "--speed", 5, "--json")
    assert ran.returncode == 0, ran.stderr
    alone, together = json.loads(evaluated.stdout), json.loads(ran.stdout)
    assert together["left_out"].keys() == {"3", "4", "5"}
    assert together["robots"].keys() == alone["robots"].keys() == {"1", "2"}
    for name in alone["robots"]:
        assert together["robots"][name]["samples"] > 200
        # On a busy machine some help comes too late
        assert together["robots"][name]["position_rmse_m"] < 0.05
        assert alone["robots"][name]["position_rmse_m"] < 0.02


def test_a_team_spreads_over_machines_by_an_endpoint_in_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its run is shown as a table, and drawn."""
    endpoint, written, picture = free_endpoint(), tmp_path / "report.json", tmp_path / "run.png"
    text = f'{PAIR}\n[transport]\nlisten = ["{endpoint}"]\nconnect = ["{endpoint}"]\n'
    (tmp_path / "team.toml").write_text(text)
    monkeypatch.chdir(tmp_path)
    elsewhere = [*PROGRAM, "robot", "team.toml", "watcher"]
    options = ("--duration", 8, "--picture", picture, "--report", written)
    with subprocess.Popen(elsewhere, stderr=subprocess.DEVNULL) as other:
        ran = cpcbl_team("up", "team.toml", "--robots", "driver", *options)
        other.send_signal(signal.SIGINT)
        other.wait(timeout=30.0)
    assert ran.returncode == 0, ran.stderr
    report = json.loads(written.read_text())
    assert report["robots"]["watcher"]["samples"] > 0
    assert report["robots"]["driver"]["messages_received"] > 0
    for word in ("driver", "watcher", "err m", "RMSE m", "NEES"):
        assert word in ran.stdout
    assert max(map(len, ran.stdout.splitlines())) <= 80
    assert picture.read_bytes().startswith(b"\x89PNG")
