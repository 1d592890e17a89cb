"""What a supervisor is made of: at its start, when it is changed while it works, and when another takes its place."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import msgspec

from ..actors.errors import HoldfastError, Ignore, SpecError, StartIgnored, remote_crash, type_name
from ..actors.kernel.cell import GONE
from ..actors.kernel.message import RuntimeOrder
from ..actors.kernel.node import Node
from .admin import ChangeSupervisor, opened
from .children import STOPPED, UP, Child, complete
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


class Account(msgspec.Struct, frozen=True):
    """What a supervisor leaves to the one that takes its place."""

    children: tuple[str, ...]
    """The ids of its children, in start order."""
    restarts: tuple[float, ...]
    """How many seconds ago each restart was that may still count, the oldest first."""


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
    now = supervisor.ctx._cell.node.loop.time()
    return Account(tuple(supervisor._listed()), tuple(now - at for at in supervisor._restarts))


def take_over(supervisor: Supervisor, account: Account) -> None:
    """Have a supervisor go on with the children that it has got, in the order of the one that had them."""
    now, known = supervisor.ctx._cell.node.loop.time(), supervisor._children
    supervisor._restarts = tuple(sorted((*supervisor._restarts, *(now - ago for ago in account.restarts))))
    first = {name: known[name] for name in account.children if name in known}
    supervisor._children = {**first, **known}
