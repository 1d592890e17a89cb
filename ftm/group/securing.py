"""The root's end of a group's secured link, if its outermost mechanism wants one."""

from __future__ import annotations

import asyncio
import contextvars
from typing import TYPE_CHECKING, Any

from ...actors.errors import AskTimeout, NoSuchActor
from ...actors.kernel.message import Message, message_name
from ...actors.kernel.ref import ActorRef
from ..bricks.sealed_frames import ORDERS, LinkLost, Part

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from ...actors.kernel.node import Node
    from ..bricks.sealed_frames import Reach, SecuredLink
    from ..model.mechanism import Mechanism


class Securing:
    """The part of a group that reaches its replicas."""

    node: Node
    path: str
    epoch: int
    names: tuple[str, ...]
    primary: str | None
    is_over: bool
    link: SecuredLink | None = None
    """All that replicas are told, and say, is sealed."""

    def place(self, name: str) -> str:
        """The address of an actor of the mechanism."""
        return f"{self.path}/ftm/{name}"

    def life_of(self, name: str) -> int:
        """The number of the life that a replica lives now; 0 if none."""
        raise NotImplementedError

    def secure(self, outermost: Mechanism, link: SecuredLink | None = None) -> None:
        """Have the link that the outermost mechanism wants, from here on; `link`, if it is open already."""
        if self.link is not None:
            if self.link.mechanism == outermost:
                return
            self.link.close()
        self.link = link or self.linked(outermost, lambda: self.names)

    def linked(self, outermost: Mechanism, names: Callable[[], Iterable[str]]) -> SecuredLink | None:
        """The root's end of the link that a mechanism wants, to replicas of these names; None if it wants none."""
        return outermost.open_link(
            self.node,
            self.path,
            self.place("proxy"),
            lambda: self.epoch,
            lambda: [self.place(one) for one in names()],
        )

    def is_plain(self) -> bool:
        """Whether what comes need not be sealed; else it counts as an attempt."""
        if self.link is not None:
            self.link.plain()
        return self.link is None

    def reach(self, name: str) -> Reach:
        """How to ask the outermost RequestProtocol of a replica."""

        async def ask(message: Message[Any], seconds: float) -> Any:
            return await self.entry(name).ask(message, timeout=seconds)

        return ask

    def tell_sealed(self, message: Message[Any]) -> None:
        """Tell whoever leads, over the secured link."""
        name, epoch, link = self.primary, self.epoch, self.link
        if name is None or link is None:
            return  # It has died: all of it goes to the next one.

        def still() -> bool:
            return self.primary == name and self.epoch == epoch and not self.is_over

        link.tell(self.place(name), message, self.reach(name), still)

    def protocol(self, name: str) -> ActorRef[Any] | Sealing:
        """The outermost RequestProtocol of a replica; over the secured link, if there is one."""
        return self.entry(name) if self.link is None else Sealing(self, name, self.link)

    def entry(self, name: str) -> ActorRef[Any]:
        """The outermost RequestProtocol of a replica.

        Raises:
            NoSuchActor: it is not there, or not yet.
        """
        path = self.place(f"{name}/protocol")
        cell = self.node.find(path)
        if cell is None:
            raise NoSuchActor(path)
        return cell.ref


class Sealing:
    """Asks a replica over the secured link."""

    def __init__(self, group: Securing, name: str, link: SecuredLink) -> None:
        self._group, self._name, self._link = group, name, link

    def ask(self, message: Message[Any], timeout: float) -> asyncio.Future[Any]:
        """As a ref does; a replica that has ended fails it."""
        asked = self._ask(message, timeout)
        return self._group.node.loop.create_task(asked, context=contextvars.Context())

    async def _ask(self, message: Message[Any], timeout: float) -> Any:
        group, name, codec = self._group, self._name, self._group.node.codec
        life, path = group.life_of(name), group.place(self._name)
        part = Part(message_name(type(message)), codec.encode(message, path))
        if not life:
            raise NoSuchActor(path)

        def still() -> bool:
            return group.life_of(name) == life and self._link is group.link

        try:
            async with asyncio.timeout(timeout):
                back = await self._link.call(path, ORDERS, part, group.reach(name), still)
        except TimeoutError:
            raise AskTimeout(path, timeout) from None
        except LinkLost:
            raise NoSuchActor(path) from None
        if back.kind == "reply":
            return codec.decode_reply(type(message), back.body)
        raise codec.decode_error(back.kind, back.name, back.body)
