"""Files with secrets: read only where nobody but their owner can have read or written them."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Final

from ...actors.errors import SpecError

MOST_BYTES: Final = 65536


def read_private(where: str, path: Path) -> bytes:
    """What a file says that belongs to this user, or to root, and that nobody else may use.

    Args:
        where: the option that names it, for the error.

    Raises:
        SpecError: it is not there, is no regular file, is somebody else's, or others may use it.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError as error:
        raise SpecError(where, f"the file {path} cannot be read: {error.strerror}") from error
    info = os.fstat(descriptor)
    if not stat.S_ISREG(info.st_mode):  # Python opens no folder, and says so in its own way.
        os.close(descriptor)
        raise SpecError(where, f"{path} must be a regular file")
    with open(descriptor, "rb") as file:
        if info.st_uid not in (0, os.geteuid()):
            raise SpecError(
                where, f"{path} belongs to the user {info.st_uid}: copy it to a file of your own, mode 0600"
            )
        if info.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            mode = stat.S_IMODE(info.st_mode)
            raise SpecError(where, f"others may use {path} (its mode is {mode:04o}): chmod 600 {path}")
        return file.read(MOST_BYTES)
