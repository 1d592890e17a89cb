"""Certificates of a protected actor that moves: issued for the new address, revoked for the old one."""

from __future__ import annotations

from collections.abc import Container, Iterable
from typing import TYPE_CHECKING, Any

from ...supervision.spec import ChildSpec
from ..bricks.standing import protected_at
from ..model.composition import layers_of
from .authority import GetCertificate, Revoke
from .certificates import about
from .participants import LinkEnd, ask_authority, certified, order_certificate
from .sec_errors import EnrolmentRefused, NoCertificate

if TYPE_CHECKING:
    from ...actors.kernel.message import Message

PREPARED_WITHIN = 5.0
"""Seconds in which the authority has to answer before the move."""
SETTLED_WITHIN = 15.0
"""Seconds in which it has to answer behind it: it may be between two lives."""


class CertifiedMove:
    """What the authority is told for one move.

    Args:
        end: the root's end of the links.
        paths: of each participant the address that it leaves, and the one where it goes.
        enrolled: who of them has been certified where it is.
    """

    def __init__(self, end: LinkEnd, paths: Iterable[tuple[str, str]], enrolled: Container[str]) -> None:
        self._node, self._settings, self._paths, self._enrolled = end.node, end.mechanism, tuple(paths), enrolled
        self._before: dict[str, int] = {}
        """By name: the serial number of the newest certificate that somebody else has there; 0: there is none."""
        self._certified: set[str] = set()

    async def prepare(self) -> None:
        """Have all be certified where they go, but those who were revoked: they stay so.

        Raises:
            HoldfastError: the authority refuses, or does not answer.
        """
        for was, now in self._paths:
            name = certified(now)
            if name in self._certified or (was in self._enrolled and not await self._newest(certified(was))):
                continue
            self._before.setdefault(name, await self._newest(name))  # First: what follows may be cancelled.
            await self._enrol(name, now)
            self._certified.add(name)

    async def _enrol(self, name: str, path: str) -> None:
        try:
            await order_certificate(self._node, self._settings, path, name)
        except EnrolmentRefused:
            if not self._settings.is_per_start or self._is_taken(path):
                raise
            await self._ask(Revoke(name))  # It was that of an earlier start.
            await order_certificate(self._node, self._settings, path, name)

    async def settle(self, *, is_moved: bool) -> None:
        """Have what was certified for where they are not be revoked; of where they are, what others had before.

        Raises:
            HoldfastError: the authority does not answer.
        """
        if is_moved:
            for was, _ in self._paths:
                if not self._is_taken(was):  # Else whoever has come there has it revoked.
                    await self._ask(Revoke(certified(was)), SETTLED_WITHIN)
        for name, serial in self._before.items():
            if not is_moved:
                await self._ask(Revoke(name, after=serial), SETTLED_WITHIN)
            elif serial:
                await self._ask(Revoke(name, until=serial), SETTLED_WITHIN)

    def _is_taken(self, path: str) -> bool:
        """Whether somebody whose links are secured lives at the address of a participant now."""
        address = protected_at(path)
        cell = self._node.find(address)
        if cell is None or cell.path != address or not isinstance(cell.spec, ChildSpec) or not cell.spec.mechanism:
            return False
        return any(one.secures for one in layers_of(cell.spec.mechanism))

    async def _newest(self, name: str) -> int:
        try:
            serial, _ = about(await self._ask(GetCertificate(name)))
        except NoCertificate:
            return 0
        return serial

    async def _ask(self, message: Message[Any], within: float = PREPARED_WITHIN) -> Any:
        return await ask_authority(self._node, self._settings.authority, message, within)
