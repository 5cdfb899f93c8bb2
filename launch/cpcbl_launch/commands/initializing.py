"""`cpcbl-team init`: a team file and a driver for robots of one's own, after few questions."""

import math
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from string import Template
from typing import Annotated, NamedTuple

import typer
from typer import Argument, Option

from cpcbl_launch.commands import options
from cpcbl_launch.team.checks import warnings
from cpcbl_launch.team.file import parse_team
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import NAME_PATTERN

PORT = 7447
SIGHTS = ("driver", "camera", "none")
FIELD_M = (4.0, 3.0)
CORNERS = {  # landmark: x m, y m, colour bands
    "southwest": (0.0, 0.0, ("orange", "blue")),
    "southeast": (FIELD_M[0], 0.0, ("blue", "orange")),
    "northeast": (*FIELD_M, ("orange", "green")),
    "northwest": (0.0, FIELD_M[1], ("green", "orange")),
}


class Plan(NamedTuple):
    """What is written: the answers to the questions."""

    team: str
    robots: dict[str, str]  # name -> how it sees landmarks, of SIGHTS
    router: str  # the endpoint at which robots look for it


def init(
    place: Annotated[
        Path, Argument(metavar="[FOLDER|TEAM]", help="Folder for team.toml, or the team file.")
    ] = Path(),
    team_name: Annotated[str, Option(help="Name of the team; asked for if not given.")] = "",
    robots: Annotated[str, Option(help="Names of the robots, e.g. r1,r2,r3.")] = "",
    router: Annotated[str, Option(help="Address of the router's machine, e.g. 192.168.1.10.")] = "",
    camera: Annotated[
        str, Option(help="Robots in whose camera images this program finds the landmarks.")
    ] = "",
    blind: Annotated[str, Option(help="Robots that see no landmarks.")] = "",
    yes: Annotated[
        bool, Option("--yes", help="Ask nothing: defaults for what is left out.")
    ] = False,
    force: Annotated[bool, Option("--force", help="Replace files that are there.")] = False,
) -> None:
    """Write a team file of your own robots with a driver, after a few questions."""
    file = place if place.suffix == ".toml" else place / "team.toml"
    driver = file.with_name("driver.py")
    for path in (file, driver):
        if path.exists() and not force:
            raise InputError(f"{path}: is there already; name another folder, or add --force")
    ask = _no_question if yes or not sys.stdin.isatty() else _ask
    plan = _plan(
        team_name, robots, router, options.parse_names(camera), options.parse_names(blind), ask
    )
    text = team_text(plan, file.name, driver.name)
    team = parse_team(text, str(file))
    options.require_folder("init", file.parent)
    for path, content in ((file, text), (driver, driver_text(plan, file.name))):
        try:
            path.write_text(content, encoding="utf-8")
        except OSError as error:
            raise InputError(f"{path}: not written: {error.strerror}; name a folder") from error
    for warning in warnings(team):
        typer.echo(f"{file}: warning: {warning}", err=True)
    typer.echo(_next_steps(plan, file, driver))


def _no_question(question: str, default: str) -> str:
    return default


def _ask(question: str, default: str) -> str:
    return str(typer.prompt(question, default=default))


def _plan(
    name: str,
    robots: str,
    router: str,
    camera: Sequence[str],
    blind: Sequence[str],
    ask: Callable[[str, str], str],
) -> Plan:
    """The answers, and the options in place of those that are given. Raises InputError."""
    team = _checked_name("--team-name", name or ask("Name of the team", "lab"))
    names = options.parse_names(robots or ask("Names of the robots", "r1,r2,r3"))
    if not names:
        raise InputError("--robots: names no robot; write it as r1,r2,r3")
    for i, own in enumerate(names):
        _checked_name("--robots", own)
        if own in names[:i] or own in CORNERS:
            raise InputError(f"--robots: {own} is the name of two things; use another")
    for option, given in (("--camera", camera), ("--blind", blind)):
        if unknown := [own for own in given if own not in names]:
            raise InputError(
                f"{option}: no robot {', '.join(unknown)}; there are {', '.join(names)}"
            )
    endpoint = _endpoint(router or ask("Address of the machine with the router", "127.0.0.1"))
    known = dict.fromkeys(camera, "camera") | dict.fromkeys(blind, "none")
    sights = {own: known.get(own) or _sight(own, ask) for own in names}
    return Plan(team, sights, endpoint)


def _sight(robot: str, ask: Callable[[str, str], str]) -> str:
    question = f"{robot}: who finds landmarks? your driver, this program in camera images, or none"
    while (answer := ask(f"{question} ({'/'.join(SIGHTS)})", SIGHTS[0])) not in SIGHTS:
        typer.echo(f"{answer!r} is no choice; use one of {', '.join(SIGHTS)}", err=True)
    return answer


