"""Sees to it that no recorded actor would repeat, behind a commit, what it has sent under addresses of before.

Who has sent anything since its last snapshot is asked for another one. Who has sent again when that is there comes to
rest with one more, and goes on when the transaction is over: it would have sent again by the next look as well.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

from ...actors.errors import HoldfastError
from ...actors.process.process_host import WorkerPlace
from ...checkpoint.home.recorded_home import said_of_turn
from ...checkpoint.places.life_here import LifeHere
from ...checkpoint.protocol import SnapshotNow
from ...supervision.respec import recipe_spec
from ...supervision.spec import ChildSpec
from .relocation import Gated

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ...actors.kernel.node import Node
    from ...checkpoint.home.switch import Switch


@dataclasses.dataclass(frozen=True, eq=False)
class AtHome:
    """Whoever lives where a home says, or has lived there last."""

    switch: Switch
    before: Cell

    def living(self, node: Node) -> Cell:
        """The cell that lives there now, or a dead one."""
        return (self.switch.cell or self.before).living


class Standstill(Gated):
    """The rest of one sender, which a transaction can do without if it cannot be had."""

    @property
    def is_waiting(self) -> bool:
        """Whether it stands still, or cannot: then its snapshots are waited for as those of others are."""
        return (self.task is not None and self.task.done()) or super().is_waiting


class OtherSenders:
    """Recorded actors that are not changed by a transaction, and what they have sent meanwhile."""

    def __init__(self) -> None:
        self._asked: dict[Switch, int] = {}  # who was asked for a snapshot, behind which turn
        self._first: dict[Switch, int] = {}  # the same of the first time
        self._rests: dict[Switch, tuple[AtHome, Standstill]] = {}  # of those that send again and again
        self._restless: set[Switch] = set()  # who has not come to rest in time, when that was tried last

    def settle(self, others: Iterable[Switch]) -> None:
        """Have them take a snapshot, so that no replay sends to an address of before; each turn once."""
        for switch in others:
            life = switch.life
            if is_unsettled(switch) and self._asked.get(switch) != switch.turn and life.port and life.is_released:
                self._asked[switch] = switch.turn
                self._first.setdefault(switch, switch.turn)
                life.port.to_life(SnapshotNow(urgent=True))  # also if it is suspended

    def find_standing(self, others: Iterable[Switch], held: Collection[Switch]) -> Collection[Switch]:
        """Those that stand still for the commit; `held` are not ours to hold, for another step does."""
        for switch in others:
            cell = switch.cell
            if cell is None or switch in self._rests or switch in held:
                continue
            if self._sends_on(switch) and can_rest(switch, cell):
                at = AtHome(switch, cell)
                self._rests[switch] = at, Standstill(at, f"standstill of {switch.path}")
        return self._rests.keys() - self._restless

    def _sends_on(self, switch: Switch) -> bool:
        """Whether it has sent again since the snapshot that it was asked for, and would always be asked for another."""
        first, method = self._first.get(switch, switch.turn), switch.method
        is_saved = switch.ledger.state_turn >= first if method.snapshots else not method.replays
        return switch.turn > first and is_saved and is_unsettled(switch)

    def standing(self) -> list[tuple[AtHome, Gated]]:
        """Those that are to stand still, and how each does."""
        return [one for switch, one in self._rests.items() if switch not in self._restless]

    def try_again_later(self) -> None:
        """Some have not come to rest in time: the next time those are not waited for."""
        self._restless = {switch for switch, (_, rest) in self._rests.items() if not rest.is_waiting}

    def have_all_rest(self) -> None:
        """The next time those are waited for again that had not come to rest in time."""
        self._restless.clear()

    def waits_for(self, others: Iterable[Switch]) -> str:
        """Whose snapshot is not there yet; "" if nobody's is missing."""
        late = next(filter(is_unsettled, others), None)
        if late is None:
            return ""
        why = f"{late.path} may have to repeat what it has sent, so its next snapshot is waited for"
        if late in self._rests:
            why = f"{late.path} sends again and again, so it is to stand still for the commit, and does not yet"
        said = "" if late.cell is None else said_of_turn(late.cell)
        return f"{why}; {said}" if said else why

    async def go_on(self) -> None:
        """Nobody stands still for us any more."""
        await asyncio.gather(*(rest.give_up() for _, rest in self._rests.values()))

    def open(self) -> None:
        """It is in force: they go on."""
        for _, rest in self._rests.values():
            rest.open()

    async def gone_on(self) -> None:
        """Wait until they have gone on."""
        for _, rest in self._rests.values():
            if rest.task is not None:
                with contextlib.suppress(HoldfastError):
                    await asyncio.shield(rest.task)


def can_rest(switch: Switch, cell: Cell) -> bool:
    """Whether it lives where it can be brought to rest."""
    if switch.life.port is None or not switch.life.is_released:
        return False
    spec = cell.spec if isinstance(cell.spec, ChildSpec) else recipe_spec(cell)
    is_protected = spec is not None and spec.mechanism is not None
    return is_protected or isinstance(cell.host.place, (LifeHere, WorkerPlace))


def is_unsettled(switch: Switch) -> bool:
    """Whether what it has sent may be sent again, to be compared."""
    ledger, method = switch.ledger, switch.method
    if not (method.replays or method.snapshots):  # Protected, without recovery: only the turn in hand is made again.
        return ledger.is_sending
    return ledger.has_sent
