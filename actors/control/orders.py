"""The orders that can be given to a live actor, as plain data that can cross a process border.

An order is carried out where the actor lives, between two of its turns.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, cast

from ..errors import ControlFailed, NotSuspended, SpecError, error_text, type_name
from ..kernel import lifecycle, mailbox
from ..kernel.actor import Actor, Start
from ..kernel.envelope import message_in
from ..kernel.message import message_name
from ..process.wire.start_codec import imported, pack_recipe, unpack_recipe
from ..state_hooks import migrated
from ..turn_stacks import waits_at
from ..values import UnsavableValue
from .live_state import TriedState, change_state, keeping_variables, state_to_show, tried_state
from .other_class import add_variables, become_other
from .state_outline import outline_of
from .tracing import Statistics, tap_of

if TYPE_CHECKING:
    from ..kernel.cell import Cell

Change = Callable[[Any], Any]
"""Takes a state and returns the one that shall be in its place."""


class Order:
    """Base of all orders, which an actor obeys ahead of its messages."""

    verb: ClassVar[str]
    is_beside: ClassVar[bool] = False
    """Whether it is obeyed in the middle of a turn that waits, too."""
    is_look: ClassVar[bool] = False
    """Whether it only looks at the state: it is obeyed beside a turn that rests, as an ask that changes nothing is."""
    is_change: ClassVar[bool] = False
    """Whether turns are not run behind it as they would have been: it is not obeyed ahead of one that had begun."""
    is_behind_transactions: ClassVar[bool] = False
    """Whether it is obeyed behind a transaction that holds the actor, which has tried its own change before."""

    def run(self, cell: Cell, actor: Actor) -> Any:
        """Carry it out; raises ControlFailed."""
        raise NotImplementedError

    def pack(self, where: str) -> dict[str, Any]:
        """The order's fields for another process. Raises SpecError if they cannot be sent."""
        return {}

    @classmethod
    def unpack(cls, data: dict[str, Any]) -> Order:
        """Make the order again of the data that it travelled as."""
        return cls()


class Suspend(Order):
    """Handle no message until Resume; twice is once."""

    verb = "suspend"

    def run(self, cell: Cell, actor: Actor) -> None:
        mailbox.suspend(cell)


class Resume(Order):
    """Handle messages again, in the order in which they came."""

    verb = "resume"

    def run(self, cell: Cell, actor: Actor) -> None:
        mailbox.resume(cell)


class GetState(Order):
    """A copy of the state."""

    verb = "get_state"
    is_look = True

    def run(self, cell: Cell, actor: Actor) -> Any:
        return state_to_show(actor)


class OutlineState(Order):
    """A short text of each variable of the state, however large it is."""

    verb = "outline"
    is_look = True

    def run(self, cell: Cell, actor: Actor) -> dict[str, str]:
        return outline_of(actor)


@dataclasses.dataclass(frozen=True, slots=True)
class ReplaceState(Order):
    """Put what `change` makes of the state in its place; returns the new one."""

    verb: ClassVar[str] = "replace_state"
    is_change: ClassVar[bool] = True
    is_behind_transactions: ClassVar[bool] = True
    change: Change

    def run(self, cell: Cell, actor: Actor) -> Any:
        change_state(actor, keeping_variables(actor, self.change))
        return state_to_show(actor)

    def pack(self, where: str) -> dict[str, Any]:
        return {"change": pack_function(self.change, where, self.verb)}

    @classmethod
    def unpack(cls, data: dict[str, Any]) -> ReplaceState:
        return cls(unpack_function(data["change"]))


