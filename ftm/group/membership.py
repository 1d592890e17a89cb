"""Who of a group of replicas is up, is suspected, counts, and leads."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ...actors.errors import HoldfastError
from ...actors.exit_reasons import Crash, Exited, ExitReason, Hung, OutOfMemory, Shutdown, Signal
from ...actors.kernel.cell import RUNNING, Cell
from ...actors.kernel.message import Message
from ...actors.process.process_watchdog import waited_for_processor
from ..events import ReplicaLost, WrongSuspicion
from .securing import Securing

if TYPE_CHECKING:
    from ...actors.kernel.ref import ActorRef
    from ...actors.process.worker_pool import Worker
    from ..model.detection import Detection


FROM_OUTSIDE: Final = frozenset({1, 2, 3, 9, 15, 19, 20})
"""Signals (HUP, INT, QUIT, KILL, TERM, STOP, TSTP) by which others end a process, or stop it."""
BARE: Final = 50_000_000
"""Bytes that a replica has in memory without a state."""
SLOWEST: Final = 20_000_000
"""Bytes of what else it has in memory that it goes through in a second, on a busy machine."""
OUTVOTED: Final = "OutvotedHere"
"""The error of a replica that was outvoted, which is no fault of its bricks."""


def fault_of(reason: ExitReason) -> str:
    """Why the end of a replica may be the fault of its own code; "" if somebody else has ended it."""
    match reason:
        case Crash() | Hung() | OutOfMemory() | Exited():
            why = str(reason)
        case Signal() if reason.number not in FROM_OUTSIDE:
            why = str(reason)
        case Shutdown() if reason.detail:  # A replica ends so when a brick of it has crashed.
            why = reason.detail
        case _:
            why = ""
    return "" if OUTVOTED in why else why


def is_blocked(pid: int) -> bool:
    """Whether the silence of a process can be the doing of its own code.

    One that sleeps though it has something to do is blocked, by a call that does not return. One that computes may be
    in a loop without end, or may have got no processor: where more want one than there are, that cannot be told apart.
    One that was stopped by a signal, or waits for a disk, is silent for another reason.
    """
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state == "S" or (state == "R" and os.getloadavg()[0] <= (os.cpu_count() or 1))


def work_on_state(pid: int) -> float:
    """Seconds for which a process may hold its event loop to go through all that it has, if it computes; else 0.0.

    Encoding, comparing and restoring a state do that. What it is at nobody can tell from here, only how much there is.
    """
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        resident = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return 0.0
    return max(0, resident - BARE) / SLOWEST if state in "RD" else 0.0


def is_within(place: str, sender: ActorRef[Any] | None) -> bool:
    """Whether a replica, or what is below it, has said this."""
    return sender is not None and f"{sender.path}/".startswith(f"{place}/")


class Look(Message):
    """Something has happened to the group: see what is to be done."""


class Members(Securing):
    """The part of a group that knows its replicas."""

    def __init__(self, cell: Cell, names: tuple[str, ...], epoch: int, detection: Detection) -> None:
        self.node, self.cell, self.path = cell.node, cell, cell.path
        self.names, self.detection = names, detection
        self.epoch = epoch
        self.primary: str | None = None
        self.leading: str | None = None  # who is to lead in this epoch: `Lead` may or may not have reached it
        self.why = ""  # why the last one does not any more
        self.noticed = 0.0  # and since when that is known, on the monotonic clock
        self.keeps_members = (
            False  # through a failover: the next leader brings them to its state before anything leaves
        )
        self.members: dict[str, int] = {}  # name to life, of those that hold all state: the primary and its backups
        self.condemned: dict[str, int] = {}  # name to life, of those that must be dead before the next one leads
        self.dropped: set[str] = set()  # backups that the primary still has to forget
        self.up: dict[str, int] = {}  # name to life, of those heard of
        self.joining: dict[str, int] = {}  # name to life, of those that the primary is bringing to its state
        self.suspects: dict[str, int] = {}  # name to life
        self.doubts: dict[str, str] = {}  # name to why it was suspected last
        self.silences: dict[str, int] = {}  # name to life, of those suspected for their silence alone
        self.renewing: str | None = None  # the primary, if it is to lead anew, with other bricks
        self.suspected_at: dict[str, float] = {}  # on the loop's clock
        self.wrong = 0  # suspicions
        self.is_over = False
        self._stirred: list[asyncio.Future[None]] = []
        self._was_whole, self._whole_since = False, time.time()
        self.on_fault: Callable[[str, str], None] = lambda name, why: None

    def cell_of(self, name: str) -> Cell | None:
        """The cell of an actor of the mechanism, if there is one now."""
        return self.node.find(self.place(name))

    def worker_of(self, name: str) -> Worker | None:
        """The process of a replica, if it has one now."""
        cell = self.cell_of(name)
        return None if cell is None else cell.host.place.process(cell)

    def bind_proxy(self) -> None:
        """Show who leads: the proxy is bound to its RequestProtocol."""
        proxy = self.cell_of("proxy")
        if proxy is not None and self.primary is not None:
            self.node.bind(proxy, "protocol", self.node.cell_at(self.place(f"{self.primary}/protocol")))

    def life_of(self, name: str) -> int:
        """The number of the life that a replica lives now; 0 if none."""
        cell = self.cell_of(name)
        return cell.life if cell is not None and cell.state is RUNNING else 0

    def is_from_leader(self, sender: ActorRef[Any] | None) -> bool:
        """Whether whoever leads, or is told to, has said this."""
        names = self.primary, self.leading
        return any(name is not None and is_within(self.place(name), sender) for name in names)

    def is_well(self, name: str) -> bool:
        """Whether a member is the one that was taken in, and nobody suspects it."""
        life = self.members.get(name, 0)
        return life > 0 and self.life_of(name) == life and self.suspects.get(name) != life

    def is_awaited(self, name: str) -> bool:
        """Whether a member that is suspected, and may yet be heard of again, is all there is."""
        life = self.members.get(name, 0)
        is_alive = life > 0 and self.life_of(name) == life
        waited = self.node.loop.time() - self.suspected_at.get(name, -math.inf)
        return is_alive and not self.backups() and waited < self.detection.hopeless

    def backups(self) -> list[str]:
        """Those that could lead instead of the primary, in order."""
        return [name for name in self.names if name not in (self.primary, self.leading) and self.is_well(name)]

    def peer_of(self, leading: str) -> str | None:
        """The path of a member that goes on under the next leader, if its mechanism keeps its members."""
        left = [name for name in self.names if name != leading and self.is_well(name)] if self.keeps_members else []
        return self.place(left[0]) if left else None

    def watched(self) -> Iterator[tuple[str, int]]:
        """Who is expected to be heard of, and is not suspected already: name and life."""
        for name, life in list(self.up.items()):
            if self.life_of(name) == life and self.suspects.get(name) != life:
                yield name, life

    def heard(self, name: str, life: int) -> None:
        """A replica has given a sign of life."""
        if self.suspects.get(name) == life:
            if self.silences.get(name) != life:
                return  # Something else is wrong with it.
            self.wrong += 1
            del self.suspects[name]
            self.node.emit(WrongSuspicion(self.path, name, self.wrong))
        if self.up.get(name) != life:
            self.up[name] = life
            self.watch(name)
            self.wake()

    def watch(self, name: str) -> None:
        """Hear of the end of a replica's present life."""
        cell = self.cell_of(name)
        if cell is not None and cell.state is RUNNING:
            cell.ended().add_done_callback(lambda done: self._died(name, done))

    def _died(self, name: str, done: asyncio.Future[ExitReason]) -> None:
        if not self.noticed:
            self.noticed = time.monotonic()
        if not done.cancelled() and (why := fault_of(done.result())):
            self.at_fault(name, f"its process has ended: {why}")
        self.wake()

    def expect(self, name: str) -> None:
        """A replica is about to be started, and none of its name is there: what is known is of an earlier one.

        The lives of each are counted from one.
        """
        for known in (self.up, self.suspects, self.silences, self.joining):
            known.pop(name, None)

    def suspect(self, name: str, life: int, why: str) -> None:
        """A replica must be replaced; no sign of life changes that."""
        self.silences.pop(name, None)
        self._suspect(name, life, why)

    def _suspect(self, name: str, life: int, why: str) -> None:
        self.suspects[name], self.doubts[name] = life, why
        self.suspected_at[name] = self.node.loop.time()
        if name in (self.primary, self.leading):
            self.why, self.noticed = why, time.monotonic()
        self.wake()

    def at_fault(self, name: str, why: str) -> None:
        """A replica has ended by what its own code has done, or looks as if it had."""
        if name in self.names and not self.is_over:
            self.on_fault(name, why)

    def silent(self, name: str, life: int, why: str) -> None:
        """No sign of life has come from a replica for too long: unless one comes in time, it is replaced."""
        self.silences[name] = life
        self._suspect(name, life, why)
        pid = self._pid_of(name)
        if pid is not None and is_blocked(pid):
            self.at_fault(name, why)

    def starved(self, name: str) -> float:
        """Seconds for which a replica was ready to go on and got no processor, so far."""
        pid = self._pid_of(name)
        return 0.0 if pid is None else waited_for_processor(pid)

    def at_work(self, name: str) -> float:
        """Seconds of silence for which its state may be the reason; never more than until it is hopeless."""
        pid = self._pid_of(name)
        return 0.0 if pid is None else min(work_on_state(pid), self.detection.hopeless)

    def excused(self, name: str, starved: float) -> float:
        """Seconds of a silence that need not be a replica's fault: it got no processor, or goes through its state.

        `starved`: for how long it had got none when the silence began. Never more than until it is hopeless, of each.
        """
        return min(max(0.0, self.starved(name) - starved), self.detection.hopeless) + self.at_work(name)

    def _pid_of(self, name: str) -> int | None:
        worker = self.worker_of(name)
        return None if worker is None else worker.pid

    def broken(self, name: str, life: int, why: str) -> None:
        """A replica ends by itself, and nobody needs to wait for that."""
        self.suspect(name, life, why)
        if OUTVOTED not in why:
            self.at_fault(name, why)

    def lost(self, name: str, why: str) -> None:
        """A replica does not count any more."""
        self.stir()
        if self.members.pop(name, None) is not None:
            self.node.emit(ReplicaLost(self.path, name, self.epoch, why))

    def whole_since(self) -> tuple[bool, float]:
        """Whether one replica leads and all others could, and since when that is so (by the system's clock)."""
        is_whole = self.primary is not None and all(map(self.is_well, self.names))
        if is_whole != self._was_whole:
            self._was_whole, self._whole_since = is_whole, time.time()
        return is_whole, self._whole_since

    def stirred(self) -> asyncio.Future[None]:
        """A future that ends when a replica begins or ceases to count."""
        future: asyncio.Future[None] = self.node.loop.create_future()
        self._stirred.append(future)
        return future

    def stir(self) -> None:
        """One has, or whoever waits for that should look again."""
        self.whole_since()
        waiting, self._stirred = self._stirred, []
        for future in waiting:
            if not future.done():
                future.set_result(None)

    def wake(self) -> None:
        """Something has happened: have the manager look."""
        if not self.is_over:
            self.tell("failover", Look())

    def tell(self, name: str, message: Message[Any]) -> None:
        """Tell an actor of the mechanism, if it is there."""
        cell = self.cell_of(name)
        if cell is None or cell.is_dead:
            return  # Whoever comes there looks by itself.
        # Not by its ref: this may be called in the turn, or by a timer, of whatever actor, whose words it is not.
        with contextlib.suppress(HoldfastError):  # The same.
            cell.admit(cell, message)
