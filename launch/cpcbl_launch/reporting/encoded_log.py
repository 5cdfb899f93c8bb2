"""Messages of a run of days, kept as they came and read again when somebody asks.

Read, each is many objects: a track takes 440 bytes, 150 as it came; the truth of four robots 920
and 200.
"""

from collections.abc import Iterator
from typing import Generic, TypeVar, cast

from cpcbl_transport.messages import Tagged, decode_tagged

M = TypeVar("M", bound=Tagged)


class EncodedLog(Generic[M]):
    """Messages of one type, in the order of their arrival."""

    def __init__(self) -> None:
        self._payloads: list[bytes] = []

    def append(self, payload: bytes) -> None:
        """A payload that has been read and is such a message."""
        self._payloads.append(payload)

    def __len__(self) -> int:
        return len(self._payloads)

    def __iter__(self) -> Iterator[M]:
        """Those that have come by now."""
        return (cast(M, decode_tagged(payload)) for payload in tuple(self._payloads))

    @property
    def last(self) -> M:
        return cast(M, decode_tagged(self._payloads[-1]))
