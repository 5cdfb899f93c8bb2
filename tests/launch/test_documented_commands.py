"""Every command of the documentation runs, in a folder of its own with small files of its kind.

`WAYS` says for each command how it runs here and where: `make test`, `make test-trial` or
`make test-long`. `ELSEWHERE` names the test that runs it otherwise, `LEFT_OUT` why none does. A
documented command that is in no table fails `test_every_documented_command_is_in_a_table`.
"""

import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.documented_files import write_files
from support.documented_ways import ALIVE, EXPERIMENT, KNOWN, LIVE, ONE_SEED, Way, Where
from support.documents import ROOT, blocks, commands, headers
from support.processes import command_line, eventually
from support.programs import Program

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint

ENDPOINT = re.compile(r"(?<=--connect )(tcp/[\d.:]+|ENDPOINT)")
PATIENCE_S = 60.0
WATCHED = LIVE._replace(says="watched for", beside="team.toml")
BUDGET = Way(EXPERIMENT, "long", "--team-size 2 --seeds 1")
SHORT, UNCERTAIN = "--duration 12", "worlds --worlds uncertain,unsurveyed"
LEDGER, GUEST = ("run, 60 s", "what each was worth"), "before, during and after guest"
LIAR, TABLE_1 = ("one liar, 2 honest",), ("errors at waypoints",)
OVAL = ("navigator, 5 loops, 20 runs",)
FIGURE_7 = "navigator, 5 loops, 50 runs", "navigator with a camera, 5 loops"
TRIPOD = "tripod took part", f"{GUEST} tripod"
SIMULATED = "errors of position and heading"
CALIBRATED = "way, true = scale x reported"
WAYS = {
    "cpcbl-team calibrate MRCLAM2 MRCLAM4 --output calibrated.toml --picture residuals.png": Way(
        "written: calibrated.toml", "trial", shows=(CALIBRATED,)
    ),
    "cpcbl-team calibrate camera --print-board board.png": Way("written: board.png"),
    "cpcbl-team calibrate camera drive.mp4 --board chessboard --squares 10x7 --square-m 0.025": Way(
        "fx_px", "trial"
    ),
    "cpcbl-team calibrate camera lab.toml pictures/ --type eye --picture residuals.png": Way(
        "written: lab.toml", "trial", shows=("640 x 480, 20 pictures",)
    ),
    "cpcbl-team calibrate colours lab.toml --preview preview.png"
    " --sample near.jpg:red=310,182,24,40 --sample far.jpg:red=142,201,5": Way("written: lab.toml"),
    "cpcbl-team calibrate colours lab.toml pictures/ --samples samples.csv": Way(
        "written: lab.toml"
    ),
    "cpcbl-team calibrate map mrclam MRCLAM6 --known 6,20 --dry-run": Way(
        r"\[map.landmarks.9\]",
        instead=("mrclam MRCLAM6 --known 6,20", "mrclam-uncalibrated MRCLAM6 --known 6,8"),
        shows=("landmarks from MRCLAM6",),
    ),
    "cpcbl-team calibrate map team.toml run --known door,east": Way("written: team.toml"),
    "cpcbl-team calibrate sensor lab.toml --pictures shots/ --poses poses.csv --robot rover1": Way(
        "written: lab.toml", "trial", shows=("ranges, errors in",)
    ),
    "cpcbl-team calibrate sensor lab.toml run.mcap --type eye": Way(
        "written: lab.toml", "long", first="cpcbl-team up lab.toml --duration 40 --record run.mcap"
    ),
    "cpcbl-team calibrate team.toml run.mcap": Way(
        "written: calibrated.toml",
        "trial",
        first="cpcbl-team up team.toml --duration 20 --record run.mcap",
    ),
    "cpcbl-team chaos --list": Way("kill-router"),
    "cpcbl-team chaos kill-router partition": Way("kill-router", "long"),
    "cpcbl-team chaos soak --duration 1800": Way("soak", "long", "--duration 120"),
    "cpcbl-team chaos all --seed 2 --json --report chaos.json --markdown chaos.md": Way(
        '"outcomes"', "long", instead=("chaos all", "chaos kill-robot")
    ),
    "cpcbl-team chaos freeze partition --keys": Way(
        "freeze", "long", instead=("freeze partition", "kill-robot")
    ),
    "cpcbl-team chaos slow-link narrow-link lossy-link": Way(
        "slow-link", "long", instead=(" narrow-link lossy-link", "")
    ),
    "cpcbl-team chaos nemesis": Way("nemesis", "long", "--duration 60"),
    "cpcbl-team chaos nemesis --seed 7 --duration 600 --history what.jsonl": Way(
        "nemesis", "long", instead=("600", "60")
    ),
    "cpcbl-team check team.toml": Way("team.toml: good: team 'lab', 3 robots"),
    "cpcbl-team compose team.toml": Way("robot-r1:"),
    "cpcbl-team compose team.toml > compose.yaml": Way("robot-r1:"),
    "cpcbl-team doctor team.toml": Way("r1", "trial", beside="team.toml", codes=(0, 1)),
    "cpcbl-team evaluate run": Way("RMSE m"),
    "cpcbl-team evaluate calibrated.toml MRCLAM6": Way("RMSE m"),
    "cpcbl-team evaluate mrclam MRCLAM6 --blind 3,4,5 --collaboration none": Way("RMSE m"),
    "cpcbl-team evaluate mrclam MRCLAM6 --blind 3,4,5 --yardstick": Way("centralized EKF", "trial"),
    "cpcbl-team evaluate mrclam MRCLAM6 --blind 3,4,5 --yardstick batch": Way("batch", "trial"),
    "cpcbl-team evaluate mrclam MRCLAM6 --known-landmarks 6,20": KNOWN,
    "cpcbl-team experiment budget --team-size 5 --world chain --seeds 6": BUDGET,
    "cpcbl-team experiment budget --world chain": BUDGET,
    "cpcbl-team experiment budget MRCLAM6": Way(EXPERIMENT, "long"),
    "cpcbl-team experiment circular-vs-oval": Way(EXPERIMENT, "trial", "--seeds 1", shows=OVAL),
    "cpcbl-team experiment figure7": Way(EXPERIMENT, "trial", "--seeds 1", shows=FIGURE_7[:1]),
    "cpcbl-team experiment figure7-cameras": Way(
        EXPERIMENT, "long", "--seeds 1", shows=FIGURE_7[1:]
    ),
    "cpcbl-team experiment liars --seeds 3": Way(EXPERIMENT, "long", "--seeds 1", shows=LIAR),
    "cpcbl-team experiment luck": Way("histories", "trial", "--seeds 1 --duration 8 --jobs 1"),
    "cpcbl-team experiment one-way-vs-both": Way(
        EXPERIMENT, "trial", "--team-sizes 2 --seeds 1", shows=("robots that move",)
    ),
    "cpcbl-team experiment table1": Way(EXPERIMENT, "long", "--seeds 1", shows=TABLE_1),
    "cpcbl-team experiment table1 --seeds 20": Way(EXPERIMENT, "long", "--seeds 2"),
    **{
        f"cpcbl-team experiment {name}": ONE_SEED
        for name in ("liars", "mapping", "worlds", UNCERTAIN, "wrong-maps", "random-worlds")
    },
    "cpcbl-team bridge access team.toml > access.json5": Way("access_control"),
    "cpcbl-team bridge ros2 team.toml": LIVE._replace(says="in ROS 2 at", beside="router"),
    "cpcbl-team gateway team.toml": LIVE._replace(
        says="gateway of team lab", more="--listen :0", beside="router"
    ),
    "cpcbl-team gateway lab.toml --guest tripod": Way("has a token of tripod"),
    "cpcbl-team gateway team.toml --guest tripod": Way("has a token of tripod"),
    "cpcbl-team init lab": Way("lab/team.toml and lab/driver.py are written", more="--yes"),
    "cpcbl-team keys team.toml --host 192.168.1.10 --observer tripod": Way("robot r1|robot/r1"),
    "cpcbl-team keys team.toml --renew r1": Way("renewed"),
    "cpcbl-team keys team.toml --revoke r1": Way("revoked"),
    "cpcbl-team look eyes rover1 --connect ENDPOINT": Way("rover1", "trial", beside="eyes"),
    "cpcbl-team look eyes rover1 --connect tcp/127.0.0.1:7447 --count 10": Way(
        "rover1", "trial", "--count 3", beside="eyes"
    ),
    "cpcbl-team look team.toml rover1 --pictures shots --output seen": Way(
        "seen/rover1_00", more="--count 2"
    ),
    'cpcbl-team observer blind rover --sensor gps --at 2,2.5 --move "7,2.5;2,2.5"'
    " --connect ENDPOINT --duration 20": Way(
        "rover took part", "trial", "--duration 4", beside="blind", shows=(f"{GUEST} rover",)
    ),
    "cpcbl-team merge run": Way("written: run/run.mcap"),
    "cpcbl-team observer blind tripod --at 4.5,6,-90 --connect ENDPOINT --duration 20": Way(
        "tripod took part", "trial", "--duration 4", beside="blind", shows=TRIPOD
    ),
    "cpcbl-team report run -o report.html": Way("written: report.html"),
    "cpcbl-team robot team.toml r1": LIVE._replace(
        says="r1: connected to team lab", beside="router"
    ),
    "cpcbl-team robot team.toml r3 --connect tcp/10.2.0.1:7447": LIVE._replace(
        says="r3: connected to team lab", beside="router"
    ),
    "cpcbl-team router --config": LIVE._replace(says="listens at", more="router.json5"),
    "cpcbl-team router --config router.json5": LIVE._replace(says="listens at"),
    "cpcbl-team router team.toml": LIVE._replace(says="router of team lab listens at"),
    "cpcbl-team router team.toml --connect tcp/10.1.0.1:7447": LIVE._replace(
        says="listens at", more="--listen FREE", beside="router"
    ),
    "cpcbl-team router team.toml --listen tcp/0.0.0.0:7447 --print-config > router.json5": Way(
        "zenohd -c FILE"
    ),
    "cpcbl-team replay run": Way(": equal to the bit: "),
    "cpcbl-team robot team.toml r1 --record run": LIVE._replace(
        says="r1: connected to team lab", beside="router"
    ),
    "cpcbl-team simulate demo --duration 20 --record run": Way(SIMULATED, "trial"),
    "cpcbl-team simulate demo --picture docs/demo.png": Way(SIMULATED, "trial", SHORT),
    "cpcbl-team traffic demo --connect tcp/127.0.0.1:32885": Way(
        "status/", "trial", "--duration 3", beside="demo", shows=("team demo at",)
    ),
    "cpcbl-team traffic team.toml": WATCHED,
    "cpcbl-team traffic team.toml --connect tcp/192.168.1.10:7447": WATCHED,
    "cpcbl-team up --view": Way(
        SIMULATED, "trial", f"{SHORT} --view-listen :0", shows=("view of team demo",)
    ),
    "cpcbl-team up blind --duration 60": LIVE._replace(says=ALIVE),
    "cpcbl-team up demo --duration 20 --record run": LIVE._replace(says=ALIVE),
    "cpcbl-team up demo --duration 26 --bytes-per-s 100 --messages-per-minute 120": LIVE._replace(
        says=ALIVE
    ),
    "cpcbl-team up eyes": LIVE._replace(says=ALIVE),
    "cpcbl-team up mrclam --data MRCLAM6 --blind 3,4,5 --speed 10": Way(
        SIMULATED, "trial", "--duration 3"
    ),
    "cpcbl-team up team.toml": LIVE._replace(says=ALIVE),
    "cpcbl-team up unmapped": LIVE._replace(says=ALIVE),
    "cpcbl-team up team.toml --duration 120 --record run.mcap": Way(SIMULATED, "trial", SHORT),
    "cpcbl-team what-if run": Way("worth", "trial", "--duration 1", shows=LEDGER),
    "cpcbl-team what-if run --without r3": Way("apart", more="--duration 1 --jobs 1"),
    "cpcbl-team what-if MRCLAM6 --duration 60 --hide 7": Way("apart", "trial", "--duration 2"),
    "cpcbl-team view run": LIVE._replace(says="view of team lab", more="--listen :0"),
    "cpcbl-team view team.toml": LIVE._replace(
        says="view of team lab", more="--listen :0", beside="router"
    ),
    "cpcbl-team view team.toml --listen 0.0.0.0:8700": LIVE._replace(
        says="Everybody who reaches", instead=("0.0.0.0:8700", "0.0.0.0:0"), beside="router"
    ),
    "pip install '.[security]'": Way(
        "Would install cpcbl-team",
        "trial",
        "--dry-run --no-deps",
        instead=("'.[security]'", f"'{ROOT}[security]'"),
    ),
}
CLUSTER = "tests/launch/lab/test_seeds.py"
IN_CONTAINERS = "tests/launch/run/test_containers.py"
SNIPPETS = "tests/launch/test_documented_snippets.py"
CURL = 'curl -H "Authorization: Bearer $token" http://127.0.0.1:8447'
ELSEWHERE = {
    "cpcbl-team chaos all": "Makefile::cpcbl-team chaos all",
    "cpcbl-team observer lab.toml tripod --at 2,0,180 --connect tcp/192.168.1.10:7447": (
        "tests/launch/run/test_observer_processes.py::test_a_real_tripod_is_fed_by_its_own_driver"
    ),
    "python docs/tripod_driver.py lab.toml tripod": (
        "tests/launch/run/test_observer_processes.py::test_a_real_tripod_is_fed_by_its_own_driver"
    ),
    "cpcbl-team up --containers team.toml": (
        f"{IN_CONTAINERS}::test_a_team_in_containers_is_as_good_as_in_processes"
    ),
    "docker-compose -f docker/compose.yaml up": (
        f"{IN_CONTAINERS}::test_the_committed_compose_file_runs_and_a_robot_that_crashes_comes_back"
    ),
    "cpcbl-team experiment worlds --cluster": f"{CLUSTER}::cluster=address",
    "dask ": f"{CLUSTER}::def dask",
    "pip install '.[cluster]'": "Makefile::.[dev]",
    "docker/base-image.sh cpcbl-base": "tests/support/docker.py::base-image.sh",
    "export CPCBL_BASE_IMAGE=cpcbl-base": "tests/support/docker.py::LOCAL_BASE",
    "pip install '.[ros2,camera]'": "Makefile::.[dev]",
    "pip install .": "tests/support/newcomer.py::def install",
    "now=$(date +%s%N)": f"{SNIPPETS}::test_the_shell_of_the_gateway",
    f"{CURL}/in/r1/odometry -d": f"{SNIPPETS}::test_the_shell_of_the_gateway",
    f"{CURL}/pose/r1": f"{SNIPPETS}::test_the_shell_of_the_gateway",
}
LEFT_OUT = {
    'cd "$(python -c': "systemd's folder of the package; its units are in the tests of systemd",
    "sudo ": "it would change this machine; the units are in the tests of systemd",
    "zenohd -c router.json5": "no package of zenohd; `router --config` reads the same file",
    "git clone": "pictures of others; CPCBL_PICTURES=FOLDER make test-long uses such a folder",
    "for f in nao": "it arranges these pictures",
}
OUTPUT_ELSEWHERE = {
    "navigator (e09a9fce): ": "tests/launch/recordings/test_replay.py::equal to the bit: ",
    "differs: patrol (0), step": "tests/launch/recordings/test_replay.py::patrol (0), step ",
    "rendered frames: 3000, seed 1": "tests/benchmarks/test_detection.py::benchmark_shows",
    "duckiebot: 15 pictures": "tests/benchmarks/test_pictures.py::test_the_benchmark_shows",
    "team.toml: warning: robots.r1": f"{SNIPPETS}::test_the_warnings_of_the_page",
    "thresholds, 8-bit HSV": "tests/launch/calibration/test_calibrate_colours.py::8-bit HSV",
}
DOCUMENTED = commands()
MAKE = [command for command in DOCUMENTED if command.startswith("make ")]