@dataclasses.dataclass(frozen=True, slots=True)
class ReplaceCode(Order):
    """Go on as another class, with the state that `change` makes of the present one, or else the class's `migrate`.

    Returns the recipe of the next lives, packed, if it is carried out in another process than it was given in.
    """

    verb: ClassVar[str] = "replace_code"
    is_change: ClassVar[bool] = True
    is_behind_transactions: ClassVar[bool] = True
    start: Start[Any]
    keeps_arguments: bool  # those of the old recipe, which only the actor's supervisor knows
    change: Change | None

    def run(self, cell: Cell, actor: Actor) -> bytes | None:
        if not cell.extra().suspended:
            raise NotSuspended(cell.path, self.verb)
        start, old = next_start(cell, self.start, keeps_arguments=self.keeps_arguments), type(actor)
        try:
            change_state(actor, self.becoming(actor, start))
        except ControlFailed as error:
            raise ControlFailed(cell.path, self.verb, error.problem) from error
        return has_become(cell, old, start)

    def becoming(self, actor: Actor, start: Start[Any]) -> Change:
        """Takes the actor's state, makes the actor one of the new class, and returns the state as that wants it."""

        def become(state: Any) -> Any:
            version = actor.schema_version
            if self.change is not None:
                return become_other(actor, start, self.change(state), is_said=True, is_whole=True)
            is_older = version != start.kind.schema_version
            if is_older:
                state = migrated(start.kind, state, version, actor.ctx.path)
            return become_other(actor, start, state, is_said=is_older)

        return become

    def pack(self, where: str) -> dict[str, Any]:
        try:
            start = pack_recipe(self.start, where)
        except UnsavableValue as error:
            raise SpecError(where, f"{self.verb}: {error}") from error
        return {
            "start": start,
            "keeps": self.keeps_arguments,
            "change": None if self.change is None else pack_function(self.change, where, self.verb),
        }

    @classmethod
    def unpack(cls, data: dict[str, Any]) -> ReplaceCode:
        change = data["change"]
        return cls(unpack_recipe(data["start"]), data["keeps"], None if change is None else unpack_function(change))


def has_become(cell: Cell, old: type[Actor], start: Start[Any]) -> bytes | None:
    """The actor is of another class than before; the recipe of its next lives, packed, for the root of a process."""
    new = start.kind
    cell.table = new._table
    if cell.more is not None and cell.more.tap is not None:
        cell.more.tap.attach()
    assert cell.ctx is not None
    cell.ctx._has_class(old, new)
    lifecycle.limit_turns(cell)
    cell.node.ports.respec(cell, start)
    return None if cell.node.ports.uplink is None else pack_recipe(start, cell.path)


def next_start(cell: Cell, new: Start[Any], *, keeps_arguments: bool) -> Start[Any]:
    """The recipe of the next lives.

    Raises:
        SpecError: the class does not take the arguments.
    """
    old = cell.more.start if cell.more is not None else None
    start = Start(new.kind, old.args, old.kwargs) if keeps_arguments and old is not None else new
    spec: Any = cell.spec
    if not dataclasses.is_dataclass(spec) or isinstance(spec, type):
        return start  # It is never started again, or by a supervisor in another process: there this is asked again.
    check_start(cell.path, spec, start)
    return start


def check_start(path: str, spec: Any, start: Start[Any]) -> None:
    """Whether a child of this spec can begin so. Raises SpecError: its class does not take the arguments."""
    try:
        start.check()
    except TypeError as error:
        problem = f"{type_name(start.kind)} does not take the arguments of the old class ({error})"
        raise SpecError(path, f"{problem}; give start({start.kind.__name__}, ...)") from error
    dataclasses.replace(spec, start=start)  # Raises what the spec does not allow.


# -- what a transaction orders: it is prepared beside what runs, and then put in force at once ------------------------


@dataclasses.dataclass(frozen=True, slots=True)
class Prepared:
    """What an actor will go on with: what has come of the trial, and its recipe if its class is another one."""

    tried: TriedState
    start: Start[Any] | None


