"""What a supervisor is made of: at its start, when it is changed while it works, and when another takes its place.

One that is to take the place of another one begins without children beside it. The children that live are given to it
each with its life. All the rest is told: flags, which children there are and in which order, the specs of those that do
not run, which restarts count, who was stopped by order, what its kind and its class know beside that, and whether it is
suspended.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from ..actors.control.live_state import live_state, put_state
from ..actors.errors import HoldfastError, Ignore, SpecError, StartIgnored, remote_crash, type_name
from ..actors.events import HookFailed
from ..actors.exit_reasons import crash
from ..actors.kernel import mailbox
from ..actors.kernel.cell import GONE, Cell
from ..actors.kernel.message import RuntimeOrder
from ..actors.kernel.node import Node
from ..actors.process.wire.start_codec import unpack_told
from ..actors.values import UnsavableValue, decode_value, encode_value
from .admin import Boxed, ChangeSupervisor, opened
from .children import STOPPED, UP, Child, complete
from .errands import Errand
from .spec import ChildSpec, Flags, Plan, check_spec

if TYPE_CHECKING:
    from .supervisor import Supervisor

FIXED = ("isolation", "recovery", "mechanism", "mailbox", "limits", "bindings")
"""What belongs to an address and not to a life: it takes a new address to change it."""


def new_plan(supervisor: Supervisor, message: ChangeSupervisor | None = None) -> Plan:
    """The plan a supervisor is to follow: what `init` returns, or what the message says.

    Raises:
        SpecError: something in it is not valid. StartIgnored, RemoteCrash: when `init` is asked anew, and raises.
    """
    node, where = supervisor.ctx._cell.node, supervisor.ctx.path
    if message is None:
        plan = _asked(supervisor)
    elif message.flags is None and message.children is None:
        plan = _asked_anew(supervisor)
    else:
        flags = opened(message.flags, node)
        specs = opened(message.children, node)
        if flags is not None and not isinstance(flags, Flags):
            raise SpecError("ChangeSupervisor", f"flags must be Flags(...) or left out, not {flags!r}")
        now = supervisor._flags if flags is None else flags
        if specs is None:
            specs = supervisor._specs()
        plan = Plan.of(now, specs)
    for spec in plan.children:
        check_spec(where, spec, plan.flags.auto_shutdown, nameless=supervisor._is_dynamic)
    check_place(where, plan.children, node)
    return plan


def _asked(supervisor: Supervisor) -> Plan:
    plan: object = supervisor.init()
    if not isinstance(plan, Plan):
        raise SpecError(type_name(type(supervisor)), f"init must return a Plan, not {plan!r}")
    return plan


def _asked_anew(supervisor: Supervisor) -> Plan:
    """`init` runs in the turn of an admin call: what it raises is the caller's business."""
    try:
        return _asked(supervisor)
    except Ignore as no:
        raise StartIgnored(supervisor.ctx.path, no.why) from no
    except HoldfastError:
        raise
    except BaseException as error:
        raise remote_crash(error) from error


def succession(supervisor: Supervisor, known: dict[str, Child], plan: Plan) -> dict[str, Child]:
    """The children after a change: those of the plan in its order, then those it does not mention.

    Source:
        Erlang/OTP `supervisor:code_change`.

    Raises:
        SpecError: a spec changes what belongs to the address of a child that has one.
    """
    specs = [complete(supervisor.ctx._cell, spec) for spec in plan.children]
    for spec in specs:
        one = known.get(spec.id)
        if one is None or one.cell is None or one.cell.state is GONE:
            continue
        for name in FIXED:
            if getattr(spec, name) != getattr(one.spec, name):
                raise SpecError(
                    f"child {spec.id!r}", f"{name} belongs to its address: terminate the child before you change it"
                )
    children: dict[str, Child] = {}
    for spec in specs:
        one = children[spec.id] = known.get(spec.id) or Child(spec)
        one.spec = spec
        if one.cell is not None and one.cell.state is not GONE:
            one.cell.spec = spec
            one.cell.extra().start = spec.start
    return {**children, **{name: one for name, one in known.items() if name not in children}}