def test_every_documented_command_is_in_a_table() -> None:
    others = {c for c in DOCUMENTED if c not in WAYS and not c.startswith("make ")}
    assert not {c for c in others if not c.startswith((*ELSEWHERE, *LEFT_OUT))}
    assert not set(WAYS) - set(DOCUMENTED)
    for begins in (*ELSEWHERE, *LEFT_OUT):
        assert any(command.startswith(begins) for command in others), begins


@pytest.mark.parametrize("place", sorted({*ELSEWHERE.values(), *OUTPUT_ELSEWHERE.values()}))
def test_what_runs_elsewhere_is_there(place: str) -> None:
    path, _, text = place.partition("::")
    assert text in (ROOT / path).read_text()


def test_every_documented_output_is_compared() -> None:
    compared = tuple(begin for way in WAYS.values() for begin in way.shows)
    for block in blocks(""):
        assert block.first_line.startswith((*compared, *OUTPUT_ELSEWHERE)), block.first_line


@pytest.mark.parametrize("command", MAKE)
def test_a_target_of_make_exists(command: str) -> None:
    words = [*shlex.split(command), "--dry-run", "--no-print-directory", "-C", str(ROOT)]
    ran = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout


def marked(where: Where) -> list[str]:
    return [command for command, way in WAYS.items() if way.where == where]


