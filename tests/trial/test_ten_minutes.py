"""What a new user does in the first ten minutes, in a clean environment with the installed program:
a team of three robots whose drivers are those of the docs, and then each mistake of a driver.
"""

import asyncio
import math
import re
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import pytest
from support.chromium import PROGRAM as CHROMIUM
from support.chromium import opened
from support.newcomer import PATIENCE_S, Newcomer, from_docs
from support.processes import eventually

from cpcbl_launch.run.up import free_endpoint

pytestmark = [pytest.mark.trial, pytest.mark.timeout(600)]
ROBOTS = ("r1", "r2", "r3")
MOVING_DRIVER = Path(__file__).with_name("moving_driver.py")
STATES = "[...document.querySelectorAll('tr[data-robot]')].map((row) => row.dataset.state)"


class Lab(NamedTuple):
    """A team that runs, and the port of its gateway."""

    user: Newcomer
    port: int


@pytest.fixture(scope="module")
def user(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Newcomer]:
    with ExitStack() as stack:
        newcomer = Newcomer(tmp_path_factory.mktemp("newcomer"), stack)
        newcomer.install()
        yield newcomer


@pytest.fixture(scope="module")
def lab(user: Newcomer) -> Lab:
    """The team that `init` writes, with its router, gateway, robots and drivers: started in an odd
    order."""
    endpoint = free_endpoint()
    port = int(free_endpoint().rpartition(":")[2])
    words = ("init", "lab", "--yes", "--robots", ",".join(ROBOTS), "--router", endpoint)
    written = user.run(*words)
    assert written.returncode == 0, written.stderr
    checked = user.run("check", "lab/team.toml")
    assert (checked.returncode, checked.stderr) == (0, "")
    write_drivers(user)
    team = "lab/team.toml"
    user.start("r3", "cpcbl-team", "robot", team, "r3")
    user.start("driver_r1", "python", "lab/driver.py", "r1")
    user.says("r3", f"no router at {endpoint} yet, waiting for it")
    user.says("driver_r1", f"waiting for a router at {endpoint}")
    user.start("router", "cpcbl-team", "router", team)
    user.start("gateway", "cpcbl-team", "gateway", team, "--listen", f":{port}")
    user.says("driver_r1", "no robot takes in/r1/odometry")
    user.start("r1", "cpcbl-team", "robot", team, "r1")
    user.start("driver_r2", "sh", "driver.sh", token(user, "r2"), "r2", f"http://127.0.0.1:{port}")
    user.start("driver_r3", "./driver", token(user, "r3"), "r3", "127.0.0.1", port)
    user.start("r2", "cpcbl-team", "robot", team, "r2")
    for robot in ROBOTS:
        user.says(robot, "first odometry", "first sightings", "knows its pose")
    return Lab(user, port)


def write_drivers(user: Newcomer) -> None:
    """Those of r2, a shell, and r3, in C, by the docs, for robots that stand at their starts."""
    shell = from_docs(
        "gateway_driver.sh",
        ('distance_m\\": 0.02', 'distance_m\\": 0'),
        ('door\\", \\"range_m\\": 2.0', 'southeast\\", \\"range_m\\": 3.354'),
        ('bearing_rad\\": 0.1', 'bearing_rad\\": -0.464'),
    )
    (user.folder / "driver.sh").write_text(shell)
    source = from_docs(
        "gateway_driver.c",
        ("0.02, 0.0", "0.0, 0.0"),
        ("door", "southeast"),
        ("2.0, 0.1", "3.750, -0.644"),
    )
    (user.folder / "driver.c").write_text(source)
    subprocess.run(["cc", "-o", "driver", "driver.c"], check=True, cwd=user.folder)


def token(user: Newcomer, robot: str) -> str:
    """The robot's token, as the gateway has written it down."""
    file = user.folder / "lab" / "gateway-tokens.json"
    assert eventually(file.exists, PATIENCE_S)
    (found,) = re.findall(rf'"{robot}":\s*"([^"]+)"', file.read_text())
    return str(found)


