"""Runs on cores and on a Dask cluster give the same figures."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from support.processes import eventually

from cpcbl_launch.lab import seeds
from cpcbl_launch.lab.experiments.runs import Case, circuit_team, run_case
from cpcbl_launch.lab.seeds import Workers, run_seeds
from cpcbl_team.errors import InputError

RUNS = [(Case(circuit_team(["runner"]), ("runner",), 3.0, 0), seed) for seed in range(1, 9)]
NO_PAGE = "--dashboard-address", "127.0.0.1:0", "--no-dashboard"


@contextmanager
def dask(*words: str, path: str = "") -> Iterator[subprocess.Popen[bytes]]:
    """`dask scheduler` or `dask worker`, until the end."""
    command, nothing = [sys.executable, "-m", "dask", *words], subprocess.DEVNULL
    paths = {**os.environ, "PYTHONPATH": path}
    with subprocess.Popen(command, stdout=nothing, stderr=nothing, env=paths) as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def cluster(folder: Path, *paths: str) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """The address of a scheduler on a free port, and its workers, one with each of these paths."""
    from distributed import Client

    file = folder / "scheduler.json"
    local = "--host", "127.0.0.1"
    found = "--scheduler-file", str(file)
    with ExitStack() as stack:
        stack.enter_context(dask("scheduler", *local, "--port", "0", *NO_PAGE, *found))
        eventually(lambda: file.exists() and bool(file.read_text()), 60.0)
        worker = "worker", *found, *local, "--nthreads", "1", "--no-nanny", *NO_PAGE
        workers = [stack.enter_context(dask(*worker, path=path)) for path in paths]
        address = str(json.loads(file.read_text())["address"])
        with Client(address, set_as_default=False) as client:  # type: ignore[no-untyped-call]
            client.wait_for_workers(len(paths), timeout=60)
        yield address, workers


@pytest.mark.long
def test_a_cluster_that_loses_a_worker_gives_the_figures_of_this_machine(tmp_path: Path) -> None:
    """A worker is killed as soon as the first run is over: what it had is run again."""
    here = run_seeds(run_case, RUNS, Workers(jobs=1))
    finished: list[int] = []
    with cluster(tmp_path, "", "") as (address, workers):

        def progress() -> None:
            if not finished:
                workers[0].kill()
            finished.append(1)

        there = run_seeds(run_case, RUNS, Workers(cluster=address), progress)
    assert workers[0].returncode == -9
    assert len(finished) == len(RUNS)
    assert repr(there) == repr(here)
    assert [run.robots["runner"].estimate.tobytes() for run in there] == [
        run.robots["runner"].estimate.tobytes() for run in here
    ]


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