def line_of(command: str, way: Way, endpoint: str) -> str:
    """The command as it runs here."""
    line = command.replace(*way.instead) if way.instead[0] else command
    line, *output = line.split(" > ")
    line = ENDPOINT.sub(endpoint, f"{line} {way.more}".strip())
    return line.replace("FREE", free_endpoint()) + "".join(f" > {name}" for name in output)


def check_output(way: Way, code: int, printed: str) -> None:
    """The exit code, what it says, and that its tables have the columns of the docs."""
    assert code in way.codes, printed
    assert re.search(way.says, printed), printed
    found = headers(printed)
    for begin in way.shows:
        shown = [block for block in blocks("") if block.first_line.startswith(begin)]
        assert shown
        for block in shown:
            assert [header for header in headers(block.text) if header not in found] == []


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    return tmp_path


@pytest.mark.parametrize("command", marked("test"))
def test_a_documented_command_runs(command: str, place: Path) -> None:
    way, endpoint = WAYS[command], "tcp/127.0.0.1:7447"
    write_files(place, command, endpoint)
    line = line_of(command, way, endpoint)
    words, _, output = line.partition(" > ")
    ran = command_line(*shlex.split(words)[1:])
    check_output(way, ran.returncode, ran.stdout + ran.stderr)
    if output:
        (place / output).write_text(ran.stdout)
    for name in written_files(line):
        assert (place / name).stat().st_size, name


