"""Transactions: all is prepared beside what runs, put in force in one step, and followed. One at a time in a system."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import TYPE_CHECKING, Any

from ...actors.errors import HoldfastError, error_text, type_name
from ...actors.kernel.ref import current
from ...actors.seconds import check_seconds
from ...supervision.arbiter import on_errand
from ..history.authors import ACTING, author
from .arrangement import Arrangement
from .change import Change
from .draft import Draft, difference
from .errors import TransactionFailed, TransactionRefused
from .events import TransactionBegan, TransactionCommitted, TransactionRolledBack
from .mechanisms import look_at_grants
from .operation import Operation
from .relocation import seen

if TYPE_CHECKING:
    from ..system import ActorSystem

RELEASE_TIMEOUT = 30.0
"""Seconds that letting go of what one step has prepared may take before it is given up, and told as such."""
CHECKED_TOGETHER = 16
"""Steps that are checked in one step of the loop."""
LOOK_AGAIN = 0.02
"""Seconds between two looks at whether nothing is in the way of a commit any more."""


class Transactions:
    """What the transactions of one system share: the lock, who is in a body, and what still goes on behind them."""

    def __init__(self) -> None:
        self.lock = asyncio.Lock()
        self.bodies: set[asyncio.Task[Any] | None] = set()
        self.behind: set[asyncio.Task[Any]] = set()


class Transaction:
    """`async with system.transaction() as change:` carries out what the body collects, when the body ends."""

    def __init__(self, system: ActorSystem, shared: Transactions, *, dry_run: bool, timeout: float) -> None:
        check_seconds("transaction", "timeout", timeout)
        self._system, self._shared = system, shared
        self._dry_run, self._timeout = dry_run, timeout
        self._change = Change(system)
        self._arrangement = Arrangement()
        self._draft: Draft | None = None
        self._task: asyncio.Task[Any] | None = None
        self._loose: list[Operation] = []  # to be prepared again, for those at rest for them have been let go of
        self._problems: list[str] = []  # of what is in force, and could not be followed

    async def __aenter__(self) -> Change:
        self._task = asyncio.current_task()
        if self._task in self._shared.bodies:
            raise TransactionRefused("begin", "this task is in a transaction already: collect all steps in one")
        self._shared.bodies.add(self._task)
        return self._change

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # What it claims is its own; in a repair step it is that step's.
        token = on_errand.set(self if on_errand.get() is None else on_errand.get())
        try:
            if error is None:
                await self._carry_out()
        finally:
            on_errand.reset(token)
            self._shared.bodies.discard(self._task)

    async def _carry_out(self) -> None:
        lock = self._shared.lock
        deadline = asyncio.get_running_loop().time() + self._timeout
        await self._in_time("begin", deadline, lock.acquire, waits_for="another transaction is not over")
        try:
            await self._check(deadline)
            if not self._dry_run:
                await self._do(deadline)
        except BaseException:
            lock.release()
            raise
        if self._dry_run:
            lock.release()
        else:
            await self._finish()

    # -- before -------------------------------------------------------------------------------------------------------

    async def _in_time(
        self, step: str, deadline: float, work: Callable[[], Coroutine[Any, Any, Any]], waits_for: str = ""
    ) -> None:
        """Do what comes before the first step; whatever keeps it from being done is a refusal."""
        try:
            async with asyncio.timeout_at(deadline):
                await work()
        except TimeoutError as error:
            why = f": {waits_for}" if waits_for else ""
            raise TransactionRefused(step, f"not within {self._timeout:g} s{why}") from error
        except HoldfastError as error:
            raise TransactionRefused(step, said(error)) from error

    async def _check(self, deadline: float) -> None:
        """All checks of all steps, each against the tree as it will be."""
        change, system = self._change, self._system
        draft = self._draft = Draft(system._node, self._arrangement, self._timeout)
        before = draft.lines()
        for number, operation in enumerate(change.operations, 1):
            if number % CHECKED_TOGETHER == 0:
                await asyncio.sleep(0)  # What else the system does, and who asks how it is, goes on meanwhile.
            await self._in_time(operation.text, deadline, lambda one=operation: one.check(system, draft))  # type: ignore[misc]
            refuse_self(operation)
        try:
            draft.check()
            system._specifications.check(draft.root)
            look_at_grants(change.operations)
        except HoldfastError as error:
            raise TransactionRefused("the tree as it would be", said(error)) from error
        change._difference = difference(before, draft.lines())

    # -- prepare, commit -----------------------------------------------------------------------------------------------

    async def _do(self, deadline: float) -> None:
        """Prepare all, and commit."""
        system, operations = self._system, self._change.operations
        self._emit(TransactionBegan(self._address, self._texts))
        begun: list[Operation] = []
        at: Operation | None = None  # What is prepared, or what was looked at last.
        failed = "begin"
        waiting = ""
        try:
            async with asyncio.timeout_at(deadline):
                await system._specifications.prepare()
                wanted = operations
                while True:
                    for operation in wanted:
                        at, failed = operation, operation.text
                        if operation not in begun:
                            begun.append(operation)  # Before it is prepared: it may be cancelled in the middle.
                        await self._prepare(operation, begun)
                    wanted, self._loose = tuple(self._loose), []
                    if wanted:
                        continue
                    for operation in operations:
                        at, failed = operation, operation.text
                        waiting = operation.ready(system)
                        if waiting:
                            wanted = (operation,)
                            break
                    else:
                        at, failed, waiting = None, "", self._arrangement.ready(system)
                        if not waiting:
                            break
                    await asyncio.sleep(LOOK_AGAIN)
            failed, waiting = "commit", ""
            system._homes.journal.barrier()
            self._commit()  # In the same step of the loop in which all were ready.
        except BaseException as error:
            failed = failed or self._arrangement.step
            cause = f"not within {self._timeout:g} s" if isinstance(error, TimeoutError) else said(error)
            try:
                if isinstance(error, TimeoutError):
                    waits = "; ".join(filter(None, (waiting, "" if at is None else at.waits_for)))
                    waits = waits or ("" if at is None else await system._turn_in_hand(at.target, is_left=True))
                    cause += f": {waits}" if waits else ""
            finally:  # Also for whoever is cancelled while it is asked what was waited for.
                undone, kept = await self._release(begun)
                self._emit(TransactionRolledBack(self._address, self._texts, failed, cause, kept))
            if isinstance(error, (HoldfastError, TimeoutError)):
                raise TransactionFailed(failed, cause, undone, kept) from error
            raise

    async def _prepare(self, operation: Operation, begun: list[Operation]) -> None:
        """Prepare one step. While its actor is between two lives, those at rest for other steps go on."""
        system = self._system
        others = [one for one in begun if one.work is not operation.work]
        if not others:
            await operation.prepare(system)
            return
        work = system._node.loop.create_task(operation.prepare(system), name=operation.text)
        work.add_done_callback(seen)  # Whoever is cancelled has no use for its error.
        is_held = True
        try:
            while not (await asyncio.wait((work,), timeout=LOOK_AGAIN))[0]:
                if is_held and operation.is_away(system):
                    is_held, each = False, list({one.work: one for one in others}.values())
                    gone_on = await asyncio.gather(*(one.let_go(system) for one in each))
                    self._loose += [one for one, goes_on in zip(each, gone_on, strict=True) if goes_on]
        finally:
            work.cancel()
            await asyncio.wait((work,))
        work.result()

    def _commit(self) -> None:
        """Put all of it in force, with no wait in between: there is no way back from here."""
        try:
            with self._system._homes.journal.together():
                for text, commit in [
                    (self._arrangement.step, self._arrangement.commit),
                    *((one.text, one.commit) for one in self._change.operations),
                    ("the specification in the store", self._note),
                ]:
                    try:
                        commit(self._system)
                    except Exception as error:  # It had said that it is ready: the others are in force all the same.
                        self._problems.append(f"{text}: {said(error)}")
        except HoldfastError as error:
            self._problems.append(f"it is not in the store, which has failed: {said(error)}")

    def _note(self, system: ActorSystem) -> None:
        """What the children of the root are from now on, for the next root."""
        assert self._draft is not None
        mechanisms = {**self._draft.mechanisms(), **system._mechanism_notes.declared()}
        system._specifications.changed(*self._draft.below_root(), self._draft.gone(), mechanisms)

    async def _release(self, begun: list[Operation]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Let go of what was prepared, last one first; a cancellation waits until that is over."""
        undone: list[str] = []
        kept: list[str] = []

        async def release_all() -> None:
            for operation in reversed(begun):
                try:
                    async with asyncio.timeout(RELEASE_TIMEOUT):
                        await operation.release(self._system)
                    undone.append(operation.text)
                except Exception as error:  # The others are let go of all the same, and this is told.
                    kept.append(f"{operation.text}: {said(error)}")

        work = self._system._node.loop.create_task(release_all(), name="release of a transaction")
        cancelled: asyncio.CancelledError | None = None
        while not work.done():
            try:
                await asyncio.shield(work)
            except asyncio.CancelledError as error:
                cancelled = error
        work.result()
        if cancelled is not None:
            raise cancelled
        return tuple(undone), tuple(kept)

    # -- behind -------------------------------------------------------------------------------------------------------

    async def _finish(self) -> None:
        """There is no way back: what is left goes on even if nobody waits for it any more."""
        system, shared = self._system, self._shared
        # In nobody's name: it has to go on when the life is over from whose turn it was begun.
        context = system._node.base_context.copy()
        context.run(ACTING.set, f"a transaction of {author()}")
        work = system._node.loop.create_task(self._finish_all(), name="end of a transaction", context=context)
        shared.behind.add(work)
        work.add_done_callback(shared.behind.discard)
        if not self._removes_caller():
            await asyncio.shield(work)

    async def _finish_all(self) -> None:
        problems = self._problems
        try:
            for text, finish in [
                (self._arrangement.step, self._arrangement.finish),
                *((one.text, one.finish) for one in self._change.operations),
            ]:
                try:
                    await finish(self._system)
                except Exception as error:  # The tree has changed; the others are tidied up all the same.
                    problems.append(f"{text}: {said(error)}")
            try:
                await self._system._homes.journal.safe()
            except HoldfastError as error:
                problems.append(f"it is not in the store: {said(error)}")
        finally:
            self._shared.lock.release()
            self._emit(TransactionCommitted(self._address, self._texts, tuple(problems)))

    def _removes_caller(self) -> bool:
        """Whether the turn that called us belongs to an actor that goes: its end waits for that turn."""
        caller = current.get(None)
        place = self._draft.by_cell.get(caller._cell) if caller is not None and self._draft is not None else None
        while place is not None:
            if place.is_leaving or place.is_stopped:
                return True
            place = place.parent
        return False

    @property
    def _texts(self) -> tuple[str, ...]:
        return tuple(step.text for step in self._change.steps)

    @property
    def _address(self) -> str:
        root = self._system._node.root
        return root.path if root is not None else ""

    def _emit(self, event: Any) -> None:
        if self._system._node.events.has_listeners:
            self._system._node.emit(event)


def refuse_self(operation: Operation) -> None:
    """What is done between two turns of an actor cannot be waited for in one.

    Raises:
        TransactionRefused: it would.
    """
    caller = current.get(None)
    if caller is not None and any(place.cell is caller._cell for place in operation.between_turns_of):
        raise TransactionRefused(
            operation.text, f"{caller.path} cannot change itself within its own turn: spawn a task"
        )


def said(error: BaseException) -> str:
    """An error in words."""
    if isinstance(error, asyncio.CancelledError):
        return "cancelled"
    text = error_text(error)
    return text if isinstance(error, HoldfastError) else f"{type_name(type(error))}: {text}"
