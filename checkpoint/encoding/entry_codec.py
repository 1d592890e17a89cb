"""What an entry of a journal is encoded as, in every store: exactly what was given comes back."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final, cast

import msgpack

from ..journal import Entry, Primitive

_PLAIN: Final = frozenset({int, float, str, bytes, bool, type(None)})
_BIG_INT: Final = 1  # msgpack extension type


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


def decode_entries(data: bytes) -> Iterator[Entry]:
    """The entries whose encodings stand one behind the other in these bytes; ValueError and kin if they do not."""
    unpacker = msgpack.Unpacker(
        use_list=False, ext_hook=_from_ext, unicode_errors="surrogatepass", max_buffer_size=max(1, len(data))
    )
    unpacker.feed(data)
    yield from unpacker
    if unpacker.tell() != len(data):
        raise ValueError(f"{len(data) - unpacker.tell()} bytes at the end are no entry")
