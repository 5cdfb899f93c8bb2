"""Messages of a run, as they came, for runs of days: few in memory, the others in a file."""

import logging
import os
import tempfile
import threading
import weakref
from collections import deque
from collections.abc import Iterator
from itertools import chain
from typing import Generic, TypeVar, cast

from cpcbl_transport.messages import Tagged, decode_tagged

log = logging.getLogger(__name__)

M = TypeVar("M", bound=Tagged)
RECENT = 20  # messages of which an error is known although truth comes later than the estimate
BLOCK_BYTES = 65_536  # of one log in memory: seven minutes of a robot's tracks take one or two
_LENGTH = 4  # bytes


class BlockFile:
    """A file without a name, in which logs keep what is not in memory. It is made when it is first
    needed, and ends with its process. Where the disk is full, blocks stay in memory."""

    def __init__(self) -> None:
        self._descriptor = -1
        self._end, self._failed = 0, False
        self._lock = threading.Lock()

    def store(self, block: bytes) -> "int | bytes":
        """Where the block is: its place in the file, or itself."""
        with self._lock:
            try:
                if self._descriptor < 0:
                    file = tempfile.TemporaryFile(prefix="cpcbl-", buffering=0)  # noqa: SIM115
                    weakref.finalize(self, file.close)
                    self._descriptor = file.fileno()
                if os.pwrite(self._descriptor, block, self._end) == len(block):
                    self._end += len(block)
                    return self._end - len(block)
                reason = "no room"
            except OSError as error:
                reason = error.strerror or str(error)
            if not self._failed:
                self._failed = True
                log.warning("data for the report stays in memory, so memory use grows: %s", reason)
            return block

    def load(self, place: "int | bytes", size: int) -> bytes:
        """A stored block."""
        if isinstance(place, bytes):
            return place
        return os.pread(self._descriptor, size, place)


class EncodedLog(Generic[M]):
    """Messages of one type in the order of their arrival. Decoded, each is many objects: a track
    takes 440 bytes, 150 as it came; the truth of four robots 920 and 200."""

    def __init__(self, file: BlockFile) -> None:
        self._blocks, self._file = list[tuple[int | bytes, int]](), file
        self._newest: list[bytes] = []
        self._newest_bytes = self._count = 0
        self._recent: deque[bytes] = deque(maxlen=RECENT)
        self._lock = threading.Lock()

    def append(self, payload: bytes) -> None:
        """One thread may append while another one reads."""
        with self._lock:
            self._count += 1
            self._recent.append(payload)
            self._newest.append(payload)
            self._newest_bytes += len(payload) + _LENGTH
            if self._newest_bytes >= BLOCK_BYTES:
                block = b"".join(len(p).to_bytes(_LENGTH, "little") + p for p in self._newest)
                self._blocks.append((self._file.store(block), len(block)))
                self._newest, self._newest_bytes = [], 0

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[M]:
        with self._lock:
            blocks, newest = tuple(self._blocks), tuple(self._newest)
        return (cast(M, decode_tagged(p)) for p in chain(self._stored_payloads(blocks), newest))

    def _stored_payloads(self, blocks: tuple[tuple[int | bytes, int], ...]) -> Iterator[bytes]:
        for place, size in blocks:
            block, at = self._file.load(place, size), 0
            while at < len(block):
                end = at + _LENGTH + int.from_bytes(block[at : at + _LENGTH], "little")
                yield block[at + _LENGTH : end]
                at = end

    def recent(self) -> list[M]:
        """The newest messages, in the order of their arrival."""
        with self._lock:
            recent = tuple(self._recent)
        return [cast(M, decode_tagged(payload)) for payload in recent]

    @property
    def last(self) -> M:
        return cast(M, decode_tagged(self._recent[-1]))
