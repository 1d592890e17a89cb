"""The mark: a small file that says which position was acknowledged last.

SQLite takes a damaged end of its WAL for the end of the WAL, and a missing WAL for an empty one: entries that were
acknowledged would be gone without a word. The mark knows better, and it survives the process, being in the page cache.
It is mapped into memory: to set it is no system call.
"""

from __future__ import annotations

import contextlib
import os
import struct
from typing import Final

from ..journal import DamagedStore
from .ownership import boot_id
from .snapshot_files import Word

_MARK: Final = struct.Struct("=Q?36s")  # last acknowledged position, synced at each commit?, boot
_SYNCED: Final = struct.Struct("=Q")  # behind it: the last position that was synced


class PositionMark:
    """The mark of the store at `path`; open from `check` to `close`."""

    def __init__(self, path: str) -> None:
        self.path = f"{path}-mark"
        self._store = path
        self._fd = -1
        self._word: Word | None = None

    @property
    def is_open(self) -> bool:
        """Whether it has been checked and not closed since."""
        return self._fd >= 0

    def check(self, last: int, *, synced: bool) -> None:
        """Compare what an earlier owner left with the newest position found, then set it to that.

        Raises:
            DamagedStore: later positions were acknowledged, and no power loss explains that they are gone.
        """
        boot = boot_id().encode()
        self._fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        refuse_missing(self._store, os.pread(self._fd, _MARK.size + _SYNCED.size, 0), last)
        os.pwrite(self._fd, _MARK.pack(last, synced, boot) + _SYNCED.pack(last if synced else 0), 0)
        self._word = Word(self._fd)

    def set(self, position: int) -> None:
        """Everything up to this position is acknowledged from now on."""
        assert self._word is not None
        self._word.at[0] = position  # eight bytes at once, which a kill does not tear

    def set_synced(self, position: int) -> None:
        """Everything up to this position survives a power loss, too."""
        if self._fd >= 0:
            os.pwrite(self._fd, _SYNCED.pack(position), _MARK.size)

    def close(self) -> None:
        """Give the descriptor back; the file stays. A second call does nothing."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)
        if self._word is not None:
            self._word.close()
            self._word = None

    def remove(self) -> None:
        """Remove the file: the row of the store says all now."""
        with contextlib.suppress(FileNotFoundError):
            os.unlink(self.path)


def read_mark(store: str) -> bytes:
    """What the mark of a store says now, for `refuse_missing`; empty if there is none."""
    try:
        fd = os.open(f"{store}-mark", os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        return b""
    try:
        return os.pread(fd, _MARK.size + _SYNCED.size, 0)
    finally:
        os.close(fd)


def refuse_missing(store: str, mark: bytes, last: int) -> None:
    """Compare what a mark says with the newest position found.

    Raises:
        DamagedStore: later positions were acknowledged, and no power loss explains that they are gone.
    """
    if len(mark) < _MARK.size:
        return
    boot = boot_id().encode()
    position, was_synced, marked_boot = _MARK.unpack_from(mark)
    if not was_synced and marked_boot != boot and len(mark) == _MARK.size + _SYNCED.size:
        (position,), was_synced = _SYNCED.unpack_from(mark, _MARK.size), True
    # After a power loss entries may be gone that were not synced. After anything else they may not.
    if position > last and (was_synced or marked_boot == boot):
        reason = (
            f"positions up to {position} were acknowledged, but they end at {last} "
            f"(remove {store}-mark to go on without them)"
        )
        raise DamagedStore(store, None, last + 1, reason)
