"""Passive replication (PBR): one computes, the other keeps its state.

Fault model  the crash of a replica: its process, its bricks, a hang that the failure detector sees.
Guarantee    a reply leaves when the backup has the state behind it and the reply itself: no request is lost or doubled.
Not covered  value faults: a wrong state is copied. With `acknowledge=False` the replies of the last `window` batches
             may have left without their state when the primary dies.
Needs        state access; two units. Determinism is not needed: only the primary computes.
Cost         bandwidth: a state, or what has changed in it, for each batch. One unit computes.
Source       Lauer et al. 2018, Tables I and II (A34, A35); A50 to A54.
"""

from __future__ import annotations

import asyncio
import dataclasses
from typing import Any, ClassVar

from ...actors.kernel.message import Message
from ..bricks.brick_messages import Done, Logged, ServerState, StateDelta
from ..bricks.bricks import FOREVER, After
from ..bricks.standing import PeerLost
from ..model.mechanism import Mechanism, Role
from ..replica.state_manager import MISFIT, Apply, Capture


class Checkpoint(Message[int]):
    """The state behind outcomes, and the outcomes, for the reply log of the backup (A52, A54).

    The reply is the turn that the backup has; `MISFIT` if it wants all of the state.
    """

    state: ServerState | StateDelta
    log: list[Logged]


class Checkpointing(After):
    """After of the primary: outcomes leave when the backup has the state behind them (T4)."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._out: set[asyncio.Task[None]] = set()  # checkpoints that nobody waits for
        self._unheard: list[Logged] = []  # outcomes that the backup may not have: each checkpoint says them again
        self._heard = 0  # how many have stood there before these

    async def after(self, done: Done) -> Done | None:
        """Capture, send, and wait for the acknowledgement."""
        if not done.ends:
            return done
        standing = self._standing
        if standing.other.path is None:
            self._forget_unheard(self._heard + len(self._unheard))  # Whoever joins is given all of them.
            standing.go_on_alone(end.id for end in done.ends)
            return done
        captured = await self.state.ask(Capture(standing.other.turn), timeout=FOREVER)
        state = captured.state
        standing.other.turn = state.turn
        self._unheard += standing.entries(done.ends)
        checkpoint, said = Checkpoint(captured.change or state, list(self._unheard)), self._heard + len(self._unheard)
        self.taken()
        assert isinstance(self.mechanism, PBR)
        if standing.other.state == "joining":
            self._send(checkpoint, said, state)  # It does not count yet: what it has not got does not hold up anybody.
        elif self.mechanism.acknowledge:
            await self._hand_over(checkpoint, said, state)
            if standing.other.path is None:  # It was lost with this in hand.
                standing.go_on_alone(end.id for end in done.ends)
        else:
            while len(self._out) >= self.mechanism.window:
                await asyncio.wait(self._out, return_when=asyncio.FIRST_COMPLETED)
            self._send(checkpoint, said, state)
        return done

    async def drain(self) -> None:
        """Wait until the backup has all states."""
        for task in list(self._out):
            await asyncio.wait((task,))

    async def _hand_over(self, checkpoint: Checkpoint, said: int, state: ServerState) -> None:
        try:
            if await self.ask_peer(checkpoint) == MISFIT:
                await self.ask_peer(Checkpoint(state, checkpoint.log))
        except PeerLost:
            said = self._heard + len(self._unheard)  # We are alone, or another one is brought to our state.
        self._forget_unheard(said)

    def _forget_unheard(self, said: int) -> None:
        if said > self._heard:  # Else a later one has overtaken this, and has said all of it too.
            del self._unheard[: said - self._heard]
            self._heard = said

    def _send(self, checkpoint: Checkpoint, said: int, state: ServerState) -> None:
        task = self.ctx.create_task(self._hand_over(checkpoint, said, state))
        self._out.add(task)
        task.add_done_callback(self._out.discard)


class StateUpdate(After):
    """After of the backup: keeps the state, whole or not at all (T8b)."""

    peer_messages = (Checkpoint,)

    async def from_peer(self, message: Message[Any]) -> int:
        """Take a checkpoint from the primary."""
        assert isinstance(message, Checkpoint)
        standing = self._standing
        await standing.following.until_ready()
        if message.state.turn < standing.server.turn:
            standing.log.add(message.log)  # Else what it says of these requests would be known to nobody here.
            return standing.server.turn  # It was overtaken.
        turn = await self.state.ask(Apply(message.state), timeout=FOREVER)
        if turn != MISFIT:
            standing.log.add(message.log)
        return turn


@dataclasses.dataclass(frozen=True)
class PBR(Mechanism):
    """Passive replication: the primary computes each request, and sends its state to a backup.

    Args:
        acknowledge: whether replies wait for the backup; without it the last `window` batches may be lost.
        window: batches that the backup may be behind, with `acknowledge=False`.
    """

    name: ClassVar[str] = "pbr"
    replicas: ClassVar[int] = 2
    tolerates: ClassVar[frozenset[str]] = frozenset({"crash"})
    needs: ClassVar[frozenset[str]] = frozenset({"state_access"})
    bandwidth: ClassVar[str] = "high"
    cpu: ClassVar[str] = "low"
    units: ClassVar[int] = 2
    layer: ClassVar[str] = "replication"
    roles: ClassVar[dict[str, Role]] = {
        "primary": Role(after=Checkpointing),
        "backup": Role(after=StateUpdate, computes=False),
    }

    acknowledge: bool = True
    window: int = 16

    def __post_init__(self) -> None:
        if self.acknowledge not in (True, False):
            raise ValueError(f"PBR: acknowledge must be True or False, not {self.acknowledge!r}")
        if not isinstance(self.window, int) or self.window < 1:
            raise ValueError(f"PBR: window must be a number of batches >= 1, not {self.window!r}")