@dataclasses.dataclass(frozen=True, slots=True)
class Prepare(Order):
    """Handle no message from now on, for a transaction, and try what it wants: nothing is changed by it.

    Returns, from another process: the recipe of the next lives, packed, if there is another one, and the new state as
    the home of a recorded actor is to keep it.
    """

    verb: ClassVar[str] = "prepare"
    is_change: ClassVar[bool] = True
    attempt: int
    wanted: tuple[ReplaceState | ReplaceCode, ...]

    def run(self, cell: Cell, actor: Actor) -> tuple[bytes | None, list[bytes]]:
        mailbox.suspend(cell, mailbox.BY_TRANSACTION)
        hold = mailbox.held(cell)
        assert hold is not None
        hold.attempt, hold.prepared = self.attempt, None
        if not self.wanted:
            return None, []
        start: Start[Any] | None = None
        changes: list[Change] = []
        for one in self.wanted:
            if isinstance(one, ReplaceCode):
                start = next_start(cell, one.start, keeps_arguments=one.keeps_arguments)
                changes.append(one.becoming(actor, start))
            else:
                changes.append(keeping_variables(actor, one.change))
        tried = tried_state(actor, changes, self.wanted[0].verb)
        hold.prepared = Prepared(tried, start)
        if cell.node.ports.uplink is None:
            return None, []
        return None if start is None else pack_recipe(start, cell.path), tried.saved

    def pack(self, where: str) -> dict[str, Any]:
        return {"attempt": self.attempt, "wanted": [[one.verb, one.pack(where)] for one in self.wanted]}

    @classmethod
    def unpack(cls, data: dict[str, Any]) -> Prepare:
        kinds: dict[str, Any] = {kind.verb: kind for kind in (ReplaceState, ReplaceCode)}
        return cls(data["attempt"], tuple(kinds[verb].unpack(fields) for verb, fields in data["wanted"]))


@dataclasses.dataclass(frozen=True, slots=True)
class Conclude(Order):
    """The transaction is over: go on with what it has prepared, or as before.

    Raises NotSuspended: this life was not prepared for it.
    """

    verb: ClassVar[str] = "conclude"
    is_change: ClassVar[bool] = True
    attempt: int
    is_in_force: bool
    suspended: bool | None
    """Whether it is suspended from now on; None: as before."""

    def run(self, cell: Cell, actor: Actor) -> None:
        hold = mailbox.held(cell)
        if hold is None or hold.attempt != self.attempt:
            if not self.is_in_force:
                return
            raise NotSuspended(cell.path, self.verb, "its life is not the one that was prepared")
        prepared, hold.attempt, hold.prepared = hold.prepared, 0, None
        try:
            if prepared is not None and self.is_in_force:
                go_on_with(cell, actor, prepared)
        finally:
            if self.suspended:
                mailbox.suspend(cell)
            elif self.suspended is not None:
                mailbox.resume(cell)
            mailbox.resume(cell, mailbox.BY_TRANSACTION)
            hold.let_go()

    def pack(self, where: str) -> dict[str, Any]:
        return {"attempt": self.attempt, "is_in_force": self.is_in_force, "suspended": self.suspended}

    @classmethod
    def unpack(cls, data: dict[str, Any]) -> Conclude:
        return cls(data["attempt"], data["is_in_force"], data["suspended"])


class GiveAccount(Order):
    """What it leaves to another one, if one takes its place."""

    verb = "give_account"

    def run(self, cell: Cell, actor: Actor) -> Any:
        return actor._told_account()


@dataclasses.dataclass(frozen=True, slots=True)
class WindDown(Order):
    """Another actor is to take this one's place: see to it that nothing is in the way of that. 0: it is not to be."""

    verb: ClassVar[str] = "wind_down"
    attempt: int

    def run(self, cell: Cell, actor: Actor) -> None:
        actor._wind_down(self.attempt)

    def pack(self, where: str) -> dict[str, Any]:
        return {"attempt": self.attempt}

    @classmethod
    def unpack(cls, data: dict[str, Any]) -> WindDown:
        return cls(data["attempt"])


