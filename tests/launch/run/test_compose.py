"""The compose file of a team, and what is decided about containers without any."""

import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from msgspec.structs import replace
from support.buses import robot_at, team_of
from support.docker import TOP
from support.processes import command_line

from cpcbl_launch.run.containers.compose import Deployment, Mount, compose_text, deployment_text
from cpcbl_launch.run.containers.docker import (
    SOURCES,
    DockerError,
    build_step,
    command_output,
    compose_program,
    run_command,
    tag,
    version,
)
from cpcbl_launch.run.containers.fleet import Container, containers_by_service, restarts_between
from cpcbl_launch.run.containers.launch import (
    published_router,
    run_observer_container,
    team_in_containers,
)
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError

DEMO = load_team(builtin_path("demo"))
HOW = Deployment("demo", "cpcbl-team:1")


def parsed_text(team: Team, how: Deployment = HOW) -> dict[str, Any]:
    return dict(yaml.safe_load(compose_text(team, how)))


def services(team: Team, how: Deployment = HOW) -> dict[str, Any]:
    return dict(parsed_text(team, how)["services"])


# The file ---------------------------------------------------------------------------------------


def test_the_committed_compose_file_is_what_the_command_prints() -> None:
    printed = subprocess.run(
        [*PROGRAM, "compose", "demo"],
        cwd=TOP / "docker",
        capture_output=True,
        text=True,
        check=True,
    )
    assert printed.stdout == (TOP / "docker" / "compose.yaml").read_text()


def test_the_demo_is_a_router_a_field_and_four_robots() -> None:
    found = services(DEMO)
    robots = [f"robot-{name}" for name in DEMO.robots]
    assert list(found) == ["router", "field", *robots]
    for name in DEMO.robots:
        command = found[f"robot-{name}"]["command"]
        assert command == ["robot", "demo", name, "--connect", "tcp/router:7447"]
    assert found["router"]["command"] == ["router", "demo", "--listen", "tcp/0.0.0.0:7447"]
    assert found["field"]["command"][:3] == ["field", "demo", "--seed"]


def test_robots_with_drivers_of_their_own_need_no_field() -> None:
    assert list(services(team_of(a=robot_at(), b=robot_at()))) == ["router", "robot-a", "robot-b"]


@pytest.mark.parametrize("file", ["compose.yaml", "two-sites.yaml"])
def test_every_container_is_confined_and_its_health_is_looked_at_seldom(file: str) -> None:
    for name, service in yaml.safe_load((TOP / "docker" / file).read_text())["services"].items():
        assert service["read_only"] is True, name
        assert service["tmpfs"] == ["/tmp"]
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["init"] is True
        assert service["restart"] == "unless-stopped"
        assert service["image"] == f"cpcbl-team:{version()}"
        assert service["healthcheck"]["test"][:2] == ["CMD", "linked"]
        assert int(service["healthcheck"]["interval"].removesuffix("s")) >= 10
        assert not service.keys() & {"privileged", "network_mode", "pid", "user"}
        for port in service.get("ports", []):
            assert port.startswith("127.0.0.1:"), "let in from other machines unasked"


def test_only_one_service_builds_the_image_and_all_others_come_after_it() -> None:
    found = services(DEMO, HOW._replace(context=".."))
    assert [name for name, service in found.items() if "build" in service] == ["router"]
    assert found["router"]["build"]["context"] == ".."
    assert all("router" in s["depends_on"] for name, s in found.items() if name != "router")


def test_only_a_team_with_cameras_needs_opencv_in_its_image() -> None:
    how = HOW._replace(context="..")
    assert "EXTRAS" not in services(DEMO, how)["router"]["build"]["args"]
    seeing = services(load_team(builtin_path("eyes")), how)
    assert seeing["router"]["build"]["args"]["EXTRAS"] == "camera"


def test_what_yaml_or_compose_would_take_for_something_else_stays_what_it_is() -> None:
    names = ("1", "no", "null", "1e3", "0x10", "on", "1.5", "-", "router", "field")
    team = team_of(**{name: robot_at() for name in names})
    mount = Mount("./it's: a $HOME, #1.toml", "/team/x.toml")
    found = services(team, HOW._replace(team_file=mount.target, mounts=(mount,), clock="1:2:3.0"))
    for name in names:
        command = found[f"robot-{name}"]["command"]
        assert command[:3] == ["robot", mount.target, name]
        assert command[-2:] == ["--clock", "1:2:3.0"]
        assert all(isinstance(word, str) for word in command)
    assert len(found) == len(names) + 1
    (volume,) = found["robot-1"]["volumes"]
    assert volume == {
        "type": "bind",
        "source": "./it's: a $$HOME, #1.toml",
        "target": "/team/x.toml",
        "read_only": True,
    }


def test_a_part_of_the_team_at_another_speed_and_seed() -> None:
    found = services(DEMO, HOW._replace(here=("scout",), speed=4.0, seed=9, clock="7:8:4.0"))
    assert list(found) == ["router", "field", "robot-scout"]
    assert found["router"]["command"][-2:] == ["--speed", "4"]
    assert found["field"]["command"][:3] == ["field", "demo", "--seed"]


