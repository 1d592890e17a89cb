"""The channel between bricks of different replicas: each letter is handled once, in the order sent.

A letter that has no answer after a while may have been lost on its way, or its answer; or it is still being handled.
So the other brick is asked (`Recall`): it answers what it has, or says that it never came. Then it is sent again;
those behind it wait for it there. Over a secured link, that sees to all this itself.
"""

from __future__ import annotations

import asyncio
import contextvars
import random
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, TypeVar

from ...actors.errors import AskTimeout, HoldfastError
from ...actors.kernel.actor import Actor, on
from ...actors.kernel.bindings import Binding
from ...actors.kernel.envelope import ReplyHandle
from ...actors.kernel.message import Message, Refusal, message_name
from .brick_messages import ConfigMismatch, NotFollowing, StaleLeader
from .letters import FOREVER, SEALED, Letter, Letters, Sheet, tell_in_sheets
from .sealed_frames import OpenNumbers, Part, Refused
from .standing import PeerLost

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ...actors.kernel.ref import ActorRef
    from .sealed_frames import SecuredLink
    from .standing import Standing

R = TypeVar("R")

AGAIN = 0.02
"""Seconds after which the other replica is asked again, if it could not be reached and still counts."""
PATIENCE, MOST_PATIENCE = 1.0, 8.0
"""Seconds without an answer after which it is asked whether the letter has come; doubled each time."""
MOST_STREAMS = 16
"""Streams of letters that are remembered: one for each brick that writes here, and for each of its last lives."""


class Where(Message[str]):
    """The address of a brick of this replica, in this configuration."""

    config: int
    slot: str


class Recall(Message[bytes]):
    """The answer to a letter that was sent before."""

    stream: int
    number: int


class NotHere(Refusal, text="{path} does not have this letter, or not all of it: it has to be sent again"):
    """This letter has not come, or not all of it."""

    path: str


class Outbox:
    """The letters from one brick to another, and which of them have no answer yet."""

    def __init__(self, ref: ActorRef[Any]) -> None:
        self.ref = ref
        self.stream = random.getrandbits(62) + 1
        self.numbers = OpenNumbers()


class Posted:
    """A letter that is on its way, until its answer is there."""

    def __init__(self, standing: Standing, outbox: Outbox, name: str, body: bytes, sheets: Iterator[int]) -> None:
        self._standing, self._outbox, self._name, self._body, self._sheets = standing, outbox, name, body, sheets
        self._number = outbox.numbers.open()
        self._loop = standing.node.loop
        self._patience = PATIENCE
        self.answer: asyncio.Future[bytes] = self._loop.create_future()
        self._timer = self._later()
        self._send()

    def _send(self) -> None:
        standing, outbox = self._standing, self._outbox
        number, body = tell_in_sheets(outbox.ref, self._body, self._sheets)
        letter = Letter(
            standing.epoch, standing.config, self._name, body, number, len(self._body),
            outbox.stream, self._number, outbox.numbers.floor,
        )  # fmt: skip
        outbox.ref.ask(letter, timeout=FOREVER).add_done_callback(self._answered)

    def _later(self) -> asyncio.TimerHandle:
        # In a context of its own: it is in no turn that it looks, and what it asks is no part of any chain of asks.
        return self._loop.call_later(self._patience, self._look, context=contextvars.Context())

    def _look(self) -> None:
        self._patience = min(2 * self._patience, MOST_PATIENCE)
        self._timer = self._later()
        recall = Recall(self._outbox.stream, self._number)
        self._outbox.ref.ask(recall, timeout=self._patience).add_done_callback(self._answered)

    def _answered(self, asked: asyncio.Future[bytes]) -> None:
        error = None if asked.cancelled() else asked.exception()
        if self.answer.done() or asked.cancelled() or isinstance(error, AskTimeout):
            return
        if isinstance(error, NotHere):
            contextvars.Context().run(self._send)
        elif error is not None:
            self.answer.set_exception(error)
        else:
            self.answer.set_result(asked.result())

    def close(self) -> None:
        """Nobody waits for it any more."""
        self._timer.cancel()
        self._outbox.numbers.close(self._number)
        self.answer.cancel()


