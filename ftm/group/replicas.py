"""The root's access to the replicas of a group: their processes, what is sent to them, what is heard.

Who of them counts stands in the membership, which is data; here is what a change of it does besides. If the outermost
mechanism wants that, all that replicas are told, and say, is sealed.
"""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

from ...actors.errors import ActorStopped, AskFailed, AskTimeout, HoldfastError, NoSuchActor
from ...actors.exit_reasons import (
    KILLED,
    SHUTDOWN,
    Crash,
    Exited,
    ExitReason,
    Hung,
    OutOfMemory,
    Shutdown,
    Signal,
    TrustBreach,
)
from ...actors.kernel.actor import Actor
from ...actors.kernel.cell import RUNNING, Cell
from ...actors.kernel.message import Message, message_name
from ...actors.kernel.ref import ActorRef
from ...actors.process.process_watchdog import waited_for_processor
from ..bricks.sealed_frames import ORDERS, LinkLost, Part
from ..events import ReplicaLost, WrongSuspicion
from .hold import FailoverHold
from .membership import LookAgain, Membership, Suspicion, is_within

if TYPE_CHECKING:
    from ...actors.process.worker_pool import Worker
    from ..bricks.sealed_frames import Reach, SecuredLink
    from ..model.detection import Detection
    from ..model.mechanism import Mechanism

FROM_OUTSIDE: Final = frozenset({1, 2, 3, 9, 15, 19, 20})
"""Signals (HUP, INT, QUIT, KILL, TERM, STOP, TSTP) by which others end a process, or stop it."""
BARE: Final = 50_000_000
"""Bytes that a replica has in memory without a state."""
SLOWEST: Final = 20_000_000
"""Bytes of what else it has in memory that it goes through in a second, on a busy machine."""
OUTVOTED: Final = "OutvotedHere"
"""The error of a replica that was outvoted, which is no fault of its bricks."""
TOLD_WITHIN: Final = 1.0
"""Seconds until the end of a replica that has said so is known with its reason."""
AGAIN_AFTER: Final = 0.05
"""Seconds after which a replica is claimed again that is in other hands."""


def fault_of(reason: ExitReason) -> str:
    """Why the end of a replica may be the fault of its own code; "" if somebody else has ended it."""
    match reason:
        case Crash() | Hung() | OutOfMemory() | Exited() | TrustBreach():
            why = str(reason)
        case Signal() if reason.number not in FROM_OUTSIDE:
            why = str(reason)
        case Shutdown() if reason.detail:  # A replica ends so when a brick of it has crashed.
            why = reason.detail
        case _:
            why = ""
    return "" if OUTVOTED in why else why