def test_a_file_of_ones_own_is_mounted_by_its_way_from_the_compose_file(tmp_path: Path) -> None:
    (tmp_path / "teams").mkdir()
    team_file, output = tmp_path / "teams" / "lab.toml", tmp_path / "compose.yaml"
    shutil.copy(builtin_path("demo"), team_file)
    ended = command_line("compose", team_file, "--image", "mine:2", "--output", output)
    assert ended.returncode == 0, ended.stderr
    found = yaml.safe_load(output.read_text())["services"]
    assert "build" not in found["router"]
    for service in found.values():
        assert service["image"] == "mine:2"
        assert service["volumes"][0]["source"] == "./teams/lab.toml"
        assert "/team/lab.toml" in service["command"]


GATEWAY = "[gateway]\nhost = '{}'\ntokens = 'secret/t.json'\n[robots.r1]\nsource = 'external'\n"


@pytest.mark.parametrize(
    ("host", "published"), [("localhost", "127.0.0.1:8447"), ("0.0.0.0", "8447")]
)
def test_the_gateway_is_a_service_whose_tokens_are_its_secret(
    tmp_path: Path, host: str, published: str
) -> None:
    file, tokens = tmp_path / "lab.toml", tmp_path / "secret" / "t.json"
    tokens.parent.mkdir()
    file.write_text('name = "lab"\n' + GATEWAY.format(host))
    found = yaml.safe_load(deployment_text(load_team(file), file, tmp_path, "mine:2", 1))
    gateway, owner = found["services"]["gateway"], f"{os.getuid()}:{tokens.stat().st_gid}"
    assert gateway["command"][:4] == ["gateway", "/team/lab.toml", "--listen", "0.0.0.0:8447"]
    assert gateway["command"][-2:] == ["--connect", "tcp/router:7447"]
    assert gateway["ports"] == [f"{published}:8447"]
    assert gateway["user"] == owner
    assert tokens.stat().st_mode & 0o777 == 0o600
    assert found["secrets"] == {"gateway-tokens": {"file": "./secret/t.json"}}
    (secret,) = gateway["secrets"]
    assert (secret["target"], secret["mode"]) == ("/team/secret/t.json", 0o400)
    assert f"{secret['uid']}:{secret['gid']}" == owner
    assert ["secrets" in s for s in found["services"].values()] == [False, False, True]


def test_docker_cannot_publish_the_gateway_at_a_name(tmp_path: Path) -> None:
    file = tmp_path / "lab.toml"
    (tmp_path / "secret").mkdir()
    file.write_text('name = "lab"\n' + GATEWAY.format("lab.local"))
    with pytest.raises(InputError, match=r"gateway.host: lab.local: Docker publishes at"):
        deployment_text(load_team(file), file, tmp_path, "mine:2", 1)


def test_a_log_is_not_for_a_compose_file() -> None:
    with pytest.raises(InputError, match=r"up --containers --data"):
        deployment_text(load_team(builtin_path("mrclam")), Path("mrclam"), Path(), None, 1)


def test_a_log_is_found_where_it_is_mounted() -> None:
    team = replace(load_team(builtin_path("mrclam")), data="/home/me/MRCLAM6")
    assert team_in_containers(team).data == "/team/data"
    assert team_in_containers(DEMO) == DEMO


@pytest.mark.parametrize(
    ("endpoint", "port"),
    [
        ("tcp/0.0.0.0:7447", "7447"),
        ("tcp/[::]:7447", "7447"),
        ("tcp/127.0.0.1:5", "127.0.0.1:5"),
        ("tcp/192.168.1.10:7447", "192.168.1.10:7447"),
    ],
)
def test_the_router_is_published_where_the_team_file_says(endpoint: str, port: str) -> None:
    assert published_router(endpoint) == port


def test_docker_cannot_publish_at_a_name() -> None:
    with pytest.raises(InputError, match=r"transport.listen: robot.local: Docker"):
        published_router("tcp/robot.local:7447")


# The image --------------------------------------------------------------------------------------


def sources(folder: Path) -> Path:
    for source in SOURCES:
        path = folder / source
        if (TOP / source).is_dir():
            path.mkdir()
            (path / "code.py").write_text("x = 1\n")
        else:
            path.parent.mkdir(exist_ok=True)
            path.write_text("")
    return folder


def test_the_image_has_another_name_whenever_a_source_changes(tmp_path: Path) -> None:
    top = sources(tmp_path)
    names = [tag(top, "base")]
    for source in SOURCES:
        path = top / source
        (path / "code.py" if path.is_dir() else path).write_text("x = 2\n")
        names.append(tag(top, "base"))
    (top / "agents" / "code.py").rename(top / "agents" / "renamed.py")
    names += [tag(top, "base"), tag(top, "base", "camera"), tag(top, "other")]
    assert len(set(names)) == len(names)
    (top / "launch" / "__pycache__").mkdir()
    (top / "launch" / "__pycache__" / "code.pyc").write_text("compiled")
    (top / "docs.md").write_text("not in the image")
    assert tag(top, "other") == names[-1]


