"""The latency benchmark with few sightings: its figures and its table, no bound on time."""

import math
import os
import sys
from pathlib import Path
from subprocess import run

import msgspec
import pytest
from benchmarks import latency
from support.tables import assert_fits

from cpcbl_transport.compact import FIX_BYTES


def with_path() -> dict[str, str]:
    """The environment, with this process's import path."""
    return {**os.environ, "PYTHONPATH": ":".join(sys.path)}


@pytest.mark.long
def test_sightings_change_the_teammates_belief_and_every_stage_is_measured(tmp_path: Path) -> None:
    words = (sys.executable, "-m", "benchmarks.latency", "--sightings", "10", "--output", tmp_path)
    ran = run(words, env=with_path(), capture_output=True, text=True, timeout=90.0, check=False)
    assert ran.returncode == 0, ran.stderr
    written = (tmp_path / "latency.json").read_text()
    result = msgspec.json.decode(written, type=latency.Latency)
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
