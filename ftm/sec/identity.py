"""The identity of a participant in secured links: its key file, its certificate, and whom it trusts."""

from __future__ import annotations

import asyncio
import hashlib
import os
import time
from collections import Counter
from pathlib import Path
from typing import Any

from ...actors.errors import HoldfastError
from ...actors.kernel.message import Message
from ..bricks.sealed_frames import FrameRefused
from .authority import GetCertificate, GetRevocations, GetRoot, Revoke
from .certificates import Trust, about, public_of
from .handshake import Participant
from .keys import Secret, SigningKey, raw_public, read_own, write_own
from .moved_certificates import CertifiedMove
from .participants import AUTHORITY_WITHIN, LinkEnd, ask_authority, certified, key_file, order_certificate
from .sec_errors import UNTRUSTED, EnrolmentRefused, NoCertificate, Rejected, UnsafeKeyFile
from .session import SessionLimits


def root_file(folder: str, authority: str) -> Path:
    """Where the authority's certificate is: its public half, which nobody else may exchange."""
    return Path(folder) / f"{hashlib.sha256(authority.encode()).hexdigest()[:32]}.root"


class Identity(Secret):
    """One participant. Its key and certificate are got when they are needed, and renewed in time."""

    def __init__(self, end: LinkEnd) -> None:
        self.mechanism, self.path = end.mechanism, end.path
        self._life = time.monotonic_ns()
        self._end, self._node, self._address, self._epoch = end, end.node, end.address, end.epoch
        self._enrols = end.enrols
        self.rejected: Counter[str] = Counter()
        self._me: Participant | None = None
        self._lock = asyncio.Lock()
        self._enrolled: dict[str, int] = {}  # by address: the serial number, as far as it is known

    async def ready(self) -> None:
        """Get all certificates.

        Raises:
            HoldfastError: which cannot be had, and why.
        """
        await self._identity()

    async def _identity(self) -> Participant:
        async with self._lock:
            while self._me is None or self._is_due(self._me.certificate):
                path, me = self.path, await self._identify()
                if path == self.path:  # Else it has moved meanwhile.
                    self._me = me
            me = self._me
        try:
            me.take_list(await self._authority(GetRevocations()))
        except Rejected as error:
            self._refuse(error.reason)
        except HoldfastError:
            pass  # It is between two lives: what was revoked before is known.
        me.raise_epoch(self._epoch())
        return me

    async def _identify(self) -> Participant:
        settings = self.mechanism
        if self._enrols is not None:
            root = await self._authority(GetRoot())
            self._check_root(root)
            write_root(root_file(settings.folder, settings.authority), root)
            for path in (self.path, *self._enrols()):
                await self._enrol(path)
        else:
            root = read_root(root_file(settings.folder, settings.authority))
            self._check_root(root)
        key = SigningKey.from_file(key_file(settings.folder, self.path))
        certificate = await self._authority(GetCertificate(certified(self.path)))
        if public_of(certificate) != raw_public(key.public):
            raise NoCertificate(certified(self.path))  # It is of another key than the one that is here.
        limits = SessionLimits(settings.rotate_messages, settings.rotate_seconds, lifetime=settings.lifetime)
        trust = Trust(root, needs_list=True)  # Who cannot know whether somebody was revoked believes nobody.
        trust.take_list(await self._authority(GetRevocations()), time.time())
        me = Participant(
            key, certificate, trust, incarnation=self._life, epoch=self._epoch(), suites=settings.suites, limits=limits
        )
        me.rejected = self.rejected
        return me

    def moved_certificates(self, address: str) -> CertifiedMove:
        """What has to be certified before the protected actor goes to another address."""
        assert self._enrols is not None
        paths = [(path, address + path[len(self._address) :]) for path in (self.path, *self._enrols())]
        return CertifiedMove(self._end, paths, self._enrolled)

    def _check_root(self, root: bytes) -> None:
        """The authority must be the one that everybody knows (A70)."""
        wanted = self.mechanism.fingerprint
        if wanted and hashlib.sha256(public_of(root)).hexdigest()[: len(wanted)] != wanted:
            raise Rejected(UNTRUSTED, "the certificate of the authority")

    def _is_due(self, certificate: bytes) -> bool:
        return about(certificate)[1] - time.time() < self.mechanism.renew_days * 86400.0

    async def _enrol(self, path: str) -> None:
        """Order a certificate; once, and when its time is nearly over: who was revoked needs a new life first."""
        name, key = certified(path), SigningKey.from_file(key_file(self.mechanism.folder, path))
        try:
            certificate = await self._authority(GetCertificate(name))
            if public_of(certificate) == raw_public(key.public) and not self._is_due(certificate):
                self._enrolled[path] = about(certificate)[0]
                return
        except NoCertificate:
            if path in self._enrolled:
                return
        try:
            certificate = await order_certificate(self._node, self.mechanism, path, name)
        except EnrolmentRefused:
            if not self.mechanism.is_per_start or path in self._enrolled:
                raise
            await self._authority(Revoke(name))  # It was that of an earlier start.
            certificate = await order_certificate(self._node, self.mechanism, path, name)
        self._enrolled[path] = about(certificate)[0]

    async def _authority(self, message: Message[Any], within: float = AUTHORITY_WITHIN) -> Any:
        return await ask_authority(self._node, self.mechanism.authority, message, within)

    def _refuse(self, reason: str) -> None:
        self._node.emit(FrameRefused(self._address, self.path, reason, self.rejected[reason]))


def write_root(file: Path, content: bytes) -> None:
    """Write the authority's certificate for those who have to know it. What is there must be ours (`read_own`)."""
    try:
        if read_own(file) == content:
            return
    except FileNotFoundError:
        pass
    write_own(file, content, place=os.replace)


def read_root(file: Path) -> bytes:
    """Read it. Raises UnsafeKeyFile: it is not there, or not ours."""
    try:
        return read_own(file)
    except FileNotFoundError:
        raise UnsafeKeyFile(str(file), "the certificate of the authority is not there") from None
