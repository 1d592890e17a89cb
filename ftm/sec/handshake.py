"""The hand-shake of two participants: X25519, signed by both, bound to names, lives and epoch.

    initiator                                                              responder
    Hello   certificate, one-time key, random, life, epoch, suites   ->
            <-   certificate, one-time key, random, life, suite, signature of all so far   Answer
    Finish  signature of all so far                                  ->

Each signature covers both certificates and both one-time keys, so nobody can stand in between, put the blame on
another, or use an old signature again. Of an old Hello nothing comes but an Answer that its sender cannot finish.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Final, TypeVar

import msgspec
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from .certificates import CertifiedPeer, Trust
from .keys import Secret, SigningKey, is_signed
from .sec_errors import CLOSED, FORGED, MALFORMED, REVOKED, STALE_EPOCH, STALE_LIFE, VERSION, WRONG_PEER, Rejected
from .session import SUITES, Session, SessionLimits, expand

T = TypeVar("T")

PROTOCOL: Final = 1
MOST_BYTES: Final = 32_768
RANDOM_BYTES: Final = 32


class Hello(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """The first part, by the initiator."""

    protocol: int
    to: str
    certificate: bytes
    key: bytes
    random: bytes
    incarnation: int
    epoch: int
    suites: list[str]


class AnswerBody(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """The second part, by the responder."""

    protocol: int
    certificate: bytes
    key: bytes
    random: bytes
    incarnation: int
    epoch: int
    suite: str


class Signed(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """Bytes, and the signature of the transcript up to their end."""

    body: bytes
    signature: bytes


class Participant(Secret):
    """One that seals and opens: its identity, whom it trusts, and whom it has heard of.

    Args:
        key: what it signs with.
        certificate: the authority's word that the key is its own.
        trust: whom it believes.
        incarnation: the number of this life; it rises with each.
        epoch: the lowest for which it still agrees on anything.
        suites: ciphers, the best first.
        limits: of its sessions.
        wall: Unix time. clock: seconds that do not go back.
    """

    __slots__ = (
        "_clock", "_epochs", "_key", "_lives", "_sessions", "_suites", "_wall", "certificate", "epoch", "incarnation",
        "limits", "name", "rejected", "trust",
    )  # fmt: skip

    def __init__(
        self,
        key: SigningKey,
        certificate: bytes,
        trust: Trust,
        *,
        incarnation: int,
        epoch: int = 0,
        suites: tuple[str, ...] = tuple(SUITES),
        limits: SessionLimits | None = None,
        wall: Callable[[], float] = time.time,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        unknown = [suite for suite in suites if suite not in SUITES]
        if unknown or not suites:
            raise ValueError(f"unknown suites {unknown}; there are {', '.join(SUITES)}")
        me = trust.verify(certificate, wall())
        self._key, self._suites, self._wall, self._clock = key, suites, wall, clock
        self.certificate, self.trust, self.name = certificate, trust, me.name
        self.incarnation, self.epoch = incarnation, epoch
        self.limits = SessionLimits() if limits is None else limits
        self.rejected: Counter[str] = Counter()
        self._lives: dict[str, int] = {}  # by peer: the highest incarnation that has proved itself
        self._epochs: dict[str, int] = {}
        self._sessions: dict[tuple[str, bool], Session] = {}

    # -- agreeing ---------------------------------------------------------------------------------------------------

    def begin(self, to: str) -> Initiation:
        """Begin to agree on a session with `to`; send its `hello`."""
        return Initiation(self, to)

    def answer(self, hello: bytes) -> Response:
        """Answer somebody's hello; send its `answer`.

        Raises:
            Rejected: see `reason`; the certificate, the epoch or the life is not acceptable.
        """
        return self.counted(lambda: Response(self, hello))

    def counted(self, work: Callable[[], T]) -> T:
        """Do it; a rejection is counted by its reason."""
        try:
            return work()
        except Rejected as error:
            self.rejected[error.reason] += 1
            raise

    def verify(self, certificate: bytes, name: str | None = None) -> CertifiedPeer:
        """Whose certificate this is, now."""
        return self.trust.verify(certificate, self._wall(), name)

    def check_fence(self, name: str, incarnation: int, epoch: int) -> None:
        """Refuse lives and epochs that are over."""
        if epoch < max(self.epoch, self._epochs.get(name, 0)):
            raise Rejected(STALE_EPOCH, f"a hand-shake of {name!r}")
        if incarnation < self._lives.get(name, 0):
            raise Rejected(STALE_LIFE, f"a hand-shake of {name!r}")

    def choose(self, offered: list[str]) -> str:
        """The best cipher both have."""
        for suite in self._suites:
            if suite in offered:
                return suite
        raise Rejected(VERSION, "a hand-shake")

    @property
    def suites(self) -> list[str]:
        """The ciphers it has, the best first."""
        return list(self._suites)

    def sign(self, role: bytes, transcript: bytes) -> bytes:
        """A signature that is good for this role in this hand-shake only."""
        return self._key.sign(_signed_text(role, transcript))

    def establish(
        self,
        peer: CertifiedPeer,
        incarnation: int,
        epoch: int,
        secret: bytes,
        transcript: bytes,
        suite: str,
        *,
        began: bool,
    ) -> Session:
        """The peer has proved itself: raise the fence, and put the new session in the place of the old one."""
        self.check_fence(peer.name, incarnation, epoch)  # It may have risen since the hand-shake began.
        self._lives[peer.name], self._epochs[peer.name] = incarnation, epoch
        for role in (True, False):
            old = self._sessions.get((peer.name, role))
            if old is not None and (role is began or (old.incarnation, old.epoch) != (incarnation, epoch)):
                old.close()
                del self._sessions[peer.name, role]
        master = HKDF(SHA256(), 32, transcript, b"holdfast sec session").derive(secret)
        outward, inward = expand(master, b"initiator"), expand(master, b"responder")
        session = Session(
            peer,
            expand(master, b"number", 8),
            outward if began else inward,
            inward if began else outward,
            suite=suite,
            epoch=epoch,
            incarnation=incarnation,
            clock=self._clock,
            lifetime=min(self.limits.lifetime, peer.until - self._wall()),
            limits=self.limits,
            rejected=self.rejected,
        )
        self._sessions[peer.name, began] = session
        return session

    # -- ending -----------------------------------------------------------------------------------------------------

    @property
    def sessions(self) -> tuple[Session, ...]:
        """The sessions that are open."""
        return tuple(session for session in self._sessions.values() if session.is_open)

    def raise_epoch(self, epoch: int) -> None:
        """A higher epoch has begun: what was agreed for lower ones is over."""
        if epoch > self.epoch:
            self.epoch = epoch
            self._close(STALE_EPOCH, lambda session: session.epoch < epoch)

    def take_list(self, data: bytes) -> bool:
        """Believe a list of revocations; sessions with those who are on it are over. Raises Rejected."""
        is_newer = self.counted(lambda: self.trust.take_list(data, self._wall()))
        self._close(REVOKED, lambda session: self.trust.is_revoked(session.peer.serial))
        return is_newer

    def close(self) -> None:
        """End all sessions, and agree on no more."""
        self._close(CLOSED, lambda session: True)

    def _close(self, reason: str, is_over: Callable[[Session], bool]) -> None:
        for key, session in list(self._sessions.items()):
            if is_over(session):
                session.close(reason)
                del self._sessions[key]

    def __repr__(self) -> str:
        return f"<Participant {self.name!r} life {self.incarnation} epoch {self.epoch}>"


class Initiation(Secret):
    """A hand-shake that this side has begun: send `hello`, then give the answer to `finish`."""

    __slots__ = ("_hello", "_me", "_private", "_to", "hello")

    def __init__(self, me: Participant, to: str) -> None:
        self._me, self._to = me, to
        self._private: X25519PrivateKey | None = X25519PrivateKey.generate()
        self._hello = Hello(
            PROTOCOL,
            to,
            me.certificate,
            self._private.public_key().public_bytes_raw(),
            os.urandom(RANDOM_BYTES),
            me.incarnation,
            me.epoch,
            me.suites,
        )
        self.hello = msgspec.msgpack.encode(self._hello)

    def finish(self, answer: bytes) -> tuple[Session, bytes]:
        """The session, and what the responder has to be sent before it has one, too.

        Raises:
            Rejected: the answer is not that of whom we want to talk to.
        """
        return self._me.counted(lambda: self._finish(answer))

    def _finish(self, answer: bytes) -> tuple[Session, bytes]:
        me = self._me
        signed = _decode(answer, Signed)
        body = _decode(signed.body, AnswerBody)
        _check_parts(body)
        if body.suite not in self._hello.suites:
            raise Rejected(VERSION, "an answer")
        peer = me.verify(body.certificate, self._to)
        transcript = _transcript(self.hello, signed.body)
        if not is_signed(peer.key(), signed.signature, _signed_text(b"responder", transcript)):
            raise Rejected(FORGED, "an answer")
        if body.epoch != self._hello.epoch:
            raise Rejected(STALE_EPOCH, "an answer")
        if self._private is None:
            raise Rejected(CLOSED, "an answer: there was one before")
        secret = _agree(self._private, body.key)
        session = me.establish(peer, body.incarnation, body.epoch, secret, transcript, body.suite, began=True)
        self._private = None  # A one-time key.
        return session, msgspec.msgpack.encode(Signed(b"", me.sign(b"initiator", transcript)))


class Response(Secret):
    """A hand-shake that another has begun: send `answer`, then give the last part to `complete`."""

    __slots__ = ("_body", "_hello", "_me", "_peer", "_secret", "_transcript", "answer")

    def __init__(self, me: Participant, data: bytes) -> None:
        hello = _decode(data, Hello)
        _check_parts(hello)
        if hello.to != me.name:
            raise Rejected(WRONG_PEER, "a hello")
        suite = me.choose(hello.suites)
        self._peer = me.verify(hello.certificate)
        me.check_fence(self._peer.name, hello.incarnation, hello.epoch)
        private = X25519PrivateKey.generate()
        self._secret: bytes | None = _agree(private, hello.key)
        self._me, self._hello = me, hello
        self._body = AnswerBody(
            PROTOCOL,
            me.certificate,
            private.public_key().public_bytes_raw(),
            os.urandom(RANDOM_BYTES),
            me.incarnation,
            hello.epoch,
            suite,
        )
        body = msgspec.msgpack.encode(self._body)
        self._transcript = _transcript(data, body)
        self.answer = msgspec.msgpack.encode(Signed(body, me.sign(b"responder", self._transcript)))

    @property
    def peer(self) -> CertifiedPeer:
        """Who the other says it is; true only when the hand-shake is complete."""
        return self._peer

    def complete(self, finish: bytes) -> Session:
        """The session.

        Raises:
            Rejected: it is not the one who says so, or its certificate or epoch is over by now.
        """
        return self._me.counted(lambda: self._complete(finish))

    def _complete(self, finish: bytes) -> Session:
        me, hello = self._me, self._hello
        signed = _decode(finish, Signed)
        if self._secret is None:
            raise Rejected(CLOSED, "the end of a hand-shake: there was one before")
        text = _signed_text(b"initiator", self._transcript)
        if signed.body or not is_signed(self._peer.key(), signed.signature, text):
            raise Rejected(FORGED, "the end of a hand-shake")
        peer = me.verify(hello.certificate, self._peer.name)
        session = me.establish(
            peer, hello.incarnation, hello.epoch, self._secret, self._transcript, self._body.suite, began=False
        )
        self._secret = None
        return session


def _decode(data: bytes, kind: type[T]) -> T:
    if len(data) > MOST_BYTES:
        raise Rejected(MALFORMED, "a hand-shake")
    try:
        return msgspec.msgpack.decode(data, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        raise Rejected(MALFORMED, "a hand-shake") from None


def _check_parts(part: Any) -> None:
    if part.protocol != PROTOCOL:
        raise Rejected(VERSION, "a hand-shake")
    if len(part.key) != 32 or len(part.random) != RANDOM_BYTES or min(part.incarnation, part.epoch) < 0:
        raise Rejected(MALFORMED, "a hand-shake")


def _transcript(hello: bytes, body: bytes) -> bytes:
    """A digest of all that was said, the lengths included: nothing can be moved from one part to the other."""
    digest = hashlib.sha256(b"holdfast sec 1")
    for part in (hello, body):
        digest.update(len(part).to_bytes(8, "big"))
        digest.update(part)
    return digest.digest()


def _signed_text(role: bytes, transcript: bytes) -> bytes:
    return b"holdfast sec hand-shake " + role + b"\0" + transcript


def _agree(private: X25519PrivateKey, public: bytes) -> bytes:
    try:
        return private.exchange(X25519PublicKey.from_public_bytes(public))
    except ValueError:  # A key of small order: the secret would be known to all.
        raise Rejected(MALFORMED, "a hand-shake") from None