def shows(user: Newcomer, command: str, code: int, *texts: str) -> str:
    """What `doctor` or `status` shows, as soon as all this is in it and the exit code is due."""
    ran: list[subprocess.CompletedProcess[str]] = []

    def is_shown() -> bool:
        ran.append(user.run(command, "lab/team.toml"))
        shown = " ".join(ran[-1].stdout.split())  # a long line goes on in the next one
        return ran[-1].returncode == code and all(text in shown for text in texts)

    assert eventually(is_shown, PATIENCE_S), f"{command}: no {texts}:\n{ran[-1].stdout}"
    return ran[-1].stdout


def test_three_robots_with_the_drivers_of_the_docs_run(lab: Lab) -> None:
    user = lab.user
    shows(user, "doctor", 0, "r1: σ", "r2: σ", "r3: σ", "in/r3/sightings:")
    table = shows(user, "status", 0, "r1", "r2", "r3")
    assert len(re.findall(r"\bok\b", table)) == 3
    for robot, driver in (("r2", "driver_r2"), ("r3", "driver_r3")):
        printed = user.running[driver].printed
        assert any(f'"robot":"{robot}"' in line.replace(" ", "") for line in printed), printed[-3:]
    assert "Traceback" not in "".join(program.said for program in user.running.values())


def test_a_consumer_gets_the_pose(lab: Lab) -> None:
    consumer = lab.user.folder / "consumer.py"
    consumer.write_text(from_docs("pose_consumer.py"))
    reader = lab.user.start("consumer", "python", consumer, "lab/team.toml", "r2")
    assert eventually(lambda: len(reader.printed) >= 5, PATIENCE_S)
    x_m, y_m, heading_rad = map(float, reader.printed[-1].split())
    assert math.dist((x_m, y_m), (1.0, 1.5)) < 0.3
    assert abs(heading_rad) < 0.2


@pytest.mark.skipif(not CHROMIUM, reason="needs Chromium: apt-get install chromium")
def test_the_view_shows_all_three(lab: Lab, tmp_path: Path) -> None:
    view = lab.user.start("view", "cpcbl-team", "view", "lab/team.toml", "--listen", "127.0.0.1:0")
    pattern = r"view of team lab: (http://\S+)"
    assert eventually(lambda: bool(re.search(pattern, "\n".join(view.printed))), PATIENCE_S)
    (address,) = re.findall(pattern, "\n".join(view.printed))

    async def look() -> None:
        async with opened(address, tmp_path) as tab:
            await tab.wait_for(f"({STATES}).join() === 'ok,ok,ok'", PATIENCE_S)
            await tab.save_screenshot(tmp_path / "three.png")
            assert tab.errors == []

    asyncio.run(look())
    lab.user.stop("view")
    assert (tmp_path / "three.png").stat().st_size > 20_000


def test_the_packages_and_the_gateway_refuse_a_wrong_unit_at_once(lab: Lab) -> None:
    """The robot never gets it; whoever started the driver reads it."""
    user = lab.user
    written = (user.folder / "lab" / "driver.py").read_text()
    for name, old, new, said in (
        ("degrees", "-0.245", "-14.0", "bearing_rad=-14: looks like degrees; write radians"),
        ("mm", "3.092, -", "3092.0, -", "range_m=3092: looks like mm; write metres"),
        ("no_robot", '"r1"', '"r4"', "no robot 'r4'"),
    ):
        assert old in written
        (user.folder / "lab" / f"{name}.py").write_text(written.replace(old, new))
        user.start(name, "python", f"lab/{name}.py")
        user.says(name, said)
        assert user.running[name].process.wait(timeout=PATIENCE_S) == 1
    shell = (user.folder / "driver.sh").read_text().replace("3.354", "3354")
    (user.folder / "mm.sh").write_text(shell)
    url = f"http://127.0.0.1:{lab.port}"
    asked = user.start("mm_by_gateway", "sh", "mm.sh", token(user, "r2"), "r2", url)
    said = "range_m=3354: looks like mm; write metres"
    assert eventually(lambda: said in " ".join(asked.printed), PATIENCE_S)
    user.says("gateway", said)
    user.stop("mm_by_gateway")


# Mistakes -----------------------------------------------------------------------------------------


class Mistake(NamedTuple):
    """A driver's mistake, and what people read then."""

    name: str  # in moving_driver.py
    said: str  # by the robot, in its log and its status
    doctor: str = ""  # if it says something else


