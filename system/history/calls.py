"""A system's methods for its history: past events and lives, and what follows from them in words."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any

from ...actors.control.orders import Status
from ...actors.errors import AskTimeout, HoldfastError, NoSuchActor, SpecError
from ...actors.kernel.node import cell_kind
from ...actors.kernel.ref import DEFAULT_TIMEOUT, ActorRef, Target
from ...actors.process.wire.peer import OutsideHost
from ...actors.seconds import check_seconds
from ...supervision.supervisor import Supervisor
from .counted_work import count_work
from .evidence import Evidence, PutAside, Silence, Told, below, collect, put_aside, silence_of
from .lives import PastLife, done
from .pages import MOST_ON_PAGE, HistoryPage, HistoryQuestion, answer, question
from .paths import pattern_of
from .recorder import HistoryRecorder
from .why import Cause, causes, why

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ...actors.kernel.node import Node
    from ...checkpoint.home.quarantine import QuarantinedMessage

SEVERAL = 20
"""Messages in a mailbox from which on it is looked at twice."""
BETWEEN = 0.2
"""Seconds between the two looks."""
MOST_ASKED = 100
"""Actors below a supervisor, in other processes, that are asked how they are."""
ASKED_WITHIN = 1.0
"""Seconds that each of them may take, and a supervisor in another process."""


class HistoryCalls:
    """What a system knows of its past."""

    _history: HistoryRecorder | None

    @property
    def _node(self) -> Node:
        """The node that hosts this process's actors."""
        raise NotImplementedError

    async def get_status(self, target: Target, *, timeout: float = DEFAULT_TIMEOUT) -> Status:
        """Say how an actor is now; see `Controls`."""
        raise NotImplementedError

    def pid_of(self, target: Target) -> int:
        """Return the pid of the OS process that an actor lives in; see `ActorSystem`."""
        raise NotImplementedError

    async def get_state(self, target: Target, *, timeout: float = DEFAULT_TIMEOUT) -> Any:
        """Copy an actor's state; see `Controls`."""
        raise NotImplementedError

    def quarantined(self, actor: Target | None = None) -> list[QuarantinedMessage]:
        """Messages that are put aside."""
        raise NotImplementedError

    def history(
        self,
        target: Target = "**",
        *,
        kinds: Sequence[str] = (),
        since: float = 0.0,
        until: float = float("inf"),
        after: int | None = None,
        limit: int = MOST_ON_PAGE,
    ) -> HistoryPage:
        """Past events, oldest first: the newest `limit` of those that are meant, or the first `limit` behind `after`.

        Args:
            target: an actor, an address, or a pattern: `/app/*/till` means one name by the star, `/app/shop/**` the
                shop and all below it.
            kinds: the classes of events by name, such as `["ActorCrashed", "DeadLetter"]`; empty: all.
            since, until: Unix times.
            after: the number of an event, from `page.next`: to go on where a page ended.
            limit: events at most, from 1 to 1000.

        Raises:
            SpecError: it cannot be asked so, or the system was made with `history=False`.
        """
        asked = question(pattern_of(target), kinds=kinds, since=since, until=until, after=after, limit=limit)
        return answer(self._recorder, asked)

    async def follow_history(
        self, target: Target = "**", *, after: int, kinds: Sequence[str] = (), timeout: float = 30.0
    ) -> HistoryPage:
        """Past events behind `after`, as soon as there is one; an empty page if none came within `timeout` seconds.

        Raises:
            SpecError: as `history`.
        """
        check_seconds("follow_history", "timeout", timeout)
        return await self._follow(question(pattern_of(target), kinds=kinds, after=after), timeout)

    async def _follow(self, asked: HistoryQuestion, timeout: float) -> HistoryPage:
        recorder = self._recorder
        try:
            async with asyncio.timeout(timeout):
                while not (page := answer(recorder, asked)).events:
                    await recorder.followers.changed()
        except TimeoutError:
            page = answer(recorder, asked)
        return page

    def lives(self, target: Target) -> list[PastLife]:
        """The newest lives at an address, oldest first: how each began and ended, by whom, and why; 16 at most.

        Raises:
            SpecError: the system was made with `history=False`.
        """
        path = _path(target)
        lives = self._recorder.lives.at(path)
        if lives and not lives[-1].is_over:
            done(lives[-1], count_work(self._node, path))
        return lives

    async def why(self, target: Target, *, timeout: float = DEFAULT_TIMEOUT) -> list[str]:
        """Say in a few sentences why an actor restarts, has ended, or does not get on.

        Args:
            target: an actor, or an address, whether or not anybody lives there.
            timeout: seconds that the actor's process may take to say how it is; the rest is known without it.

        Raises:
            SpecError: the system was made with `history=False`.
        """
        return why(await self._evidence("why", target, timeout))

    async def causes(self, target: Target, *, timeout: float = DEFAULT_TIMEOUT) -> list[Cause]:
        """Say what `why` says of a target, within a timeout in seconds, each sentence with the name of its cause.

        For programs; nothing if nothing is wrong. Raises SpecError: the system was made with `history=False`.
        """
        return causes(await self._evidence("causes", target, timeout))

    async def _evidence(self, call: str, target: Target, timeout: float) -> Evidence:
        check_seconds(call, "timeout", timeout)
        path = _path(target)
        node, recorder = self._node, self._recorder
        return collect(node, recorder, path, await self._ask(path, timeout), self.quarantined(path))

    def put_aside(self, target: Target | None = None) -> list[PutAside]:
        """The messages in quarantine as plain data, oldest first; what is in them only with `log_payloads`.

        `quarantined` returns the messages themselves, to be tried again or dropped.
        """
        payloads = self._history is not None and self._history.keeps_payloads
        return [put_aside(one, payloads=payloads) for one in self.quarantined(target)]

    async def _ask(self, path: str, timeout: float) -> Told:
        """What an actor says of itself, and those above and below it that live in other processes."""
        cell = self._node.find(path)
        if cell is None:
            return Told()
        above = self._node.find(path.rpartition("/")[0])
        itself, state, others = await asyncio.gather(
            self._ask_itself(cell, timeout), self._ask_above(above, timeout), self._ask_below(cell, timeout)
        )
        return Told(itself.status, itself.queued_before, itself.overview, itself.silence, state, others)

    async def _ask_itself(self, cell: Cell, timeout: float) -> Told:
        """What an actor says of itself; if several messages wait, what it said a moment before, too."""
        try:
            status = await self.get_status(cell.ref, timeout=timeout)
            before = None
            if status.queued >= SEVERAL:
                before = status.queued
                await asyncio.sleep(BETWEEN)
                status = await self.get_status(cell.ref, timeout=timeout)
        except AskTimeout:
            return Told(silence=self._silence(cell.ref, timeout))
        except HoldfastError:
            return Told()  # It has ended meanwhile: the rest is known all the same.
        if not _supervises(cell):
            return Told(status, before)
        try:
            return Told(status, before, await self.get_state(cell.ref, timeout=timeout))
        except HoldfastError:
            return Told(status, before)  # It has a turn in hand that does not end: its status says so.

    async def _ask_above(self, cell: Cell | None, timeout: float) -> dict[str, Any]:
        """The state of a supervisor that lives in another process; empty if it does not, or does not say."""
        if cell is None or not _is_elsewhere(cell) or not _supervises(cell):
            return {}
        try:
            state: dict[str, Any] = await self.get_state(cell.ref, timeout=min(timeout, ASKED_WITHIN))
        except HoldfastError:
            return {}
        return state

    async def _ask_below(self, cell: Cell, timeout: float) -> dict[str, Status]:
        """How those are that live below a supervisor in other processes, by address, as far as they say."""
        far = islice((one for one in below(cell) if _is_elsewhere(one)), MOST_ASKED) if _supervises(cell) else ()
        told = await asyncio.gather(*(self._ask_status(one, min(timeout, ASKED_WITHIN)) for one in far))
        return {status.address: status for status in told if status is not None}

    async def _ask_status(self, cell: Cell, timeout: float) -> Status | None:
        try:
            return await self.get_status(cell.ref, timeout=timeout)
        except HoldfastError:
            return None

    def _silence(self, ref: ActorRef[Any], seconds: float) -> Silence | None:
        """That the process of an actor has not answered; None if it lives in this one, or nowhere at the moment."""
        try:
            pid = self.pid_of(ref)
        except NoSuchActor:
            return None
        return None if pid == os.getpid() else silence_of(pid, seconds)

    @property
    def _recorder(self) -> HistoryRecorder:
        if self._history is None:
            raise SpecError("history", "the system keeps none: it was made with history=False, or is not running")
        return self._history


def _supervises(cell: Cell) -> bool:
    kind = cell_kind(cell)
    return kind is not None and issubclass(kind, Supervisor)


def _is_elsewhere(cell: Cell) -> bool:
    """Whether another process knows more of an actor than this one."""
    return not cell.is_dead and (isinstance(cell.host, OutsideHost) or cell.host.place.process(cell) is not None)


def _path(target: Target) -> str:
    path = target.path if isinstance(target, ActorRef) else target
    if not isinstance(path, str):
        raise SpecError("history", f"takes an actor or an address, not {target!r}")
    return path
