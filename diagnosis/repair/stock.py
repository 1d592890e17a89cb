"""The actions that come with holdfast, each made for the actors, channels or commands of a system.

What an action can be done to follows from what it is given: `start_node({"jn": "/robot/jn"})` can start `jn` only.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import signal
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Any, Final, Protocol

from ...actors.errors import HoldfastError
from ...actors.kernel.actor import Actor
from ...actors.kernel.ref import ActorRef
from ...supervision.admin import ChildBusy, ChildParked, RestartChild, TerminateChild
from ...supervision.arbiter import OPERATOR, InOtherHands
from ..board import SwitchChannel
from .actions import Act, ActionFailed, RepairAction, Run, Undo
from .ping import looked_at

PATIENCE: Final = 10.0
"""Seconds for a supervisor or a board to answer."""
CHANGED_WITHIN: Final = 30.0
"""Seconds in which a mechanism must have been changed."""
SILENT: Final = 0.5
"""Seconds without an answer of its process after which an actor is not asked to end, but killed."""
OUTPUT: Final = 500
"""Characters of a failed command's output that are told."""


# -- actors ---------------------------------------------------------------------------------------------------------


def start_node(addresses: Mapping[str, str], *, timeout: float = PATIENCE, **options: Any) -> RepairAction:
    """`start_node(n)`: have its supervisor start the stopped actor (again).

    Args:
        addresses: of each component that can be started so: a child of a supervisor.
        timeout: seconds.
        options: those of `RepairAction`.
    """
    run = functools.partial(_start, addresses=addresses, timeout=timeout)
    return _action("start_node", run, addresses, {"grace": 1.0, "timeout": timeout} | options)


def stop_node(addresses: Mapping[str, str], *, timeout: float = PATIENCE, **options: Any) -> RepairAction:
    """`stop_node(n)`: have its supervisor stop the actor; its spec and what was recorded of it stay."""
    run = functools.partial(_stop, addresses=addresses, timeout=timeout)
    return _action("stop_node", run, addresses, {"timeout": timeout} | options)


def restart_child(
    addresses: Mapping[str, str],
    *,
    name: str = "restart_child",
    cost: int = 1,
    timeout: float = PATIENCE,
    **options: Any,
) -> RepairAction:
    """`restart_child(n)`: have its supervisor stop it and start it, in one call that nothing can cut in two."""
    return _restarting(name, addresses, cost, timeout, options)


def restart_replica(
    addresses: Mapping[str, str],
    *,
    name: str = "restart_replica",
    cost: int = 1,
    timeout: float = PATIENCE,
    **options: Any,
) -> RepairAction:
    """`restart_replica(n)`: have those replicas of a protected actor begun anew that neither lead nor follow.

    The one that leads works on meanwhile, and those that could take its place stay.

    Args:
        addresses: of each component that stands for replicas the address of the protected actor.
        name: of the action.
        cost: of the action.
        timeout: seconds for each replica.
        options: those of `RepairAction`.
    """
    run = functools.partial(_restart_replicas, addresses=addresses, timeout=timeout)

    def mechanism(component: str) -> str | None:
        return f"{addresses[component]}/ftm" if component in addresses else None

    more = {"grace": 5.0, "timeout": 3 * timeout, "reach": mechanism} | options
    return _action(name, run, addresses, more, pddl=_mend_text(name, cost, "node"))


def restart_subtree(
    addresses: Mapping[str, str],
    *,
    name: str = "restart_subtree",
    cost: int = 5,
    timeout: float = PATIENCE,
    **options: Any,
) -> RepairAction:
    """`restart_subtree(n)`: stop and start the supervisor above a component, with all below it.

    A person has to approve it, unless `Policy(allow={"restart_subtree"})` does.

    Args:
        addresses: of each component the supervisor that is restarted: itself a child of a supervisor. What lives below
            it is touched too, and is in our hands meanwhile.
        name: of the action.
        cost: dearer than what touches one component only, so that it comes when nothing else is left.
        timeout: seconds for each half.
        options: those of `RepairAction`.
    """
    more = {"is_dangerous": True} | options
    return restart_child(addresses, name=name, cost=cost, timeout=timeout, **more)


