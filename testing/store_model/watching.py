"""Watching an engine at work: each call of C code by its Python code, which is where files are changed, and may fail.

A profile function sees these calls without the engine's help. What an engine does in other threads, in other processes,
or inside one call of C code is not seen.
"""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Final

_WRITES: Final = frozenset(
    getattr(os, name)
    for name in ("write", "pwrite", "writev", "pwritev", "posix_fallocate", "ftruncate", "truncate", "sendfile")
    if hasattr(os, name)
)
_NAMES: Final = frozenset(
    getattr(os, name) for name in ("open", "rename", "replace", "link", "unlink", "remove", "mkdir", "rmdir")
)
_RENAMES: Final = frozenset((os.rename, os.replace, os.link))
_SYNCS: Final = frozenset(getattr(os, name) for name in ("fsync", "fdatasync", "sync") if hasattr(os, name))
_METHODS: Final = frozenset(("write", "writelines", "truncate", "flush"))
_HARMLESS: Final = (list, dict, set, frozenset, tuple, str, bytes, bytearray, int, type, memoryview)

Look = Callable[[str, Any], None]


def is_write(call: Any) -> bool:
    """Whether this C function or method writes to a file."""
    owner = getattr(call, "__self__", None)
    return call in _WRITES if not isinstance(owner, io.IOBase) else call.__name__ in _METHODS


def is_sync(call: Any) -> bool:
    """Whether it brings a file to the disk."""
    return call in _SYNCS


def is_renaming(call: Any) -> bool:
    """Whether it gives a file another name."""
    return call in _RENAMES


def touches_files(call: Any) -> bool:
    """Whether it writes, syncs, opens, renames or removes a file."""
    return is_write(call) or call in _NAMES or call in _SYNCS or call is io.open


@contextmanager
def watched(look: Look) -> Generator[None, None, None]:
    """Call `look(event, function)` at each call and return of this thread, as `sys.setprofile` has it."""
    before = sys.getprofile()

    def profile(_: FrameType, event: str, argument: Any) -> None:
        if event[0] != "c":
            look(event, None)
        elif not isinstance(getattr(argument, "__self__", None), _HARMLESS):
            look(event, argument)

    sys.setprofile(profile)
    try:
        yield
    finally:
        sys.setprofile(before)


class FileFault:
    """An OSError in place of one of the file operations that happen meanwhile.

    Attributes:
        left: how many operations are let through before it.
        struck: the operation that failed, once it has.
    """

    def __init__(self, left: int, error: int = errno.EIO, which: Callable[[Any], bool] = touches_files) -> None:
        self.left, self.struck = left, ""
        self._error, self._which = error, which

    @contextmanager
    def installed(self) -> Generator[None, None, None]:
        """Have it happen within."""
        with watched(self._look):
            yield

    def _look(self, event: str, call: Any) -> None:
        if event != "c_call" or self.struck or not self._which(call):
            return
        if self.left:
            self.left -= 1
            return
        self.struck = str(call.__name__)
        raise OSError(self._error, os.strerror(self._error))  # What a profile function raises, its call raises.


Signature = dict[str, tuple[int, int, int]]


def signature(folder: Path) -> Signature:
    """What tells that a file was changed: inode, size and time of its last change, by path."""
    found: Signature = {}
    waiting = [str(folder)]
    while waiting:
        try:
            with os.scandir(waiting.pop()) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(entry.path)
                        found[entry.path] = (entry.inode(), 0, 0)
                    else:
                        status = entry.stat(follow_symlinks=False)
                        found[entry.path] = (status.st_ino, status.st_size, status.st_mtime_ns)
        except FileNotFoundError:
            pass  # The engine's own thread has removed it: there will be another look.
    return found


def grown(before: Signature, now: Signature) -> tuple[str, int, int] | None:
    """The one file that is longer than before, while all others are as they were; with its old size and its new one."""
    changed = [path for path, known in now.items() if before.get(path) != known]
    if len(changed) != 1 or before.keys() - now.keys():
        return None
    (path,) = changed
    old = before.get(path, (now[path][0], 0, 0))
    is_longer = old[0] == now[path][0] and now[path][1] - old[1] > 1
    return (path, old[1], now[path][1]) if is_longer else None


@contextmanager
def full_disk(folder: Path) -> Generator[None, None, None]:
    """Let no file of this process grow more than a few bytes beyond the end of the largest one in the folder.

    The kernel sees to it (RLIMIT_FSIZE): a write is cut off there, and the next one fails. Nothing happens where there
    are no such limits.
    """
    try:
        import resource
    except ImportError:
        yield
        return
    size = max((size for _, size, _ in signature(folder).values()), default=0)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 7, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
