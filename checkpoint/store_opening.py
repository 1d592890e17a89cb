"""Opens the store that a name such as `sqlite:app.db` stands for."""

from __future__ import annotations

from pathlib import Path
from typing import Final, get_args

from ..actors.errors import SpecError
from .engine_calls import Called
from .journal import Journal, MemoryJournal, StoreEngine, StoreFile
from .method import Durability
from .store_key import StoreKey, read_store_key


def open_journal(store: str | Journal | None, *, takeover: bool = False, key: StoreKey | None = None) -> StoreEngine:
    """The journal that `store` names: None or "memory", or "sqlite:PATH"; or the open engine that it is.

    Raises:
        SpecError: the name is of no known form, its folder is not there, or the key is none. StoreInUse: another living
            process has it open. WrongStoreKey: the key is not the store's.
    """
    if store is None or store == "memory":
        return MemoryJournal()
    if not isinstance(store, str):
        return store if isinstance(store, MemoryJournal) else Called(store)
    kind, _, path = store.partition(":")
    if kind != "sqlite" or not path:
        raise SpecError(
            "store", f"must be None, 'memory', 'sqlite:PATH', 'nats://HOST/NAME' or an engine, not {store!r}"
        )
    if not Path(path).parent.is_dir() or Path(path).is_dir():
        raise SpecError("store", f"{store!r} must name a file in a folder that is there")
    from .sqlite import SqliteJournal  # only now: sqlite3 takes a while to import, and most tests need no store

    secret = read_store_key(key)
    engine = SqliteJournal(path, takeover=takeover, key=secret)
    return Called(engine, StoreFile(engine.path, secret))


UNFINISHED: Final = "copy that was not finished"
"""The fact that a store has while something is copied into it."""


def systems_in(journal: Journal) -> set[str]:
    """The names of the systems of which a store has something."""
    return {address.split("/")[1] for address in journal.addresses() if address.startswith("/")}


def check_system(journal: Journal, system: str) -> None:
    """Refuse a store that another system has filled: under this name nothing of it would come back.

    Raises:
        SpecError: naming the systems whose it is; or it is a copy that was never finished.
    """
    if journal.noted(UNFINISHED) is not None:
        raise SpecError("store", "it is a copy that was never finished: make it again, by `holdfast store copy`")
    names = systems_in(journal)
    if names and system not in names:
        known = ", ".join(map(repr, sorted(names)))
        raise SpecError("store", f"it has what was recorded in the system {known}, and nothing of {system!r}")


PARTS = (
    "append", "sync", "cut", "load", "erase", "keep_blocks", "read_blocks", "packs", "forget_blocks",
    "addresses", "note", "noted", "notes", "close", "durable", "epoch",
)  # fmt: skip
"""What an engine has."""


def check_durability(store: str | Journal | None, durability: Durability | None) -> None:
    """Refuse what cannot be kept.

    Raises:
        SpecError: it is no known word, or there is no store for it; or the store has not what an engine has.
    """
    if durability is not None and durability not in get_args(Durability):
        known = ", ".join(map(repr, get_args(Durability)))
        raise SpecError("ActorSystem", f"durability must be one of {known} or left out, not {durability!r}")
    if store is not None and not isinstance(store, str):
        missing = [part for part in PARTS if not hasattr(store, part)]
        if missing:
            raise SpecError("store", f"must be a name or an engine, but {store!r:.100} has no {missing[0]!r}")
    lasts = store is not None and store != "memory" and (isinstance(store, str) or store.durable)
    if durability in ("os", "fsync") and not lasts:
        raise SpecError("ActorSystem", f"durability={durability!r} needs a store: store='sqlite:PATH'")


def check_store_key(store: str | Journal | None, key: StoreKey | None) -> None:
    """Refuse a key for what is not encrypted.

    Raises:
        SpecError: the store is none of holdfast's own on disks.
    """
    if key is not None and not (isinstance(store, str) and store.startswith(("sqlite:", "nats:", "tls:"))):
        problem = "store_key needs a store on the disk that it encrypts: store='sqlite:PATH', or 'nats://HOST/NAME'"
        raise SpecError("ActorSystem", problem)