def check_place(where: str, specs: Iterable[ChildSpec], node: Node) -> None:
    """Whether children can be below a supervisor that lives here. Raises SpecError: see `check_subtree`."""
    if node.ports.uplink is not None:
        check_subtree(where, specs)


def check_subtree(where: str, specs: Iterable[ChildSpec]) -> None:
    """Whether specs, and what is below them, can be below a supervisor with a process of its own.

    An actor there may have one too; the root has it, and the supervisor decides on it. A supervisor may not.

    Raises:
        SpecError: one of them cannot.
    """
    for spec in everything(specs):
        if spec.isolation == "process" and spec.is_supervisor:
            why = "cannot hold another supervisor with a process of its own: give the actors below it theirs"
            raise SpecError(where, f"a subtree in a process {why}")


def everything(specs: Iterable[ChildSpec]) -> Iterator[ChildSpec]:
    """The specs, and those below them as far as they are known before anything runs."""
    for spec in specs:
        yield spec
        if spec.is_supervisor:
            yield from everything(spec.below())


Bequest: TypeAlias = "dict[str, int | list[str]]"
"""What a kind of supervisor knows beside its children."""


class Heir(msgspec.Struct, frozen=True):
    """A child as the supervisor has it that leaves it."""

    id: str
    state: str
    spec: Any
    """In a box; from another process its bytes; None: it cannot be told."""
    attempts: int
    """Restarts in a row without a healthy life."""
    up_for: float
    """Seconds that its life has been up."""
    changed: tuple[str, ...] | None = None
    """What of it is not as in the template; None: it may be anything."""


class Account(msgspec.Struct, frozen=True):
    """What a supervisor leaves to the one that takes its place."""

    flags: Flags
    children: tuple[Heir, ...]
    """In start order."""
    restarts: tuple[float, ...]
    """How many seconds ago each restart was that may still count, the oldest first."""
    parked: tuple[str, ...]
    """Who was stopped by order, and would come back with its next life."""
    dismissed: tuple[str, ...]
    """Who was stopped by order, and is forgotten."""
    planned: tuple[str, ...]
    """Whom its own plan names."""
    template: Any
    """That of a dynamic supervisor, as the specs of the children; None: there is none."""
    own: dict[str, int | list[str]]
    """What its kind knows beside that: `Supervisor._bequest`."""
    state: bytes | None
    """That of a class of the user's own, as far as it can be saved; None: there is none."""
    is_suspended: bool


class TakeOver(RuntimeOrder[None]):
    """Go on in the place of another supervisor, whose children are yours by now."""

    account: Account


def why_occupied(supervisor: Supervisor) -> str:
    """What keeps a supervisor from giving its children away between two turns; "" if nothing does."""
    if any(not errand.is_over for errand in supervisor._errands):
        return "it is starting or stopping children"
    busy = next((one for one in supervisor._listed().values() if one.state not in (UP, STOPPED)), None)
    return "" if busy is None else f"its child {busy.spec.id!r} is {busy.state}"


def account_of(supervisor: Supervisor) -> Account:
    """What a supervisor leaves to the one that takes its place."""
    cell = supervisor.ctx._cell
    now = cell.node.loop.time()
    return Account(
        supervisor._flags,
        tuple(
            Heir(
                one.spec.id,
                one.state,
                Boxed(one.spec),
                one.attempts,
                now - one.up_since,
                supervisor._changed_of(one),
            )
            for one in supervisor._listed().values()
        ),
        tuple(now - at for at in supervisor._restarts),
        tuple(supervisor._parked),
        tuple(supervisor._dismissed),
        tuple(supervisor._planned),
        None if supervisor._template is None else Boxed(supervisor._template),
        supervisor._bequest(),
        _saved(supervisor),
        bool(cell.more is not None and cell.more.suspended & mailbox.BY_USER),
    )


def has_stood_down(cell: Cell) -> bool:
    """Whether a supervisor in a process does nothing any more, because another one is to take its place."""
    hold = mailbox.held(cell)
    return hold is not None and bool(hold.attempt)


