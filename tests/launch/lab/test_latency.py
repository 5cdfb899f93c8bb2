"""Experiments in real processes at tiny sizes: what they tell. Nothing is timed here."""

import io
import math
import os
import time
from collections.abc import Iterable
from pathlib import Path

import msgspec
import pytest
from rich.console import Console, RenderableType
from support.processes import cpcbl_team

from cpcbl_launch.lab.experiments import latency, processes
from cpcbl_launch.run.usage import MIB, process_usage
from cpcbl_team.errors import InputError
from cpcbl_transport.compact import BELIEF_BYTES, FIX_BYTES


def test_sightings_change_the_teammates_belief_and_every_stage_is_told(tmp_path: Path) -> None:
    ran = cpcbl_team("experiment", "latency", "--sightings", 10, "--output", tmp_path, "--json")
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout == (tmp_path / "latency.json").read_text()
    result = msgspec.json.decode(ran.stdout, type=latency.Latency)
    assert result.experiment == "latency"
    assert result.sightings == 10
    assert 5 <= result.changed <= 10
    assert 5 <= result.bare_puts <= 10
    assert result.payload_bytes == FIX_BYTES
    stages = (result.in_observer, result.on_bus, result.in_teammate)
    for q in (result.bare, result.sighting_to_belief, result.driver_to_belief, *stages):
        assert 0.0 < q.p50_us <= q.p99_us < math.inf
    assert max(q.p50_us for q in stages) < result.sighting_to_belief.p50_us
    assert result.sighting_to_belief.p50_us < result.driver_to_belief.p50_us
    assert result.ratio_p50 == result.sighting_to_belief.p50_us / result.bare.p50_us


def test_the_latency_table_fits_80_columns() -> None:
    q = latency.Quantiles(12_345.6, 123_456.7)
    stages = dict.fromkeys(
        ("bare", "sighting_to_belief", "in_observer", "on_bus", "in_teammate", "driver_to_belief"),
        q,
    )
    result = latency.Latency(
        experiment="latency",
        version="1",
        sightings=500,
        changed=499,
        bare_puts=500,
        payload_bytes=FIX_BYTES,
        ratio_p50=1.0,
        ratio_p99=1.0,
        cores=2,
        load_average=0.5,
        **stages,
    )
    assert_fits(latency.tables(result), "belief changed", "12346")


def test_a_team_and_a_broadcast_of_the_same_size_are_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(processes, "WARM_S", 1.0)
    done: list[None] = []
    result = processes.measured([2], 3.0, lambda: done.append(None))
    assert len(done) == 1
    (size,) = result.sizes
    assert size.robots == 2
    assert result.most_kept in (0, 2)
    for load in (size.team, size.broadcast):
        assert 0.0 <= load.kept <= load.kept_mean <= 1.0
        assert load.kept_mean > 0.0
        assert 0.0 <= load.cpu < 2.0  # two that only read may take less than a tick of the clock
        assert 0.0 < load.proportional_mib <= load.resident_mib
    assert size.team.cpu > 0.0
    assert size.team.field_kept is not None
    assert size.team.cpu_field is not None
    assert size.broadcast.field_kept is size.broadcast.cpu_field is None
    assert size.broadcast.received_hz > 0.0
    received = size.broadcast.received_bytes_s / BELIEF_BYTES
    assert received == pytest.approx(size.broadcast.received_hz, rel=0.1)
    assert_fits(processes.tables(result), "broadcast", "10 Hz")


def test_sizes_grow_until_one_does_not_keep_10_hz(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(robots: int, seconds: float) -> processes.Load:
        figures = dict.fromkeys(processes.Load.__struct_fields__, 1.0)
        return processes.Load(**{**figures, "kept": 0.96 if robots < 8 else 0.94})

    monkeypatch.setattr(processes, "_team", load)
    monkeypatch.setattr(processes, "_broadcast", load)
    result = processes.measured([2, 4, 8, 16], 1.0)
    assert [size.robots for size in result.sizes] == [2, 4, 8]
    assert result.most_kept == 4


@pytest.mark.parametrize("text", ["", "4,", "0", "4,x", "-1", "10000"])
def test_sizes_are_checked(text: str) -> None:
    with pytest.raises(InputError, match="such as 4,8,16"):
        processes.sizes_in(text)
    assert processes.sizes_in("4, 8,16") == [4, 8, 16]


def test_a_bad_size_is_one_line_and_exit_code_2(tmp_path: Path) -> None:
    ran = cpcbl_team("experiment", "processes", "--robots", "x", "--output", tmp_path)
    assert ran.returncode == 2
    assert ran.stderr.splitlines() == [
        "cpcbl-team: --robots x: name sizes from 1 to 9999, such as 4,8,16"
    ]


def test_the_use_of_a_process_is_its_own() -> None:
    before, until = process_usage(os.getpid()), time.process_time() + 0.2
    while time.process_time() < until:
        pass
    after = process_usage(os.getpid())
    assert after.cpu_s - before.cpu_s >= 0.1
    assert 10 * MIB < after.proportional_bytes <= after.resident_bytes
    with pytest.raises(OSError, match="No such"):
        process_usage(2**30)


def assert_fits(tables: Iterable[RenderableType], *words: str) -> None:
    """Everything is shown on 80 columns, nothing cut."""
    paper = io.StringIO()
    for shown in tables:
        Console(file=paper, width=80).print(shown, highlight=False)
    text = paper.getvalue()
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    assert all(word in text for word in words)
