"""What holds for every test: none is timed, and no process that it started outlives it."""

import gc
import logging
import os
import signal
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings
from support.children import adopt_orphans, children, end
from support.processes import eventually

REAL = {
    "benchmark",
    "subprocess",
    "programs",
    "cpcbl_team",
    "patient_up",
    "PROGRAM",
    "open_bus",
    "open_router",
    "running",
}

settings.register_profile(
    "usual", max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("thorough", settings.get_profile("usual"), max_examples=200)
settings.load_profile("usual")  # `make test-thorough` chooses the other one


def pytest_configure() -> None:
    """Restores the signals that a background job or `nohup` ignores, for children inherit that.

    The tests themselves still survive a closed terminal; what they start reacts as in a terminal.
    Numpy, which no module here has loaded yet, works without threads, as in every command.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda number, frame: None)
    adopt_orphans()


def pytest_collection() -> None:
    """Does not look for garbage while thousands of tests are found, nor ever again among them."""
    gc.disable()


def pytest_collection_finish() -> None:
    """Looks for garbage more seldom than usual: of what tests make, little refers to itself."""
    gc.enable()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks the tests of modules that start processes or open Zenoh sessions: `process`."""
    for item in items:
        module = getattr(item, "module", None)
        if REAL & vars(module).keys():
            item.add_marker("process")


@pytest.fixture(autouse=True)
def log_levels_are_as_at_first() -> None:
    """A command that ran in the process of a test, or of a module's fixture, may say less than
    others: `replay` of what robots said in the run itself."""
    for package in ("cpcbl_agents", "cpcbl_launch", "cpcbl_team", "cpcbl_transport"):
        logging.getLogger(package).setLevel(logging.NOTSET)


@pytest.fixture(autouse=True, scope="module")
def no_process_outlives_its_module() -> Iterator[None]:
    """Ends the processes that are left after the tests and fixtures of a module, and says so."""
    before = set(children())
    yield

    def left() -> dict[int, str]:
        return {pid: command for pid, command in children().items() if pid not in before}

    eventually(lambda: not left(), 5.0)  # a process that is ending may still be closing its session
    outlived = left()
    end(outlived)
    assert not outlived, f"processes that outlived their tests: {outlived}"
