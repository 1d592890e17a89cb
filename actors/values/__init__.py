"""Values without a schema as bytes, for snapshots: each returns with its type, or is refused by name.

A value is first lowered to a tree of what msgpack has types for: lists, dicts with scalars for keys, scalars. What is
so already is left as it is. Anything else becomes a list that starts with a mark, which is an empty extension value;
the mark's code is that of the type, and the rest of the list are the value's parts.

The bytes: version, flag; with flag 0 a msgpack tree without marks; with flag 1 the length of the tree (8 bytes, big
endian), the tree, and the raw buffers that its marks mention, in that order.

`value_writer.py` lowers and packs, `value_reader.py` unpacks and makes again, `value_describer.py` says what would be
made. What they know of the types is in `forms.py` (the builtin ones), `classes.py` (those of users) and `arrays.py`
(numpy's).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable

from ..errors import DamagedValue, UnsavableValue
from .budget import LargeInts, TooMany, check_containers
from .byte_parts import ByteParts, in_one
from .forms import FORMAT, LENGTH
from .saved_refs import SavedHandle, SavedRef
from .value_describer import Describer, ValueDescription
from .value_reader import Decoder, unpack
from .value_writer import ALONE, HEAD_ALONE, Links, pieces, scalar_bytes, walked_pieces

__all__ = [
    "ALONE",
    "ByteParts",
    "DamagedValue",
    "Links",
    "SavedRef",
    "ValueDescription",
    "UnsavableValue",
    "adopt_value",
    "decode_value",
    "describe_value",
    "encode_value",
    "in_one",
    "state_digest",
    "walked_pieces",
]


def encode_value(value: object, *, where: str = "value", refs: bool = True) -> bytes:
    """Save a value with the types of all that is in it.

    What can change (a list, dict, array, dataclass ...) and is reached twice is one object again when read; only arrays
    that overlap in memory become separate. Equal values may differ in bytes: compare their `state_digest`.

    Args:
        value: of the builtin types and those of collections, datetime (UTC, fixed offset, ZoneInfo), decimal,
            fractions, uuid and pathlib; a random.Random; an Enum, dataclass, msgspec.Struct or NamedTuple whose class
            can be imported; a ref, of which the address is saved; a numpy array or scalar of any dtype without objects,
            Generator or RandomState. A subclass of one of these is another type.
        where: the name of the value in errors.
        refs: False where the reader has no actors, and can make no refs.

    Raises:
        UnsavableValue: something in it is of another type, contains itself, or is nested deeper than about 300 levels.

    >>> decode_value(encode_value({"seen": {(1, 2)}, 7: b"x"}))
    {'seen': {(1, 2)}, 7: b'x'}
    >>> encode_value({"x": [1, object()]}, where="balance")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    holdfast.actors.errors.UnsavableValue: balance['x'][1]: a value of type object cannot be saved; make it ...
    """
    simple = scalar_bytes(value)
    return b"".join(pieces(value, where, canonical=False, refs=refs)) if simple is None else simple


def state_digest(value: object) -> bytes:
    """Digest a value: 16 bytes (blake2b), the same in every process for values of equal types and contents.

    The order of a dict counts; that of a set does not, nor whether two equal parts are one object. Only numpy's
    longdouble is not covered: some of its bytes have no meaning.

    Raises:
        UnsavableValue: as `encode_value`.

    >>> state_digest({"b", "a"}) == state_digest({"a", "b"}), state_digest([1]) == state_digest([True])
    (True, False)
    """
    digest = hashlib.blake2b(digest_size=16)
    for piece in pieces(value, "value", canonical=True):
        digest.update(piece)
    return digest.digest()


def decode_value(
    data: bytes | memoryview,
    *,
    imports: bool = True,
    shared: dict[int, object] | None = None,
    refs: Callable[[str], object] = SavedRef,
    handles: Callable[[SavedHandle], None] = SavedHandle.nobody,
) -> object:
    """Read what `encode_value` wrote. Arrays are writable and own their memory.

    Classes are found by importing their module, and must be of the kind that was saved. No `__init__` is called; only
    a Struct has to be made by its constructor, after which its fields are set to what they were.

    Args:
        data: the bytes. Whoever made them: keys that clash, lengths that lie and units that do not exist are refused.
        imports: False for bytes that another process made: it has nothing imported here, and no more lists and dicts
            made than `MOST_CONTAINERS`.
        shared: what values that were written before it share with it (`Links`); what is read is added.
        refs: gives the ref of an address (`Node.ref_at`); left out, a `SavedRef` stands for it, which cannot send.
        handles: told each handle that is read.

    Raises:
        DamagedValue: whatever is wrong with the bytes.

    >>> decode_value(encode_value((1, 2.0, True, None)))
    (1, 2.0, True, None)
    >>> decode_value(b"")
    Traceback (most recent call last):
    holdfast.actors.errors.DamagedValue: a saved value cannot be read: it is cut short; use an older snapshot
    """
    return _read(
        data,
        lambda buffers: Decoder(buffers, imports=imports, shared=shared, refs=refs, handles=handles),
        is_checked=not imports,
    )


def adopt_value(
    data: memoryview | ByteParts,
    *,
    shared: dict[int, object] | None = None,
    refs: Callable[[str], object] = SavedRef,
    handles: Callable[[SavedHandle], None] = SavedHandle.nobody,
) -> object:
    """Read what `encode_value` wrote into memory that is the reader's own: large arrays stay where they lie in it.

    Such an array is writable and keeps the memory alive; but it does not own it, so that it cannot be resized in place.
    `shared`, `refs` and `handles` are as for `decode_value`.

    Raises:
        DamagedValue: whatever is wrong with the bytes.
    """
    return _read(
        data, lambda buffers: Decoder(buffers, adopts=True, shared=shared, refs=refs, handles=handles), is_checked=False
    )


def describe_value(data: bytes | memoryview, *, shared: dict[int, object] | None = None) -> object:
    """Read what `encode_value` wrote without importing anything: each instance of a class is a `ValueDescription`.

    `shared` is as for `decode_value`.

    Raises:
        DamagedValue: whatever is wrong with the bytes, or numpy is needed and not there.
    """
    return _read(data, lambda buffers: Describer(buffers, shared=shared), is_checked=False)


def _read(data: bytes | memoryview | ByteParts, decoder: Callable[[ByteParts], Decoder], *, is_checked: bool) -> object:
    try:
        flag, tree, left = _opened(data)
        if is_checked:
            check_containers(tree)
        if flag == 0:
            return unpack(tree, ext_hook=LargeInts().make)
        return decoder(left).value(tree)
    except TooMany as error:
        raise DamagedValue(str(error)) from error
    except (DamagedValue, MemoryError):  # Out of memory is no damage: the bytes may be good.
        raise
    except Exception as error:
        raise DamagedValue(f"{type(error).__name__}: {error}") from error


def _opened(data: bytes | memoryview | ByteParts) -> tuple[int, memoryview, ByteParts]:
    """The flag of a value, its tree, and the buffers behind that."""
    if isinstance(data, bytes) and data.startswith(HEAD_ALONE):  # Most are so, and small.
        return 0, memoryview(data)[len(HEAD_ALONE) :], _NOTHING
    left = data if isinstance(data, ByteParts) else ByteParts((memoryview(data).cast("B"),))
    if len(left) < len(HEAD_ALONE):
        raise DamagedValue("it is cut short")
    version, flag = in_one(left.take(len(HEAD_ALONE)))
    if version != FORMAT or flag > 1:
        raise DamagedValue(f"it has format {version}.{flag}, and only format {FORMAT} is known")
    size = len(left) if flag == 0 else LENGTH.unpack(in_one(left.take(LENGTH.size)))[0]
    return flag, in_one(left.take(size)), left


_NOTHING = ByteParts(())