def _checked_name(option: str, name: str) -> str:
    if not re.fullmatch(NAME_PATTERN, name):
        raise InputError(f"{option} {name}: a name has 1 to 32 letters, digits, _, . or -")
    return name


def _endpoint(address: str) -> str:
    """An address as people write it, as an endpoint of Zenoh. Raises InputError."""
    host = address.removeprefix("tcp/")
    if host.count(":") > 1 and not host.startswith("["):  # IPv6
        host = f"[{host}]"
    if not re.search(r":\d+$", host.rpartition("]")[2]):
        host = f"{host}:{PORT}"
    if not re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[\w.-]+):\d{1,5}", host):
        raise InputError(f"--router {address}: no address; write it as 192.168.1.10")
    return f"tcp/{host}"


# What is written ---------------------------------------------------------------------------------


def team_text(plan: Plan, file: str, driver: str) -> str:
    """The commented team file."""
    cameras = "camera" in plan.robots.values()
    host, _, port = plan.router.partition("/")[2].rpartition(":")
    local = host in ("127.0.0.1", "localhost", "[::1]")
    everywhere = "[::]" if host.startswith("[") else "0.0.0.0"
    text = _template("team.toml.txt").substitute(
        team=plan.team,
        count=len(plan.robots),
        file=file,
        driver=driver,
        landmarks="".join(_landmark_line(name, cameras) for name in CORNERS),
        listen=plan.router if local else f"tcp/{everywhere}:{port}",
        connect=plan.router,
    )
    return text + "".join(_robot_table(plan, name) for name in plan.robots)


def _landmark_line(name: str, cameras: bool) -> str:
    x_m, y_m, (upper, lower) = CORNERS[name]
    bands = f', colours = ["{upper}", "{lower}"]' if cameras else ""
    return f"{name} = {{ x_m = {x_m}, y_m = {y_m}{bands} }}\n"


def _robot_table(plan: Plan, name: str) -> str:
    x_m, y_m = start_of(plan, name)
    start = f"x_m = {x_m}, y_m = {y_m}, heading_deg = 0.0"
    more = {
        "driver": "",
        "camera": 'sensing = "camera" # its images: messages, or camera.frames (docs/eyes.md)\n',
        "none": "sensor = { sees_landmarks = false } # teammates help it\n",
    }
    return f"\n[robots.{name}]\nstart = {{ {start} }}\n{more[plan.robots[name]]}"


def start_of(plan: Plan, name: str) -> tuple[float, float]:
    """Where a robot starts (m): in a row, in the west of the field."""
    i, count = list(plan.robots).index(name), len(plan.robots)
    return 1.0, round(FIELD_M[1] * (i + 1) / (count + 1), 2)


def driver_text(plan: Plan, file: str) -> str:
    """The driver of the team's robots, which stand until their sensors are put in."""
    lines = [f'    "{name}": {_landmarks_ahead(plan, name)},\n' for name in plan.robots]
    return _template("driver.py.txt").substitute(
        file=file, first=next(iter(plan.robots)), seen="".join(lines)
    )


def _landmarks_ahead(plan: Plan, name: str) -> str:
    """The landmarks before a robot that stands at its start, as the text of a list."""
    if plan.robots[name] != "driver":
        return "[]"
    x_m, y_m = start_of(plan, name)
    ahead = {mark: (x - x_m, y - y_m) for mark, (x, y, _) in CORNERS.items() if x > x_m}
    rows = [
        f'("{mark}", {math.hypot(x, y):.3f}, {math.atan2(y, x):.3f})'
        for mark, (x, y) in ahead.items()
    ]
    return f"[{', '.join(rows)}]"


def _template(name: str) -> Template:
    return Template((resources.files("cpcbl_launch") / "templates" / name).read_text("utf-8"))


def _next_steps(plan: Plan, file: Path, driver: Path) -> str:
    first = next(iter(plan.robots))
    path = shlex.quote(str(file))
    steps = {
        f"cpcbl-team router {path}": "on the machine of the router",
        f"cpcbl-team robot {path} {first}": "on each robot, with its own name",
        f"python {shlex.quote(str(driver))} {first}": "beside it: its driver",
        f"cpcbl-team doctor {path}": "says what is missing",
    }
    width = max(map(len, steps))
    lines = [f"  {step:{width}}  # {why}" for step, why in steps.items()]
    return "\n".join(
        [f"{file} and {driver} are written. Put your landmarks and sensors in; then", *lines]
    )
