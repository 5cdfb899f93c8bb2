"""The time from a sighting on one robot to the changed belief of its teammate, over Zenoh.

Four processes use one router: an observer and a robot that it sees, each in the project's own loop,
and a bare pair, of which one process puts as many bytes as a fix has and the other receives them.
Sightings and bare puts take turns. The observer does not move, so that no frame waits for odometry.

`make bench-latency ARGS='--sightings 500'`
"""

import argparse
import os
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from benchmarks.latency_processes import (
    ChildProcess,
    Driver,
    Passed,
    RobotTimes,
    bare_receiver,
    bare_sender,
    latency_team,
    run_timed_robot,
    sleep_until,
)
from benchmarks.report import show_and_write
from rich.console import RenderableType
from support.routers import open_router

from cpcbl_agents.clock import Clock
from cpcbl_launch.reporting.tables import table
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.inputs import Fix, Sightings
from cpcbl_transport.bus import Bus
from cpcbl_transport.compact import FIX_BYTES, decode_help
from cpcbl_transport.messages import decode_tagged
from cpcbl_transport.zenoh_bus import open_bus

PERIOD_NS = 103_000_000  # no multiple of the filter's 100 ms, so that every phase of it occurs
UNMEASURED = 10  # sightings at the start, while code and caches warm up
SETTLE_NS = 1_000_000_000
PATIENCE_S = 20.0


class Quantiles(msgspec.Struct, frozen=True):
    """The quantiles of a latency, in microseconds."""

    p50_us: float
    p99_us: float


class Latency(msgspec.Struct, frozen=True, kw_only=True):
    """What the benchmark writes."""

    experiment: str
    version: str
    sightings: int
    """The measured sightings that the driver put."""
    changed: int
    """Those of them that changed the teammate's belief."""
    bare_puts: int
    payload_bytes: int
    bare: Quantiles
    """A put on a declared publisher in one process -> the callback in another."""
    sighting_to_belief: Quantiles
    """The observer's process receives the sighting -> the teammate's filter has changed."""
    in_observer: Quantiles
    """The part of it until the observer puts the fix."""
    on_bus: Quantiles
    in_teammate: Quantiles
    """The part of it after the teammate's process has received the fix."""
    driver_to_belief: Quantiles
    """The driver's put of the sighting -> the teammate's filter has changed."""
    ratio_p50: float
    """Sighting to belief, as a multiple of a bare put."""
    ratio_p99: float
    cores: int
    load_average: float
    """Of the last minute before the end: other work on the machine changes the figures."""


