"""Compression of what goes to a store, by the zstandard library if the program wants it."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, Final

from ...actors.errors import SpecError

PLAIN: Final = 0
ZSTD: Final = 1
DEFAULT_LEVEL: Final = 3

Compress = Callable[["bytes | memoryview"], "tuple[int, bytes | memoryview]"]


def check_compress(where: str, value: object) -> bool | int:
    """What `compress=` may be.

    Raises:
        SpecError: it is no level, or the library is not installed.
    """
    if isinstance(value, bool) or (isinstance(value, int) and 1 <= value <= 22):
        if value:
            _library(where)
        return value
    raise SpecError(where, f"compress must be True, False or a level from 1 to 22, not {value!r}")


def _library(where: str) -> Any:
    try:
        return importlib.import_module("zstandard")  # only now: few programs have it
    except ImportError as error:
        raise SpecError(where, "compress needs the library zstandard: pip install 'holdfast[compress]'") from error


def compressor(level: bool | int) -> Compress:
    """What compresses: gives the codec and the bytes; what does not become smaller stays as it is."""
    if not level:
        return lambda data: (PLAIN, data)
    deflate = _library("compress").ZstdCompressor(level=DEFAULT_LEVEL if level is True else level).compress

    def compress(data: bytes | memoryview) -> tuple[int, bytes | memoryview]:
        small = deflate(data)
        return (ZSTD, small) if len(small) < len(data) else (PLAIN, data)

    return compress


class LibraryMissing(ValueError):
    """The bytes may be good, but nobody here can decompress them."""


def decompress(codec: int, data: bytes, length: int) -> bytes:
    """What `compressor` made smaller.

    Raises:
        ValueError: the bytes are damaged. LibraryMissing: the library is not there.
    """
    if codec == PLAIN:
        return data
    if codec != ZSTD:
        raise ValueError(f"it has codec {codec}")
    try:
        library = _library("compress")
    except SpecError as error:
        raise LibraryMissing(str(error)) from error
    try:
        return bytes(library.ZstdDecompressor().decompress(data, max_output_size=length))
    except library.ZstdError as error:
        raise ValueError(f"it cannot be decompressed: {error}") from error
