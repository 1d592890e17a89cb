"""Stores by name: where journals and snapshots go."""

from __future__ import annotations

from ..actors.errors import SpecError
from .journal import Journal, MemoryJournal


def open_journal(store: str | None, *, takeover: bool = False) -> Journal:
    """The journal that `store` names: None or "memory", or "sqlite:PATH".

    Raises:
        SpecError: the name is of no known form. StoreInUse: another living process has it open.
    """
    if store is None or store == "memory":
        return MemoryJournal()
    kind, _, path = store.partition(":")
    if kind != "sqlite" or not path:
        raise SpecError("store", f"must be None, 'memory' or 'sqlite:PATH', not {store!r}")
    from .sqlite import SqliteJournal  # only now: sqlite3 takes a while to import, and most tests need no store

    return SqliteJournal(path, takeover=takeover)
