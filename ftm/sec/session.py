"""A session: sealed frames between two participants, under keys that only they have, each accepted once.

    frame = version (1) | session (8) | generation (4) | sequence (8) | sealed text, with a tag of 16

The head, and what both sides know besides (`about`, say a request's number), are sealed along. Each direction has keys
of its own. A nonce is made of the sequence number, which only rises and is never saved: a session ends with its
process. The keys are exchanged for the next *generation* after so many frames or seconds, by a one-way function, so
that keys which are found out do not open what came before.
"""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Callable
from typing import Final

import msgspec
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand

from .certificates import CertifiedPeer
from .keys import Secret
from .sec_errors import (
    EXHAUSTED,
    EXPIRED,
    FORGED,
    FORKED,
    GENERATION,
    REPLAYED,
    TOO_OLD,
    TRUNCATED,
    VERSION,
    WRONG_SESSION,
    Rejected,
)

FORMAT: Final = 1
HEAD: Final = struct.Struct(">B8sIQ")
TAG_BYTES: Final = 16
MOST_FRAMES: Final = 1 << 48
LEAP: Final = 8
"""Generations by which a sender may be ahead: all frames of those between may be lost."""
SUITES: Final[dict[str, type[AESGCM] | type[ChaCha20Poly1305]]] = {
    "aes-256-gcm": AESGCM,
    "chacha20-poly1305": ChaCha20Poly1305,
}


class SessionLimits(msgspec.Struct, frozen=True):
    """When keys are exchanged, and when a session ends.

    Args:
        messages, seconds: after so many frames, or so long, the sender goes on with the next generation of keys.
        grace: seconds in which frames under the keys before are still accepted.
        lifetime: seconds after which a session is over; never later than the other's certificate is.
        window: how far a frame may be behind the newest one.
    """

    messages: int = 1 << 20
    seconds: float = 3600.0
    grace: float = 30.0
    lifetime: float = 86_400.0
    window: int = 1024

    def __post_init__(self) -> None:
        if self.messages < 1 or self.window < 1 or min(self.seconds, self.lifetime) <= 0 or self.grace < 0:
            raise ValueError("messages and window must be >= 1, seconds and lifetime > 0, grace >= 0")


def expand(secret: bytes, info: bytes, size: int = 32) -> bytes:
    """A key made of another one; there is no way back."""
    return HKDFExpand(SHA256(), size, b"holdfast sec " + info).derive(secret)


class _Keys(Secret):
    """One generation of one direction."""

    __slots__ = ("_iv", "_secret", "cipher", "number", "sealed", "since")

    def __init__(self, suite: str, secret: bytes, number: int, since: float) -> None:
        self._secret = secret
        self.cipher = SUITES[suite](expand(secret, b"key"))
        self._iv = int.from_bytes(expand(secret, b"iv", 12), "big")
        self.number, self.since, self.sealed = number, since, 0

    def nonce(self, sequence: int) -> bytes:
        return (self._iv ^ sequence).to_bytes(12, "big")

    def later(self, suite: str, number: int, since: float) -> _Keys:
        """The keys of a later generation."""
        secret = self._secret
        for _ in range(number - self.number):
            secret = expand(secret, b"next")
        return _Keys(suite, secret, number, since)


class Window:
    """Which sequence numbers were here: all that are too far behind count as such."""

    __slots__ = ("_bits", "_size", "newest")

    def __init__(self, size: int) -> None:
        self._size = size
        self._bits = 0  # bit i: newest - i was here
        self.newest = -1

    def refusal(self, number: int) -> str:
        """Why a number is not accepted; empty if it is."""
        behind = self.newest - number
        if behind < 0:
            return ""
        if behind >= self._size:
            return TOO_OLD
        return REPLAYED if self._bits >> behind & 1 else ""

    def put(self, number: int) -> None:
        """Note that the frame of this number has come."""
        ahead = number - self.newest
        if ahead > 0:
            # A number far ahead must not make a number of that many bits.
            self._bits = 1 if ahead >= self._size else (self._bits << ahead | 1) & ((1 << self._size) - 1)
            self.newest = number
        else:
            self._bits |= 1 << -ahead