def roll_back(
    addresses: Mapping[str, str],
    *,
    name: str = "roll_back",
    cost: int = 10,
    timeout: float = PATIENCE,
    **options: Any,
) -> RepairAction:
    """`roll_back(n)`: have a recorded actor stopped and started with its snapshot before the newest, in one such call.

    If there is no older snapshot the action has failed, and the actor goes on as it was. A person has to approve it,
    unless the policy allows it.
    """
    return _restarting(name, addresses, cost, timeout, {"is_dangerous": True} | options, older=True)


def bind_port(
    bindings: Mapping[str, tuple[str, str, str]], *, name: str = "rebind", cost: int = 2, **options: Any
) -> RepairAction:
    """`rebind(n)`: point a binding of an actor elsewhere, such as from a failed provider to its stand-in.

    If that does not help, the binding is put back.

    Args:
        bindings: of each component (its address, the port, the address the port shall lead to).
        name: of the action.
        cost: of the action.
        options: those of `RepairAction`.
    """
    owners = {component: owner for component, (owner, _, _) in bindings.items()}
    run = functools.partial(_bind, bindings=bindings)
    return _action(name, run, owners, options, pddl=_mend_text(name, cost))


def _restarting(
    name: str,
    addresses: Mapping[str, str],
    cost: int,
    timeout: float,
    options: Mapping[str, Any],
    *,
    older: bool = False,
) -> RepairAction:
    """An action that restarts actors; `older`: with the snapshot before the newest."""
    run = functools.partial(_restart, addresses=addresses, timeout=timeout, older=older)
    more = {"grace": 1.0, "timeout": 2 * timeout, "is_restart": True, **options}
    return _action(name, run, addresses, more, pddl=_restart_text(name, cost))


def _action(
    name: str, run: Run, addresses: Mapping[str, str], options: Mapping[str, Any], *, pddl: str = ""
) -> RepairAction:
    known: dict[str, Any] = {"takes": addresses.__contains__, "reach": addresses.get}
    return RepairAction(name, run, pddl, **(known | dict(options)))


async def _start(act: Act, node: str, *, addresses: Mapping[str, str], timeout: float) -> None:
    keeper, child = _keeper(act, addresses[node])
    with contextlib.suppress(ChildBusy):  # It runs, or is being started: whether it does, its observer says.
        await _ordered(act, keeper, addresses[node], RestartChild(child, unless_parked=True), timeout)


async def _ordered(act: Act, keeper: ActorRef[Any], address: str, request: RestartChild, timeout: float) -> None:
    try:
        started = await keeper.ask(request, timeout)
    except ChildParked as error:
        raise InOtherHands(address, OPERATOR, "it was stopped by order") from error
    if started is None:
        raise ActionFailed(str(act.step), f"{address} did not want to be started")


async def _stop(act: Act, node: str, *, addresses: Mapping[str, str], timeout: float) -> None:
    keeper, child = _keeper(act, addresses[node])
    await keeper.ask(TerminateChild(child, parks=False), timeout)


async def _restart(act: Act, node: str, *, addresses: Mapping[str, str], timeout: float, older: bool = False) -> None:
    address = addresses[node]
    keeper, child = _keeper(act, address)
    is_silent = await looked_at(act.ctx._cell.node, address, SILENT) is None
    act.check()
    # Who hears nothing would have all of its `shutdown`, for nothing.
    order = RestartChild(child, running=True, unless_parked=True, older=older, blames_turn=True, at_once=is_silent)
    try:
        await _ordered(act, keeper, address, order, 2 * timeout)
    except ChildBusy as error:
        raise InOtherHands(address, "its supervisor", f"it is {error.state}") from error


