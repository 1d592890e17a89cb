"""Replaces a supervisor by a new one, where it cannot just be given another address.

The new one is started beside it, at the new address and without children. All its children are moved there, each as if
it were moved alone; at the commit, when it has none any more, all that others have tied to the old one is tied to the
new one: refs, links, monitors, names, bindings, what waits for it, and it is told what the old one leaves to it
(`supervision/supervisor_changes.py`). The old one ends, and nobody but itself hears of that. A part of a supervisor
that is nothing without it beside it, such as the router of a pool, gives way to another one in the same way.
"""

from __future__ import annotations

import contextlib
import dataclasses
from typing import TYPE_CHECKING

import msgspec

from ...actors.control.orders import Conclude, StandDown, WindDown
from ...actors.control.orders_lane import order
from ...actors.errors import ActorStopped, AskFailed
from ...actors.exit_reasons import Shutdown
from ...actors.kernel import lifecycle, links, mailbox
from ...actors.kernel.cell import GONE, RUNNING, Cell
from ...actors.migration.luggage import let_come
from ...actors.migration.quiesce import ATTEMPTS, farewell, handed_on, replaced, without_room
from ...actors.process.process_host import WorkerPlace
from ...actors.process.wire.peer import OutsideHost
from ...actors.process.worker_pool import Worker
from ...supervision.admin import Boxed
from ...supervision.children import STOPPED, complete
from ...supervision.supervisor import Supervisor
from ...supervision.supervisor_changes import Account, Heir, TakeOver, account_of, take_over
from .arrangement import child_of, lose_child, planned_spec
from .draft import DraftPlace, heard_account, is_elsewhere
from .lasting import recipe_parts
from .operation import wrong
from .rework import CONCLUDED_WITHIN, PREPARED_WITHIN
from .structure import Newcomer, fill

if TYPE_CHECKING:
    from ..system import ActorSystem
    from .draft import Draft

ENDS_WITHIN = 5.0
"""Seconds that the process of a supervisor may take to end when it has none any more."""


def check_succession(place: DraftPlace) -> None:
    """Whether another one can take the place of this supervisor, or of this part of one.

    Raises:
        SpecError: why not.
    """
    if place.spec is None or place.cell is None or place.is_planned:
        raise wrong(place.path, "it has begun, or moved, by this very transaction: use the next one")
    if place.is_stopped:
        raise wrong(place.path, "it does not run: start it first")
    changed = (one for one in place.children.values() if one.is_planned or one.is_leaving or one.is_switched)
    if (one := next(changed, None)) is not None:
        raise wrong(one.path, "it is changed by this very transaction: move its supervisor in the next one")


class NewSupervisor:
    """A supervisor that begins before the commit, with no children but supervisors like itself; it may be given up."""

    async def prepare(self, system: ActorSystem) -> None:
        """Have it started, unless it is."""
        raise NotImplementedError

    def ready(self, system: ActorSystem) -> str:
        """Why it is not up at this instant; "" if it is."""
        raise NotImplementedError

    async def release(self, system: ActorSystem) -> None:
        """Nothing is left of it."""
        raise NotImplementedError


class Elsewhere(NewSupervisor):
    """A candidate at another address, which its supervisor starts as one more child."""

    def __init__(self, place: DraftPlace) -> None:
        self._place, self._newcomer = place, Newcomer(place)
        self._forwarded: dict[str, str] | None = None  # who had lived at its address, or below it, and where that is

    async def prepare(self, system: ActorSystem) -> None:
        if self._forwarded is None:
            self._forwarded = system._homes.addresses.left(self._place.path)
        await self._newcomer.prepare(system)

    def ready(self, system: ActorSystem) -> str:
        return self._newcomer.ready(system)

    async def release(self, system: ActorSystem) -> None:
        await self._newcomer.release(erase=False)
        system._homes.addresses.put_back(self._forwarded or {})


