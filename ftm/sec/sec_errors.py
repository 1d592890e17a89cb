"""Errors of keys, certificates, hand-shakes and frames."""

from __future__ import annotations

from typing import Final

from ...actors.errors import HoldfastError
from ...actors.kernel.message import Refusal

TRUNCATED, MALFORMED, VERSION = "truncated", "malformed", "version"
WRONG_SESSION, STALE_EPOCH, STALE_LIFE = "wrong_session", "stale_epoch", "stale_life"
GENERATION, REPLAYED, TOO_OLD, FORGED = "generation", "replayed", "too_old", "forged"
EXPIRED, NOT_YET, REVOKED, UNTRUSTED, WRONG_PEER = "expired", "not_yet_valid", "revoked", "untrusted", "wrong_peer"
STALE_LIST, CLOSED, EXHAUSTED, FORKED = "stale_list", "closed", "exhausted", "forked"

_WORDS: Final = {
    TRUNCATED: "it is cut short",
    MALFORMED: "it is not of the right form",
    VERSION: "it is of a version that is not known here",
    WRONG_SESSION: "it belongs to another session",
    STALE_EPOCH: "its epoch is over",
    STALE_LIFE: "its sender's life is over",
    GENERATION: "its key is out of reach",
    REPLAYED: "it was here before",
    TOO_OLD: "it is older than what is remembered",
    FORGED: "its seal is broken: it was changed, or its maker has another key",
    EXPIRED: "its time is over",
    NOT_YET: "its time has not come",
    REVOKED: "its certificate was revoked",
    UNTRUSTED: "its certificate is not from our authority",
    WRONG_PEER: "it is somebody else's",
    STALE_LIST: "the list of revocations is too old",
    CLOSED: "the session is closed here",
    FORKED: "the session belongs to the process that this one was forked from",
    EXHAUSTED: "the session has sealed all that it may: agree on a new one",
}


class Rejected(HoldfastError):
    """Something was not accepted; `reason` is one of the constants here. It never tells of keys or contents."""

    reason: str
    what: str = ""

    def __str__(self) -> str:
        about = f"{self.what}: " if self.what else ""
        return f"rejected ({self.reason}): {about}{_WORDS.get(self.reason, self.reason)}"


class UnsafeKeyFile(HoldfastError, text="the key file {path} is not used: {problem}"):
    """A file of private keys that others could have read or written, or that is none."""

    path: str
    problem: str


class EnrolmentRefused(Refusal, text="no certificate for {name!r}: {problem}"):
    """The authority issues no certificate for this."""

    name: str
    problem: str


class KeyRevoked(EnrolmentRefused, text="no certificate for {name!r}: {problem}"):
    """All that the key was certified with under this name was revoked: only another key is certified."""


class NoCertificate(Refusal, text="there is no valid certificate of {name!r}"):
    """The authority has issued none, or only revoked ones."""

    name: str
