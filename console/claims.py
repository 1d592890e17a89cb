"""A Unix socket for one process: claimed by a lock beside it, so that of several that want the path one has it."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import stat
from collections.abc import Generator
from pathlib import Path

from ..actors.errors import HoldfastError
from ..system.script import check_folders

MOST_WAITING = 32
"""Connections that the kernel keeps until they are accepted."""
LONGEST_PROBE = 10.0
"""Seconds that a live process may take to accept a connection."""


class EndpointInUse(HoldfastError, text="control endpoint {path}: {why}"):
    """A live process listens at this socket, it is no socket, or the system cannot watch one more."""

    path: str
    why: str


@contextlib.contextmanager
def claimed(path: Path) -> Generator[None, None, None]:
    """Have the path for oneself: of several processes that find the socket of a dead one, one replaces it.

    The claim is a lock on a file beside the socket, which the kernel takes back when its holder dies, however.

    Raises:
        EndpointInUse: a live process has it. UntrustedFile: others may write the folder.
    """
    beside = path.with_name(f"{path.name}.lock")
    try:
        check_folders(path.parent, {os.geteuid()}, may_share=True)
        file = _locked(beside, str(path))
    except OSError as error:
        raise EndpointInUse(str(path), error.strerror or str(error)) from error
    try:
        yield
    finally:
        remove(beside, os.fstat(file).st_ino)
        os.close(file)


def _locked(beside: Path, path: str) -> int:
    while True:
        file = os.open(beside, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            ours, there = os.fstat(file), os.stat(beside, follow_symlinks=False)
        except BlockingIOError:
            os.close(file)
            raise EndpointInUse(path, "a live process listens there") from None
        except FileNotFoundError:  # Its last holder has just ended in good order.
            os.close(file)
            continue
        except BaseException:
            os.close(file)
            raise
        if (ours.st_dev, ours.st_ino) == (there.st_dev, there.st_ino):
            if not stat.S_ISREG(ours.st_mode) or ours.st_uid != os.geteuid() or ours.st_nlink != 1 or ours.st_size:
                os.close(file)
                raise EndpointInUse(path, f"{beside} is no lock of ours: an empty file of this user, with one name")
            return file
        os.close(file)


def absolute(path: str | os.PathLike[str]) -> Path:
    """The path from the root on: the folder in which we are may change."""
    return Path(path).absolute()


def remove(path: Path, inode: int) -> None:
    """Remove what we have made, unless something else is there by now."""
    try:
        if os.lstat(path).st_ino == inode:
            os.unlink(path)
    except FileNotFoundError:
        pass


def listen(path: Path) -> tuple[socket.socket, int]:
    """A listening socket at `path` that never had wider rights than 0600, and its inode."""
    clear(path)
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
    try:
        os.fchmod(sock.fileno(), 0o600)  # The file gets these rights, less the umask: there is no moment with more.
        before = os.umask(0o177)
        try:
            sock.bind(str(path))
        finally:
            os.umask(before)
        sock.listen(MOST_WAITING)
        return sock, os.lstat(path).st_ino
    except OSError as error:
        sock.close()
        raise EndpointInUse(str(path), error.strerror or str(error)) from error


def clear(path: Path) -> None:
    """Remove the socket that a dead process has left. Raises EndpointInUse if it is not that."""
    try:
        found = os.lstat(path)
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(found.st_mode) or found.st_uid != os.geteuid():
        raise EndpointInUse(str(path), "there is something else at this path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(LONGEST_PROBE)
        code = probe.connect_ex(str(path))
    if code != errno.ECONNREFUSED:
        raise EndpointInUse(str(path), "a live process listens there")
    remove(path, found.st_ino)
