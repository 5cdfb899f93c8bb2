"""Many runs with seeds of their own: on the cores of this machine, or on an existing Dask cluster.

A run is a function of its arguments alone, so its result is the same wherever it ran, and results
are in the order of the arguments. There is no scheduler here: Dask has one, which also runs again
what a lost worker had (extra `cluster`).
"""

import importlib.util
import os
import platform
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from importlib import metadata
from itertools import starmap
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from cpcbl_agents.extras import install_command
from cpcbl_agents.flight_recorder import program_version
from cpcbl_team.errors import DependencyError, InputError

if TYPE_CHECKING:
    from distributed import Client

ANSWER_S = 10.0  # for a scheduler to answer
LOOK_S = 5.0  # between two looks whether there are workers
PROGRAM = "cpcbl-team"
NO_CERTIFICATE = (
    "needs a certificate of the client and its authority: set"
    " DASK_DISTRIBUTED__COMM__TLS__CA_FILE, __CLIENT__CERT and __CLIENT__KEY (docs/recordings.md)"
)
Result = TypeVar("Result")


class Workers(NamedTuple):
    """What runs work: processes of this machine, or an existing cluster."""

    jobs: int | None = None  # processes at a time; None: one a core
    cluster: str = ""  # the address of a Dask scheduler


HERE = Workers()


def run_seeds(
    function: Callable[..., Result],
    arguments: Sequence[tuple[Any, ...]],
    where: Workers = HERE,
    progress: Callable[[], None] = lambda: None,
) -> list[Result]:
    """The function's results for each of these arguments, in their order. `progress` is called
    after each run.

    The function is one of a module of this package, or a `partial` of one. Raises what it raises;
    InputError for a cluster that cannot be used, DependencyError without Dask.
    """
    if where.cluster:
        with _cluster(where.cluster) as client:
            runs = [partial(function, *a) for a in arguments]
            return _run_on_cluster(client, runs, f"--cluster {where.cluster}", progress)
    results = []
    with ProcessPoolExecutor(where.jobs, mp_context=get_context("spawn")) as pool:
        alone = where.jobs == 1 or os.cpu_count() == 1 or len(arguments) < 2  # then in this process
        columns = zip(*arguments, strict=True)
        each = starmap(function, arguments) if alone else pool.map(function, *columns)
        for result in each:
            results.append(result)
            progress()
    return results


@contextmanager
def _cluster(address: str) -> "Iterator[Client]":
    """The client of a cluster whose workers have what this process has. Raises InputError."""
    if importlib.util.find_spec("distributed") is None:
        raise DependencyError(f"--cluster {address} needs Dask: {install_command('cluster')}")
    from distributed import Client

    if address.startswith("tls://") and not _has_certificate():
        raise InputError(f"--cluster {address}: {NO_CERTIFICATE}")
    try:
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, TypeError, ValueError, ImportError) as error:
        why = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"--cluster {address}: no Dask scheduler answers there: {why}") from error
    with client, client.as_current():
        if problem := _workers_problem(client):
            raise InputError(f"--cluster {address}: {problem}")
        yield client


def _has_certificate() -> bool:
    """Whether Dask's settings have what the client needs for encrypted links."""
    from dask import config

    return all(config.get(f"distributed.comm.tls.{name}") for name in ("ca-file", "client.cert"))


def _workers_problem(client: "Client") -> str:
    """Why the workers would not compute what this process does; empty if they would."""
    own: dict[str, tuple[Any, ...]] = {  # each asked by a function that a worker has in any case
        "Python": (platform.python_version,),
        PROGRAM: (metadata.version, PROGRAM),
        "NumPy": (metadata.version, "numpy"),
        "its sources": (program_version,),
    }
    if not client.nthreads():
        return "its scheduler has no workers; start some with `dask worker`"
    for what, (ask, *argument) in own.items():
        here = ask(*argument)
        answers: dict[str, Any] = client.run(ask, *argument, on_error="return")
        for worker, there in answers.items():
            if there != here:
                has = f"lacks {PROGRAM}" if isinstance(there, Exception) else f"has {what} {there}"
                return f"worker {worker} {has}, here it is {here}; install the same there"
    return ""


def _run_on_cluster(
    client: "Client",
    runs: Sequence[Callable[[], Result]],
    option: str,
    progress: Callable[[], None],
) -> list[Result]:
    from distributed import KilledWorker, wait

    # Not pure: a run is made for this client, not taken from what another one asked for
    futures = [client.submit(run, pure=False) for run in runs]
    left = set(futures)
    try:
        while left:
            try:
                finished, left = wait(left, timeout=LOOK_S, return_when="FIRST_COMPLETED")
            except TimeoutError:
                if not client.nthreads():
                    raise InputError(f"{option}: all its workers are gone") from None
                continue
            for _ in finished:
                progress()
        results: list[Result] = client.gather(futures)
    except KilledWorker as error:
        raise InputError(f"{option}: one run ended several workers: {error}") from error
    except CancelledError as error:
        raise InputError(f"{option}: its scheduler is gone") from error
    return results
