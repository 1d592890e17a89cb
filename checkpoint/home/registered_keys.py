"""What recorded actors hold in registries, as the store has it: it is theirs, and is moved and erased with them."""

from __future__ import annotations

from collections.abc import Mapping

from ...actors.persistence import ENTRIES, entries_key
from ..addresses import renamed
from ..group_commit import Commits


class RegisteredKeys:
    """By which facts the store knows what recorded actors hold in registries."""

    def __init__(self, journal: Commits) -> None:
        self._journal = journal
        self._registries: dict[str, set[str]] = {}  # by holder
        for key in journal.notes(ENTRIES):
            self._add(key)

    def _add(self, key: str) -> None:
        holder, registry = _addresses(key)
        self._registries.setdefault(holder, set()).add(registry)

    def noted(self, key: str, value: bytes | None) -> None:
        """Take note of a fact that was kept, or (None) forgotten."""
        if value is not None:
            self._add(key)
            return
        holder, registry = _addresses(key)
        left = self._registries.get(holder, set())
        left.discard(registry)
        if not left:
            self._registries.pop(holder, None)

    def erase(self, holder: str) -> None:
        """Forget what an actor holds. Raises HoldfastError: the store refused."""
        for registry in list(self._registries.get(holder, ())):
            key = entries_key(holder, registry)
            self._journal.note(key, None)
            self.noted(key, None)

    def rename(self, names: Mapping[str, str]) -> None:
        """Actors have moved, with all below them. Raises HoldfastError: the store refused."""
        moved: dict[str, bytes | None] = {}
        for holder, registries in self._registries.items():
            for registry in registries:
                was = entries_key(holder, registry)
                now = entries_key(renamed(names, holder), renamed(names, registry))
                if now != was:
                    moved.setdefault(was, None)
                    moved[now] = self._journal.noted(was)
        for key, value in moved.items():
            self._journal.note(key, value)
            self.noted(key, value)


def _addresses(key: str) -> tuple[str, str]:
    """The addresses of the holder and of the registry."""
    holder, _, registry = key.removeprefix(ENTRIES).partition("\n")
    return holder, registry
