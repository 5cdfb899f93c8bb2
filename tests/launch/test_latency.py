"""Experiments in real processes at tiny sizes: what they tell. Nothing is timed here."""

import io
import math
from collections.abc import Iterable

import msgspec
from rich.console import Console, RenderableType

from cpcbl_launch.experiments import latency
from cpcbl_transport.compact import FIX_BYTES


def test_sightings_change_the_teammates_belief_and_every_stage_is_told() -> None:
    done: list[None] = []
    result = latency.measured(10, lambda: done.append(None))
    assert len(done) == 10 + latency.UNMEASURED
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
    assert msgspec.json.decode(msgspec.json.encode(result))["experiment"] == "latency"


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


def assert_fits(tables: Iterable[RenderableType], *words: str) -> None:
    """Everything is shown on 80 columns, nothing cut."""
    paper = io.StringIO()
    for shown in tables:
        Console(file=paper, width=80).print(shown, highlight=False)
    text = paper.getvalue()
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    assert all(word in text for word in words)