class Session(Secret):
    """Seals and opens frames, with one peer, in one epoch and one life of both.

    Args:
        peer: whom it is with, verified.
        number: 8 bytes, the same on both sides.
        sending, receiving: the secrets of the two directions.
        suite: "aes-256-gcm" or "chacha20-poly1305".
        epoch: for which it was agreed.
        clock: seconds that do not go back.
        lifetime: seconds until it is over.
        rejected: where rejections are counted, by reason.
    """

    __slots__ = (
        "_clock", "_closed", "_limits", "_pid", "_previous", "_receiving", "_sending", "_sequence", "_suite", "_until",
        "_window", "epoch", "incarnation", "number", "opened", "peer", "rejected", "sealed",
    )  # fmt: skip

    def __init__(
        self,
        peer: CertifiedPeer,
        number: bytes,
        sending: bytes,
        receiving: bytes,
        *,
        suite: str,
        epoch: int,
        incarnation: int,
        clock: Callable[[], float],
        lifetime: float,
        limits: SessionLimits,
        rejected: Counter[str],
    ) -> None:
        now = clock()
        self.peer, self.number, self.epoch, self.incarnation = peer, number, epoch, incarnation
        self.rejected = rejected
        self.sealed = self.opened = 0
        self._suite, self._limits, self._clock = suite, limits, clock
        self._sending = _Keys(suite, sending, 0, now)
        self._receiving = _Keys(suite, receiving, 0, now)
        self._previous: _Keys | None = None
        self._window = Window(limits.window)
        self._sequence = 0
        self._until = now + lifetime
        self._closed = ""
        self._pid = os.getpid()

    @property
    def is_open(self) -> bool:
        """Whether frames can be sealed and opened."""
        return not self._closed and self._clock() < self._until

    @property
    def generation(self) -> int:
        """Of the keys that are sealed with."""
        return -1 if self._closed else self._sending.number

    def close(self, reason: str = "closed") -> None:
        """Forget the keys; from now on everything is rejected for this reason."""
        if not self._closed:
            self._closed = reason
            del self._sending, self._receiving
            self._previous = None

    def seal(self, text: bytes, about: bytes = b"") -> bytes:
        """A frame that only the peer can read, and that nobody can change.

        Args:
            text: what is sealed.
            about: what the peer must know anyhow, and say when it opens the frame.

        Raises:
            Rejected: the session is closed, expired or exhausted, or this process was forked.
        """
        now = self._check()
        keys, limits = self._sending, self._limits
        if keys.sealed >= limits.messages or now - keys.since >= limits.seconds:
            keys = self._sending = keys.later(self._suite, keys.number + 1, now)
        sequence = self._sequence
        if sequence >= MOST_FRAMES or keys.number >= 0xFFFFFFFF:
            raise self._reject(EXHAUSTED)
        # First counted: whatever happens next, this number is not used again.
        self._sequence += 1
        keys.sealed += 1
        self.sealed += 1
        head = HEAD.pack(FORMAT, self.number, keys.number, sequence)
        return head + keys.cipher.encrypt(keys.nonce(sequence), text, head + about)

    def open(self, frame: bytes, about: bytes = b"") -> bytes:
        """What the peer has sealed.

        Raises:
            Rejected: it is not the peer's, or was here before; see `reason`. Nothing is changed by a rejected frame.
        """
        now = self._check()
        if len(frame) < HEAD.size + TAG_BYTES:
            raise self._reject(TRUNCATED)
        head = bytes(frame[: HEAD.size])
        version, number, generation, sequence = HEAD.unpack(head)
        if version != FORMAT:
            raise self._reject(VERSION)
        if number != self.number:
            raise self._reject(WRONG_SESSION)
        refusal = TOO_OLD if sequence >= MOST_FRAMES else self._window.refusal(sequence)
        if refusal:
            raise self._reject(refusal)
        keys = self._keys_of(generation, now)
        try:
            text = keys.cipher.decrypt(keys.nonce(sequence), bytes(frame[HEAD.size :]), head + about)
        except InvalidTag:
            raise self._reject(FORGED) from None
        # Only now is anything of the head true.
        if keys.number > self._receiving.number:
            self._receiving.since = now  # from here on its grace is counted
            self._previous, self._receiving = self._receiving, keys
        self._window.put(sequence)
        self.opened += 1
        return text

    def _keys_of(self, generation: int, now: float) -> _Keys:
        current, previous = self._receiving, self._previous
        if previous is not None and now - previous.since > self._limits.grace:
            previous = self._previous = None
        if generation == current.number:
            return current
        if previous is not None and generation == previous.number:
            return previous
        if current.number < generation <= current.number + LEAP:
            return current.later(self._suite, generation, now)
        raise self._reject(GENERATION)

    def _check(self) -> float:
        if self._closed:
            raise self._reject(self._closed)
        if os.getpid() != self._pid:  # Parent and child would seal different texts under the same nonce.
            raise self._reject(FORKED)
        now = self._clock()
        if now >= self._until:
            raise self._reject(EXPIRED)
        return now

    def _reject(self, reason: str) -> Rejected:
        self.rejected[reason] += 1
        return Rejected(reason, f"a frame of {self.peer.name!r}")

    def __repr__(self) -> str:
        state = self._closed or "open"
        return f"<Session with {self.peer.name!r} epoch {self.epoch} {state}>"