def measure(sightings: int) -> Latency:
    """Measures so many sightings. Raises TimeoutError if the processes do not get ready."""
    team, endpoint, parent = latency_team(), free_endpoint(), os.getpid()
    clock = Clock(time.time_ns(), time.monotonic_ns(), 1.0)
    common = team.name, endpoint, parent
    with (
        open_router(team.name, [endpoint]),
        open_bus(team.name, [endpoint]) as bus,
        ChildProcess(run_timed_robot, "observer", team, endpoint, clock, parent) as observer,
        ChildProcess(run_timed_robot, "teammate", team, endpoint, clock, parent) as teammate,
        ChildProcess(bare_sender, *common) as sender,
        ChildProcess(bare_receiver, *common) as receiver,
    ):
        _wait_for(
            bus, ("alive/*/observer/*", "alive/*/teammate/*", "ready/sender", "ready/receiver")
        )
        driver = Driver(bus, team, clock)
        first_ns = time.monotonic_ns() + SETTLE_NS
        turns = [first_ns + n * PERIOD_NS for n in range(UNMEASURED + sightings)]
        sender.pipe.send([at_ns + PERIOD_NS // 2 for at_ns in turns])
        for at_ns in turns:
            sleep_until(at_ns - PERIOD_NS // 4)
            driver.put_odometry()
            sleep_until(at_ns)
            driver.put_sighting()
            sleep_until(at_ns + PERIOD_NS // 4)
            driver.put_odometry()
        sleep_until(turns[-1] + PERIOD_NS)
        stamps = list(driver.put_ns)[UNMEASURED:]
        stages = _stages(stamps, driver.put_ns, observer.end(), teammate.end())
        return _latency(len(stamps), stages, receiver.end()[UNMEASURED:])


def _wait_for(bus: Bus, tokens: Sequence[str]) -> None:
    """Waits until all tokens are declared. Raises TimeoutError."""
    events = []
    for keys in tokens:
        event = threading.Event()
        bus.watch_liveliness(keys, lambda key, alive, event=event: event.set())  # type: ignore[misc]
        events.append(event)
    until = time.monotonic() + PATIENCE_S
    for keys, event in zip(tokens, events, strict=True):
        if not event.wait(until - time.monotonic()):
            raise TimeoutError(f"{keys} did not come within {PATIENCE_S:.0f} s")


class Stages(NamedTuple):
    """The times at which one sighting, and the fix made from it, passed each stage."""

    put_ns: int
    received_ns: int
    fix_put_ns: int
    fix_received_ns: int
    changed_ns: int


def _stages(
    stamps: Sequence[int], put_ns: Mapping[int, int], observer: RobotTimes, teammate: RobotTimes
) -> list[Stages]:
    """The sightings that changed the teammate's belief."""
    sightings, fixes = _by_stamp(observer.received), _by_stamp(observer.sent)
    received, changed = _by_stamp(teammate.received), teammate.changed_ns
    return [
        Stages(put_ns[s], sightings[s], fixes[s], received[s], changed[s])
        for s in stamps
        if s in changed
    ]


def _by_stamp(messages: Sequence[Passed]) -> dict[int, int]:
    """When each sighting and each fix passed for the first time, by its stamp."""
    passed: dict[int, int] = {}
    for at_ns, key, payload in messages:
        fix = key.startswith("fix/")
        message = decode_help(key, payload) if fix else decode_tagged(payload)
        if isinstance(message, Sightings | Fix):
            passed.setdefault(message.stamp_ns, at_ns)
    return passed


def _latency(sightings: int, stages: Sequence[Stages], bare_ns: Sequence[int]) -> Latency:
    """The figures. Raises RuntimeError if nothing arrived."""
    if not stages or not bare_ns:
        raise RuntimeError("no sighting changed a belief, or no bare put was received")
    at = np.array(stages)
    bare, whole = _quantiles(bare_ns), _quantiles(at[:, 4] - at[:, 1])
    return Latency(
        experiment="latency",
        version=version("cpcbl-team"),
        sightings=sightings,
        changed=len(stages),
        bare_puts=len(bare_ns),
        payload_bytes=FIX_BYTES,
        bare=bare,
        sighting_to_belief=whole,
        in_observer=_quantiles(at[:, 2] - at[:, 1]),
        on_bus=_quantiles(at[:, 3] - at[:, 2]),
        in_teammate=_quantiles(at[:, 4] - at[:, 3]),
        driver_to_belief=_quantiles(at[:, 4] - at[:, 0]),
        ratio_p50=whole.p50_us / bare.p50_us,
        ratio_p99=whole.p99_us / bare.p99_us,
        cores=os.cpu_count() or 1,
        load_average=os.getloadavg()[0],
    )


def _quantiles(nanoseconds: Any) -> Quantiles:
    p50, p99 = np.percentile(nanoseconds, [50.0, 99.0]) * 1e-3
    return Quantiles(float(p50), float(p99))


def tables(result: Latency) -> Iterable[RenderableType]:
    """The figures for people."""
    shown = table(
        f"Latency, {result.changed} of {result.sightings} sightings",
        ("from -> to",),
        ("p50 us", "p99 us", "p50 x", "p99 x"),
    )
    for stage, q in (
        (f"bare put -> callback, {result.payload_bytes} B", result.bare),
        ("sighting received -> teammate's belief changed", result.sighting_to_belief),
        ("  sighting received -> fix put", result.in_observer),
        ("  fix put -> received", result.on_bus),
        ("  fix received -> belief changed", result.in_teammate),
        ("driver's put -> teammate's belief changed", result.driver_to_belief),
    ):
        ratios = q.p50_us / result.bare.p50_us, q.p99_us / result.bare.p99_us
        shown.add_row(stage, f"{q.p50_us:.0f}", f"{q.p99_us:.0f}", *(f"{r:.2f}" for r in ratios))
    yield shown
    yield f"{result.cores} cores, load average {result.load_average:.1f}"


def main() -> None:
    """Measures, prints a table and writes `latency.json`."""
    parser = argparse.ArgumentParser(prog="bench-latency", description=main.__doc__)
    parser.add_argument("--sightings", type=int, default=500, help="Ten are made per second.")
    parser.add_argument("--output", type=Path, default=Path("build"), help="Folder for the JSON.")
    given = parser.parse_args()
    result = measure(given.sightings)
    show_and_write(result, tables(result), given.output / "latency.json")


if __name__ == "__main__":
    main()