def process_state(pid: int) -> str:
    """What a process does: "R" if it computes or could, "S" if it sleeps, "D" at a disk, "T" stopped, "" if gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (OSError, IndexError):
        return ""


def is_blocked(pid: int) -> bool:
    """Whether the silence of a process can be the doing of its own code.

    One that sleeps though it has something to do is blocked, by a call that does not return. One that computes may be
    in a loop without end, or may have got no processor: where more want one than there are, that cannot be told apart.
    One that was stopped by a signal, or waits for a disk, is silent for another reason.
    """
    state = process_state(pid)
    return state == "S" or (state == "R" and os.getloadavg()[0] <= (os.cpu_count() or 1))


def work_on_state(pid: int) -> float:
    """Seconds for which a process may hold its event loop to go through all that it has, if it computes; else 0.0.

    Encoding, comparing and restoring a state do that. What it is at nobody can tell from here, only how much there is.
    """
    if process_state(pid) not in ("R", "D"):
        return 0.0
    try:
        resident = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return 0.0
    return max(0, resident - BARE) / SLOWEST


class Replicas:
    """The replicas of one group, each in a process of its own, and the parts of its mechanism in the root.

    Args:
        cell: of the protected actor.
        membership: who of them counts.
        detection: how they are watched.
        on_fault: told the name of one that fails by what its own code has done, and why.
    """

    def __init__(
        self, cell: Cell, membership: Membership, detection: Detection, on_fault: Callable[[str, str], None]
    ) -> None:
        self.node, self.cell = cell.node, cell
        self.membership, self.detection, self._on_fault = membership, detection, on_fault
        self.link: SecuredLink | None = None
        self.hold = FailoverHold(cell)
        self.wrong = 0  # suspicions
        self._stirred: list[asyncio.Future[None]] = []
        self._was_whole, self._whole_since = False, self.node.clock.wall()

    # -- where they are ---------------------------------------------------------------------------------------------

    @property
    def path(self) -> str:
        """The address of the protected actor."""
        return self.cell.path

    def place(self, name: str) -> str:
        """The address of an actor of the mechanism."""
        return f"{self.path}/ftm/{name}"

    def cell_of(self, name: str) -> Cell | None:
        """The cell of an actor of the mechanism, if there is one now."""
        return self.node.find(self.place(name))

    def worker_of(self, name: str) -> Worker | None:
        """The process of a replica, if it has one now."""
        cell = self.cell_of(name)
        return None if cell is None else cell.host.place.process(cell)

    def life_of(self, name: str) -> int:
        """The number of the life that a replica lives now; 0 if none."""
        cell = self.cell_of(name)
        return cell.life if cell is not None and cell.state is RUNNING else 0

    def lives(self) -> dict[str, int]:
        """The lives that replicas live now, by name, as decisions about the membership want them."""
        known = self.membership
        return {name: self.life_of(name) for name in {*known.names, *known.members, *known.up, *known.joining}}

    def is_well(self, name: str) -> bool:
        """Whether a member is the one that was taken in, and nobody suspects it."""
        return self.membership.is_well(name, self.lives())

    def well(self) -> dict[str, int]:
        """The members that are well: name to life."""
        return self.membership.well(self.lives())

    def backups(self) -> list[str]:
        """Those that could lead instead of the primary, in order."""
        return self.membership.backups(self.lives())

    # -- how they are reached ---------------------------------------------------------------------------------------

    def secure(self, outermost: Mechanism, link: SecuredLink | None = None) -> None:
        """Have the link that the outermost mechanism wants, from here on; `link`, if it is open already."""
        if self.link is not None:
            if self.link.mechanism == outermost:
                return
            self.link.close()
        self.link = link or self.linked(outermost, lambda: self.membership.names)

    def linked(self, outermost: Mechanism, names: Callable[[], Iterable[str]]) -> SecuredLink | None:
        """The root's end of the link that a mechanism wants, to replicas of these names; None if it wants none."""
        return outermost.open_link(
            self.node,
            self.path,
            self.place("proxy"),
            lambda: self.membership.epoch,
            lambda: [self.place(one) for one in names()],
            lambda path, why: self.distrust(path.rpartition("/")[2], why),
        )

    def is_plain(self) -> bool:
        """Whether what comes need not be sealed; else it counts as an attempt."""
        if self.link is not None:
            self.link.plain()
        return self.link is None

    def is_from_leader(self, sender: ActorRef[Any] | None) -> bool:
        """Whether whoever leads, or is told to, has said this."""
        names = self.membership.primary, self.membership.leading
        return any(name is not None and is_within(self.place(name), sender) for name in names)

    def entry(self, name: str) -> ActorRef[Any]:
        """The outermost RequestProtocol of a replica.

        Raises:
            NoSuchActor: it is not there, or not yet.
        """
        path = self.place(f"{name}/protocol")
        cell = self.node.find(path)
        if cell is None:
            raise NoSuchActor(path)
        return cell.ref

    def ask(self, name: str, message: Message[Any], timeout: float) -> asyncio.Future[Any]:
        """Ask the outermost RequestProtocol of a replica; over the secured link, if there is one.

        Raises:
            NoSuchActor: it is not there, or not yet; over a link the future has that error.
        """
        if self.link is None:
            return self.entry(name).ask(message, timeout)
        asked = self._ask_sealed(self.link, name, message, timeout)
        return self.node.loop.create_task(asked, context=contextvars.Context())

    async def _ask_sealed(self, link: SecuredLink, name: str, message: Message[Any], timeout: float) -> Any:
        life, path, codec = self.life_of(name), self.place(name), self.node.codec
        part, reach = Part(message_name(type(message)), codec.encode(message, path)), self.reach(name)
        if not life:
            raise NoSuchActor(path)
        try:
            async with asyncio.timeout(timeout):
                back = await link.call(
                    path, ORDERS, part, reach, lambda: self.life_of(name) == life and self.link is link
                )
        except TimeoutError:
            raise AskTimeout(path, timeout) from None
        except LinkLost:
            raise NoSuchActor(path) from None
        if back.kind == "reply":
            return codec.decode_reply(type(message), back.body)
        raise codec.decode_error(back.kind, back.name, back.body)

    def reach(self, name: str) -> Reach:
        """How to ask the outermost RequestProtocol of a replica."""
        return lambda message, seconds: self.entry(name).ask(message, timeout=seconds)

    def tell_primary(self, message: Message[Any]) -> None:
        """Tell whoever leads; if it has died, all of it goes to the next one."""
        known = self.membership
        name, then = known.primary, (known.primary, known.epoch, False)
        if name is None:
            return
        if self.link is not None:
            path, reach = self.place(name), self.reach(name)
            self.link.tell(path, message, reach, lambda: (known.primary, known.epoch, known.is_over) == then)
        else:
            with contextlib.suppress(HoldfastError):
                self.entry(name).tell(message)

    def bind_proxy(self) -> None:
        """Show who leads: the proxy is bound to its RequestProtocol."""
        proxy, primary = self.cell_of("proxy"), self.membership.primary
        if proxy is not None and primary is not None:
            self.node.bind(proxy, "protocol", self.node.cell_at(self.place(f"{primary}/protocol")))

    def tell(self, name: str, message: Message[Any]) -> None:
        """Tell a part of the mechanism in the root, if it is there."""
        cell = self.cell_of(name)
        if cell is None or cell.is_dead:
            return  # Whoever comes there looks by itself.
        # Not by its ref: this may be called in the turn, or by a timer, of whatever actor, whose words it is not.
        with contextlib.suppress(HoldfastError):  # The same.
            cell.admit(cell, message)

    def wake(self) -> None:
        """Something has happened: have the failover manager look."""
        if not self.membership.is_over:
            self.tell("failover", LookAgain())

    def watch_as(self, detection: Detection) -> None:
        """They are watched like this from now on."""
        self.detection = detection

    # -- what is heard of them --------------------------------------------------------------------------------------

    def watched(self) -> list[tuple[str, int]]:
        """Who is expected to be heard of, and is not suspected already: name and life."""
        return list(self.membership.watched(self.lives()))

    def heard(self, name: str, life: int) -> bool:
        """Take down a sign of life; True if it is the first one of this life."""
        match self.membership.hear(name, life):
            case "new":
                if self.link is not None:
                    self.link.begins_life(self.place(name))
                self.watch(name)
                self.wake()
                return True
            case "cleared":
                self.wrong += 1
                self.node.emit(WrongSuspicion(self.path, name, self.wrong))
            case "again" | "known":
                pass
        return False

    def watch(self, name: str) -> None:
        """Hear of the end of a replica's present life."""
        cell = self.cell_of(name)
        if cell is not None and cell.state is RUNNING:
            cell.ended().add_done_callback(lambda done: self._died(name, done))

    def _died(self, name: str, done: asyncio.Future[ExitReason]) -> None:
        if not self.membership.noticed:
            self.membership.noticed = time.monotonic()
        if not done.cancelled() and (why := fault_of(done.result())):
            self.at_fault(name, f"its process has ended: {why}")
        self.wake()

    def suspect(self, name: str, life: int, why: str, *, is_silence: bool = False) -> None:
        """A replica must be replaced; unless it is silent and nothing else, no sign of life changes that."""
        self.membership.suspect(name, Suspicion(life, why, self.node.loop.time(), is_silence), time.monotonic())
        self.wake()

    def distrust(self, name: str, why: str) -> None:
        """Nothing can be exchanged with a replica any more: it must be replaced, even if it is all there is."""
        known = self.membership
        life = known.members.get(name, 0) or known.up.get(name, 0)
        if life and not known.is_over and not known.is_suspect(name, life):
            known.suspect(name, Suspicion(life, why, self.node.loop.time(), is_barred=True), time.monotonic())
            self.stir()
            self.wake()

    def at_fault(self, name: str, why: str) -> None:
        """A replica has ended by what its own code has done, or looks as if it had."""
        if name in self.membership.names and not self.membership.is_over:
            self._on_fault(name, why)

    def silent(self, name: str, life: int, why: str) -> None:
        """No sign of life has come from a replica for too long: unless one comes in time, it is replaced."""
        self.suspect(name, life, why, is_silence=True)
        pid = self._pid_of(name)
        if pid is not None and is_blocked(pid):
            self.at_fault(name, why)

    def blame(self, name: str, life: int, why: str) -> None:
        """A replica must be replaced, and that may be the fault of its own code."""
        self.suspect(name, life, why)
        if OUTVOTED not in why:
            self.at_fault(name, why)

    def lost(self, name: str, why: str) -> None:
        """A replica does not count any more."""
        self.stir()
        if self.membership.members.pop(name, None) is not None:
            self.node.emit(ReplicaLost(self.path, name, self.membership.epoch, why))

    def whole_since(self) -> tuple[bool, float]:
        """Whether one replica leads and all others could, and since when that is so (by the system's clock)."""
        is_whole = self.membership.is_whole(self.lives())
        if is_whole != self._was_whole:
            self._was_whole, self._whole_since = is_whole, self.node.clock.wall()
        return is_whole, self._whole_since

    def stirred(self) -> asyncio.Future[None]:
        """A future that ends when a replica begins or ceases to count."""
        future: asyncio.Future[None] = self.node.loop.create_future()
        self._stirred.append(future)
        return future

    def stir(self) -> None:
        """A replica begins or ceases to count, or whoever waits for that should look again."""
        self.whole_since()
        waiting, self._stirred = self._stirred, []
        finish(waiting)

    async def have_backup(self) -> None:
        """Wait until somebody could take over, or no replica is left."""
        while len(self.membership.members) < 2 and not self.membership.is_over:
            await self.stirred()

    # -- their processes --------------------------------------------------------------------------------------------

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

    async def bury(self, name: str, life: int) -> None:
        """Kill a replica's process, if it is that life, and wait until it has been reaped."""
        while not self.membership.is_over:
            with self.hold.of(self.place(name), "it does not count any more") as is_ours:
                if is_ours:
                    await self.kill(name, life)
                    return
            await asyncio.sleep(AGAIN_AFTER)

    async def kill(self, name: str, life: int) -> None:
        """Kill a replica's process, if it is that life, and wait until it has been reaped; by nobody's leave."""
        cell = self.cell_of(name)
        if cell is None or cell.life != life or cell.state is not RUNNING:
            return
        worker = self.worker_of(name)
        if worker is None:
            cell.kill()
            await cell.ended()
        else:
            worker.kill(KILLED)
            await worker.gone()

    def dismiss(self) -> None:
        """Kill the processes of all replicas, since the mechanism has ended, or is taken away: that is no fault."""
        for name in self.membership.names:
            worker = self.worker_of(name)
            if worker is not None:
                worker.kill(SHUTDOWN)

    async def why_ended(self, name: str, life: int, error: HoldfastError) -> str:
        """Why a replica has not done as it was told: if it has ended, it says soon of what."""
        cell = self.cell_of(name)
        if not isinstance(error, (ActorStopped, AskFailed)) or cell is None:
            return str(error)
        if self.life_of(name) == life:
            await asyncio.wait((cell.ended(),), timeout=TOLD_WITHIN)
        return str(cell.extra().reason)


class GroupPart(Actor):
    """A part of a group in the root; it looks again when its timer is over."""

    _is_part: ClassVar[bool] = True

    deterministic = False

    _timer: asyncio.TimerHandle | None = None

    def on_stop(self, reason: object) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def call_later(self, seconds: float, call: Callable[[], None]) -> None:
        """Do something then, instead of what was to be done before."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self.ctx._cell.node.loop.call_later(seconds, call)


def finish(waiting: Iterable[asyncio.Future[None]]) -> None:
    """Tell all who wait for the same thing that it has come."""
    for future in waiting:
        if not future.done():
            future.set_result(None)
