"""The progress of a change of mechanisms, and the next step of it: data and decisions.

What is under way stands here, outside all actors: the engine (`adaptation_engine.py`) may die at any moment, and its
next life goes on. Up to the commit a change can be given up; from there on it is carried to its end, for a replica that
has changed stays so.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Literal

from ...actors.errors import AskTimeout, HoldfastError

if TYPE_CHECKING:
    import asyncio

    from ...actors.migration.move import CommitGate
    from ..bricks.replica_orders import Stand
    from ..bricks.sealed_frames import SecuredLink
    from ..model.mechanism import Description, Mechanism
    from .membership import Lives, Membership

MOST_BROKEN_OFF = 3
"""Replicas that end while they prepare, whoever has ended them: then it is given up."""

Stage = Literal["preparing", "resting", "committing", "tidying", "undoing", "over"]
STEPS = ("try", "start", "prepare", "rest", "quiesce", "commit", "switch", "tidy")
"""Where the engine may be struck by a test; undoing has `abort` instead of the last three."""


class CannotAdapt(HoldfastError, text="{actor} keeps its mechanism: {why}"):
    """The mechanism stays as it was."""

    actor: str
    why: str


@dataclasses.dataclass(slots=True)
class Preparation:
    """What has been made ready for a change.

    Attributes:
        is_under_way: replicas start the new bricks.
        is_tried: the stack has worked where it could hurt nobody.
        broken_off: how often a replica has ended, or has changed its part, while it prepared.
        started: replicas that are new.
        lives: name to life, of those that have the new bricks.
        epoch: in which they have got them.
    """

    is_under_way: bool = False
    is_tried: bool = False
    broken_off: int = 0
    started: list[str] = dataclasses.field(default_factory=list)
    lives: dict[str, int] = dataclasses.field(default_factory=dict)
    epoch: int = -1

    def still_holds(self, known: Membership, lives: Lives) -> bool:
        """Whether those that count are those that were prepared, in the parts that they had then."""
        return known.epoch == self.epoch and known.well(lives) == self.lives

    def break_off(self, name: str) -> str:
        """A replica has ended while it prepared: why it is given up, "" if it is tried again."""
        self.broken_off += 1
        is_hopeless = self.broken_off == MOST_BROKEN_OFF
        return f"{MOST_BROKEN_OFF} replicas have ended while they prepared it, {name} last" if is_hopeless else ""


@dataclasses.dataclass(slots=True, eq=False)
class Reconfiguration:
    """One change of a stack of mechanisms, as far as it has come.

    Attributes:
        path: of the protected actor.
        config: the number of the new stack.
        layers: the new stack, outermost first.
        descriptions: the same as data.
        names: the replicas that there are to be.
        given_up: ends with the reason if it is not wanted any more.
        outcome: ends when it is made, or with `CannotAdapt`.
        on_given_up: has the engine look.
        is_back: it leads to what has worked before.
        gate: where it waits when all is ready.
        stage: how far it has come.
        why: it is given up.
        link: that of the new stack, if it is another one.
        preparation: what has been made ready.
        turn: the last one of the primary when it had come to rest.
        failed: name to life, of those that have not changed though they should have.
        rest_at: when it has come to rest, on the monotonic clock.
        gone_on_at: when requests flowed again.
    """

    path: str
    config: int
    layers: tuple[Mechanism, ...]
    names: tuple[str, ...]
    loop: dataclasses.InitVar[asyncio.AbstractEventLoop]
    on_given_up: Callable[[], None]
    is_back: bool = False
    gate: CommitGate | None = None
    stage: Stage = "preparing"
    why: str = ""
    link: SecuredLink | None = None
    preparation: Preparation = dataclasses.field(default_factory=Preparation)
    turn: int = -1
    failed: dict[str, int] = dataclasses.field(default_factory=dict)
    rest_at: float = 0.0
    gone_on_at: float = 0.0
    descriptions: list[Description] = dataclasses.field(init=False)
    given_up: asyncio.Future[str] = dataclasses.field(init=False)
    outcome: asyncio.Future[None] = dataclasses.field(init=False)

    def __post_init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.descriptions = [layer.for_replicas().describe() for layer in self.layers]
        self.given_up, self.outcome = loop.create_future(), loop.create_future()

    @property
    def is_committed(self) -> bool:
        """Whether the new stack is in force."""
        return self.stage in ("tidying", "over") and not self.why

    def next_stage(self) -> Stage:
        """Decide what is to be done: a change that was given up is undone."""
        if self.why and self.stage in ("preparing", "resting"):
            self.stage = "undoing"
        return self.stage

    def give_up(self, why: str) -> None:
        """It is not wanted any more, unless it has gone too far."""
        if self.stage in ("preparing", "resting"):
            self.why = self.why or why
            if not self.given_up.done():
                self.given_up.set_result(self.why)
            self.on_given_up()

    def close(self, why: str) -> None:
        """The life at the address is over; the next one begins as its recipe says."""
        if self.is_committed:
            self.succeed()
        else:
            self.fail(why)

    def succeed(self) -> None:
        """Tell whoever waits for it that it is made."""
        if not self.outcome.done():
            self.outcome.set_result(None)

    def fail(self, why: str) -> None:
        """Tell whoever waits for it that nothing has changed."""
        if not self.outcome.done():
            self.outcome.set_exception(CannotAdapt(self.path, why))
            self.outcome.exception()  # Nobody may wait for it any more.

    def judge_commit(self, turns: Mapping[str, int], errors: Mapping[str, BaseException], lives: Lives) -> set[str]:
        """Decide what follows when replicas were told to change.

        As soon as one has, there is no way back, and who has not, though it should have, has failed. One that has
        refused has what it had, which all go on with if none has changed.

        Args:
            turns: the last turn of each that has changed.
            errors: of those that have not.
            lives: that they live now.

        Returns:
            Those that have changed, and have not got all that the primary had.
        """
        for name, error in errors.items():
            life = self.preparation.lives[name]
            if lives.get(name, 0) == life and (turns or isinstance(error, AskTimeout)):
                self.failed[name] = life
        if not turns:
            self.stage, self.why = "undoing", f"no replica could: {'; '.join(map(str, errors.values()))}"
        return {name for name, turn in turns.items() if turn != self.turn}


@dataclasses.dataclass(slots=True)
class Adaptation:
    """Which stack of mechanisms is in force, and which one is on its way.

    Attributes:
        config: the number of the stack in force.
        change: that is being made.
        gone_back: a change that a failover has made: what is left is to tidy up.
        is_changing: the replicas change it: nobody else may tell them anything.
    """

    config: int
    change: Reconfiguration | None = None
    gone_back: Reconfiguration | None = None
    is_changing: bool = False

    def next_change(self) -> Reconfiguration | None:
        """Find the change to go on with; what a failover has left to tidy up comes behind it."""
        if self.change is None or self.change.stage == "over":
            self.change, self.gone_back = self.gone_back, None
        return self.change

    def end(self, change: Reconfiguration) -> None:
        """It is made, or undone."""
        change.stage = "over"
        if self.change is change:
            self.change = None


def names_for(known: Membership, layers: tuple[Mechanism, ...]) -> tuple[str, ...]:
    """The replicas that there are to be: those that are there, as far as they are needed, the primary first."""
    wanted = max(layer.replicas for layer in layers)
    there = sorted(known.names, key=lambda name: (name != known.primary, name not in known.members))
    new = (f"r{number}" for number in range(1, len(there) + wanted + 1))
    return (*there, *(name for name in new if name not in known.names))[:wanted]


def what_is_wrong(stands: Mapping[str, Stand], primary: str, config: int) -> str:
    """Why replicas that are at rest must not change, "" if nothing is wrong: one leads, and all have the same stack."""
    leading = [name for name, stand in stands.items() if stand.leads]
    if leading != [primary]:
        return f"{', '.join(leading) or 'nobody'} leads, and it should be {primary} alone"
    configs = {stand.config for stand in stands.values()}
    return "" if configs == {config} else f"the replicas have different configurations: {sorted(configs)}"


def still_silent(
    errors: Mapping[str, BaseException], seconds: float, excused: Mapping[str, float], within: float
) -> list[str]:
    """Those that may not have heard an order yet.

    Args:
        errors: of all that have not done as they were told.
        seconds: since they were told first.
        excused: for how many of these it is no fault of theirs.
        within: how many they have.
    """
    late = (name for name, error in errors.items() if isinstance(error, AskTimeout))
    return [name for name in late if seconds - excused[name] < within]
