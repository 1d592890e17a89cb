"""Orders of the root to the replicas of a group besides their work, and reports of the replicas.

All orders go to the outermost RequestProtocol of a replica. Each can come twice: the manager that gave it may have died
before it heard the reply, and the next one gives it again. Twice is once.
"""

from __future__ import annotations

from typing import Any

import msgspec

from ...actors.kernel.message import Message
from ...checkpoint.protocol import Clock, TurnEnd
from ..model.mechanism import Description


class Setting(msgspec.Struct, array_like=True, frozen=True):
    """What a replica is made with, besides its layers and the recipe of the protected actor.

    The address of that is not among it: a replica finds it by its own, `ftm/NAME` below it, wherever that is now.
    """

    name: str
    """This replica's: "r1"."""
    config: int
    method: dict[str, Any]
    """What a life has to know of its recovery method (`Method.data`)."""
    bindings: dict[str, str]
    """Of the protected actor: port to address."""
    beat: float
    """Seconds between two heartbeats, if no layer says; 0: there are none."""
    watch_turns: float = 0.0
    """Seconds that a turn may take, if no layer says; 0: as many as it wants."""
    claimed: frozenset[str] = frozenset()
    """Ports of which only another actor process says where they lead: these grant nothing."""


class Install(Message[None]):
    """A piece of the state to begin with; then `Lead` comes. Without it the replica begins afresh."""

    epoch: int
    turn: int
    data: bytes
    stash: list[int]
    is_last: bool
    log: list[tuple[str, int, int, TurnEnd]]
    traps: bool = False  # `ctx.trap_exits` of the life that it comes from
    variables: tuple[str, ...] = ()  # that its class had when it was saved
    timers: dict[str, Clock] = msgspec.field(default_factory=dict)  # that ran then


class SetPeer(Message[None]):
    """Your other replica is the one at this path from now on; None: you are alone, wait for nobody."""

    epoch: int
    path: str | None


class Join(Message[int]):
    """Have the replica at `peer` catch up, between two batches, and count it in from the next batch on.

    The reply is the turn whose state it has acknowledged; an error if it cannot.
    """

    epoch: int
    peer: str


class Stand(msgspec.Struct, array_like=True):
    """How a replica stands when nothing is inside."""

    epoch: int
    config: int
    turn: int
    leads: bool


class Quiesce(Message[Stand]):
    """Answered when nothing is inside, and the other replica has all that it was sent. Nothing new may be sent in.

    `settles`: and when all that has come here has been handled here. One that follows may be behind the one that leads.
    """

    epoch: int
    config: int
    settles: bool = False


class PrepareStack(Message[None]):
    """Start the bricks of another stack of mechanisms beside those of the present one."""

    config: int
    layers: list[Description]


class Commit(Message[int]):
    """Bind everything as that stack wants it, and end the bricks that are not needed. Nothing may be inside.

    The reply is the last turn whose state is here. `insists`: bricks that do not come to an end are not waited for.
    """

    config: int
    insists: bool = False


class Abort(Message[None]):
    """End the bricks that were prepared; everything stays as it was."""

    config: int


class Doing(msgspec.Struct, array_like=True):
    """What a replica does with what is inside."""

    computes: bool
    """The protected actor, or another life of it here, is at work; else what is inside is in the bricks."""
    keeps: bool
    """Nothing that was computed has been lost in the bricks: what is inside can be asked for again."""
    passes: bool = True
    """The bricks have handled what had come to them; not looked at where it leads."""


class Computes(Message[Doing]):
    """What do you do with what is inside? `turn` is the last one that home knows of.

    One that does not lead has `seconds` for its bricks to handle what has come to them.
    """

    turn: int
    seconds: float = 0.0


class Rehearse(Message[None]):
    """To a replica that is no part of a group yet: play this role, and let a batch without requests pass its bricks.

    `is_new`: all of them are made anew.
    """

    leads: bool
    is_new: bool


class Finish(Message[None]):
    """End in good order: a last snapshot (if the method takes any), then `on_stop` of the protected actor."""

    epoch: int
    reason: dict[str, Any]


class EndTurn(Message[None]):
    """The turn of this input, if it is in hand, is over: as if its handler had raised; or it is tried `again`."""

    epoch: int
    number: int
    again: bool


class Withdraw(Message[bool]):
    """Give back what is inside, if that is a turn which only rests (for days, perhaps), and go back to before it.

    The reply is False if more than that is out: nothing has happened then. What is given back is sent again.
    `number`: the input that the turn handles; a follower that is not there yet has nothing to give back.
    `stranded`: its outputs that are asks whose receivers have been stopped: who waits for their next lives rests, too.
    """

    epoch: int
    config: int
    number: int
    stranded: list[int]


class ReplicaBeat(Message):
    """This replica's bricks are running. Goes as it is, over secured links too: see there."""

    name: str
    epoch: int


class Broken(Message):
    """From a replica to the detector: a brick has crashed. It ends by itself, but what is in hand may hold that up."""

    name: str
    life: int
    why: str


class Stalled(Message):
    """From a replica to the proxy: the turn of this input takes too long."""

    name: str
    epoch: int
    number: int


class Exported(msgspec.Struct, array_like=True):
    """The state of the protected actor after turn `turn`, as a snapshot has it."""

    turn: int
    data: bytes
    stash: list[int]
    traps: bool  # `ctx.trap_exits`


EXPORTED_WITHIN = 5.0
"""Seconds until whoever leads is asked again for the state: it may have died with the question."""


class Export(Message[Exported]):
    """Give out the state between two batches, when no background work is out: the actor is to live without a mechanism.

    After `seconds` nobody waits for it any more.
    """

    epoch: int
    seconds: float = EXPORTED_WITHIN
