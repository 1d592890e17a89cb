"""The bytes of a store beside its entries: the checksum of each row, and lists of positions."""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Sequence
from hashlib import blake2b
from typing import Final

CHUNK: Final = 500  # Rows removed in one transaction: about 1 ms, which a caller of `append` may have to wait.
PLACE: Final = struct.Struct("<QQQ")  # position, address id, chain number


def row_crc(position: int, address: int, chain: int, data: bytes) -> int:
    """Checksum of an entry, over its place and content."""
    return zlib.crc32(data, zlib.crc32(PLACE.pack(position, address, chain)))


def crc_of(*fields: object, key: bytes = b"") -> int:
    """Checksum of the fields of a small row; with a key it is one that nobody else can make."""
    data = repr(fields).encode("utf-8", "surrogatepass")
    if not key:
        return zlib.crc32(data)
    return int.from_bytes(blake2b(data, digest_size=8, key=key).digest(), "little", signed=True)


def snapshot_digest(address: str, turn: int, epoch: int, data: bytes, key: bytes = b"") -> bytes:
    """Checksum of a snapshot: 16 bytes; with a key it tells nothing of the snapshot."""
    digest = blake2b(repr((address, turn, epoch, len(data))).encode(), digest_size=16, key=key)
    digest.update(data)  # releases the GIL, so the loop goes on while a worker thread is here
    return digest.digest()


def pack_positions(positions: Sequence[int]) -> bytes:
    """Sorted positions as one blob; zlib adds the checksum (Adler-32)."""
    return zlib.compress(array("q", sorted(set(positions))).tobytes(), 1)


def unpack_positions(blob: bytes) -> array[int]:
    """What `pack_positions` packed; zlib.error or ValueError if the blob is damaged."""
    positions = array("q")
    if blob:
        positions.frombytes(zlib.decompress(blob))
    return positions
