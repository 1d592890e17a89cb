"""A mapped file that outlives the process and says which input each recorded actor has in hand.

It is mapped into memory: to say that a turn begins or ends is no system call, and a kill of the process loses nothing.
After one, whoever opens the store next knows in whose turns it died, and counts that against those inputs: against the
one that was at work; if none was, against those for which a thread or a task of their own may have ended it. A power
loss may lose it: then nothing is counted.

The file has the identity of the store, then for each actor a digest of its address and a word (`turn_word.py`).
"""

from __future__ import annotations

import contextlib
import mmap
import os
from hashlib import blake2b
from typing import Final

from ..turn_word import WAITS, blamed, is_at_work
from .snapshot_files import refuse_shared

_PAGE: Final = mmap.PAGESIZE
_HEAD: Final = 16


class InputsInHand:
    """The inputs in hand of the store at `path`; open from `open` to `close`."""

    def __init__(self, path: str) -> None:
        self.path = f"{path}-hands"
        self._fd = -1
        self._pages: list[tuple[mmap.mmap, memoryview]] = []
        self._places: dict[int, int] = {}
        self._left: dict[int, int] = {}  # the words of the last owner
        self._one_worked = False
        self._digest_key = b""

    def open(self, identity: bytes, digest_key: bytes) -> None:
        """Take up what an earlier owner has left, if it was this store's.

        Raises:
            OSError: it cannot be had.
        """
        self._digest_key = digest_key
        self._fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        refuse_shared(self.path, os.fstat(self._fd))
        if os.pread(self._fd, _HEAD, 0) != identity:
            os.ftruncate(self._fd, 0)
            os.pwrite(self._fd, identity, 0)
        for _ in range(max(1, -(-os.fstat(self._fd).st_size // _PAGE))):
            self._map()
        for place in range(1, self._size):
            digest, word = self._at(place)
            if digest:
                self._places[digest] = place
                self._left[digest] = word
                if is_at_work(word):
                    self._one_worked = True
                    self._at(place)[1] = word | WAITS  # At the next death another one was, if this does not live again.

    def begun(self, address: str) -> int:
        """The input in whose turn the last owner was killed, as far as the words say; -1: none. It is said once."""
        return blamed(self._left.pop(self._digest(address), 0), one_works=self._one_worked)

    def word(self, address: str) -> memoryview:
        """The word of an actor, to be set as `word[0]`."""
        digest = self._digest(address)
        place = self._places.get(digest)
        if place is None:
            place = self._places[digest] = len(self._places) + 1
            if place >= self._size:
                self._map()
            entry = self._at(place)
            entry[1] = 0
            entry[0] = digest
        return self._at(place)[1:]

    def close(self, *, remove: bool) -> None:
        """Let go of the file, and remove it if nobody was killed. A second call does nothing."""
        if self._fd < 0:
            return
        fd, self._fd = self._fd, -1
        if remove:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(self.path)
        os.close(fd)
        self._pages.clear()  # Each page is unmapped when the last life that has a word of it is gone.

    @property
    def _size(self) -> int:
        return len(self._pages) * _PAGE // _HEAD

    def _at(self, place: int) -> memoryview:
        page, rest = divmod(place * _HEAD, _PAGE)
        return self._pages[page][1][rest // 8 : rest // 8 + 2]

    def _map(self) -> None:
        begin = len(self._pages) * _PAGE
        if os.fstat(self._fd).st_size < begin + _PAGE:
            os.posix_fallocate(self._fd, begin, _PAGE)  # A hole in a full disk would be a signal when it is written to.
        page = mmap.mmap(self._fd, _PAGE, offset=begin)
        self._pages.append((page, memoryview(page).cast("Q")))

    def _digest(self, address: str) -> int:
        data = blake2b(address.encode(errors="surrogatepass"), digest_size=8, key=self._digest_key).digest()
        return int.from_bytes(data, "little") or 1