def test_all_that_the_image_is_built_from_is_let_in_and_counts() -> None:
    ignored = (TOP / ".dockerignore").read_text().splitlines()
    let_in = {line[1:] for line in ignored if line.startswith("!")}
    recipe = (TOP / "docker" / "Dockerfile").read_text().splitlines()
    copied = {
        word
        for line in recipe
        if line.startswith("COPY") and "--from" not in line
        for word in line.split()[1:-1]
    }
    assert "launch/cpcbl_launch/keys" in let_in  # this package is no folder of keys
    assert copied == let_in - {"launch/cpcbl_launch/keys"} == set(SOURCES) - {"docker/Dockerfile"}
    assert "*" in ignored


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("Step 7/22 : COPY pyproject.toml .", "  7/22 COPY pyproject.toml ."),
        ("#9 [build 3/9] RUN pip install", "  3/9 RUN pip install"),
        ("#12 [stage-1 2/4] COPY a b", "  2/4 COPY a b"),
        ("#9 0.512 Collecting numpy", None),
        (" ---> Using cache", None),
    ],
)
def test_of_a_build_its_steps_are_told(line: str, said: str | None) -> None:
    assert build_step(line) == said


# Docker's command line --------------------------------------------------------------------------


def inspected(service: str, **state: Any) -> dict[str, Any]:
    return {
        "Id": state.pop("id", "c1"),
        "RestartCount": state.pop("restarts", 0),
        "Config": {"Labels": {"com.docker.compose.service": service}},
        "State": {
            "Running": True,
            "Restarting": False,
            "Pid": 7,
            "ExitCode": 0,
            "StartedAt": "10:00",
            **state,
        },
    }


def one(**state: Any) -> Container:
    return containers_by_service([inspected("robot-a", **state)])["robot-a"]


@pytest.mark.parametrize(
    ("now", "restarts"),
    [
        ({}, 0),
        ({"Running": False}, 0),
        ({"StartedAt": "10:05"}, 1),
        ({"StartedAt": "10:05", "restarts": 3}, 3),
        ({"id": "c2", "StartedAt": "10:05"}, 1),
    ],
)
def test_restarts_are_counted_whoever_did_them(now: dict[str, Any], restarts: int) -> None:
    assert restarts_between(one(), one(**now)) == restarts


def test_a_container_that_waits_to_be_restarted_does_not_run() -> None:
    assert not one(Restarting=True).running
    assert one(Restarting=True).restarting


def program(folder: Path, name: str, script: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)


@pytest.mark.parametrize(
    ("second", "first", "found"),
    [
        ("exit 0", "exit 0", ("docker", "compose")),
        ("exit 1", "exit 0", ("docker-compose",)),
        ("exit 1", None, None),
    ],
)
def test_either_compose_will_do(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    second: str,
    first: str | None,
    found: tuple[str, ...] | None,
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    program(tmp_path, "docker", second)
    if first is not None:
        program(tmp_path, "docker-compose", first)
    if found is not None:
        assert compose_program() == found
    else:
        with pytest.raises(DockerError, match="apt-get install docker-compose"):
            compose_program()


def test_without_docker_one_line_says_what_to_install(tmp_path: Path) -> None:
    ended = subprocess.run(
        [*PROGRAM, "up", "demo", "--containers"],
        env={**os.environ, "PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 2
    *_, line = ended.stderr.splitlines()
    assert "no program docker here: install Docker" in line


def test_a_command_that_fails_is_told_by_its_line_about_the_error() -> None:
    script = "echo begin; echo 'ERROR: port is taken' >&2; echo Encountered difficulties; exit 3"
    with pytest.raises(DockerError, match="port is taken"):
        command_output(["sh", "-c", script])


def test_lines_are_told_as_they_come_and_in_order() -> None:
    told: list[str] = []
    ended = run_command(
        ["sh", "-c", "printf 'a\\rb\\n'; sleep 0.2; printf 'c\\n\\nd'"], print_line=told.append
    )
    assert told == ["a\rb", "c", ""]
    assert ended.output == "a\rb\nc\n\nd"


def test_a_command_is_ended_when_the_user_wants_to_stop() -> None:
    with pytest.raises(DockerError, match="stopped during sleep 60"):
        run_command(["sleep", "60"], stop=lambda: True)
    with pytest.raises(DockerError, match="no end of sleep 60"):
        run_command(["sleep", "60"], timeout_s=0.1)


SLOW_TO_START = """
cd "$(dirname "$0")"
case $1 in
  info) uname -r ;;
  run) while [ ! -e ended ]; do sleep 0.05; done; exit 7 ;;
  stop) echo stop >> asked; [ "$(wc -l < asked)" -lt 3 ] || touch ended ;;
esac
"""


def test_a_container_is_stopped_again_until_it_is_there_to_be_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    program(tmp_path, "docker", SLOW_TO_START)
    assert run_observer_container("tripod", DEMO, "gps", [], "image", lambda: True) == 7
    assert (tmp_path / "asked").read_text().split() == ["stop"] * 3