class Beside(NewSupervisor):
    """A candidate at the address of the one whose place it takes, where nobody finds it: it is to live elsewhere."""

    def __init__(self, place: DraftPlace) -> None:
        self._place = place
        self._cell: Cell | None = None

    async def prepare(self, system: ActorSystem) -> None:
        if self._settle():
            return
        await self.release(system)
        assert self._place.parent is not None
        above, node = self._place.parent.living(system._node), system._node
        spec = complete(above, planned_spec(self._place, in_force=False))
        cell = self._cell = Cell(node, above, spec.id, node.ports.host_for(spec))
        cell.spec, cell.extra().start = spec, spec.start
        for port, path in spec.bindings.items():
            node.bind(cell, port, node.cell_at(path))
        up = cell.host.start(cell)
        if up is not None:
            await up
        self._settle()

    def _settle(self) -> bool:
        """Have it, and those below it, be found by the draft; returns whether it is up."""
        cell = self._cell
        if cell is None or cell.state is not RUNNING or not cell.host.is_up(cell):
            return False
        fill(self._place, cell)
        return cell.parent is not None and cell.parent.state is not GONE

    def ready(self, system: ActorSystem) -> str:
        return "" if self._settle() else f"{self._place.path} is being started"

    async def release(self, system: ActorSystem) -> None:
        cell, self._cell = self._cell, None
        if cell is not None and cell.state is not GONE:
            await lifecycle.stop_in_time(cell)
            lifecycle.retire(cell, "it does not take the place of another one")


class Succession:
    """One supervisor, and the one that takes its place."""

    def __init__(self, place: DraftPlace, draft: Draft) -> None:
        assert place.spec is not None
        self.place = place
        """That of the supervisor, in which the new one will be."""
        self.left = DraftPlace(place.name, place.was.below, place.cell, place.spec)
        """What is left of the old one."""
        self._attempt = next(ATTEMPTS)
        self._is_asked = False  # to stand down, in another process
        self._held: tuple[Cell, int] | None = None  # which life has done so
        self._winding: tuple[Cell, int] | None = None  # which life was told that another one is to take its place
        self._account: Account | None = None
        for one in draft.places():
            if one.was.below is place:
                one.was.below = self.left
        if place.parent is place.was.below and place.parent is not None:  # Its place is free at once.
            place.parent.was.children -= {place.name}
        self.left.was.children, self.left.kind = place.was.children, place.kind
        place.was.start = self.left.was.start = place.spec.start
        place.cell, place.is_planned = None, True

    def check(self) -> None:
        """Whether another one can take its place with all else that the transaction wants of it. Raises SpecError."""
        if self.place.rework is not None:
            raise wrong(
                self.place.path,
                "another one takes its place by this very transaction: suspend or resume it in the next one",
            )

    # -- before the commit --------------------------------------------------------------------------------------------

    async def wind_down(self, system: ActorSystem) -> None:
        """Have nothing be in the way of its end, as far as that is its own."""
        cell = self.left.living(system._node)
        if self._winding == (cell, cell.life):
            return
        self._winding = cell, cell.life
        with contextlib.suppress(AskFailed, ActorStopped):  # It has ended: its next life is told.
            await order(cell, WindDown(self._attempt), PREPARED_WITHIN)

    async def give_up(self, system: ActorSystem) -> None:
        """Nobody takes its place."""
        cell, winding, self._winding = self.left.now(system._node), self._winding, None
        if cell is not None and winding is not None:
            with contextlib.suppress(AskFailed, ActorStopped):
                await order(cell, WindDown(0), CONCLUDED_WITHIN)

    async def hold(self, system: ActorSystem) -> None:
        """Have it give orders no more, if it lives in another process."""
        cell = self.left.living(system._node)
        if not is_elsewhere(cell) or self._held == (cell, cell.life):
            return
        life, self._is_asked = cell.life, True
        with contextlib.suppress(AskFailed, ActorStopped):  # It has ended: its next life is asked.
            told = await order(cell, StandDown(self._attempt), PREPARED_WITHIN)
            if told is not None:
                self._held = cell, life
                self._account = heard_account(cell.path, told) if self.place.is_supervisor else None

    async def let_go(self, system: ActorSystem) -> None:
        """It goes on."""
        is_asked, self._is_asked, self._held = self._is_asked, False, None
        cell = self.left.now(system._node)
        if is_asked and cell is not None:  # Also if its answer was not waited for.
            with contextlib.suppress(AskFailed, ActorStopped):  # It is another life by now.
                await order(cell, Conclude(self._attempt, False, None), CONCLUDED_WITHIN)

    def ready(self, system: ActorSystem) -> str:
        """What is in the way of its end at this instant; "" if nothing is.

        Raises:
            HoldfastError: it cannot be done any more.
        """
        cell = self.left.living(system._node)
        if is_elsewhere(cell):
            if self._held != (cell, cell.life) or not cell.host.is_up(cell) or cell.host.place.is_ending:
                return f"{cell.path} has not stood down yet"
        else:
            actor = cell.actor
            if actor is None or not cell.host.is_up(cell) or cell.extra().turn is not None:
                return f"{cell.path} is in the middle of something"
            if occupied := actor._why_occupied():
                return f"{cell.path}: {occupied}"
            self._account = account_of(actor) if isinstance(actor, Supervisor) else None
        for heir in self._account.children if self._account is not None else ():
            known = self.place.children.get(heir.id)
            if heir.id not in self.left.was.children or (known is not None and known.is_idle and heir.state != STOPPED):
                raise wrong(cell.path, f"it has another child by now, {heir.id!r}: try again")
        return ""

    # -- the commit ---------------------------------------------------------------------------------------------------

    def leave_tree(self, system: ActorSystem) -> tuple[str, str]:
        """The old one is below nobody any more; returns its address, and that of the new one."""
        old, new = self.left.living(system._node), self.place.living(system._node)
        self._ends, self._was, above = old, old.path, old.parent
        assert above is not None
        one = child_of(above, old.name)
        if new.parent is above and new.name == old.name:
            above.children = {**(above.children or {}), old.name: new}
            if one is not None:
                one.cell, one.ignored_life = new, 0  # Its lives are counted anew.
        else:
            (above.children or {}).pop(old.name, None)
            if one is not None and isinstance(above.actor, Supervisor):
                lose_child(above.actor, old.name, self.left.was.below)
        old.parent, old.name = new, ""  # Its address is that of the new one, wherever that goes.
        return self._was, new.path

    def commit(self, system: ActorSystem) -> None:
        """From here on the new one is the one; its children are below it already."""
        old, new = self._ends, self.place.living(system._node)
        _hand_over(old, new)
        waiting = _end(old, new, self._was)
        if self._account is not None:
            account = self._bequest(self._account)
            if isinstance(new.actor, Supervisor):
                take_over(new.actor, account)
            else:
                new.admit(new, TakeOver(account))
        let_come(new, waiting)

    def _bequest(self, account: Account) -> Account:
        """What is left, as the transaction makes it: the children that stay, in their order."""
        heirs = {heir.id: heir for heir in account.children}
        assert self.place.was.start is not None
        recipe = {spec.id: spec for spec in recipe_parts(self.place.was.start)[1] or ()}
        children = list[Heir]()
        for name, child in self.place.children.items():
            if name in heirs:
                known = recipe.get(name) or child.spec
                spec = heirs[name].spec if known is None else Boxed(known)
                children.append(msgspec.structs.replace(heirs[name], spec=spec))
        flags = dataclasses.replace(account.flags, **self.place.wanted)
        return msgspec.structs.replace(account, flags=flags, children=tuple(children))