async def _restart_replicas(act: Act, node: str, *, addresses: Mapping[str, str], timeout: float) -> None:
    address = addresses[node]
    cell = act.ctx._cell.node.find(address)
    states = None if cell is None else cell.host.place.replica_states()
    ill = [name for name, state in (states or {}).items() if state not in ("leads", "follows")]
    if not ill:
        raise ActionFailed(str(act.step), f"{address} has no replica that neither leads nor follows")
    for name in ill:
        act.check()
        path = f"{address}/ftm/{name}"
        keeper, child = _keeper(act, path)
        with contextlib.suppress(ChildBusy):  # It is being started already.
            await _ordered(act, keeper, path, RestartChild(child, running=True, unless_parked=True), timeout)


async def _bind(act: Act, node: str, *, bindings: Mapping[str, tuple[str, str, str]]) -> Undo | None:
    address, port, target = bindings[node]
    here = act.ctx._cell.node
    owner = here.find_ref(address, Actor)._cell
    before = owner.more.bindings.get(port) if owner.more is not None else None
    here.bind(owner, port, here.find_ref(target, Actor)._cell)
    if before is None:
        return None

    async def undo() -> None:
        here.bind(here.find_ref(address, Actor)._cell, port, here.find_ref(before.path, Actor)._cell)

    return undo


def _keeper(act: Act, address: str) -> tuple[ActorRef[Any], str]:
    """The supervisor of an address, and the child's id."""
    above, _, child = address.rpartition("/")
    try:
        return act.ctx.find(above, Actor), child
    except HoldfastError as error:
        raise ActionFailed(str(act.step), f"the supervisor of {address} is not there: {error}") from error


def _restart_text(name: str, cost: int) -> str:
    return (
        f"(:action {name} :parameters (?n - node)"
        " :precondition (and (bad ?n) (forall (?h - hardware) (imply (drives ?n ?h) (and (on ?h) (good ?h)))))"
        f" :effect (and (running ?n) (good ?n) (not (bad ?n)) (increase (total-cost) {cost})))"
    )


def _mend_text(name: str, cost: int, kind: str = "component") -> str:
    return (
        f"(:action {name} :parameters (?c - {kind}) :precondition (bad ?c)"
        f" :effect (and (good ?c) (not (bad ?c)) (increase (total-cost) {cost})))"
    )


# -- the power board ------------------------------------------------------------------------------------------------


def power_up(board: str, channels: Mapping[str, int], *, timeout: float = PATIENCE, **options: Any) -> RepairAction:
    """`power_up(h)`: switch the device's channel on; a person has to approve it, unless the policy allows it.

    Args:
        board: the address of the `BoardActor`.
        channels: of each device.
        timeout: seconds.
        options: those of `RepairAction`.
    """
    run = functools.partial(_switch, board=board, channels=channels, on=True, timeout=timeout)
    return _channel("power_up", run, channels, {"grace": 1.0, "timeout": timeout} | options)


def shutdown(board: str, channels: Mapping[str, int], *, timeout: float = PATIENCE, **options: Any) -> RepairAction:
    """`shutdown(h)`: switch the device's channel off; a person has to approve it, unless the policy allows it."""
    run = functools.partial(_switch, board=board, channels=channels, on=False, timeout=timeout)
    return _channel("shutdown", run, channels, {"timeout": timeout} | options)


def _channel(name: str, run: Run, channels: Mapping[str, int], options: Mapping[str, Any]) -> RepairAction:
    known: dict[str, Any] = {"takes": channels.__contains__, "is_dangerous": True}
    return RepairAction(name, run, **(known | dict(options)))


async def _switch(act: Act, device: str, *, board: str, channels: Mapping[str, int], on: bool, timeout: float) -> None:
    await act.ctx.find(board, Actor).ask(SwitchChannel(channels[device], on), timeout)


# -- anything else --------------------------------------------------------------------------------------------------