class Answered:
    """What was answered to a letter, or who waits for that."""

    def __init__(self) -> None:
        self._outcome: bytes | Refusal | None = None
        self._waiting: list[ReplyHandle[bytes]] = []

    def give(self, handle: ReplyHandle[bytes]) -> None:
        """Answer this one too, now or when the letter is handled."""
        if self._outcome is None:
            self._waiting.append(handle)
        elif isinstance(self._outcome, Refusal):
            handle.fail(self._outcome)
        else:
            handle.reply(self._outcome)

    def set(self, outcome: bytes | Refusal) -> None:
        """Note the outcome of a request, which is handled."""
        self._outcome = outcome
        waiting, self._waiting = self._waiting, []
        for handle in waiting:
            self.give(handle)


class Inbox:
    """The letters from one brick to this one: those that came too early, and the answers that may be asked again."""

    def __init__(self) -> None:
        self._next = 1
        self._early: dict[int, tuple[Letter, bytes]] = {}
        self._answers: dict[int, Answered] = {}

    def take(self, letter: Letter, body: bytes, handle: ReplyHandle[bytes]) -> None:
        """A letter has come: the first time, or once more."""
        number, floor, answers = letter.number, letter.floor, self._answers
        for old in [one for one in answers if one < floor] if next(iter(answers), floor) < floor else ():
            del answers[old]
        self._next = max(self._next, floor)
        if number >= self._next and number not in self._early:
            self._early[number] = letter, body
            answers[number] = Answered()
        if number in answers:
            answers[number].give(handle)

    def recall(self, number: int) -> Answered | None:
        """The answer to a letter, if that has come."""
        return self._answers.get(number)

    def pop(self) -> tuple[Letter, bytes, Answered] | None:
        """The next letter in order, if it is there."""
        early = self._early.pop(self._next, None)
        if early is None:
            return None
        self._next += 1
        return *early, self._answers[self._next - 1]


