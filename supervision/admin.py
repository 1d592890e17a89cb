"""Administration: the messages that a supervisor answers, and its refusals."""

from __future__ import annotations

from typing import Any

import msgspec

from ..actors.errors import HoldfastError, SpecError, shown
from ..actors.exit_reasons import SHUTDOWN, ExitReason, check_reason, unpack_exit
from ..actors.kernel.codec import Packable, Packed
from ..actors.kernel.message import Message, Refusal, RuntimeCall, RuntimeOrder
from ..actors.kernel.node import Node
from ..actors.kernel.ref import ActorRef
from ..actors.process.wire.start_codec import pack_argument, pack_data, unpack_argument, unpack_data

# -- refusals -------------------------------------------------------------------------------------------------------


class AlreadyStarted(
    Refusal, text="child {id!r} runs already, at {ref.path}: use that one, or give the new one another id"
):
    """A child of this id is there already; `ref` is it. `in_vain`: why it cannot be recovered, if that is so."""

    id: str
    ref: ActorRef[Any]
    in_vain: str = ""

    def __str__(self) -> str:
        if not self.in_vain:
            return super().__str__()
        return (
            f"child {self.id!r} is there, at {self.ref.path}, and cannot be recovered: {self.in_vain}; change the "
            "template to the class that has recorded it (ChangeSupervisor), then TerminateChild and StartChild"
        )


class AlreadyPresent(
    Refusal, text="child {id!r} is known already: start it with RestartChild if it does not run, or delete it first"
):
    """A child of this id is known, but does not run now: restart or delete it."""

    id: str


class ChildBusy(Refusal, text="child {id!r} is {state}: stop it first, with TerminateChild"):
    """The child is "running", "restarting" or "recovering": terminate it first."""

    id: str
    state: str


class ChildParked(
    Refusal, text="child {id!r} was stopped by order and is left alone: start it by order, with RestartChild"
):
    """The child was stopped by order: repair leaves it alone until it is started by order again."""

    id: str


class NoSuchChild(Refusal, text="there is no child {id!r}: WhichChildren lists those that there are"):
    """The supervisor has no child of this id."""

    id: str


class MaxChildren(
    Refusal, text="there are as many children as there may be ({max_children}): stop one, or raise max_children"
):
    """A dynamic supervisor has as many children as it may have; those that are being restarted count."""

    max_children: int


class NotSupported(Refusal, text="{why}"):
    """A supervisor of this kind does not do that; `why` says what to do instead."""

    why: str


class NoPartitions(Refusal, text="{supervisor} has no partitions to route to: give it some with ResizePartitions"):
    """A partition supervisor was resized to nothing: there is nobody to route to."""

    supervisor: str


# -- requests -------------------------------------------------------------------------------------------------------


class Boxed(Packable):
    """A child spec, recipe or plan in a message: as it is in this process, packed when it leaves it."""

    __slots__ = ("value",)

    def __init__(self, value: Any) -> None:
        self.value = value

    def packed(self) -> bytes:
        """As bytes; raises UnsavableValue or SpecError if it cannot be sent."""
        return pack_data(self.value, type(self.value).__name__)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Boxed) and other.value == self.value

    __hash__ = None  # type: ignore[assignment]  # specs hold dicts

    def __repr__(self) -> str:
        return repr(self.value)


def boxed(value: Any) -> Any:
    """`value` so that it can be sent, unless it is plain data already."""
    return value if value is None or isinstance(value, (Boxed, Packed)) else Boxed(value)


def opened(value: Any, node: Node) -> Any:
    """What is in a box.

    Raises:
        SpecError: it came from another process than the root: nothing that comes from there is imported or made here.
    """
    if not isinstance(value, Packed):
        return value.value if isinstance(value, Boxed) else value
    if node.ports.uplink is None:
        raise SpecError(
            "supervisor", "a child spec from an actor process is not taken here: start from a template with plain args"
        )
    try:
        return unpack_data(value.data)
    except HoldfastError as error:
        raise SpecError("supervisor", str(error)) from error


class BoxedArgument(Boxed):
    """A value in a message of which nothing declares the type: its bytes say it."""

    __slots__ = ()

    def packed(self) -> bytes:
        return pack_argument(self.value, "argument")


AS_THEY_ARE = (type(None), bool, int, float, str, bytes, ActorRef)
"""What arrives as it was sent, whatever declares it."""


def boxed_argument(value: Any) -> Any:
    """A value whose type nothing declares, so that it arrives as what it is."""
    return value if type(value) in AS_THEY_ARE or isinstance(value, (Boxed, Packed)) else BoxedArgument(value)


def opened_argument(value: Any, node: Node) -> Any:
    """The value that is in a box. From another process than the root only classes are made that are loaded here.

    Raises:
        SpecError: a class of it cannot be found here.
    """
    if not isinstance(value, Packed):
        return value.value if isinstance(value, Boxed) else value
    try:
        return unpack_argument(value.data, node.ref_at, imports=node.ports.uplink is not None)
    except HoldfastError as error:
        raise SpecError("supervisor", f"an argument cannot be read here: {error}") from error