def _hand_over(old: Cell, new: Cell) -> None:
    """What others have tied to the old one."""
    node, its = old.node, old.extra()
    for name in links.hand_over(old, new):
        new.host.told(new, "replaces", {"was": name})
    for name, scope in list(its.belongings.names.items()):
        node.unregister(name)
        node.register(name, new, scope=scope)
    for topic in list(its.belongings.topics):
        node.topics.unsubscribe(topic, old)
        node.topics.subscribe(topic, new)
    for port, target in its.bindings.items():
        if new.extra().bindings.get(port) is not target:
            node.bind(new, port, target)
    if its.enders:
        new.extra().enders = [*(new.extra().enders or ()), *its.enders]
        its.enders = None
    if its.tap is not None:
        its.tap.close()


def _end(old: Cell, new: Cell, was: str) -> list[object]:
    """End the old one, wherever it lives, without telling anybody; returns what has waited for it."""
    host, reason = old.host, Shutdown(f"moved to {new.path}")
    if old.actor is not None:
        life, items, commands = replaced(old)
        for command in commands:
            command.undelivered(old, str(reason))
        farewell(life, lifecycle.Stop(reason))
    elif isinstance(host.place, WorkerPlace):
        worker, outlet = host.place.process(old), old.extra().outlet
        _, queued = outlet.close()
        late = without_room(old) if old.extra().bound is not None else []
        items = handed_on([*queued, *(old.queue or ()), *late])
        if worker is not None:
            again = set(map(id, queued))
            worker.pending = {key: ask for key, ask in worker.pending.items() if id(ask) not in again}
            if was != new.path:
                worker.readdress(was, new.path)  # It hears of its end by the address that its actor has here.
            worker.replaced(old)
            worker.leave(old, reason, ENDS_WITHIN, answers=True)
    else:
        assert isinstance(host, OutsideHost)
        assert isinstance(host.peer, Worker)
        host.peer.disown(new, was)
        items = []
    old.queue = old.children = None
    old.state, old.admit = GONE, mailbox.admit_gone  # Whoever has a ref to it reaches the new one.
    return items
