"""The place of a supervisor that has its own process, and the homes of the addresses below it."""

from __future__ import annotations

from typing import Any

from ...actors.exit_reasons import ExitReason
from ...actors.kernel import lifecycle
from ...actors.kernel.address_host import AddressHost
from ...actors.kernel.cell import Cell
from ...actors.kernel.lifecycle import NEAR
from ...actors.persistence import child_key
from ...actors.process.process_host import FLIGHT, WorkerPlace
from ...actors.process.resource_limits import Limits
from ...actors.process.wire import frames
from ...actors.process.worker_pool import Worker, Workers
from ..home.homes import Homes
from ..home.life_ports import records_of
from ..protocol import ToHome
from ..turn_word import is_at_work
from .far_parent import FarParent, Lives


class SubtreePlace(WorkerPlace):
    """A process of a supervisor's own."""

    def __init__(self, workers: Workers, limits: Limits | None, homes: Homes, lives: Lives) -> None:
        super().__init__(FLIGHT, NEAR, workers, limits)
        self._homes, self._lives = homes, lives
        self._below: dict[str, FarParent] = {}
        self._slots: Slots | None = None
        self._has_ended_in_turn = False

    @property
    def has_ended_in_turn(self) -> bool:
        return self._has_ended_in_turn

    async def take(self, cell: Cell) -> tuple[Worker, bytes]:
        worker, recipe = await super().take(cell)
        slots = self._slots = Slots(len(worker.page))

        def joined(path: str) -> FarParent:
            parent = self.at(path)
            parent.joined(cell, worker, slots.of(path))
            return parent

        def taker(path: str) -> frames.TakeRecord:
            joined(path)

            def taken(record: ToHome) -> None:
                parent = self._below.get(path) or joined(path)  # It was vacated, and somebody is wanted there again.
                parent.hear(worker, record)

            return records_of(worker, taken)

        worker.record_taker = taker
        return worker, recipe

    def options(self, cell: Cell) -> dict[str, Any]:
        file = self._homes.file
        more = {} if file is None else {"recovery_file": file.data()}
        left = self._homes.addresses.left_below(cell.path)
        return {
            "kept": self._homes.notes(child_key(cell.path, "")),
            "known": self._homes.known(cell.path),
            "left": left,
            **more,
        }

    def at(self, path: str) -> FarParent:
        """The supervisor of an address below."""
        parent = self._below.get(path)
        if parent is None:
            parent = self._below[path] = FarParent(self._homes, self.workers, path, self._lives, self._vacated)
        return parent

    def lived_at(self, path: str) -> Cell | None:
        parent = self._below.get(path)
        return None if parent is None else parent.cell

    def _vacated(self, parent: FarParent) -> None:
        """Nobody lives at an address below any more: what is known of it here goes, and its place on the page."""
        if self._below.get(parent.path) is not parent:
            return
        del self._below[parent.path]
        if self._slots is not None:
            self._slots.give_back(parent.path)

    def died(self, cell: Cell, reason: ExitReason) -> None:
        worker = self.workers.of(cell)
        if worker is not None:
            one_works = self._slots is not None and self._slots.is_any_at_work(worker.page)
            ended_it = [parent.lost(worker, reason, one_works=one_works) for parent in self._below.values()]
            self._has_ended_in_turn = any(ended_it)
        super().died(cell, reason)

    def retired(self, cell: Cell) -> None:
        super().retired(cell)
        for parent in reversed(list(self._below.values())):
            if parent.cell is not None:
                parent.leaves(is_restarting=True)
                lifecycle.retire(parent.cell, "its supervisor has stopped")
        self._below.clear()


class Slots:
    """Places on the page: which input each recorded life in a process is handling. The first two are taken."""

    def __init__(self, count: int) -> None:
        self._unused = iter(range(2, count))
        self._free: list[int] = []  # given back
        self._by_path: dict[str, int] = {}

    def of(self, path: str) -> int:
        """The place of an address; 0 when there is none left."""
        slot = self._by_path.get(path)
        if slot is None:
            slot = self._free.pop() if self._free else next(self._unused, 0)
            if slot:
                self._by_path[path] = slot
        return slot

    def is_any_at_work(self, page: memoryview) -> bool:
        """Whether one of the lives has a turn in hand that does not wait."""
        return any(is_at_work(page[slot]) for slot in self._by_path.values())

    def give_back(self, path: str) -> None:
        """Nobody lives at an address any more."""
        slot = self._by_path.pop(path, 0)
        if slot:
            self._free.append(slot)


def subtree(workers: Workers, limits: Limits | None, homes: Homes, lives: Lives) -> AddressHost:
    """The host of a supervisor with a process of its own."""
    return AddressHost(FLIGHT, SubtreePlace(workers, limits, homes, lives), NEAR)
