"""Runs on cores and on a Dask cluster give the same figures."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest
from dask import config as dask_config
from support.processes import eventually
from support.simulated import record_run

from cpcbl_launch.keys.authority import issue_certificate, new_authority
from cpcbl_launch.lab import seeds
from cpcbl_launch.lab.experiments.runs import Case, circuit_team, run_case
from cpcbl_launch.lab.luck.sweep import sweep
from cpcbl_launch.lab.seeds import Workers, run_seeds
from cpcbl_launch.lab.what_if.changes import Change
from cpcbl_launch.lab.what_if.comparison import what_if
from cpcbl_launch.lab.what_if.inputs import read_inputs
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.errors import InputError

RUNS = [(Case(circuit_team(["runner"]), ("runner",), 3.0, 0), seed) for seed in range(1, 9)]
NONE: Mapping[str, str] = MappingProxyType({})
NO_PAGE = "--dashboard-address", "127.0.0.1:0", "--no-dashboard"


@contextmanager
def dask(
    *words: str, path: str = "", settings: Mapping[str, str] = NONE
) -> Iterator[subprocess.Popen[bytes]]:
    """`dask scheduler` or `dask worker`, until the end. `settings`: of Dask, in the environment."""
    command, nothing = [sys.executable, "-m", "dask", *words], subprocess.DEVNULL
    environment = {**os.environ, "PYTHONPATH": path, **settings}
    with subprocess.Popen(command, stdout=nothing, stderr=nothing, env=environment) as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def cluster(
    folder: Path, *paths: str, protocol: str = "tcp", settings: Mapping[str, str] = NONE
) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """The address of a scheduler on a free port, and its workers, one with each of these paths."""
    from distributed import Client

    file = folder / "scheduler.json"
    local = "--host", "127.0.0.1", "--protocol", protocol
    found = "--scheduler-file", str(file)
    with ExitStack() as stack:
        scheduler = "scheduler", *local, "--port", "0", *NO_PAGE, *found
        stack.enter_context(dask(*scheduler, settings=settings))
        eventually(lambda: file.exists() and bool(file.read_text()), 60.0)
        worker = "worker", *found, *local, "--nthreads", "1", "--no-nanny", *NO_PAGE
        workers = [
            stack.enter_context(dask(*worker, path=path, settings=settings)) for path in paths
        ]
        address = str(json.loads(file.read_text())["address"])
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(len(paths), timeout=60)
        yield address, workers


Figures = Callable[[Workers, Callable[[], None]], Any]
"""The figures of some work on these workers; what is called after each run."""


def figures_of_runs(where: Workers, progress: Callable[[], None]) -> Any:
    runs = run_seeds(run_case, RUNS, where, progress)
    return [run.robots["runner"].estimate.tobytes() for run in runs], repr(runs)


def figures_of_luck(where: Workers, progress: Callable[[], None]) -> Any:
    return sweep(range(4), 5.0, where, progress)


def figures_of_what_if(folder: Path, where: Workers, progress: Callable[[], None]) -> Any:
    run = folder / "run"
    if not run.exists():
        record_run(run, load_team(builtin_path("demo")), 1, 2.0, with_bus=True)
    return what_if(read_inputs(run), Change(without=("scout",)), True, where, lambda _: progress())


@pytest.mark.long
@pytest.mark.parametrize("kind", ["runs", "luck", "what-if"])
def test_a_cluster_that_loses_a_worker_gives_the_figures_of_this_machine(
    kind: str, tmp_path: Path
) -> None:
    """A worker is killed as soon as the first run is over: what it had is run again."""
    ways: dict[str, Figures] = {
        "runs": figures_of_runs,
        "luck": figures_of_luck,
        "what-if": partial(figures_of_what_if, tmp_path),
    }
    figures, runs = ways[kind], list[int]()
    here = figures(Workers(jobs=1), lambda: runs.append(1))
    finished: list[int] = []
    with cluster(tmp_path, "", "") as (address, workers):

        def progress() -> None:
            if not finished:
                workers[0].kill()
            finished.append(1)

        there = figures(Workers(cluster=address), progress)
    assert workers[0].returncode == -9
    assert len(finished) == len(runs) >= 4
    assert there == here


@pytest.mark.long
def test_a_cluster_with_certificates(tmp_path: Path) -> None:
    """As docs/recordings.md has it: Dask's own settings, in the environment."""
    now = datetime.now(UTC)
    authority = new_authority("lab", now)
    pair = issue_certificate(authority, "dask", ("127.0.0.1",), now, timedelta(days=1))
    files = {"ca": authority.certificate, "cert": pair.certificate, "key": pair.private_key}
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    names = {"ca-file": "ca"} | {
        f"{who}.{what}": what
        for who in ("client", "scheduler", "worker")
        for what in ("cert", "key")
    }
    tls = {f"distributed.comm.tls.{key}": str(tmp_path / name) for key, name in names.items()}
    settings = {
        f"DASK_{key.upper().replace('.', '__').replace('-', '_')}": path
        for key, path in tls.items()
    }
    with cluster_of_tls(tmp_path, tls, settings) as address:
        there = run_seeds(run_case, RUNS[:2], Workers(cluster=address))
        with (
            dask_config.set(dict.fromkeys(tls)),
            pytest.raises(InputError, match="needs a certificate of the client"),
        ):
            run_seeds(run_case, RUNS[:2], Workers(cluster=address))
    assert repr(there) == repr(run_seeds(run_case, RUNS[:2], Workers(jobs=1)))


@contextmanager
def cluster_of_tls(
    folder: Path, tls: Mapping[str, str], settings: Mapping[str, str]
) -> Iterator[str]:
    """The address of a cluster whose links are encrypted, for a client with these settings."""
    with dask_config.set(tls), cluster(folder, "", protocol="tls", settings=settings) as (at, _):
        assert at.startswith("tls://")
        yield at


@pytest.mark.long
def test_a_worker_with_another_version_is_refused_in_one_line(tmp_path: Path) -> None:
    other = tmp_path / "cpcbl_team-9.9.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: cpcbl-team\nVersion: 9.9\n")
    with cluster(tmp_path, str(tmp_path)) as (address, _):
        with pytest.raises(InputError, match=r"has cpcbl-team 9\.9, here it is") as refused:
            run_seeds(run_case, RUNS, Workers(cluster=address))
        assert "\n" not in str(refused.value)


def test_what_is_no_cluster_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seeds, "ANSWER_S", 0.5)
    for address in ("127.0.0.1:9", "no-such-protocol://here:1"):
        with pytest.raises(InputError, match=f"--cluster {address}: ") as refused:
            run_seeds(run_case, RUNS, Workers(cluster=address))
        assert "\n" not in str(refused.value)
