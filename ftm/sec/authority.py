"""The certification authority: an actor that issues, serves and revokes the certificates of one system (A68 to A70)."""

from __future__ import annotations

import datetime as dt
import os
from typing import Any

from ...actors.kernel.actor import Actor, on
from ...actors.kernel.envelope import ReplyHandle
from ...actors.kernel.message import Message, RuntimeCall, RuntimeOrder
from .certificates import (
    HEARTBEAT,
    LIFETIME,
    SKEW,
    about,
    digest_of,
    issue,
    make_list,
    make_root,
    public_of,
    read_request,
)
from .keys import SigningKey, raw_public
from .sec_errors import EnrolmentRefused, KeyRevoked, NoCertificate, Rejected


class GetRoot(Message[bytes]):
    """Asks for the authority's own certificate."""


class Enrol(RuntimeOrder[bytes]):
    """Issue a certificate: `request` is from `make_request`. The reply is the certificate.

    The root's code may say so, and from another process only who was granted the authority's address: who has no key
    would else be whoever it says, until the real one comes.
    """

    request: bytes


class GetCertificate(RuntimeCall[bytes]):
    """The newest valid certificate of a participant (A69)."""

    name: str


class Revoke(RuntimeOrder[int]):
    """Revoke the certificates of a participant; the reply is how many that were.

    All of them, if nothing else is said: then its name is free for another key. Who may enrol may revoke.
    """

    name: str
    after: int = 0
    """Only those that were issued after the one with this serial number; 0: from the first one on."""
    until: int = 0
    """And not after the one with this serial number; 0: to the last one."""


class GetRevocations(RuntimeCall[bytes]):
    """The list of revoked certificates, newly signed."""


class AwaitRevocations(RuntimeCall[bytes]):
    """The list of revoked certificates, as soon as it is another one than that with the digest `known`.

    It comes after `HEARTBEAT` seconds, too: whoever hears nothing for longer must not believe the list it has.
    """

    known: bytes


class _Beat(Message):
    """Those who wait are to hear that we live."""


class CertificationAuthority(Actor):
    """Issues certificates for names, each to one key at a time.

    What it has issued and revoked are its key variables; its key is not. With a key of its own start (no `key_file`)
    what an earlier life has issued is void, and forgotten.

    Args:
        key_file: where its key is, mode 0600; None: a new one at each start.
        names: whom it issues certificates for; None: anybody, once.
        lifetime_days: how long a certificate is valid.
    """

    deterministic = False  # Serial numbers and keys are random.
    key_variables = ("root", "issued", "revoked", "list_number")

    def __init__(
        self,
        key_file: str | os.PathLike[str] | None = None,
        names: tuple[str, ...] | None = None,
        lifetime_days: float = LIFETIME.days,
    ) -> None:
        self._key = SigningKey.per_start() if key_file is None else SigningKey.from_file(key_file)
        self._names = names
        self._lifetime = dt.timedelta(days=lifetime_days)
        self.root = b""
        self.issued: dict[str, list[tuple[int, bytes, bytes]]] = {}  # by name: serial, public key, certificate
        self.revoked: dict[int, float] = {}
        self.list_number = 0
        self._waiting: list[ReplyHandle[bytes]] = []

    def on_start(self, restored: bool) -> None:
        if not self.root or public_of(self.root) != raw_public(self._key.public):
            self.root = make_root(self._key, f"holdfast authority {self._key.fingerprint}", self.ctx.now())
            self.issued, self.revoked = {}, {}

    @on(GetRoot, readonly=True)
    def _get_root(self, message: GetRoot) -> bytes:
        return self.root

    @on(Enrol)
    def _enrol(self, message: Enrol) -> bytes:
        try:
            name, public = read_request(message.request)
        except Rejected as error:
            raise EnrolmentRefused("", str(error)) from None
        if self._names is not None and name not in self._names:
            raise EnrolmentRefused(name, "it is not among the names that certificates are issued for")
        if any(key != public for _, key, _ in self._valid(name)):
            raise EnrolmentRefused(name, "the name belongs to another key; revoke that one first")
        if self._is_key_revoked(name, public):
            raise KeyRevoked(name, "its key was revoked; make another one")
        self._forget_old(name)
        certificate = issue(self._key, self.root, name, public, self.ctx.now(), self._lifetime)
        self.issued.setdefault(name, []).append((about(certificate)[0], public, certificate))
        return certificate

    def _is_key_revoked(self, name: str, public: bytes) -> bool:
        if any(key == public for _, key, _ in self._valid(name)):
            return False
        return any(key == public and serial in self.revoked for serial, key, _ in self.issued.get(name, []))

    def _valid(self, name: str) -> list[tuple[int, bytes, bytes]]:
        now = self.ctx.now()
        return [
            (serial, key, certificate)
            for serial, key, certificate in self.issued.get(name, [])
            if serial not in self.revoked and about(certificate)[1] > now
        ]

    def _forget_old(self, name: str) -> None:
        """Of what nobody would accept any more nothing needs to be known; of what was revoked, that it was."""
        now = self.ctx.now()
        kept = [one for one in self.issued.get(name, []) if about(one[2])[1] > now - SKEW.total_seconds()]
        for serial, _, _ in self.issued.get(name, []):
            if serial not in [one[0] for one in kept]:
                self.revoked.pop(serial, None)
        self.issued[name] = kept

    @on(GetCertificate, readonly=True)
    def _get_certificate(self, message: GetCertificate) -> bytes:
        valid = self._valid(message.name)
        if not valid:
            raise NoCertificate(message.name)
        return valid[-1][2]

    @on(Revoke)
    def _revoke(self, message: Revoke) -> int:
        issued = [serial for serial, _, _ in self.issued.get(message.name, [])]
        begin = issued.index(message.after) + 1 if message.after in issued else 0
        end = issued.index(message.until) + 1 if message.until in issued else 0 if message.until else len(issued)
        valid = {serial for serial, _, _ in self._valid(message.name)}.intersection(issued[begin:end])
        self.revoked |= dict.fromkeys(valid, self.ctx.now())
        self._tell_all()
        return len(valid)

    @on(AwaitRevocations)
    def _await_revocations(self, message: AwaitRevocations) -> Any:
        if message.known != digest_of(self.revoked):
            return self._list()
        if not self._waiting:
            self.ctx.tell_after(HEARTBEAT, _Beat())
        handle: ReplyHandle[bytes] = self.ctx.reply_handle()
        self._waiting.append(handle)
        return handle

    @on(_Beat)
    def _beat(self, message: _Beat) -> None:
        self._tell_all()

    def _tell_all(self) -> None:
        waiting, self._waiting = self._waiting, []
        if waiting:
            listed = self._list()
            for handle in waiting:
                handle.reply(listed)

    @on(GetRevocations)
    def _get_revocations(self, message: GetRevocations) -> bytes:
        return self._list()

    def _list(self) -> bytes:
        self.list_number += 1
        return make_list(self._key, self.root, self.revoked, self.list_number, self.ctx.now())
