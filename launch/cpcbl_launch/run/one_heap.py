"""One heap for all threads of a process, so that its memory stays flat. Every command uses it."""

import ctypes
from contextlib import suppress

_M_ARENA_MAX = -8  # of malloc.h


def use_one_heap() -> None:
    """Lets all threads of this process share one heap; to be called before they start. The GNU C
    library has several by default, and memory that is free in one is not used for what another one
    needs, so the process grows for hours. Other C libraries are left as they are."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)
