"""What reaches a protected actor besides messages: orders go to whoever leads, bindings to every replica."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...actors.control.orders import Ready, ReplaceCode, ReplaceState, Resume, Suspend
from ...actors.control.orders_lane import Call, send_call
from ...actors.errors import ControlFailed
from ...actors.kernel import mailbox
from ...actors.kernel.cell import Cell
from ...actors.process.process_host import ProcessHost
from ...actors.process.wire import frames
from ...checkpoint.home.homes import HomeHost

if TYPE_CHECKING:
    from .group import Group

AGAIN_AFTER = 0.01
"""Seconds after which an order is given again that nobody could take."""


class Steered(HomeHost):
    """The part of the host of a protected actor that steers its replicas."""

    group: Group | None

    def control(self, cell: Cell, call: Call) -> None:
        """Orders go to the actor of the replica that leads; what would change one replica alone is refused."""
        group, ask = self.group, call.ask
        if isinstance(call.order, (ReplaceState, ReplaceCode)):
            why = "it is protected, and all replicas have to be alike: detach its mechanism, and attach it again after"
            ask.fail(ControlFailed(cell.path, call.order.verb, why))
            return
        if group is None or group.is_over or group.primary is None or not self.is_up(cell):
            cell.node.loop.call_later(AGAIN_AFTER, give_again, cell, call)
            return
        if isinstance(call.order, Ready):
            call.give(None)
            return
        if isinstance(call.order, (Suspend, Resume)):
            self._hold(cell, group, is_suspended=isinstance(call.order, Suspend))
            call.give(None)
            return
        leads = group.cell_of(group.primary)
        worker = leads.host.worker_of(leads) if leads is not None and isinstance(leads.host, ProcessHost) else None
        if worker is None:
            ask.fail(ControlFailed(cell.path, call.order.verb, "the replica that leads has just ended; try again"))
            return
        send_call(worker, group.place(f"{group.primary}/server"), call)

    def _hold(self, cell: Cell, group: Group, *, is_suspended: bool) -> None:
        group.is_suspended = is_suspended
        cell.extra().suspended = mailbox.BY_USER if is_suspended else 0
        group.poke()

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        """Links and monitors are the home's; a binding is that of the actor in each replica."""
        group = self.group
        if verb == "bind" and group is not None:
            for name in group.names:
                self._bind(group, name, data)

    def _bind(self, group: Group, name: str, data: dict[str, Any]) -> None:
        cell = group.cell_of(name)
        worker = cell.host.worker_of(cell) if cell is not None and isinstance(cell.host, ProcessHost) else None
        if worker is not None and group.life_of(name):
            to = worker.connection.name_out(group.place(f"{name}/server"))
            worker.connection.send(frames.Command(to, "bind", data))

    def _bind_all(self, cell: Cell, group: Group, name: str) -> None:
        """A replica that was started again: what was bound since the first start."""
        more = cell.extra()
        for port, target in more.bindings.items():
            data = {"port": port, "target": target.path, "is_claimed": port in more.claimed}
            self._bind(group, name, data)


def give_again(cell: Cell, call: Call) -> None:
    """An order had to wait until somebody leads: give it to whoever lives there now, if it is still waited for."""
    if call.ask.is_done:
        return
    if cell.is_dead:
        call.ask.undelivered(cell, "it has ended")
    else:
        cell.host.control(cell, call)