def told(account: Account) -> Any:
    """An account as plain data."""
    return msgspec.to_builtins(account, builtin_types=(bytes,), enc_hook=_packed)


def _packed(spec: Boxed) -> bytes | None:
    try:
        return spec.packed()
    except HoldfastError:
        return None  # Whoever wants it moved is told so where it is to be known.


def heard(data: Any) -> Account:
    """An account that was told.

    Raises:
        msgspec.ValidationError: it is none.
    """
    account = msgspec.convert(data, Account, builtin_types=(bytes,))
    heirs = tuple(msgspec.structs.replace(heir, spec=_opened(heir.spec)) for heir in account.children)
    return msgspec.structs.replace(account, children=heirs, template=_opened(account.template))


def _opened(data: Any) -> Boxed | None:
    """A spec from another process, in a box; None if it cannot be made here, or gives more than that process has.

    What it is bound to it may give orders to, if the root says so: no word from there makes the root do that.
    """
    try:
        spec = unpack_told(data, ChildSpec) if isinstance(data, bytes) else None
    except HoldfastError:
        return None
    return None if spec is None or any(one.bindings for one in everything((spec,))) else Boxed(spec)


def _saved(supervisor: Supervisor) -> bytes | None:
    """The state of a class of the user's own, as bytes; None if there is none, or it cannot be saved."""
    try:
        state = live_state(supervisor)
        return encode_value(state, where=supervisor.ctx.path) if state else None
    except UnsavableValue:
        return None  # It begins afresh there.
    except Exception as error:  # The user's own `get_state`.
        _tell_failed(supervisor, "get_state", error)
        return None


def _restore(supervisor: Supervisor, state: bytes) -> None:
    node = supervisor.ctx._cell.node
    try:
        put_state(supervisor, decode_value(state, imports=node.ports.uplink is not None, refs=node.ref_at))
    except Exception as error:  # The user's own `set_state`, or a class that is not there: it begins afresh.
        _tell_failed(supervisor, "set_state", error)


def _tell_failed(supervisor: Supervisor, hook: str, error: Exception) -> None:
    supervisor.ctx._cell.node.emit(HookFailed(supervisor.ctx.path, hook, crash(error)))


def take_over(supervisor: Supervisor, account: Account) -> None:
    """Have a supervisor go on with what another one has left, whose living children it has got."""
    cell, known = supervisor.ctx._cell, supervisor._children
    now = cell.node.loop.time()
    supervisor._flags = account.flags
    supervisor._restarts = tuple(sorted((*supervisor._restarts, *(now - ago for ago in account.restarts))))
    supervisor._parked, supervisor._planned = set(account.parked), frozenset(account.planned)
    supervisor._dismissed = dict.fromkeys(account.dismissed)
    supervisor._template = opened(account.template, cell.node)
    specs = {heir.id: opened(heir.spec, cell.node) for heir in account.children}
    changed = {heir.id: heir.changed for heir in account.children}
    children = dict[str, Child]()
    for heir in account.children:
        one, spec = known.get(heir.id), specs[heir.id]
        if one is None and heir.state == STOPPED and spec is not None:
            one = Child(spec)
        if one is not None:
            children[heir.id] = one
            one.attempts, one.up_since = heir.attempts, now - heir.up_for
    supervisor._children, supervisor._is_in_place = {**children, **known}, True
    supervisor._inherit(account.own)
    for name, one in children.items():
        supervisor._keep_noted(one, specs[name] or one.spec, changed.get(name))
    if account.state is not None:
        _restore(supervisor, account.state)
    if account.is_suspended:
        _suspend(supervisor)


def _suspend(supervisor: Supervisor) -> None:
    """Handle no message any more; that those have come who are there is noted all the same."""
    cell = supervisor.ctx._cell
    for errand in supervisor._errands:
        errand.is_urgent = True
    queue = mailbox.queue_of(cell)
    for index, item in enumerate(queue):
        if isinstance(item, Errand):
            queue[index] = mailbox.NOTHING  # Not removed: the run loop has counted it.
            cell.urge(item)
    mailbox.suspend(cell)
