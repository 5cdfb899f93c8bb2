"""What the recorder knows while a team runs."""

import pytest
from support.buses import SECOND

from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Track, Truth, Truths, encode


@pytest.mark.parametrize("truth_until_s", [1.7, 2.0, 2.3])
def test_the_live_error_compares_equal_stamps(truth_until_s: float) -> None:
    hub = MemoryHub()
    recorder, bus = Recorder(hub.session()), hub.session()
    truths = bus.publisher(topics.TRUTH.at(), topics.TRUTH.qos)
    tracks = bus.publisher(topics.TRACK.at(robot="r1"), topics.TRACK.qos)
    for tenth in range(round(10 * truth_until_s) + 1):  # at 2 m/s along x
        stamp_ns = tenth * SECOND // 10
        truths.put(encode(Truths(stamp_ns, (Truth("r1", 0.2 * tenth, 0.0, 0.0),))))
    for tenth in range(20):
        stamp_ns = tenth * SECOND // 10 + SECOND // 20
        tracks.put(encode(Track("r1", stamp_ns, 0.2 * tenth + 0.1, 0.03, 0.0, None, 3)))
    assert recorder.latest_errors_m() == {"r1": pytest.approx(0.03)}


def test_without_truth_there_is_no_live_error() -> None:
    hub = MemoryHub()
    recorder, bus = Recorder(hub.session()), hub.session()
    tracks = bus.publisher(topics.TRACK.at(robot="r1"), topics.TRACK.qos)
    tracks.put(encode(Track("r1", 0, 1.0, 2.0, 0.0, None, 3)))
    assert recorder.latest_errors_m() == {}
