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
    in_vain: str = ""
    """Why the last start has failed, and each further one will, unless with other code; "" if that is not so."""

    def take_in(self, cell: Cell) -> None:
        """Record what is sent to an address ahead of its first life in this program, and hold it for that.

        Raises:
            HoldfastError: what is recorded of it cannot be read, or does not fit its class.
        """
        raise NotImplementedError


def said_of_turn(cell: Cell) -> str:
    """What the turn in hand of a recorded actor waits for, as words behind its address; "" if that is not known."""
    switch = switch_of(cell)
    said = "" if switch is None else switch.calls.said()
    return f"a turn of {cell.path} {said}" if said else ""


def why_in_vain(cell: Cell) -> str:
    """Why a recorded actor cannot be brought back by the code that it has, in words; "" if that is not known."""
    home = cell.host.home
    return home.in_vain if isinstance(home, RecordedHome) else ""


def give_other_code(cell: Cell) -> None:
    """The next start has other code: why the last one has failed says nothing of it."""
    home = cell.host.home
    if isinstance(home, RecordedHome):
        home.in_vain = ""


def switch_of(cell: Cell) -> Switch | None:
    """The switch of a recorded actor's cell."""
    home = cell.host.home
    return home.switch if isinstance(home, RecordedHome) else None
