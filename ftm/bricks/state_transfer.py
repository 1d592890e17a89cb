"""State transfer: brings another replica to the leader's state between two batches (T8c).

The two RequestProtocols do it: the leader's captures and sends, the follower's takes, and may ask for it again. The
leader's gives it out, too, when the actor is to live without a mechanism.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Coroutine
from typing import TYPE_CHECKING, Any

from ...actors.errors import ActorStopped, AskTimeout, HoldfastError
from ...actors.kernel.actor import on
from ...actors.kernel.bindings import Binding
from ...actors.kernel.envelope import ReplyHandle
from ...actors.kernel.message import Message
from ...checkpoint.snapshot.key_variables import save_state
from .brick_messages import CannotJoin, ConfigMismatch, Done, Logged, ServerState, StaleLeader, Strayed
from .bricks import FOREVER, Abandon, Brick, Flush
from .replica_orders import Export, Exported, Join, SetPeer
from .sealed_gate import SealedGate
from .standing import PeerLost

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor


class TakeState(Message[int]):
    """The state and reply log of the replica that leads, for one that joins; the reply is its turn."""

    leader: str
    state: ServerState | None
    log: list[Logged]


class Assume(Message[None]):
    """To the replica: have its bricks play the part of one that leads, or not."""

    leads: bool


class Play(Message[None]):
    """To a replica that is no part of a group yet: have the bricks of this role, but not the protected actor.

    `is_new`: all of them are made anew.
    """

    leads: bool
    is_new: bool


class Astray(Message[None]):
    """To the RequestProtocol of the leader: this follower does not have your state any more. Do not count on it."""

    path: str


class GoneAstray(Message):
    """To the RequestProtocol of a follower, from its After: tell the leader."""


class Transfer(SealedGate):
    """The part of a RequestProtocol that speaks with that of the other replica."""

    peer_messages = (TakeState, Astray)
    answers_later = True

    next: Binding[Actor]
    proceed: Binding[Actor]

    _holds: int  # who wants nothing to go in
    _lock: asyncio.Lock

    def _check(self, epoch: int, config: int | None = None) -> None:
        """Refuse an order of an earlier epoch; from here on this one counts."""
        raise NotImplementedError

    def _answer(self, work: Coroutine[Any, Any, Any]) -> ReplyHandle[Any]:
        """Answer when the work is done."""
        raise NotImplementedError

    async def _quiet(self) -> None:
        """Wait until nothing is inside, or another epoch has begun."""
        raise NotImplementedError

    def _go_on(self) -> None:
        """Let in what waits, if nothing is inside."""
        raise NotImplementedError

    @on(SetPeer)
    def _peer(self, message: SetPeer) -> None:
        self._check(message.epoch)
        other = self._standing.other
        other.told += 1
        if message.path != other.path:
            other.replace(message.path, "live")

    @on(Join)
    def _join(self, message: Join) -> Any:
        self._check(message.epoch)
        return self._answer(self._bring(message.peer, self._standing.other.told))

    async def _bring(self, path: str, told: int) -> int:
        """Bring another replica to our state; requests wait only while that is captured.

        `told`: as it was when this was ordered. If home has said since who the other one is, that life may have ended.
        """
        standing, server = self._standing, self._standing.server
        if not standing.leads:
            raise CannotJoin(path=path, why=f"{standing.path} does not lead")
        if standing.other.path == path:  # It follows, or lives, anew: it does not count on what it had.
            standing.other.replace(path, "joining")
        epoch = standing.epoch
        self._holds += 1
        try:
            await self._quiet()
            standing.check(epoch)
            await server.ensure()
            if standing.other.told != told:
                raise CannotJoin(path=path, why="it was given up meanwhile")
            state, point = None, server.points.point
            if server.state.has_access:
                state = self._captured(path) if point is not None or server.turn >= 0 else None
            elif point is not None and server.turn == point.turn and not point.data.size:
                state = point  # It has begun afresh, and so does the other one.
            elif server.turn >= 0:
                why = "the state of the protected actor cannot be read, and it has handled requests already"
                raise CannotJoin(path=path, why=why)
            log = standing.log.entries()
            standing.other.replace(path, "joining", -2 if state is None else state.turn)
            asked = self.ctx.create_task(self._offer(TakeState(standing.path, state, log)))
        finally:
            self._holds -= 1
            self._go_on()
        turn = await asked
        if isinstance(turn, HoldfastError):
            if standing.other.path == path:
                standing.other.replace(None, "none")
            raise CannotJoin(path=path, why=str(turn))
        if standing.other.path == path:
            standing.other.caught_up()
            await self._drain_bricks()  # What left while it joined may have gone home ahead of the state behind it.
        if standing.other.path != path:
            raise CannotJoin(path=path, why="another one has taken its place, or it was given up meanwhile")
        return turn

    def _captured(self, path: str) -> ServerState:
        try:
            return self._standing.server.capture()
        except Exception as error:  # What the user's own values and methods raise is no reason to end: we are alone.
            raise CannotJoin(path=path, why=f"the state cannot be saved: {error}") from error

    async def _drain_bricks(self) -> None:
        for cell in list(self._standing.bricks.values()):
            if isinstance(cell.actor, Brick):
                await cell.actor.drain()  # No ask: one of them may be waiting for us.

    async def _offer(self, take: TakeState) -> int | HoldfastError:
        try:
            return await self.ask_peer(take)
        except (PeerLost, ConfigMismatch, StaleLeader, HoldfastError) as error:
            return error

    async def from_peer(self, message: Message[Any]) -> Any:
        """We join, or a follower has to join again."""
        if isinstance(message, Astray):
            self._forsake(message.path)
            return None
        assert isinstance(message, TakeState)
        return await self._taken(message)

    def _forsake(self, path: str) -> None:
        """From here on no reply counts on this follower, and the root is told: it has to join again."""
        standing = self._standing
        if not standing.leads or standing.is_fenced:
            return
        if standing.other.path == path:
            standing.other.replace(None, "none")
        self.next.tell(Done(standing.epoch, standing.config, -1, [], False, None, [Strayed(path)]))

    @on(GoneAstray)
    def _astray(self, message: GoneAstray) -> None:
        self.ctx.create_task(self._tell_leader())

    async def _tell_leader(self) -> None:
        with contextlib.suppress(
            HoldfastError
        ):  # It has died, or counts no more: whoever leads now brings us its state.
            await self.ask_peer(Astray(self._standing.path))

    async def _taken(self, take: TakeState) -> int:
        standing, server = self._standing, self._standing.server
        standing.other.replace(take.leader, "live")
        if not self._is_further(take):
            standing.following.unready()
            standing.following.number -= 1  # What is on its way to Proceed now, or in it, leads on from another state.
            await self.proceed.ask(Abandon(), timeout=FOREVER)
            await server.drop_life()
            if not self._is_further(take):  # Nothing may come between this and the state.
                server.install(take.state)
                standing.log.replace(take.log)
            standing.inside.clear()
            if standing.computes:
                await server.ensure_as_given()
        standing.following.ready()
        return server.turn

    def _is_further(self, take: TakeState) -> bool:
        """Whether what was computed here for the leader, which waits for nobody to join, leads on from that state."""
        return self._standing.following.computed > (self._standing.epoch, -1 if take.state is None else take.state.turn)

    # -- out of the group ---------------------------------------------------------------------------------------------

    @on(Export)
    def _export(self, message: Export) -> Any:
        self._check(message.epoch)
        handle = self.ctx.reply_handle()
        self.ctx.create_task(self._exported(handle, message))
        return handle

    async def _exported(self, handle: ReplyHandle[Any], message: Export) -> None:
        """Give out the state when no background work is out, which may take as long as it likes.

        Neither requests nor other orders wait for that: whoever has asked may have given it up since.
        """
        server = self._standing.server
        try:
            async with asyncio.timeout(message.seconds):
                while True:
                    await server.until_work_is_back()
                    async with self._lock:
                        exported = await self._give_out(message.epoch)
                    if exported is not None:
                        handle.reply(exported)
                        return
        except TimeoutError:
            handle.fail(AskTimeout(self._standing.path, message.seconds, True))
        except HoldfastError as error:
            handle.fail(error)
        except BaseException:
            handle.fail(ActorStopped(self._standing.path))  # We end: nobody must wait for us.
            raise

    async def _give_out(self, epoch: int) -> Exported | None:
        """The state between two batches; None if background work is out again."""
        self._holds += 1
        try:
            await self._quiet()
            self._standing.check(epoch)
            server = self._standing.server
            await server.ensure()
            life = server.life
            if life is None or life.cell.actor is None:
                raise ActorStopped(server.address)
            if life.pipes:
                return None
            await self.proceed.ask(Flush(), timeout=FOREVER)  # What has come of it goes home first.
            stash = [fed.feed.id for fed in life.stash]
            return Exported(life.turn, save_state(life.cell.actor), stash, life.cell.extra().trap_exits)
        finally:
            self._holds -= 1
            self._go_on()
