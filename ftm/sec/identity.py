"""Who a participant of secured links is: its key file, its certificate from the authority, whom it trusts."""

from __future__ import annotations

import asyncio
import hashlib
import os
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ...actors.errors import ActorStopped, HoldfastError
from ...actors.kernel.message import Message
from ..bricks.sealed_frames import FrameRefused
from ..model.mechanism import MechanismRefused
from .authority import Enrol, GetCertificate, GetRevocations, GetRoot, Revoke
from .certificates import MOST_NAME, Trust, about, make_request, public_of
from .handshake import Participant
from .keys import Secret, SigningKey, raw_public, read_own, write_own
from .sec_errors import UNTRUSTED, EnrolmentRefused, NoCertificate, Rejected, UnsafeKeyFile
from .session import SessionLimits

if TYPE_CHECKING:
    from ...actors.kernel.node import Node
    from ..mechanisms.sec import SEC

AUTHORITY_WITHIN = 5.0
"""Seconds in which the authority has to answer."""


def certified(path: str) -> str:
    """The name of a participant in certificates: its address; of a long one, its end and a digest."""
    if len(path) <= MOST_NAME:
        return path
    digest = hashlib.sha256(path.encode()).hexdigest()[:32]
    return f"{digest}…{path[-(MOST_NAME - 33) :]}"


def key_file(folder: str, path: str) -> Path:
    """Where the key of a participant is."""
    return Path(folder) / f"{hashlib.sha256(path.encode()).hexdigest()[:32]}.key"


def root_file(folder: str, authority: str) -> Path:
    """Where the authority's certificate is: its public half, which nobody else may exchange."""
    return Path(folder) / f"{hashlib.sha256(authority.encode()).hexdigest()[:32]}.root"


class LinkEnd(NamedTuple):
    """Whose end of secured links it is."""

    node: Node
    """Of this process."""
    address: str
    """The protected actor's."""
    path: str
    """This participant's."""
    mechanism: SEC
    """Its settings."""
    epoch: Callable[[], int]
    """The present one."""
    enrols: Callable[[], list[str]] | None = None
    """Of whom this one orders certificates; None: it is enrolled by another."""


class Identity(Secret):
    """One participant. Its key and certificate are got when they are needed, and renewed in time."""

    def __init__(self, end: LinkEnd) -> None:
        self.mechanism, self.path = end.mechanism, end.path
        self._node, self._address, self._epoch, self._enrols = end.node, end.address, end.epoch, end.enrols
        self.rejected: Counter[str] = Counter()
        self._me: Participant | None = None
        self._lock = asyncio.Lock()
        self._enrolled: set[str] = set()

    async def ready(self) -> None:
        """Get all certificates.

        Raises:
            HoldfastError: which cannot be had, and why.
        """
        await self._identity()

    async def _identity(self) -> Participant:
        async with self._lock:
            if self._me is None or self._is_due(self._me.certificate):
                self._me = await self._identify()
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
        settings, old = self.mechanism, self._me
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
        limits = SessionLimits(settings.rotate_messages, settings.rotate_seconds, lifetime=settings.lifetime)
        life = time.monotonic_ns() if old is None else old.incarnation
        trust = Trust(root, needs_list=True)  # Who cannot know whether somebody was revoked believes nobody.
        trust.take_list(await self._authority(GetRevocations()), time.time())
        me = Participant(
            key, certificate, trust, incarnation=life, epoch=self._epoch(), suites=settings.suites, limits=limits
        )
        me.rejected = self.rejected
        return me

    def _check_root(self, root: bytes) -> None:
        """The authority must be the one that everybody knows (A70)."""
        wanted = self.mechanism.fingerprint
        if wanted and hashlib.sha256(public_of(root)).hexdigest()[: len(wanted)] != wanted:
            raise Rejected(UNTRUSTED, "the certificate of the authority")

    def _is_due(self, certificate: bytes) -> bool:
        return about(certificate)[1] - time.time() < self.mechanism.renew_days * 86400.0

    async def _enrol(self, path: str) -> None:
        """Order a certificate; once, and when its time is nearly over: one that was revoked stays so."""
        name, key = certified(path), SigningKey.from_file(key_file(self.mechanism.folder, path))
        try:
            certificate = await self._authority(GetCertificate(name))
            if public_of(certificate) == raw_public(key.public) and not self._is_due(certificate):
                self._enrolled.add(name)
                return
        except NoCertificate:
            if name in self._enrolled:
                return
        request = make_request(key, name)
        try:
            await self._authority(Enrol(request))
        except EnrolmentRefused:
            if not self.mechanism.is_per_start or name in self._enrolled:
                raise
            await self._authority(Revoke(name))  # It was that of an earlier start.
            await self._authority(Enrol(request))
        self._enrolled.add(name)

    async def _authority(self, message: Message[Any], within: float = AUTHORITY_WITHIN) -> Any:
        where = self.mechanism.authority
        try:
            return await self._node.cell_at(where).ref.ask(message, timeout=within)
        except ActorStopped as error:
            raise MechanismRefused(
                "sec", f"no authority lives at {where}: start a CertificationAuthority there"
            ) from error

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
