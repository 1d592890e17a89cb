"""What a store with a key keeps is encrypted, and bound to its place in that store: all of it passes through here.

AES-256-GCM. Each opening of a store draws a salt; its key is derived from the user's key, that salt and the identity of
the store (HKDF-SHA256), and it numbers what it seals. So key and nonce never come together twice: neither in a copy of
the files, nor when older files are put back.

Sealed bytes are the salt, the number, and pieces of 1 MiB, each with its tag. The nonce of a piece says which one it is
and whether it is the last. The place (kind, address, number) is authenticated with each: bytes that were moved from
another place or another store are refused, as changed ones are.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from functools import lru_cache
from hashlib import blake2b
from itertools import count
from typing import TYPE_CHECKING, Final, Protocol

from ...actors.errors import SpecError
from ..encoding.entry_codec import decode_entry, entry_packer
from ..journal import Entry, Primitive
from .row_codec import crc_of

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

Bytes = bytes | memoryview
_SALT: Final = 16
_HEAD: Final = struct.Struct("<16sQ")  # salt, number
_NONCE: Final = struct.Struct("<QI")  # number, piece
_LAST: Final = 1 << 31
_PIECE: Final = 1 << 20
_TAG: Final = 16
_NAME: Final = struct.Struct("<I")  # length of the name of a note
_BLOCK: Final = struct.Struct("<QQQI")  # pack, offset, length, codec
_ONE: Final = struct.Struct("<q")


class Cipher(Protocol):
    """What turns payloads into what is kept, and back.

    Attributes:
        digest_key: what digests and checksums are keyed with; empty in a store without a key.
    """

    digest_key: bytes

    def seal(self, place: bytes, data: Bytes) -> Bytes:
        """What is kept of `data` at that place."""
        ...

    def sealed_parts(self, place: bytes, data: Bytes) -> Iterator[Bytes]:
        """The same, piece by piece."""
        ...

    def unseal(self, place: bytes, kept: bytes) -> bytes:
        """The data again.

        Raises:
            ValueError: they were changed, or are not of this place.
        """
        ...


class HasCipher(Protocol):
    """The parts of a store, which know its cipher once they are unlocked."""

    @property
    def cipher(self) -> Cipher:
        """What all payloads go through."""
        ...


class NoCipher:
    """Of a store without a key: everything is kept as it is."""

    digest_key = b""

    def seal(self, place: bytes, data: Bytes) -> Bytes:
        """Return it as it is."""
        return data

    def sealed_parts(self, place: bytes, data: Bytes) -> Iterator[Bytes]:
        """Give it as it is."""
        yield data

    def unseal(self, place: bytes, kept: bytes) -> bytes:
        """Return it as it is."""
        return kept


class StoreCipher:
    """Of a store with a key, for one opening of it.

    Args:
        key: of the user, 32 bytes.
        identity: of the store, 16 bytes.

    Raises:
        SpecError: the library is not installed.
    """

    def __init__(self, key: bytes, identity: bytes) -> None:
        try:  # Only now: few programs have it.
            from cryptography.hazmat.primitives.ciphers.aead import AESGCM
            from cryptography.hazmat.primitives.hashes import SHA256
            from cryptography.hazmat.primitives.kdf.hkdf import HKDF
        except ImportError as error:
            raise SpecError("store_key", "needs the library cryptography: pip install 'holdfast[crypto]'") from error

        def derived(purpose: bytes, salt: bytes) -> bytes:
            return HKDF(SHA256(), 32, salt, b"holdfast store " + purpose + identity).derive(key)

        def opened(salt: bytes) -> AESGCM:
            return AESGCM(derived(b"seal", salt))

        self.digest_key = derived(b"digest", bytes(_SALT))
        self._of_salt = lru_cache(maxsize=256)(opened)
        self._salt = os.urandom(_SALT)
        self._own = opened(self._salt)
        self._numbers = count(1)

    def seal(self, place: bytes, data: Bytes) -> Bytes:
        """Encrypt it, for this place only."""
        if len(data) > _PIECE:
            return b"".join(self.sealed_parts(place, data))
        number = next(self._numbers)
        return _HEAD.pack(self._salt, number) + self._own.encrypt(_NONCE.pack(number, _LAST), data, place)

    def sealed_parts(self, place: bytes, data: Bytes) -> Iterator[Bytes]:
        """Encrypt it, for this place only, piece by piece: other threads run in between."""
        number = next(self._numbers)
        yield _HEAD.pack(self._salt, number)
        view = memoryview(data)
        for piece, at in enumerate(range(0, max(1, len(view)), _PIECE)):
            nonce = _nonce(number, piece, is_last=at + _PIECE >= len(view))
            yield self._own.encrypt(nonce, view[at : at + _PIECE], place)

    def unseal(self, place: bytes, kept: bytes) -> bytes:
        """Decrypt it.

        Raises:
            ValueError: it was changed, or is not of this place.
        """
        from cryptography.exceptions import InvalidTag

        if not isinstance(kept, bytes) or len(kept) < _HEAD.size + _TAG:
            raise ValueError("it is no sealed data")
        salt, number = _HEAD.unpack_from(kept)
        cipher, view = self._of_salt(salt), memoryview(kept)[_HEAD.size :]
        size = _PIECE + _TAG
        try:
            if len(view) <= size:
                return cipher.decrypt(_NONCE.pack(number, _LAST), view, place)
            parts: list[bytes] = []
            for piece, at in enumerate(range(0, len(view), size)):
                nonce = _nonce(number, piece, is_last=at + size >= len(view))
                parts.append(cipher.decrypt(nonce, view[at : at + size], place))
            return b"".join(parts)
        except InvalidTag:
            raise ValueError("it was changed, or belongs to another place: its tag is wrong") from None


def _nonce(number: int, piece: int, *, is_last: bool) -> bytes:
    return _NONCE.pack(number, piece | _LAST if is_last else piece)


# ---- formats: an older holdfast refuses those that it does not know

FORMATS: Final = (1, 2, 3, 4)
_SEALED: Final = 2  # more than in a store without a key


def format_of(cipher: Cipher, *, may_have_log: bool) -> int:
    """The format of a store, which says whether there may be a log with rows."""
    return 1 + may_have_log + (_SEALED if cipher.digest_key else 0)


def is_sealed(version: int) -> bool:
    """Whether stores of this format are encrypted."""
    return version > _SEALED


def may_have_log(version: int) -> bool:
    """Whether stores of this format may have rows in a log."""
    return version % 2 == 0


# ---- places


def snapshot_place(number: int) -> bytes:
    """Of a snapshot in its row."""
    return b"snapshot" + _ONE.pack(number)


def drops_place(number: int) -> bytes:
    """Of what a snapshot makes superfluous."""
    return b"drops" + _ONE.pack(number)


def file_place(name: str) -> bytes:
    """Of a snapshot in a file."""
    return b"file" + name.encode()


def block_place(address: str, number: int, offset: int, length: int, codec: int) -> bytes:
    """Of a block in a pack."""
    return b"block" + _BLOCK.pack(number, offset, length, codec) + address.encode(errors="surrogatepass")


# ---- entries: what is kept of one is an entry, too, of no kind

SEALED_KIND: Final = ""


def _entry_place(packed: bytes) -> bytes:
    return b"entry" + packed


def entry_sealer(cipher: Cipher) -> Callable[[bytes, bytes], bytes] | None:
    """What seals encoded entries: called with a packed place (`PLACE`) and the entry; None in a store without a key."""
    if not cipher.digest_key:
        return None
    seal, pack = cipher.seal, entry_packer()
    return lambda place, data: pack((SEALED_KIND, bytes(seal(_entry_place(place), data))))


def kept_kind(cipher: Cipher, entry: Entry) -> Primitive:
    """What the row of an entry has as its kind."""
    return SEALED_KIND if cipher.digest_key else entry[0]


def sealed_entry(cipher: Cipher, place: bytes, entry: Entry, encoded: bytes) -> tuple[Primitive, bytes]:
    """What the row of an entry has as its kind and its data."""
    seal = entry_sealer(cipher)
    return kept_kind(cipher, entry), encoded if seal is None else seal(place, encoded)


def unseal_entry(cipher: Cipher, place: bytes, data: bytes) -> bytes:
    """An encoded entry, of what is kept of it at that packed place.

    Raises:
        ValueError, TypeError: it was changed.
    """
    if not cipher.digest_key:
        return data
    kind, kept = decode_entry(data)
    if kind != SEALED_KIND or not isinstance(kept, bytes):
        raise ValueError("it is no sealed data")
    return cipher.unseal(_entry_place(place), kept)


# ---- rows whose keys are not to be read either


def seal_path(cipher: Cipher, number: int, path: str | None) -> str | Bytes | None:
    """What the row of an address has as its path."""
    if path is None or not cipher.digest_key:
        return path
    return cipher.seal(b"address" + _ONE.pack(number), path.encode(errors="surrogatepass"))


def unseal_path(cipher: Cipher, number: int, kept: str | bytes | None) -> str | None:
    """The address of a row.

    Raises:
        ValueError: it was changed.
    """
    if kept is None or not cipher.digest_key:
        return kept if kept is None else str(kept)
    data = kept if isinstance(kept, bytes) else b""  # A flipped bit may also change the type of a column.
    return cipher.unseal(b"address" + _ONE.pack(number), data).decode(errors="surrogatepass")


def note_name(cipher: Cipher, name: str) -> str:
    """Under which name a note is kept."""
    if not cipher.digest_key:
        return name
    return blake2b(name.encode(errors="surrogatepass"), digest_size=16, key=cipher.digest_key).hexdigest()


def note_row(cipher: Cipher, name: str, value: bytes) -> tuple[str, Bytes, int]:
    """The row of a note: name, value, checksum."""
    kept_name, kept = note_name(cipher, name), value
    if cipher.digest_key:
        known = name.encode(errors="surrogatepass")
        kept = bytes(cipher.seal(b"note" + kept_name.encode(), _NAME.pack(len(known)) + known + value))
    return kept_name, kept, crc_of(kept_name, kept, key=cipher.digest_key)


def read_note(cipher: Cipher, kept_name: str, kept: bytes, crc: int) -> tuple[str, bytes]:
    """Name and value of a note.

    Raises:
        ValueError: it was changed.
    """
    if crc != crc_of(kept_name, kept, key=cipher.digest_key):
        raise ValueError(f"the checksum of note {kept_name!r} is wrong")
    if not cipher.digest_key:
        return kept_name, kept
    data = cipher.unseal(b"note" + kept_name.encode(), kept)
    end = _NAME.size + _NAME.unpack_from(data)[0]
    return data[_NAME.size : end].decode(errors="surrogatepass"), data[end:]
