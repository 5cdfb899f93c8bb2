"""Containers for tests: an image of these sources, compose projects that leave nothing behind."""

import os
import secrets
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from cpcbl_launch.run.containers import BASE_IMAGE, BASE_VARIABLE
from cpcbl_launch.run.containers.docker import (
    DockerError,
    command_output,
    compose_program,
    ensure_image,
    fetch_image,
    has_image,
    never_stop,
    version,
)
from cpcbl_launch.run.containers.fleet import Project
from cpcbl_launch.run.up import free_endpoint

TOP = Path(__file__).parents[2]
LOCAL_BASE = "cpcbl-base"


@cache
def base_image() -> str:
    """The base that the user chose, or the usual one, or one made here where it is out of reach."""
    chosen = os.environ.get(BASE_VARIABLE)
    if chosen:
        return chosen
    try:
        fetch_image(BASE_IMAGE, never_stop, print, "")
    except DockerError:
        if not has_image(LOCAL_BASE):
            subprocess.run([TOP / "docker" / "base-image.sh", LOCAL_BASE], check=True)
        return LOCAL_BASE
    return BASE_IMAGE


@cache
def image(extras: str = "") -> str:
    """The image of these sources with these extras, built when it is not there."""
    return ensure_image(base_image(), never_stop, print, extras)


def left_of(project: str) -> list[str]:
    """Containers and networks whose names begin like this, running or not."""
    containers = command_output(["docker", "ps", "--all", "--format", "{{.Names}}"]).splitlines()
    networks = command_output(["docker", "network", "ls", "--format", "{{.Name}}"]).splitlines()
    return [name for name in (*containers, *networks) if name.startswith(project)]


class Composed(Project):
    """A project that runs."""

    def id_of(self, service: str) -> str:
        return self.containers()[service].id

    def started(self) -> dict[str, str]:
        """Service -> container and when it was started: what a restart would change."""
        return {name: f"{c.id} {c.started_at}" for name, c in self.containers().items()}


@contextmanager
def composed(
    name: str, folder: Path, ports: tuple[str, ...]
) -> Iterator[tuple[Composed, list[str]]]:
    """Brings up docker/NAME with the image of these sources; yields it and its free endpoints.

    `ports`: those of the file that free ones stand in for.
    """
    text = (TOP / "docker" / name).read_text().replace(f"cpcbl-team:{version()}", image())
    endpoints = [free_endpoint() for _ in ports]
    for port, endpoint in zip(ports, endpoints, strict=True):
        assert f"127.0.0.1:{port}:" in text
        text = text.replace(f"127.0.0.1:{port}:", endpoint.removeprefix("tcp/") + ":")
    file = folder / name
    file.write_text(text)
    project = Composed(compose_program(), f"cpcbl-test-{secrets.token_hex(3)}", file)
    try:
        project.up()
        yield project, endpoints
    except BaseException as error:
        for service in project.containers():
            error.add_note(f"{service}: {project.last_log_line(service)}")
        raise
    finally:
        project.down()
    assert left_of(project.name) == []