class StartChild(RuntimeOrder[Any]):
    """Start one more child; the reply is its ref, or None if it did not want to be started (`Ignore`).

    `spec` is a child spec; a dynamic supervisor takes a bare `start(...)` too. From a template a child is started by
    `StartChild(args=(...), kwargs={...}, id=...)`. With `fresh` nothing comes back that was recorded at its address.
    With `unless_stopped` a child whose spec has `autostart=False` is known and stopped then, as at a start of its
    supervisor, and the reply is None.
    A `candidate` (a number that nobody else uses) may be asked for twice, and withdrawn: nobody knows what has become
    of a request when its supervisor ends.
    """

    spec: Any = None
    args: tuple[Any, ...] = ()
    kwargs: dict[str, Any] = msgspec.field(default_factory=dict)
    id: str | None = None
    fresh: bool = False
    candidate: int = 0
    unless_stopped: bool = False

    def __post_init__(self) -> None:
        set_field = msgspec.structs.force_setattr
        set_field(self, "spec", boxed(self.spec))
        if isinstance(self.args, (tuple, list)):
            set_field(self, "args", tuple(map(boxed_argument, self.args)))
        if isinstance(self.kwargs, dict):
            set_field(self, "kwargs", {name: boxed_argument(value) for name, value in self.kwargs.items()})

    def arguments(self, node: Node) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """Read what the actor is given behind the template's own arguments. Raises SpecError if that cannot be had."""
        named = {name: opened_argument(value, node) for name, value in self.kwargs.items()}
        return tuple(opened_argument(value, node) for value in self.args), named


class TerminateChild(RuntimeOrder[None]):
    """Stop a child by its spec; the spec stays, unless it is temporary. A pending restart is void.

    `reason` is what `pack_exit` gives; None is SHUTDOWN. The child is parked then: repair does not start it
    again before you do, unless `parks` is False.
    """

    id: str
    reason: dict[str, Any] | None = None
    parks: bool = True


class RestartChild(RuntimeOrder[Any]):
    """Start a stopped child again; the reply is its ref, or None if it did not want to be started.

    With `fresh` what was recorded of it (of a supervisor: of all below it) is erased first. With `running` a child that
    runs is stopped first: from there to its start it is one call, which goes on if whoever has asked ends meanwhile. If
    that start fails, the caller is told so, and the supervisor tries on as after a crash.
    With `unless_parked` a child that was stopped by order is refused (ChildParked): so asks repair. With `blames_turn`
    a turn that has to be cut off for this did not end, which counts against its message as a death does: so asks
    repair, too, and else nobody's order counts. With `older` it
    begins with its snapshot before the newest; if there is none, one that ran goes on as it was, and the reply is
    ControlFailed. With `at_once` one that runs is killed, and not asked to end: it may hear nothing.
    """

    id: str
    fresh: bool = False
    running: bool = False
    unless_parked: bool = False
    older: bool = False
    blames_turn: bool = False
    at_once: bool = False


class DeleteChild(RuntimeOrder[None]):
    """Forget a stopped child, and (unless `erase` is False) what was recorded of it and of all below it.

    A dynamic supervisor forgets those that have ended by itself; this erases what was recorded of one.
    """

    id: str
    erase: bool = True


class RemoveChild(RuntimeOrder[None]):
    """Stop a child and forget its spec, and with `erase` what was recorded of it; nobody starts it in between.

    With a `candidate` only if it was started as that one: if not, there is nothing to be done, and whoever has it keeps
    it. Without one repair takes it for stopped by order.
    """

    id: str
    reason: dict[str, Any] | None = None
    erase: bool = False
    candidate: int = 0


def reason_in(message: TerminateChild | RemoveChild) -> ExitReason:
    """For which reason the child is to end. Raises SpecError: what the message has is none."""
    if message.reason is None:
        return SHUTDOWN
    where = type(message).__name__
    try:
        return check_reason(where, unpack_exit(message.reason))
    except msgspec.ValidationError as error:
        raise SpecError(where, f"reason is what pack_exit gives, not {shown(message.reason)}: {error}") from error


class ChildInfo(Message[None]):
    """One child, as `WhichChildren` tells it. `state`: running, restarting, recovering or stopped."""

    id: str
    state: str
    path: str
    is_supervisor: bool


class WhichChildren(Message[list[ChildInfo]]):
    """All children, in start order."""


class EndedChild(Message[None]):
    """A child that has ended and was not started again: why, in words, and whether anything recorded of it is kept."""

    id: str
    path: str
    reason: str
    is_recorded: bool


class EndedChildren(Message[list[EndedChild]]):
    """The children that have ended, or were stopped, and were not started again, the last one last.

    Those whose spec is gone are among them (temporary ones, and all of a dynamic supervisor), until they are deleted
    (`DeleteChild`). The newest 100 of this life of the supervisor are known.
    """


class ChildCounts(Message[None]):
    """The number of specs, how many of them run, and how many are supervisors and workers, running or not.

    `awaited`: how many wait for somebody to whom their specs bind them, by the address of that one.
    """

    specs: int
    active: int
    supervisors: int
    workers: int
    awaited: dict[str, int] = msgspec.field(default_factory=dict[str, int])


class CountChildren(Message[ChildCounts]):
    """Ask a supervisor how many children it has."""


class GetChildSpec(RuntimeCall[Any]):
    """The child's spec, with everything that was left out filled in."""

    id: str


class ChangeSupervisor(RuntimeOrder[None]):
    """Change a supervisor while it works. What is left out stays; with nothing given its `init` is asked anew.

    Flags hold at once. A child whose id is known gets its new spec and goes on; a new one is added and not started; one
    that is not mentioned stays, behind the others. If anything is not valid, nothing changes. The next lives of the
    supervisor begin with it too, unless its class has an `init` of its own, which is asked at each start.
    """

    flags: Any = None
    children: Any = None

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "flags", boxed(self.flags))
        msgspec.structs.force_setattr(self, "children", boxed(self.children))
