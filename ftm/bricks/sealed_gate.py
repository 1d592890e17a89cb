"""The gate of a replica: where a link is secured, nothing comes in except over it."""

from __future__ import annotations

from collections.abc import Awaitable
from typing import Any, ClassVar

from ...actors.errors import HoldfastError
from ...actors.kernel.actor import Actor, on
from ...actors.kernel.bindings import Binding
from ...actors.kernel.envelope import ReplyHandle
from ...actors.kernel.message import Message
from .bricks import FOREVER, Brick
from .sealed_frames import Agree, Greet, Opened, Refused, Sealed


class SealedGate(Brick):
    """Passes frames to the brick that opens them, and takes what was in them; what came plain is not admitted."""

    handlers: ClassVar[dict[type[Message[Any]], str]] = {}

    gate: Binding[Actor]

    _is_opened = False  # what is being handled has come over the secured link

    @on(Greet)
    def _greet(self, message: Greet) -> Any:
        return self._to_gate(message)

    @on(Agree)
    def _agree(self, message: Agree) -> Any:
        return self._to_gate(message)

    @on(Sealed)
    def _sealed(self, message: Sealed) -> Any:
        return self._to_gate(message)

    def _to_gate(self, message: Message[Any]) -> Any:
        if self._standing.link is None:
            raise Refused(path=self._standing.path, reason="closed")
        handle = self.ctx.reply_handle()
        self.ctx.create_task(self._passed(handle, self.gate.ask(message, timeout=FOREVER)))
        return handle

    async def _passed(self, handle: ReplyHandle[Any], asked: Awaitable[Any]) -> None:
        try:
            handle.reply(await asked)
        except HoldfastError as error:
            handle.fail(error)

    @on(Opened)
    def _opened(self, message: Opened) -> Any:
        real = self._standing.opened.take(message.key, tuple(self.handlers))
        if real is None:
            raise Refused(path=self._standing.path, reason="forged")
        self._is_opened = True
        try:
            return getattr(self, self.handlers[type(real)])(real)
        finally:
            self._is_opened = False

    def _admits(self) -> bool:
        """Whether this may come as it does: with a secured link, over that only."""
        link = self._standing.link
        if link is None or self._is_opened:
            return True
        link.plain()
        return False