DRIVEN_M = 0.3  # an estimate without odometry stays where it was, while the robot drives on
NO_ODOMETRY = "no odometry on in/{robot}/odometry for"
ROUNDS = (
    (
        Mistake("bearings in degrees", "sightings refused: bearings look like degrees"),
        Mistake("distances in mm", "distances look like millimetres"),
        Mistake("stamps in s", "odometry refused: stamps look like seconds"),
    ),
    (
        Mistake("stamps in ms", "odometry refused: stamps look like milliseconds"),
        Mistake("ranges in mm", "look like millimetres"),
        Mistake("mirrored bearings", "left is positive"),
    ),
    (
        Mistake("stamps 2 s ahead", "odometry refused: stamps are 2 s ahead of this robot's clock"),
        Mistake("monotonic stamps", "odometry refused: stamps look like a monotonic clock's"),
        Mistake("NaN", "odometry refused: numbers are infinite or NaN"),
    ),
    (
        Mistake("duplicates", "odometry refused: "),
        Mistake(
            "wrong team",
            NO_ODOMETRY,
            "this team is `lab`; somebody publishes to `labb` (r2)",
        ),
        Mistake("wrong robot", NO_ODOMETRY, "somebody publishes to in/r3b/odometry"),
    ),
    (
        Mistake("stamps 5 s old", "odometry refused: stamps are 5 s behind this robot's clock"),
        Mistake("silence", NO_ODOMETRY),
        Mistake("wrong key", "unknown key 'distance'; did you mean 'distance_m'?"),
    ),
    (
        Mistake("wrong landmark", "`Southeast` (`southeast`?)"),
        Mistake("turns in degrees", "look like degrees"),
        Mistake("mirrored turns", "the wrong sign; left is positive"),
    ),
    (
        Mistake("bearings 90° off", "bearings are 90° off; ahead is 0, left is positive"),
        Mistake("distances backwards", "distances have the wrong sign or frame"),
        Mistake("lost pieces", "of the time: pieces are lost"),
    ),
)


@pytest.fixture(scope="module")
def moving(lab: Lab) -> Newcomer:
    """The team with drivers that can make mistakes, in place of the first ones."""
    for robot in ROBOTS:
        lab.user.stop(f"driver_{robot}")
        file = lab.user.folder / f"{robot}.mistake"
        file.write_text("none")
        words = ("python", MOVING_DRIVER, "lab/team.toml", robot, file)
        lab.user.start(f"moving_{robot}", *words)
    return lab.user


def beyond_3_sigma_m(user: Newcomer, robot: str, port: int) -> float:
    """How far the estimate is from the truth, less 3 σ; 0 without a pose, or if it is said to be
    lost."""
    pose = user.pose(robot, port)
    if not pose or pose["lost"]:
        return 0.0
    truth = [float(n) for n in user.running[f"moving_{robot}"].printed[-2].split()]
    sigma_m = math.sqrt(pose["covariance"][0][0] + pose["covariance"][1][1])
    return math.dist((pose["x_m"], pose["y_m"]), truth) - 3.0 * sigma_m


@pytest.mark.parametrize("mistakes", ROUNDS, ids=lambda r: ", ".join(m.name for m in r))
def test_each_mistake_is_said(moving: Newcomer, lab: Lab, mistakes: tuple[Mistake, ...]) -> None:
    shows(moving, "status", 0)
    before = {name: len(program.said) for name, program in moving.running.items()}
    words = [m.said.format(robot=robot) for robot, m in zip(ROBOTS, mistakes, strict=True)]
    try:
        for robot, mistake in zip(ROBOTS, mistakes, strict=True):
            (moving.folder / f"{robot}.mistake").write_text(mistake.name)
        for robot, mistake, said in zip(ROBOTS, mistakes, words, strict=True):
            moving.says(robot, said, since=before[robot])
            assert beyond_3_sigma_m(moving, robot, lab.port) < DRIVEN_M, mistake.name
        shows(moving, "status", 1, *words)
        of_doctor = [m.doctor or said for m, said in zip(mistakes, words, strict=True)]
        shows(moving, "doctor", 1, *of_doctor)
    finally:
        for robot in ROBOTS:
            (moving.folder / f"{robot}.mistake").write_text("none")
