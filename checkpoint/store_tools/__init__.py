"""Tools for those who look after a store: verify it, copy it, and read what is in it.

All of them take the path of the database. All but `compact_store` only read it, and a system may have it open. The
commands `holdfast store ...` are these functions; `await system.backup(path)` is `back_up_store` for the system's own
store.
"""

from __future__ import annotations

from ..journal import NotCopied
from .compaction import Compaction, compact_store
from .copies import StoreCopy, back_up_store, rekey_store, restore_store
from .plain_export import export_store
from .store_counts import AddressStats, SnapshotStats, StoreStats, store_stats
from .verification import Damage, Verification, verify_store

__all__ = [
    "AddressStats",
    "Compaction",
    "Damage",
    "NotCopied",
    "SnapshotStats",
    "StoreCopy",
    "StoreStats",
    "Verification",
    "back_up_store",
    "compact_store",
    "export_store",
    "rekey_store",
    "restore_store",
    "store_stats",
    "verify_store",
]
