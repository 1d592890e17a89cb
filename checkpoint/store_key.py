"""The key of an encrypted store: the 32 bytes themselves, a file that has them, or a function that gives them."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from typing import Final, TypeAlias

from ..actors.errors import SpecError

StoreKey: TypeAlias = "bytes | str | os.PathLike[str] | Callable[[], bytes]"

KEY_BYTES: Final = 32
_MOST_BYTES: Final = 2 * KEY_BYTES + 2  # in hexadecimal, with the end of a line


def read_store_key(key: StoreKey | None) -> bytes | None:
    """The bytes of a key; None if there is none.

    Args:
        key: 32 bytes; or the path of a file that nobody but its owner may read, with 32 bytes or 64 hexadecimal digits;
            or a function that returns 32 bytes.

    Raises:
        SpecError: it gives no such key.
    """
    if key is None:
        return None
    if isinstance(key, str | os.PathLike):
        return _read_file(os.fspath(key))
    found: object = key() if callable(key) else key
    if not isinstance(found, bytes | bytearray) or len(found) != KEY_BYTES:
        told = f"{len(found)} bytes" if isinstance(found, bytes | bytearray) else f"a {type(found).__name__}"
        raise SpecError("store_key", f"must be {KEY_BYTES} bytes, not {told}")  # Never the bytes themselves.
    return bytes(found)


def _read_file(path: str) -> bytes:
    try:
        with open(path, "rb") as file:
            info = os.fstat(file.fileno())
            if not stat.S_ISREG(info.st_mode) or info.st_uid not in (0, os.geteuid()):
                raise SpecError("store_key", f"the key file {path} must be a regular file of this user")
            data = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise SpecError("store_key", f"the key file cannot be read: {error}") from error
    found = data
    if len(data) != KEY_BYTES:
        try:
            found = bytes.fromhex(data.decode("ascii").strip())
        except ValueError:
            found = b""
    if len(found) != KEY_BYTES:
        raise SpecError("store_key", f"the key file {path} must have {KEY_BYTES} bytes or {2 * KEY_BYTES} hex digits")
    if info.st_mode & (stat.S_IRWXG | stat.S_IRWXO):  # Not before: the advice is for keys, and harms other files.
        raise SpecError("store_key", f"others may use the key file {path}: chmod 600 {path}")
    return found
