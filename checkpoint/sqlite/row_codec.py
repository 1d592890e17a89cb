"""The bytes of a store: what an entry is encoded as, and the checksum of each row."""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Callable, Sequence
from hashlib import blake2b
from typing import Final, cast

import msgpack

from ..journal import Entry, Primitive

CHUNK: Final = 500  # Rows removed in one transaction: about 1 ms, which a caller of `append` may have to wait.
_PLAIN: Final = frozenset({int, float, str, bytes, bool, type(None)})
_BIG_INT: Final = 1  # msgpack extension type
PLACE: Final = struct.Struct("<QQQ")  # position, address id, chain number


def entry_packer() -> Callable[[Entry], bytes]:
    """What encodes an entry that `check_entry` has let pass; not for two threads at once."""
    return cast("Callable[[Entry], bytes]", msgpack.Packer(default=_big_int, unicode_errors="surrogatepass").pack)


def check_entry(entry: Entry) -> None:
    """Refuse what would not come back as it is: a list (as a tuple), an Enum (as its value), a dict, ..."""
    if type(entry) is not tuple or not entry or type(entry[0]) is not str:
        raise TypeError(f"an entry is a tuple that opens with its kind, a str, not {entry!r:.100}")
    _check_items(entry)


def is_plain(entry: Entry) -> bool:
    """Whether it certainly passes `check_entry`: the common case, and a quick look."""
    return type(entry) is tuple and _PLAIN.issuperset(map(type, entry)) and bool(entry) and type(entry[0]) is str


def _check_items(items: tuple[Primitive, ...]) -> None:
    if _PLAIN.issuperset(map(type, items)):
        return
    for item in items:
        if type(item) is tuple:
            _check_items(item)
        elif type(item) not in _PLAIN:
            raise TypeError(f"a journal entry holds primitives and tuples of them, not {type(item).__name__}")


def _big_int(value: object) -> msgpack.ExtType:
    """Called by msgpack for what it cannot encode, which after `check_entry` is only an int of more than 64 bits."""
    assert isinstance(value, int)
    return msgpack.ExtType(_BIG_INT, value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True))


def _from_ext(code: int, data: bytes) -> int:
    if code != _BIG_INT:
        raise ValueError(f"unknown extension type {code}")
    return int.from_bytes(data, "little", signed=True)


def decode_entry(data: bytes) -> Entry:
    """The entry that `entry_packer` encoded; ValueError and kin if these bytes are none."""
    return cast("Entry", msgpack.unpackb(data, use_list=False, ext_hook=_from_ext, unicode_errors="surrogatepass"))


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
