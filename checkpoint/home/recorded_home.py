"""The base of recorded homes: an address is recorded if its home has a switch."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...actors.process.process_host import WorkerHome

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from .switch import Switch


class RecordedHome(WorkerHome):
    """A home with a switch, which numbers, journals and feeds what it accepts."""

    switch: Switch | None
    """There is none before the first life begins, or is waited for with a message."""

    def take_in(self, cell: Cell) -> None:
        """Record what is sent to an address ahead of its first life in this program, and hold it for that.

        Raises:
            HoldfastError: what is recorded of it cannot be read, or does not fit its class.
        """
        raise NotImplementedError

    @property
    def keeps_turns(self) -> bool:
        """Whether the next life knows all that the last one has handled."""
        raise NotImplementedError


def said_of_turn(cell: Cell) -> str:
    """What the turn in hand of a recorded actor waits for, as words behind its address; "" if that is not known."""
    switch = switch_of(cell)
    said = "" if switch is None else switch.calls.said()
    return f"a turn of {cell.path} {said}" if said else ""


def switch_of(cell: Cell) -> Switch | None:
    """The switch of a recorded actor's cell."""
    home = cell.host.home
    return home.switch if isinstance(home, RecordedHome) else None