@dataclasses.dataclass(frozen=True, slots=True)
class StandDown(Order):
    """Handle no message from now on, until `Conclude`: another actor is to take this one's place.

    Returns what it leaves to that one; None: nobody can take its place now, and it goes on.
    """

    verb: ClassVar[str] = "stand_down"
    is_change: ClassVar[bool] = True
    attempt: int

    def run(self, cell: Cell, actor: Actor) -> Any:
        if actor._why_occupied():
            return None
        mailbox.suspend(cell, mailbox.BY_TRANSACTION)
        hold = mailbox.held(cell)
        assert hold is not None
        hold.attempt = self.attempt
        return actor._told_account()

    def pack(self, where: str) -> dict[str, Any]:
        return {"attempt": self.attempt}

    @classmethod
    def unpack(cls, data: dict[str, Any]) -> StandDown:
        return cls(data["attempt"])


def go_on_with(cell: Cell, actor: Actor, prepared: Prepared) -> None:
    """Have an actor between two turns go on with what was prepared for it. Raises ControlFailed."""
    old, start = type(actor), prepared.start

    def put(_: Any) -> Any:
        if start is not None:
            cast("Any", actor).__class__ = start.kind
            add_variables(actor, prepared.tried.added)
            actor.ctx._first_variables = prepared.tried.first_variables
        return prepared.tried.state

    change_state(actor, put, is_new=False)
    if start is not None:
        has_become(cell, old, start)


@dataclasses.dataclass(frozen=True, slots=True)
class ObserveTurns(Order):
    """Count (`statistics`) and follow (`trace`) what the actor does, or do not any more; returns the counts."""

    verb: ClassVar[str] = "look"
    is_beside: ClassVar[bool] = True
    counting: bool | None  # None: as it is
    tracing: bool | None

    def run(self, cell: Cell, actor: Actor) -> Statistics | None:
        return tap_of(cell).switch(self.counting, self.tracing)

    def pack(self, where: str) -> dict[str, Any]:
        return {"counting": self.counting, "tracing": self.tracing}

    @classmethod
    def unpack(cls, data: dict[str, Any]) -> ObserveTurns:
        return cls(data["counting"], data["tracing"])


class Mark(Order):
    """Do nothing: its turn says that everything before it has been handled, and how many messages stand behind it."""

    verb = "mark"

    def run(self, cell: Cell, actor: Actor) -> int:
        return sum(map(mailbox.counts, cell.queue or ()))


class Ready(Order):
    """Do nothing, ahead of all messages: its turn says that a life is up."""

    verb = "ready"

    def run(self, cell: Cell, actor: Actor) -> None:
        return None


ORDERS: dict[str, type[Order]] = {
    kind.verb: kind
    for kind in (
        Suspend,
        Resume,
        GetState,
        OutlineState,
        ReplaceState,
        ReplaceCode,
        Prepare,
        GiveAccount,
        WindDown,
        StandDown,
        Conclude,
        ObserveTurns,
        Mark,
        Ready,
    )
}


# -- the status is no order: it is asked for while a turn runs --------------------------------------------------------


@dataclasses.dataclass(frozen=True, slots=True)
class Status:
    """One actor, as `get_status` tells it."""

    address: str
    kind: str
    """The class, `module.Class`."""
    state: str
    """"running", "suspended", "restarting" (no life now, or being recovered) or "ending"."""
    parent: str | None
    life: int
    """The number of this life at the address, from 1."""
    queued: int
    """Messages that wait."""
    turn: str | None
    """The message whose turn is not over, by type; seen only if the turn waits for something."""
    turn_seconds: float
    """How long that turn has taken so far, over all lives it was handled in, as far as that is known."""
    links: int
    monitors: int
    """Who watches this actor."""
    pid: int
    """The OS process; 0 if there is none now."""
    bindings: dict[str, str] = dataclasses.field(default_factory=dict)
    """Who is bound to its ports: port to address."""
    turn_at: str = ""
    """The line of the user's code at which that turn waits, `shop.py:41, await reader.readline()`; "" if none does."""
    turn_rests: str = ""
    """What that turn waits for that is no other actor's work: a sleep, an effect that is out; "" if none is known."""


