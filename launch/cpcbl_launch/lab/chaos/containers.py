"""Two sites in containers, between whose routers the network is disconnected and reconnected."""

import os
import secrets
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from cpcbl_agents.clock import Clock
from cpcbl_launch.lab.chaos.expectations import partition
from cpcbl_launch.lab.chaos.run_log import RunLog, RunRecorder
from cpcbl_launch.lab.chaos.scenario import FaultRun, MissingError, ScenarioOptions, ScenarioResult
from cpcbl_launch.lab.chaos.team import PATIENCE_S, ChaosError
from cpcbl_launch.run.containers import BASE_IMAGE, BASE_VARIABLE, docker
from cpcbl_launch.run.containers.fleet import Project
from cpcbl_launch.run.up import free_endpoint
from cpcbl_transport.zenoh_bus import open_bus

SITES = Path("docker/two-sites.yaml")
OWN_BASE = "cpcbl-base"
WEST, EAST = ("navigator", "observer"), ("scout", "patrol")
PORTS = ("7447", "7448")
CUT_S, AFTER_S = 10.0, 13.0
BEGINS_S = 20.0  # the demonstration's robots help from 10 s on
BLIND_M = 1.0  # the blind scout is far from those that know best


def missing_docker() -> str:
    """The missing requirement of containers on this machine; empty if there is none."""
    if docker.checkout() is None:
        return f"needs a checkout, for {SITES} and the image's sources"
    try:
        docker.check_daemon()
        docker.compose_program()
    except docker.DockerError as error:
        return f"needs Docker: {error}"
    return ""


def partition_containers(options: ScenarioOptions) -> ScenarioResult:
    """Runs `docker network disconnect` for one site's router, then `connect`."""
    with _sites(options) as (project, west, east):
        options.report_progress("starting a team at two sites, in containers")
        end_s = time.monotonic() + 2.0 * PATIENCE_S
        while not _helps(west.run_log(), east.run_log()):
            if time.monotonic() > end_s:
                raise ChaosError("the team did not begin to help")
            time.sleep(0.2)
        time.sleep(BEGINS_S)
        options.report_progress(f"the sites are apart for {CUT_S:g} s")
        ends = [f"{project.name}_link", project.containers()["router-east"].id]
        cut_s = west.now_s
        docker.command_output(["docker", "network", "disconnect", *ends])
        time.sleep(CUT_S)
        docker.command_output(["docker", "network", "connect", *ends])
        healed_s = west.now_s
        options.report_progress("the link between the sites is back")
        time.sleep(AFTER_S)
        log = west.run_log()
        if options.machine is not None:
            log = log._replace(machine=options.machine.log(west.zero_s))
        run = FaultRun(log, (*WEST, *EAST), "", cut_s, healed_s, west.now_s, far=EAST)
        run.far_log = east.run_log()._replace(truth=log.truth, machine=log.machine)
        return ScenarioResult(partition(run, most_far_m=BLIND_M))


def _helps(west: RunLog, east: RunLog) -> bool:
    """Whether tracks of all robots arrive, and the scout of the east receives help."""
    arrive = {*WEST, *EAST} <= west.tracks.keys() & east.tracks.keys()
    return arrive and east.latest_counts("scout")["messages_received"] > 20


@contextmanager
def _sites(options: ScenarioOptions) -> Iterator[tuple[Project, RunRecorder, RunRecorder]]:
    """(the running containers, what is received in the west, and in the east)."""
    top = docker.checkout()
    assert top is not None
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cpcbl-chaos-")))
        endpoints = [free_endpoint() for _ in PORTS]
        text = (top / SITES).read_text().replace(f"cpcbl-team:{docker.version()}", _image(options))
        for port, endpoint in zip(PORTS, endpoints, strict=True):
            text = text.replace(f"127.0.0.1:{port}:", endpoint.removeprefix("tcp/") + ":")
        file = folder / SITES.name
        file.write_text(text)
        project = Project(docker.compose_program(), f"cpcbl-chaos-{secrets.token_hex(3)}", file)
        stack.callback(project.down)
        project.up()
        clock = Clock.wall()
        west, east = RunRecorder(clock), RunRecorder(clock)
        for recorder, endpoint in zip((west, east), endpoints, strict=True):
            recorder.listen(stack.enter_context(open_bus("demo", [endpoint])))
        yield project, west, east


def _image(options: ScenarioOptions) -> str:
    """The image of these sources. Raises MissingError if it cannot be built."""
    bases = (os.environ.get(BASE_VARIABLE), BASE_IMAGE, OWN_BASE)
    try:
        base = next((b for b in bases if b and docker.has_image(b)), bases[0] or BASE_IMAGE)
        return docker.ensure_image(base, docker.never_stop, options.report_progress)
    except docker.DockerError as error:
        raise MissingError(f"needs an image: {error}") from error
