"""A file that outlives the program: written whole or not at all, and refused where it holds something else."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TypeVar

import msgspec

T = TypeVar("T")


def read_kept(path: Path, kind: type[T], what: str) -> T | None:
    """What a file holds, as JSON; None: there is no such file.

    Args:
        path: of the file.
        kind: what it is to hold.
        what: it is called so in errors.

    Raises:
        ValueError: it holds something else. OSError: it cannot be read.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.DecodeError as error:
        raise ValueError(f"{path} has no {what} ({error}); remove it to begin anew") from error


def write_kept(path: Path, content: object) -> None:
    """Write a file whole, so that whoever reads it after a crash has what was there before, or all that is new.

    Raises:
        OSError: it cannot be written; what was there is there.
    """
    beside = path.with_name(f"{path.name}.new")
    with beside.open("wb") as file:
        file.write(msgspec.json.encode(content))
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)