def written_files(line: str) -> list[str]:
    """Files that a command says that it writes."""
    return re.findall(r"(?:--picture|--record|--preview|--report|--markdown|>) (\S+)", line)


@contextmanager
def program(folder: Path, name: str, line: str) -> Iterator[Program]:
    """A command as a process of its own, which ends by SIGINT at the latest."""
    words = shlex.split(line)
    pip = (sys.executable, "-m", "pip")
    started = Program(folder, name, *(PROGRAM if words[0] == "cpcbl-team" else pip), *words[1:])
    try:
        yield started
    finally:
        interrupt(started)


def interrupt(running: Program) -> int:
    """Ends a program by SIGINT, if it has not ended. Returns its exit code."""
    if running.process.poll() is None:
        running.process.send_signal(signal.SIGINT)
    return running.process.wait(timeout=PATIENCE_S)


def all_of(running: Program) -> str:
    return "\n".join(running.printed) + running.said


@contextmanager
def team_beside(folder: Path, team: str, endpoint: str) -> Iterator[tuple[str, Program | None]]:
    """A team that runs, or its router alone: its endpoint, and its process."""
    if not team:
        yield endpoint, None
        return
    words = "router team.toml" if team == "router" else f"up {team} --duration 600"
    with program(folder, "beside", f"cpcbl-team {words}") as beside:
        sign = "listens at" if team == "router" else ALIVE
        assert eventually(lambda: bool(re.search(sign, all_of(beside))), PATIENCE_S), all_of(beside)
        found = re.search(r"--connect (\S+)", all_of(beside))
        yield (found[1] if found else endpoint), beside


