"""A map from keys with wildcards to entries, searched by key: a tree of chunks.

The cost of a search grows with what is found, not with what is stored.
"""

from collections.abc import Iterator
from itertools import count
from typing import Generic, TypeVar

Thing = TypeVar("Thing")


class _Branch(Generic[Thing]):
    """What lies under the chunks so far, with its number, and the chunks that may follow."""

    __slots__ = ("here", "next")

    def __init__(self) -> None:
        self.here: dict[Thing, int] = {}
        self.next: dict[str, _Branch[Thing]] = {}


class KeyTree(Generic[Thing]):
    """Each thing lies under one key or pattern and is found in the order in which it was added."""

    def __init__(self) -> None:
        self._root: _Branch[Thing] = _Branch()
        self._numbers = count()

    def add(self, keys: str, thing: Thing) -> None:
        branch = self._root
        for chunk in keys.split("/"):
            branch = branch.next.setdefault(chunk, _Branch())
        branch.here[thing] = next(self._numbers)

    def remove(self, keys: str, thing: Thing) -> bool:
        """Takes a thing back; whether it was there. Branches that bear nothing more go too."""
        way, branch = [], self._root
        for chunk in keys.split("/"):
            way.append((branch, chunk))
            if chunk not in branch.next:
                return False
            branch = branch.next[chunk]
        if branch.here.pop(thing, None) is None:
            return False
        for before, chunk in reversed(way):
            if branch.here or branch.next:
                break
            del before.next[chunk]
            branch = before
        return True

    def find(self, keys: str) -> list[Thing]:
        """For a key, what lies under it and under the patterns that include it; for a pattern,
        what lies under the keys that it includes."""
        found: dict[Thing, int] = {}
        for branch in self._branches(keys.split("/")):
            found.update(branch.here)
        return sorted(found, key=found.__getitem__) if len(found) > 1 else list(found)

    def _branches(self, chunks: list[str]) -> Iterator[_Branch[Thing]]:
        level = [self._root]
        for chunk in chunks:
            if chunk == "**":
                for branch in level:
                    yield from _with_all_beyond(branch)
                return
            following: list[_Branch[Thing]] = []
            for branch in level:
                if "**" in branch.next:
                    yield branch.next["**"]
                if chunk == "*":
                    following += branch.next.values()
                    continue
                for name in (chunk, "*"):
                    if name in branch.next:
                        following.append(branch.next[name])
            level = following
        for branch in level:
            yield branch
            if "**" in branch.next:
                yield branch.next["**"]


def _with_all_beyond(branch: _Branch[Thing]) -> Iterator[_Branch[Thing]]:
    yield branch
    for further in branch.next.values():
        yield from _with_all_beyond(further)
