"""Names and records of participants in secured links, and their requests to the authority."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ...actors.errors import ActorStopped
from ..model.mechanism import MechanismRefused
from .authority import Enrol
from .certificates import MOST_NAME, make_request
from .keys import SigningKey
from .sec_errors import KeyRevoked

if TYPE_CHECKING:
    from ...actors.kernel.message import Message
    from ...actors.kernel.node import Node
    from ..mechanisms.sec import SEC


AUTHORITY_WITHIN = 5.0
"""Seconds in which the authority has to answer."""


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
    distrusts: Callable[[str, str], None] | None = None
    """Told the address of one whom nothing can be exchanged with any more, and why."""


def certified(path: str) -> str:
    """The name of a participant in certificates: its address; of a long one, its end and a digest."""
    if len(path) <= MOST_NAME:
        return path
    digest = hashlib.sha256(path.encode()).hexdigest()[:32]
    return f"{digest}…{path[-(MOST_NAME - 33) :]}"


def key_file(folder: str, path: str) -> Path:
    """Where the key of a participant is."""
    return Path(folder) / f"{hashlib.sha256(path.encode()).hexdigest()[:32]}.key"


async def order_certificate(node: Node, settings: SEC, path: str, name: str) -> bytes:
    """A certificate for the key of a participant; a key that was revoked is never certified, but a new one is made.

    Raises:
        HoldfastError: the authority refuses, or does not answer.
    """
    file = key_file(settings.folder, path)
    try:
        return await _enrolled(node, settings, make_request(SigningKey.from_file(file), name))
    except KeyRevoked:
        return await _enrolled(node, settings, make_request(SigningKey.renewed(file), name))


async def _enrolled(node: Node, settings: SEC, request: bytes) -> bytes:
    certificate: bytes = await ask_authority(node, settings.authority, Enrol(request), AUTHORITY_WITHIN)
    return certificate


async def ask_authority(node: Node, where: str, message: Message[Any], within: float) -> Any:
    """What the authority that lives at `where` answers.

    Raises:
        HoldfastError: it refuses, does not answer within so many seconds, or nobody lives there (MechanismRefused).
    """
    try:
        return await node.cell_at(where).ref.ask(message, timeout=within)
    except ActorStopped as error:
        raise MechanismRefused("sec", f"no authority lives at {where}: start a CertificationAuthority there") from error