def run_as_process(command: str, folder: Path) -> None:
    """Runs a command to its end, or until its sign of life and SIGINT, and checks it."""
    way, endpoint = WAYS[command], free_endpoint()
    write_files(folder, f"{command} {way.more}", endpoint)
    if way.first:
        with program(folder, "first", way.first) as made:
            assert made.process.wait(timeout=PATIENCE_S) == 0, all_of(made)
    with team_beside(folder, way.beside, endpoint) as (reached, beside):
        line = line_of(command, way, reached)
        with program(folder, "command", line) as ran:
            if way.until_sigint:
                said = eventually(lambda: bool(re.search(way.says, all_of(ran))), PATIENCE_S)
                assert said, all_of(ran)
                code = interrupt(ran)
            else:
                code = ran.process.wait(timeout=600.0)
        if beside is not None:
            interrupt(beside)
        printed = all_of(ran) + (all_of(beside) if beside else "")
    check_output(way, code, printed)
    for name in written_files(line):
        assert (folder / name).stat().st_size, name


@pytest.mark.trial
@pytest.mark.timeout(300)
@pytest.mark.parametrize("command", marked("trial"))
def test_a_documented_command_runs_as_a_process(command: str, place: Path) -> None:
    run_as_process(command, place)


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("command", marked("long"))
def test_a_long_documented_command_runs(command: str, place: Path) -> None:
    run_as_process(command, place)
