"""Members of a secured team."""

from cpcbl_transport.bus import Bus
from cpcbl_transport.topics import Qos
from support.buses import wait_until

MARK = "mark"


def say(bus: Bus, key: str, payload: bytes = b"?") -> None:
    publisher = bus.publisher(key, Qos.INPUT)
    wait_until(lambda: publisher.matching)
    publisher.put(payload)