def run_coroutine(pddl: str, run: Run, **options: Any) -> RepairAction:
    """Any coroutine as an action; `action` is the decorator for it."""
    from .actions import action

    return action(pddl, **options)(run)


def run_command(pddl: str, *command: str, timeout: float = 30.0, **options: Any) -> RepairAction:
    """A command of the operating system, such as the paper's USB reset (D11).

    Args:
        pddl: the `(:action ...)`; `{0}`, `{1}`, ... in the command are its parameters.
        command: the program and its arguments; no shell reads them.
        timeout: seconds; after them it is killed, with all that it has started.
        options: those of `RepairAction`.
    """
    if not command:
        raise ValueError("run_command needs a program")
    return run_coroutine(pddl, functools.partial(_command, command=command), timeout=timeout, **options)


async def _command(act: Act, *names: str, command: Sequence[str]) -> None:
    argv = [part.format(*names) for part in command]
    process = await asyncio.create_subprocess_exec(
        *argv,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        start_new_session=True,
    )
    try:
        said, _ = await process.communicate()
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            await process.communicate()
    if process.returncode:
        text = said.decode(errors="replace").strip()[-OUTPUT:]
        raise ActionFailed(str(act.step), f"{argv[0]} ended with {process.returncode}: {text}")


# -- fault-tolerance mechanisms -------------------------------------------------------------------------------------


class ChangePort(Protocol):
    """What repair needs of a transaction's `change`."""

    def protect(self, target: str, stack: Any) -> None:
        """Have an actor protected by just this stack of mechanisms."""
        ...


class TransactionPort(Protocol):
    """`system.transaction`: the system gives it, since repair knows nothing of mechanisms."""

    def __call__(self, *, timeout: float) -> AbstractAsyncContextManager[ChangePort]:
        """Collect what is to be done in the block; at its end it is done, or undone."""
        ...


def protect_by(
    transaction: TransactionPort, mechanism: Any, addresses: Mapping[str, str], **options: Any
) -> RepairAction:
    """`protect_pbr(n)`: protect an actor by just this stack of mechanisms, while requests flow.

    Args:
        transaction: `system.transaction`.
        mechanism: what `change.protect` takes: its name, its file, one with its settings, or several, outermost first.
        addresses: of each component that can be protected so.
        options: those of `RepairAction`; `name` of the action, `cost`, and `timeout`: seconds until it is undone.
    """
    whole: dict[str, Any] = {"timeout": CHANGED_WITHIN, "cost": 5, "name": f"protect_{_word(mechanism)}", **options}
    seconds, cost, name = whole.pop("timeout"), whole.pop("cost"), whole.pop("name")

    async def run(act: Act, node: str) -> None:
        async with transaction(timeout=seconds) as change:
            change.protect(addresses[node], mechanism)

    more = {"grace": 1.0, "timeout": seconds + PATIENCE} | whole
    return _action(name, run, addresses, more, pddl=_mend_text(name, cost, "node"))


def _word(mechanism: Any) -> str:
    """A mechanism in the name of an action."""
    if isinstance(mechanism, (tuple, list)):
        return "_".join(map(_word, mechanism))
    name = mechanism if isinstance(mechanism, str) else str(mechanism.name)
    return name if name.isidentifier() else "mechanism"


def change_mechanism(
    change: Callable[[str], Awaitable[None]],
    addresses: Mapping[str, str],
    *,
    name: str = "change_mechanism",
    cost: int = 5,
    **options: Any,
) -> RepairAction:
    """`change_mechanism(n)`: have mechanisms changed in any other way, such as several at once.

    Args:
        change: `await change(address)` does it, in the context of this call: a transaction in another task would be
            refused, since the actor is in our hands.
        addresses: of each component that can be protected otherwise.
        name: of the action; give each change its own.
        cost: of the action.
        options: those of `RepairAction`.
    """

    async def run(act: Act, node: str) -> None:
        await change(addresses[node])

    return _action(name, run, addresses, options, pddl=_mend_text(name, cost, "node"))
