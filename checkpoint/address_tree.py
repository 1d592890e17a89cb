"""A set of addresses that tells which of them are below another one, without a look at all the others."""

from __future__ import annotations

from collections.abc import Iterable, Iterator


class AddressTree:
    """A set of addresses; what is asked of one costs what is at and below it.

    >>> tree = AddressTree(["/app/a", "/app/a/b/c", "/app/ab"])
    >>> sorted(tree.below("/app/a")), tree.has("/app/a/b"), "/app/a/b" in tree
    (['/app/a/b/c'], True, False)
    >>> sorted(tree.below("")) == ["/app/a", "/app/a/b/c", "/app/ab"]
    True
    """

    __slots__ = ("_below", "_paths")

    def __init__(self, paths: Iterable[str] = ()) -> None:
        self._paths: set[str] = set()
        self._below: dict[str, dict[str, None]] = {}  # by address, those directly below it that lead to one of ours
        for path in paths:
            self.add(path)

    def __contains__(self, path: str) -> bool:
        return path in self._paths

    def has(self, path: str) -> bool:
        """Whether this address, or one below it, is among them."""
        return path in self._paths or path in self._below

    def add(self, path: str) -> None:
        """Add an address; once is enough."""
        self._paths.add(path)
        while path and path not in self._below.get(above := path.rpartition("/")[0], ()):
            self._below.setdefault(above, {})[path] = None
            path = above

    def discard(self, path: str) -> None:
        """Take an address out, if it is there."""
        self._paths.discard(path)
        while path and not self.has(path):
            above = path.rpartition("/")[0]
            siblings = self._below.get(above, {})
            siblings.pop(path, None)
            if not siblings:
                self._below.pop(above, None)
            path = above

    def below(self, top: str) -> Iterator[str]:
        """Those below an address; none may come or go meanwhile."""
        waiting = [iter(self._below.get(top, ()))]
        while waiting:
            path = next(waiting[-1], None)
            if path is None:
                waiting.pop()
                continue
            if path in self._paths:
                yield path
            waiting.append(iter(self._below.get(path, ())))
