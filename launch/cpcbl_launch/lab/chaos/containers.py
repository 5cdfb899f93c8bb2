"""Two sites in containers, between whose routers the network is disconnected and reconnected."""

import os
import secrets
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from cpcbl_agents.clock import Clock
from cpcbl_launch.lab.chaos.figures import latest_counts
from cpcbl_launch.lab.chaos.network import AFTER_S, CUT_S, partition_checks
from cpcbl_launch.lab.chaos.run_log import RunLog, RunRecorder
from cpcbl_launch.lab.chaos.scenario import CannotRunError, ScenarioOptions, ScenarioResult
from cpcbl_launch.lab.chaos.team import PATIENCE_S, ChaosError
from cpcbl_launch.run.containers import BASE_IMAGE, BASE_VARIABLE
from cpcbl_launch.run.containers.docker import (
    DockerError,
    check_daemon,
    checkout,
    command_output,
    compose_program,
    ensure_image,
    has_image,
    never_stop,
    version,
)
from cpcbl_launch.run.containers.fleet import Project
from cpcbl_launch.run.up import free_endpoint
from cpcbl_transport.zenoh_bus import open_bus

SITES = Path("docker/two-sites.yaml")
OWN_BASE = "cpcbl-base"
WEST, EAST = ("navigator", "observer"), ("scout", "patrol")
PORTS = ("7447", "7448")
BEGINS_S = 20.0  # the demonstration's robots help from 10 s on
BLIND_M = 1.0  # the blind scout is far from those that know best


class _Sites(NamedTuple):
    project: Project
    west: RunRecorder
    east: RunRecorder

    @property
    def logs(self) -> tuple[RunLog, RunLog]:
        """The logs of the west and of the east; the truth is published in the west only."""
        west = self.west.run_log()
        return west, self.east.run_log()._replace(truth=west.truth)


def missing_requirement() -> str:
    """The missing requirement of containers on this machine; empty if there is none."""
    if checkout() is None:
        return f"needs a checkout, for {SITES} and the image's sources"
    try:
        check_daemon()
        compose_program()
    except DockerError as error:
        return f"needs Docker: {error}"
    return ""


def partition_containers(options: ScenarioOptions) -> ScenarioResult:
    """Runs `docker network disconnect` for one site's router, then `connect`."""
    with _sites(options) as sites:
        options.report_progress("starting a team at two sites, in containers")
        _wait_until(lambda: _helps(sites), "the team did not begin to help")
        time.sleep(BEGINS_S)
        link = f"{sites.project.name}_link"
        router = sites.project.containers()["router-east"].id
        options.report_progress(f"the sites are apart for {CUT_S:g} s")
        cut_s = sites.west.now_s
        command_output(["docker", "network", "disconnect", link, router])
        time.sleep(CUT_S)
        command_output(["docker", "network", "connect", link, router])
        healed_s = sites.west.now_s
        options.report_progress("the link between the sites is back")
        time.sleep(5.0 + AFTER_S)
        times = cut_s, healed_s, sites.west.now_s
        return ScenarioResult(partition_checks(*sites.logs, WEST, EAST, *times, most_far_m=BLIND_M))


def _helps(sites: _Sites) -> bool:
    """Whether tracks of all robots arrive, and the scout of the east receives help."""
    west, east = sites.logs
    heard = {*WEST, *EAST} <= west.tracks.keys() & east.tracks.keys()
    return heard and latest_counts(east, "scout")["messages_received"] > 20


def _wait_until(condition: Callable[[], bool], otherwise: str) -> None:
    end_s = time.monotonic() + 2.0 * PATIENCE_S
    while not condition():
        if time.monotonic() > end_s:
            raise ChaosError(otherwise)
        time.sleep(0.2)


@contextmanager
def _sites(options: ScenarioOptions) -> Iterator[_Sites]:
    top = checkout()
    assert top is not None
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cpcbl-chaos-")))
        endpoints = [free_endpoint() for _ in PORTS]
        text = (top / SITES).read_text().replace(f"cpcbl-team:{version()}", _image(options))
        for port, endpoint in zip(PORTS, endpoints, strict=True):
            text = text.replace(f"127.0.0.1:{port}:", endpoint.removeprefix("tcp/") + ":")
        file = folder / SITES.name
        file.write_text(text)
        project = Project(compose_program(), f"cpcbl-chaos-{secrets.token_hex(3)}", file)
        stack.callback(project.down)
        project.up()
        takers, clock = [], Clock.wall()
        for endpoint in endpoints:
            bus = stack.enter_context(open_bus("demo", [endpoint]))
            takers.append(RunRecorder(clock))
            takers[-1].listen(bus)
        yield _Sites(project, *takers)


def _image(options: ScenarioOptions) -> str:
    """The image of these sources. Raises CannotRunError if it cannot be built."""
    bases = (os.environ.get(BASE_VARIABLE), BASE_IMAGE, OWN_BASE)
    try:
        base = next((b for b in bases if b and has_image(b)), bases[0] or BASE_IMAGE)
        return ensure_image(base, never_stop, options.report_progress)
    except DockerError as error:
        raise CannotRunError(f"needs an image: {error}") from error
