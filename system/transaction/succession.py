"""Replaces a supervisor by a new one, where it cannot just be given another address.

The new one is started beside it, at the new address and without children. All its children are moved there, each as if
it were moved alone; at the commit, when it has none any more, all that others have tied to the old one is tied to the
new one: refs, links, monitors, names, bindings, what waits for it. Of itself the new one has what its start gives it,
and the restarts of the old one that still count. The old one ends, and nobody but itself hears of that.
"""

from __future__ import annotations

import contextlib
import dataclasses
from typing import TYPE_CHECKING

import msgspec

from ...actors.control.orders import Conclude, StandDown
from ...actors.control.orders_lane import order
from ...actors.errors import ActorStopped, AskFailed
from ...actors.exit_reasons import Shutdown
from ...actors.kernel import lifecycle, links, mailbox
from ...actors.kernel.actor import Start
from ...actors.kernel.cell import GONE, RUNNING, Cell
from ...actors.migration.quiesce import ATTEMPTS, farewell, handed_on, part, sorted_out
from ...actors.process.process_host import WorkerPlace
from ...actors.process.wire.peer import OutsideHost
from ...actors.process.worker_pool import Worker
from ...supervision.children import complete
from ...supervision.spec import Flags
from ...supervision.supervisor import Supervisor
from ...supervision.supervisor_changes import Account, TakeOver, account_of, take_over, why_occupied
from .arrangement import busy, child_of, planned_spec
from .draft import DraftPlace, check_awake, is_elsewhere
from .operation import wrong
from .rework import CONCLUDED_WITHIN, PREPARED_WITHIN
from .structure import Newcomer, fill

if TYPE_CHECKING:
    from ..system import ActorSystem
    from .draft import Draft

ENDS_WITHIN = 5.0
"""Seconds that the process of a supervisor may take to end when it has none any more."""


def check_succession(place: DraftPlace, above: DraftPlace) -> None:
    """Whether another supervisor, which will be below `above`, can take the place of this one.

    Raises:
        SpecError: why not.
    """
    if above.flags is not None and above.flags.journal:
        raise wrong(above.path, "its journal would say that this one begins without children")
    spec, kind = place.spec, place.kind
    if spec is None or kind is None or place.cell is None or place.is_planned:
        raise wrong(place.path, "it has begun, or moved, by this very transaction: use the next one")
    if place.is_stopped:
        raise wrong(place.path, "it does not run: start it first")
    check_awake(place)
    assert issubclass(kind, Supervisor)
    if kind._irreplaceable:
        raise wrong(place.path, kind._irreplaceable)
    args = spec.start.args
    if kind.init is not Supervisor.init:
        raise wrong(place.path, "its class has an init of its own, which alone says with which children it begins")
    if len(args) != 2 or not isinstance(args[0], Flags) or place.flags is None:
        raise wrong(place.path, "its recipe does not say its flags and children")
    if place.flags.journal:
        raise wrong(place.path, "its journal is kept under its address")
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
        assert place.flags is not None
        self.place = place
        """That of the supervisor, in which the new one will be."""
        self.left = DraftPlace(place.name, place.was.below, place.cell, place.spec)
        """What is left of the old one."""
        self._attempt = next(ATTEMPTS)
        self._is_asked = False  # to stand down, in another process
        self._held: tuple[Cell, int] | None = None  # which life has done so
        self._account: Account | None = None
        for one in draft.places():
            if one.was.below is place:
                one.was.below = self.left
        if place.parent is place.was.below and place.parent is not None:  # Its place is free at once.
            place.parent.was.children -= {place.name}
        self.left.was.children = place.was.children
        template = place.spec.start.args[1] if place.is_dynamic else ()
        start = Start(place.spec.start.kind, (place.flags, template), place.spec.start.kwargs)
        place.spec = dataclasses.replace(place.spec, start=start)
        place.cell, place.is_planned = None, True

    # -- before the commit --------------------------------------------------------------------------------------------

    async def hold(self, system: ActorSystem) -> None:
        """Have it give orders no more, if it lives in another process."""
        cell = self.left.living(system._node)
        if not is_elsewhere(cell) or self._held == (cell, cell.life):
            return
        life, self._is_asked = cell.life, True
        with contextlib.suppress(AskFailed, ActorStopped):  # It has ended: its next life is asked.
            told = await order(cell, StandDown(self._attempt), PREPARED_WITHIN)
            if told is not None:
                self._held, self._account = (cell, life), msgspec.convert(told, Account)

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
        if not is_elsewhere(cell):
            why = busy(cell)
            supervisor = cell.actor
            if why or not isinstance(supervisor, Supervisor):
                return why
            if occupied := why_occupied(supervisor):
                return f"{cell.path}: {occupied}"
            self._account = account_of(supervisor)
        elif self._held != (cell, cell.life) or not cell.host.is_up(cell) or cell.host.place.is_ending:
            return f"{cell.path} has not stood down yet"
        assert self._account is not None
        known = self.left.was.children
        if come := [name for name in self._account.children if name not in known]:
            raise wrong(cell.path, f"it has another child by now, {come[0]!r}: try again")
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
                del above.actor._children[old.name]
        old.parent, old.name = new, ""  # Its address is that of the new one, wherever that goes.
        return self._was, new.path

    def commit(self, system: ActorSystem) -> None:
        """From here on the new one is the one; its children are below it already."""
        old, new, account = self._ends, self.place.living(system._node), self._account
        assert account is not None
        _hand_over(old, new)
        waiting = _end(old, new, self._was)
        account = Account(tuple(self.place.children), account.restarts)
        if isinstance(new.actor, Supervisor):
            take_over(new.actor, account)
        else:
            new.admit(new, TakeOver(account))
        for item in waiting:
            new.admit(new, item)


def _hand_over(old: Cell, new: Cell) -> None:
    """What others have tied to the old one."""
    node, its = old.node, old.extra()
    for name in links.hand_over(old, new):
        new.host.told(new, "replaces", {"was": name})
    for name in list(its.belongings.names):
        node.unregister(name)
        node.register(name, new)
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
        life = part(old)
        items, commands = sorted_out(old)
        for command in commands:
            command.undelivered(old, str(reason))
        farewell(life, lifecycle.Stop(reason))
    elif isinstance(host.place, WorkerPlace):
        worker, outlet = host.place.process(old), old.extra().outlet
        _, queued = outlet.close()
        items = [*queued, *(old.queue or ())]
        if worker is not None:
            again = set(map(id, queued))
            worker.pending = {key: ask for key, ask in worker.pending.items() if id(ask) not in again}
            if was != new.path:
                worker.readdress(was, new.path)  # It hears of its end by the address that its actor has here.
            worker.leave(old, reason, ENDS_WITHIN, answers=True)
    else:
        assert isinstance(host, OutsideHost)
        assert isinstance(host.peer, Worker)
        host.peer.disown(new, was)
        items = []
    old.queue = old.children = None
    old.state, old.admit = GONE, mailbox.admit_gone  # Whoever has a ref to it reaches the new one.
    return handed_on(items)