class Posting(Letters):
    """A brick's way to the same brick of another replica, and what comes from there."""

    peer: Binding[Actor]

    _inboxes: dict[int, Inbox]
    _sheets: dict[int, list[bytes]]
    _sending: asyncio.Lock

    # -- sending ----------------------------------------------------------------------------------------------------

    async def ask_peer(self, message: Message[R]) -> R:
        """Ask the same brick of the other replica, again and again until it answers or does not count any more.

        Raises:
            PeerLost: nobody waits for it any longer. StaleEpoch: it is we that do not count.
            Refusal: what that brick's `from_peer` has raised.
        """
        standing, peer = self._standing, self._standing.other.cell
        codec = standing.node.codec
        body = codec.encoder.encode(message)
        while True:
            if peer is None or standing.other.cell is not peer:
                raise PeerLost("there is none")
            try:
                if standing.link is not None:
                    reply = await self._ask_peer_sealed(standing.link, peer, message, body)
                else:
                    async with self._sending:  # In order: finding the peer takes the first one longer than the others.
                        if standing.other.cell is not peer:
                            continue
                        posted = self._post(await self._find_peer(peer.path), message, body)
                    reply = await self._reply_to(posted)
            except PeerLost:
                raise
            except StaleLeader:
                standing.fence()
                raise
            except NotFollowing:  # It is told soon that it follows.
                pass
            except ConfigMismatch as no:
                if no.here > no.there:  # All that mattered had come to its end before.
                    raise PeerLost("the mechanisms have changed since this was said") from no
                standing.other.lose_brick(self.slot)  # It changes them soon, or does not count any more.
            except Refusal as no:
                if not isinstance(no, Refused | NotHere):
                    raise
                standing.other.lose_brick(self.slot)
            except HoldfastError:  # It has died, which we shall be told, or its brick was exchanged.
                standing.other.lose_brick(self.slot)
            else:
                return codec.decode_reply(type(message), reply)  # type: ignore[no-any-return]
            await standing.other.changes(AGAIN)

    def _post(self, outbox: Outbox, message: Message[Any], body: bytes) -> Posted:
        return Posted(self._standing, outbox, message_name(type(message)), body, self._numbers)

    async def _reply_to(self, posted: Posted) -> bytes:
        try:
            reply: bytes = await self._standing.other.wait_for(posted.answer)
        finally:
            posted.close()
        return reply

    async def _ask_peer_sealed(self, link: SecuredLink, peer: Cell, message: Message[Any], body: bytes) -> bytes:
        standing, part = self._standing, Part(message_name(type(message)), body)

        async def find() -> ActorRef[Any]:
            return (await self._find_peer(peer.path)).ref

        return await self._ask_sealed(
            link, peer, self.slot, part, find, lambda error: standing.other.lose_brick(self.slot),
            lambda: standing.other.cell is peer,
        )  # fmt: skip

    async def ask_at(self, path: str, slot: str, message: Message[R]) -> R:
        """Ask a brick of a certain replica, once.

        Raises:
            HoldfastError: it cannot be reached, or has died. PeerLost: who is our peer has changed meanwhile.
        """
        standing, key = self._standing, f"{path}#{slot}"
        codec = standing.node.codec
        body = codec.encoder.encode(message)
        if standing.link is not None:
            errors: list[HoldfastError] = []
            replica = standing.node.cell_at(path)
            part = Part(message_name(type(message)), body)

            async def find() -> ActorRef[Any]:
                return (await self._find(replica.path, slot, key)).ref

            try:
                back = await self._ask_sealed(
                    standing.link, replica, slot, part, find, errors.append, lambda: not errors
                )  # fmt: skip
            except PeerLost as lost:
                standing.other.lose_brick(key)
                raise (errors or [lost])[0] from None
            return codec.decode_reply(type(message), back)  # type: ignore[no-any-return]
        try:
            reply = await self._reply_to(self._post(await self._find(path, slot, key), message, body))
        except StaleLeader:
            standing.fence()
            raise
        except HoldfastError:
            standing.other.lose_brick(key)
            raise
        return codec.decode_reply(type(message), reply)  # type: ignore[no-any-return]

    async def _find_peer(self, path: str) -> Outbox:
        standing = self._standing
        outbox = standing.other.brick(self.slot)
        if outbox is None:
            outbox = await self._find(path, self.slot, self.slot)
            standing.node.bind(self.ctx._cell, "peer", outbox.ref._cell)
        return outbox

    async def _find(self, path: str, slot: str, key: str) -> Outbox:
        standing = self._standing
        outbox = standing.other.brick(key)
        if outbox is None:
            where = Where(standing.config, slot)
            asked = standing.node.cell_at(f"{path}/protocol").ref.ask(where, timeout=PATIENCE)
            outbox = Outbox(standing.node.cell_at(await standing.other.wait_for(asked)).ref)
            standing.other.remember_brick(key, outbox)
        return outbox

    # -- taking -----------------------------------------------------------------------------------------------------

    @on(Sheet)
    def _sheet(self, message: Sheet) -> None:
        self._sheets.setdefault(message.sheets, []).append(message.data)

    @on(Letter)
    async def _take_letter(self, letter: Letter) -> bytes | ReplyHandle[bytes]:
        sheets = self._sheets.pop(letter.sheets, []) if letter.sheets else []
        body = b"".join(sheets) if sheets else letter.body
        standing = self._standing
        if standing.link is not None:
            return await self._take_sealed(standing.link, body)
        if letter.name == SEALED:
            raise Refused(path=standing.path, reason="closed")
        if len(body) != letter.size:
            raise NotHere(path=standing.path)
        handle: ReplyHandle[bytes] = self.ctx.reply_handle()
        inbox = self._inbox(letter.stream)
        inbox.take(letter, body, handle)
        while (one := inbox.pop()) is not None:
            if self.answers_later:
                self.ctx.create_task(self._open(*one))
            else:
                await self._open(*one)
        return handle

    def _inbox(self, stream: int) -> Inbox:
        inbox = self._inboxes.get(stream)
        if inbox is None:
            inbox = self._inboxes[stream] = Inbox()
            if len(self._inboxes) > MOST_STREAMS:
                del self._inboxes[next(iter(self._inboxes))]
        return inbox

    async def _open(self, letter: Letter, body: bytes, answered: Answered) -> None:
        try:
            answered.set(await self._handle_part(letter.epoch, letter.config, letter.name, body))
        except Refusal as no:
            answered.set(no)

    @on(Recall)
    def _recall(self, message: Recall) -> ReplyHandle[bytes]:
        inbox = self._inboxes.get(message.stream)
        answered = None if inbox is None else inbox.recall(message.number)
        if answered is None:
            raise NotHere(path=self._standing.path)
        handle: ReplyHandle[bytes] = self.ctx.reply_handle()
        answered.give(handle)
        return handle
