"""Private keys: in files that nobody else can read, or made anew at each start. They are never shown, and never copied.

A key is no key variable, is in no message and in no log. It cannot be pickled, encoded or copied; what is printed of it
is the fingerprint of its public half.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from .sec_errors import UnsafeKeyFile

MOST_BYTES = 10_000


class Secret:
    """Base of what must not leave the process: it is neither pickled, nor copied, nor shown."""

    __slots__ = ()

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise TypeError(f"a {type(self).__name__} holds keys: it is neither pickled nor copied")

    def __copy__(self) -> NoReturn:
        self.__reduce_ex__(2)

    def __deepcopy__(self, memo: object) -> NoReturn:
        self.__reduce_ex__(2)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}>"


class SigningKey(Secret):
    """An Ed25519 key pair: what a participant signs with."""

    __slots__ = ("_private", "public")

    def __init__(self, private: Ed25519PrivateKey) -> None:
        self._private = private
        self.public: Ed25519PublicKey = private.public_key()

    @classmethod
    def per_start(cls) -> SigningKey:
        """A new key, which ends with this process."""
        return cls(Ed25519PrivateKey.generate())

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> SigningKey:
        """The key in a file; a new one is made, mode 0600, if there is no such file.

        Raises:
            UnsafeKeyFile: somebody else could have read or written it, it is a link, or holds no Ed25519 key.
        """
        file = Path(path)
        try:
            return cls(_read(file))
        except FileNotFoundError:
            pass
        _write_new(file, Ed25519PrivateKey.generate())
        return cls(_read(file))  # Maybe another process was faster: then the key is that one's.

    @classmethod
    def renewed(cls, path: str | os.PathLike[str]) -> SigningKey:
        """A new key, in the place of the one in this file.

        Raises:
            UnsafeKeyFile: it cannot be written there.
        """
        write_own(Path(path), _pem(Ed25519PrivateKey.generate()), place=os.replace)
        return cls.from_file(path)

    def sign(self, data: bytes) -> bytes:
        """64 bytes that only this key can make."""
        return self._private.sign(data)

    @property
    def private(self) -> Ed25519PrivateKey:
        """The private key, for building certificates."""
        return self._private

    @property
    def fingerprint(self) -> str:
        """The first 16 hex digits of the SHA-256 of the public key."""
        return hashlib.sha256(raw_public(self.public)).hexdigest()[:16]

    def __repr__(self) -> str:
        return f"<SigningKey {self.fingerprint}>"


def raw_public(key: Ed25519PublicKey) -> bytes:
    """The 32 bytes of a public key."""
    return key.public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)


def is_signed(key: Ed25519PublicKey, signature: bytes, data: bytes) -> bool:
    """Whether the owner of the key has signed this."""
    try:
        key.verify(signature, data)
    except InvalidSignature:
        return False
    return True


def _read(path: Path) -> Ed25519PrivateKey:
    content = read_own(path)
    try:
        key = serialization.load_pem_private_key(content, password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        # No cause: its text could show what is in the file.
        raise UnsafeKeyFile(str(path), "it holds no private key in PEM form") from None
    if not isinstance(key, Ed25519PrivateKey):
        raise UnsafeKeyFile(str(path), "its key is not an Ed25519 key")
    return key


def _write_new(path: Path, key: Ed25519PrivateKey) -> None:
    with contextlib.suppress(FileExistsError):
        write_own(path, _pem(key), place=os.link)


def _pem(key: Ed25519PrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def read_own(path: Path) -> bytes:
    """Read a file that only this process's user can have written or read. No link is followed.

    Raises:
        UnsafeKeyFile: somebody else could have, or it is a link, has several names, or cannot be read.
        FileNotFoundError: it is not there.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise UnsafeKeyFile(str(path), error.strerror or str(error)) from error
    try:
        about = os.fstat(descriptor)
        if not stat.S_ISREG(about.st_mode):
            raise UnsafeKeyFile(str(path), "it is no regular file")
        if about.st_uid != os.geteuid():
            raise UnsafeKeyFile(str(path), "it belongs to another user")
        if about.st_mode & 0o077:
            mode = f"{stat.S_IMODE(about.st_mode):04o}"
            raise UnsafeKeyFile(str(path), f"its mode is {mode}: others can get at it. Make new keys, with mode 0600")
        if about.st_nlink > 1:
            _remove_half_made(path, about)
            if os.fstat(descriptor).st_nlink > 1:
                raise UnsafeKeyFile(str(path), "it has several names (hard links): remove all but one of them")
        return os.read(descriptor, MOST_BYTES)
    finally:
        os.close(descriptor)


def write_own(path: Path, content: bytes, *, place: Callable[[str, Path], None]) -> None:
    """Make a file, mode 0600: all of it is there, under a name of its own, before `place` puts it where it belongs.

    Raises:
        UnsafeKeyFile: it cannot be written. FileExistsError: of `place`.
    """
    import tempfile  # only now: it brings every kind of compression

    try:
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            place(name, path)
        finally:
            with contextlib.suppress(FileNotFoundError):  # It was renamed, or somebody has tidied up.
                os.unlink(name)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except FileExistsError:
        raise
    except OSError as error:
        raise UnsafeKeyFile(str(path), f"it cannot be written: {error}") from error


def _remove_half_made(path: Path, about: os.stat_result) -> None:
    """Remove the name that the file had before it was put in place: its maker was killed, or is about to do it."""
    for one in path.parent.glob(f".{glob.escape(path.name)}.*"):
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.lstat(one), about):
                os.unlink(one)