def status_of(cell: Cell) -> Status:
    """The status of an actor in this process."""
    more, parent = cell.more, cell.parent
    turn = more.turn if more is not None else None
    item = cell.item if turn is not None and cell.ctx is not None else None
    start = more.start if more is not None else None
    kind = type(cell.actor) if cell.actor is not None else start.kind if start is not None else None
    return Status(
        cell.path,
        "" if kind is None else type_name(kind),
        _state(cell),
        None if parent is None else parent.path,
        cell.life,
        cell.host.backlog(cell),
        None if turn is None else type_name(type(message_in(item))),
        0.0 if turn is None else _turn_seconds(cell, cell.node.loop.time() - turn.since),
        0 if more is None else len(more.ties.links),
        0 if more is None else len(more.ties.monitors),
        os.getpid(),
        {} if more is None else {port: target.path for port, target in more.bindings.items()},
        "" if turn is None else waits_at(turn.coroutine),
        rests_said(cell),
    )


def turns_of(cell: Cell) -> list[object]:
    """At how many looks an actor here had something new in hand, what its turn rests in, and who owes it a reply."""
    return [
        cell.extra().belongings.take_look(cell.host.work(cell).mark),
        [list(rest) for rest in cell.host.rests(cell)],
        cell.host.awaits(cell),
    ]


def rests_said(cell: Cell) -> str:
    """What the turn in hand waits for that is no other actor's work, in words; "" if none is known here."""
    now = cell.node.clock.wall()
    return " and ".join(rest.said(now) for rest in cell.host.rests(cell))


def known_at_home(status: Status, cell: Cell) -> Status:
    """A status with what the home of a recorded actor knows of its turn, and the process that it lives in does not."""
    rests = rests_said(cell) or status.turn_rests
    seconds = 0.0 if status.turn is None else _turn_seconds(cell, status.turn_seconds)
    return dataclasses.replace(status, turn_rests=rests, turn_seconds=seconds)


def _turn_seconds(cell: Cell, seconds: float) -> float:
    """How long the turn in hand has taken, which has been so many seconds in the present life."""
    begun = cell.host.work(cell).begun
    return seconds if begun is None else max(seconds, cell.node.clock.wall() - begun)


def _state(cell: Cell) -> str:
    if cell.state == "ending":
        return "ending"
    if not cell.host.is_up(cell):
        return "restarting"
    suspended = cell.more.suspended if cell.more is not None else 0
    return "suspended" if suspended & ~mailbox.BY_ITSELF else "running"


# -- functions by name ------------------------------------------------------------------------------------------------


def pack_function(function: Callable[..., Any], where: str, order: str) -> list[Any]:
    """A function that can be imported by name, or a `functools.partial` of one, as plain data.

    Raises:
        SpecError: another process could not import it.
    """
    if isinstance(function, functools.partial):
        name, args, kwargs = pack_function(function.func, where, order)
        return [name, [*args, *function.args], {**kwargs, **function.keywords}]
    path = getattr(function, "__qualname__", "")
    name = f"{getattr(function, '__module__', '')}:{path}"
    if "<" not in path:
        name = message_name(cast("Any", function))
        try:
            if imported(name) == function:
                return [name, [], {}]
        except (ImportError, AttributeError):
            pass
    raise SpecError(
        where,
        f"{order} needs a function of a module, because the actor lives in another process, which has to import it; "
        f"{path or function!r} cannot be imported",
    )


def unpack_function(packed: Any) -> Callable[..., Any]:
    """The function again. Imports its module."""
    try:
        name, args, kwargs = packed
    except (TypeError, ValueError):
        raise SpecError(
            "control", f"{packed!r:.100} is no function: a name, its arguments, and the named ones"
        ) from None
    try:
        function: Callable[..., Any] = imported(name)
    except BaseException as error:  # Importing a module runs it: it may raise anything.
        raise SpecError("control", f"{name} cannot be imported: {error_text(error)}") from error
    return functools.partial(function, *args, **kwargs) if args or kwargs else function
