"""Tools for those who look after a store: verify it, copy it, and read what is in it.

All of them take the path of the database. They read it without changing anything, also while a system has it open. The
commands `holdfast store ...` are these functions; `await system.backup(path)` is `back_up_store` for the system's own
store.
"""

from __future__ import annotations

from ..journal import NotCopied
from .copies import StoreCopy, back_up_store, restore_store
from .verification import Damage, Verification, verify_store

__all__ = [
    "Damage",
    "NotCopied",
    "StoreCopy",
    "Verification",
    "back_up_store",
    "restore_store",
    "verify_store",
]
