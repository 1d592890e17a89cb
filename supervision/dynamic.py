"""Dynamic supervisors: children come and go by request, each on its own. Elixir's DynamicSupervisor, in OTP's words.

Differences from a supervisor with a list: it starts empty; only one_for_one; a child that is not restarted is
forgotten; at the end all children are stopped at once; `max_children` bounds them; with a template each start gives
arguments only.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from collections import Counter
from collections.abc import Callable
from typing import Any, ClassVar

from ..actors import exit_reasons
from ..actors.errors import HoldfastError, SpecError, type_name
from ..actors.events import BindingAwaited, ChildStartFailed, StoreRefused
from ..actors.exit_reasons import SHUTDOWN, ExitReason
from ..actors.kernel import lifecycle
from ..actors.kernel.actor import Start, on
from ..actors.kernel.cell import DOWN, GONE, Cell
from ..actors.persistence import child_key, is_in_vain, plan_key
from ..actors.process.resource_limits import Limits
from .admin import AlreadyStarted, DeleteChild, MaxChildren, NotSupported, RestartChild, StartChild, opened
from .awaited import EACH_LOOK, LOOK_AGAIN, TELL_AFTER, lives, not_there, tell_wait
from .children import RESTARTING, STARTING, WITH_SUPERVISOR, Child, StartRow, complete, expect, tell_stopped
from .noted import (
    FIELDS,
    Noted,
    OfTemplate,
    filled,
    first_noted,
    noted_plan,
    pack_noted,
    pack_plan,
    renewed,
    unpack_noted,
)
from .respec import respec
from .rules import Rule
from .spec import NAMELESS, ChildSpec, Flags, Isolation, Plan, Restart, Shutdown, check_spec, child
from .supervisor import Supervisor, listed_at
from .supervisor_changes import check_place, check_subtree, has_stood_down

MADE_UP = b""
"""What is noted of a child whose id nobody knows when its supervisor is started again."""


class DynamicSupervisor(Supervisor):
    """Keeps children alive that are started by request. Built by `dynamic(...)`, or derived from.

    A derived class returns its flags from `init`, and as only child the template, if there is to be one.
    """

    _is_dynamic: ClassVar[bool] = True

    def __init__(self, flags: Flags | None = None, template: ChildSpec | None = None) -> None:
        self._given = Plan.of(flags or Flags(), () if template is None else (template,))

    def _begin(self, plan: Plan) -> None:
        check_dynamic(type_name(type(self)), plan)
        plan = self._in_force(plan)
        super()._begin(Plan.of(plan.flags, ()))
        self._template = plan.children[0] if plan.children else None

    def _in_force(self, declared: Plan) -> Plan:
        """The plan of this start: with what we were given while we worked, unless our recipe says something newer."""
        key, keeper = plan_key(self.ctx.path), self.ctx._cell.node.ports.keeper
        data = keeper.noted(key)
        if data is None or type(self).init is not Supervisor.init:
            return declared
        try:
            plan = noted_plan(declared, data)
            left = pack_plan(declared, plan)
            if left != data:
                keeper.note(key, left)
        except HoldfastError as error:  # It stays in the journal: perhaps its class is only not there today.
            why = f"what it was given while it worked cannot be had any more, so it begins as described: {error}"
            self.ctx._cell.node.emit(ChildStartFailed(self.ctx.path, why))
            return declared
        return plan

    async def _start_all(self) -> None:
        """Start empty, or with the children that were there before, if there is a journal of them."""
        node, where = self.ctx._cell.node, child_key(self.ctx.path, "")
        come: list[Child] = []
        for key, data in node.ports.keeper.notes(where).items():
            name = key.removeprefix(where)
            if not name or "/" in name:
                continue  # It is our own plan, or the child of a supervisor below us.
            if data == MADE_UP:
                self._errand(self._lose(name))
                continue
            if not self._flags.journal:
                continue
            try:
                spec, known = unpack_noted(self.ctx.path, self._template, name, data)
                come.append(Child(spec, noted=known))
            except HoldfastError as error:  # It stays in the journal: perhaps its class is only not there today.
                node.emit(ChildStartFailed(f"{self.ctx.path}/{name}", str(error)))
        self._children.update((one.spec.id, one) for one in come)
        self._tell_begun()
        self._expect(come)
        waiting = await self._come_back(come)
        if waiting:
            tell_wait(self.ctx._cell)
            self._errand(self._come_back_later(waiting))

    def _expect(self, come: list[Child]) -> None:
        """Those that were there before are found from now on, however long each of them has to wait for its start."""
        if self.ctx._cell.node.ports.uplink is not None:
            return  # The root finds nobody in this process whose life has not begun.
        for one in come:
            with contextlib.suppress(HoldfastError):  # Its start, which fails for the same reason, tells of it.
                expect(self.ctx._cell, one)

    async def _come_back(self, come: list[Child]) -> list[Child]:
        """Start those that were there before; returns those of them to whom somebody is missing that they need."""
        row, waiting = StartRow(come, STARTING), list[Child]()
        while (one := row.next()) is not None:
            one.awaited = not_there(self.ctx._cell.node, listed_at, self._path_of(one), one.spec)
            one.waits_apart = bool(one.awaited)
            if one.awaited:
                waiting.append(one)
                continue
            try:
                await self._come_up_in(row, one)
            except HoldfastError as error:  # One that fails must not keep the others from coming back.
                self._again(one, exit_reasons.crash(error))
        return [one for one in waiting if one.row is row]

    async def _come_back_later(self, waiting: list[Child]) -> None:
        """Start those that were there before as soon as those are there to whom they are bound."""
        node, told = self.ctx._cell.node, set[str]()
        begun = node.loop.time()
        while waiting:
            needed = Counter(one.awaited for one in waiting)
            await asyncio.sleep(LOOK_AGAIN + EACH_LOOK * len(needed))
            waiting = [one for one in waiting if one.row is not None]  # Else it was stopped.
            if any(lives(node, listed_at, path) for path in needed):
                waiting = await self._come_back(waiting)
            elif (seconds := node.loop.time() - begun) >= TELL_AFTER:
                for path in needed.keys() - told:
                    node.emit(BindingAwaited(self.ctx.path, path, needed[path], seconds))
                told |= needed.keys()

    async def _lose(self, name: str) -> None:
        """A child is over whose id nobody will use again: whoever waits for it is told, what was recorded is erased."""
        path = f"{self.ctx.path}/{name}"
        try:
            await self._erase_below(path)
            self.ctx._cell.node.ports.keeper.note(child_key(self.ctx.path, name), None)
        except HoldfastError as error:  # It is tried again at our next start.
            self.ctx._cell.node.emit(StoreRefused(path, str(error)))

    async def _erase_below(self, path: str) -> None:
        """Forget what was recorded at an address and below it. Raises HoldfastError if the store refuses."""
        erased = self.ctx._cell.node.ports.keeper.erase(path, below=True)
        if erased is not None:
            await erased

    def _enlist(self, one: Child) -> None:
        # First: what is started must come back, also if we die in the middle of the start. But of two, of which one is
        # to take the place of the other, that is noted which has it.
        if self._is_in_place and one.spec.start.begins_with is None:
            self._note(one, self._first_noted(one.spec))
        super()._enlist(one)

    def _first_noted(self, spec: ChildSpec, changed: tuple[str, ...] | None = None) -> Noted | None:
        """What is noted of a child that has come. Raises HoldfastError if it cannot be."""
        if not self._flags.journal:
            return None
        return first_noted(self._template, spec, FIELDS if changed is None else changed)

    def _note(self, one: Child, known: Noted | None) -> None:
        """Note what becomes of a child when we are started again. Raises HoldfastError if that cannot be."""
        key, keeper = child_key(self.ctx.path, one.spec.id), self.ctx._cell.node.ports.keeper
        if known is not None:
            keeper.note(key, pack_noted(known, one.spec))
            one.noted = known
        elif one.spec.made_up and self._is_recorded(one):
            keeper.note(key, MADE_UP)

    def _give_away(self, name: str) -> Child:
        one = super()._give_away(name)
        if has_stood_down(self.ctx._cell):
            return one  # Whoever takes our place comes to what is noted.
        self._try_to_note(one, lambda: self.ctx._cell.node.ports.keeper.note(child_key(self.ctx.path, name), None))
        return one

    def _welcome(self, one: Child, declared: ChildSpec) -> None:
        super()._welcome(one, declared)
        if self._is_in_place:
            self._try_to_note(one, lambda: self._note(one, self._first_noted(declared)))

    def _respecified(self, one: Child, before: ChildSpec) -> None:
        def note() -> None:
            known = renewed(one.noted, self._template, before, one.spec)
            if known is not one.noted:  # Each note is the newest in the journal, which tells the order.
                self._note(one, known)

        if self._flags.journal and self._is_in_place:
            self._try_to_note(one, note)

    def _retry(self, one: Child, number: int, reason: ExitReason) -> None:
        if number == one.retry and one.state == RESTARTING and is_in_vain(str(reason)):
            self._renew(one)
        super()._retry(one, number, reason)

    def _renew(self, one: Child) -> None:
        """A child whose code does not fit what is recorded of it is tried with that of the present template."""
        if not isinstance(one.noted, OfTemplate) or self._template is None:
            return
        try:
            start = one.noted.spec(self._template, one.spec.id, made_up=one.spec.made_up).start
        except HoldfastError:
            return  # Its arguments do not fit that one: it is tried as it is.
        if start.kind is one.spec.start.kind:
            return
        if one.cell is not None and one.cell.state is not GONE:
            respec(one.cell, start)
        else:
            before, one.spec = one.spec, dataclasses.replace(one.spec, start=start)
            self._respecified(one, before)

    def _try_to_note(self, one: Child, note: Callable[[], None]) -> None:
        """A child has come, or gone, whatever the store says."""
        try:
            note()
        except HoldfastError as error:
            self.ctx._cell.node.emit(StoreRefused(f"{self.ctx.path}/{one.spec.id}", str(error)))

    def _is_recorded(self, one: Child) -> bool:
        """Whether something may be recorded of a child, or below it."""
        spec = complete(self.ctx._cell, one.spec)
        return spec.has_home or spec.is_supervisor

    def _forget(self, one: Child) -> None:
        super()._forget(one)
        if not self._is_in_place:
            return
        node, key = self.ctx._cell.node, child_key(self.ctx.path, one.spec.id)
        is_lost = one.spec.made_up and self._is_recorded(one)  # Nobody starts an id again that was made up.
        if self._flags.journal:
            try:
                node.ports.keeper.note(key, MADE_UP if is_lost else None)
            except HoldfastError as error:  # It is over all the same, but will come back with us.
                node.emit(StoreRefused(f"{self.ctx.path}/{one.spec.id}", str(error)))
                return
        if is_lost:
            self._errand(self._lose(one.spec.id))

    def _keep_noted(self, one: Child, spec: ChildSpec, changed: tuple[str, ...] | None) -> None:
        self._try_to_note(one, lambda: self._note(one, self._first_noted(spec, changed)))

    def _changed_of(self, one: Child) -> tuple[str, ...] | None:
        return tuple(one.noted.changes) if isinstance(one.noted, OfTemplate) else None

    def _take(self, plan: Plan) -> None:
        """New flags and template; those who live now stay as they are, even if there are more than there may be."""
        check_dynamic(self.ctx.path, plan)
        self._flags, self._template = plan.flags, plan.children[0] if plan.children else None

    def _keep_plan(self, plan: Plan, *, has_children: bool) -> None:
        """With a journal it is noted, as the children are that it is for; else our recipe says it."""
        if not self._note_plan(plan):
            super()._keep_plan(plan, has_children=has_children)

    def _note_plan(self, plan: Plan) -> bool:
        """Note what we were given and our recipe does not say. False: we have no journal, or it could not be noted."""
        if type(self).init is not Supervisor.init:
            return False
        key, keeper = plan_key(self.ctx.path), self.ctx._cell.node.ports.keeper
        try:
            note = pack_plan(self._given, plan) if plan.flags.journal else None
            if note != keeper.noted(key):
                keeper.note(key, note)
        except HoldfastError as error:
            self.ctx._cell.node.emit(StoreRefused(self.ctx.path, str(error)))
            return False
        return plan.flags.journal

    def _set_flags(self, flags: Flags) -> None:
        super()._set_flags(flags)
        self._note_plan(Plan.of(flags, self._specs()))

    def _recipe_with(self, known: Any, given: tuple[ChildSpec, ...]) -> Any:
        """The template, if there is one."""
        return given[0] if given else None

    def _specs(self) -> tuple[ChildSpec, ...]:
        return () if self._template is None else (self._template,)

    # -- starting ---------------------------------------------------------------------------------------------------

    def _spec_in(self, message: StartChild) -> ChildSpec:
        own = self.ctx._cell
        given = opened(message.spec, own.node)
        if message.candidate and isinstance(given, ChildSpec):  # It may be the child of another one that we shall have.
            spec = given
        elif self._template is not None:
            if given is not None:
                raise SpecError("StartChild", f"{self.ctx.path} has a template: give args and kwargs only")
            spec = filled(self._template, *message.arguments(own.node))
        elif message.args or message.kwargs:
            raise SpecError("StartChild", f"{self.ctx.path} has no template for these arguments: give a child spec")
        elif isinstance(given, Start):
            spec = child(None, given)
        elif isinstance(given, ChildSpec):
            spec = dataclasses.replace(
                given, comes_back=True, made_up=False
            )  # As it was told of another child, perhaps.
        else:
            raise SpecError("StartChild", f"takes child(...), start(...) or supervisor(...), not {given!r}")
        check_spec("StartChild", spec, "never", nameless=True)
        check_place("StartChild", (spec,), own.node)
        if message.id is not None:
            return dataclasses.replace(spec, id=message.id)
        if spec.id != NAMELESS and (self._template is None or message.candidate):
            return spec
        # Without a journal nobody knows this id when we have been restarted: what waits for it waits for nobody.
        name = own.node.numbers.next_name(f"{self._beginning(spec)}-")
        return dataclasses.replace(spec, id=name, comes_back=self._flags.journal, made_up=True)

    def _beginning(self, spec: ChildSpec) -> str:
        """What a made-up id begins with: the template's or the class's name."""
        return spec.start.kind.__name__.lower() if spec.id == NAMELESS else spec.id

    async def _check_free(self, spec: ChildSpec) -> None:
        known = await self._come_so_far(spec.id)
        if known is not None:
            ref = self.ctx._cell.node.cell_at(f"{self.ctx.path}/{spec.id}").ref
            raise AlreadyStarted(spec.id, ref, known.in_vain)
        most = self._flags.max_children
        if most is not None and len(self._children) >= most:
            self.ctx._cell.node.numbers.no_room["children", spec.start.kind] += 1
            raise MaxChildren(most)

    async def _come_so_far(self, name: str) -> Child | None:
        """A child, if there is one; if it comes back, when it has its address: what is said there then waits for it."""
        while True:
            known = self._children.get(name)
            if known is None or known.cell is not None or known.row is None:
                return known
            await asyncio.sleep(LOOK_AGAIN)

    # -- ending -----------------------------------------------------------------------------------------------------

    def _give_up_address(self, one: Child, reason: object) -> None:
        super()._give_up_address(one, reason)
        self._forget(one)
        self._dismiss(one)

    async def _stop_children(self) -> None:
        """We end: all children are told at once, and each has the time its spec gives it."""
        for one in list(self._listed().values()):
            self._has_ended(one)
        await stop_together(list((self.ctx._cell.children or {}).values()))

    # -- what makes no sense here -----------------------------------------------------------------------------------

    @on(RestartChild)
    def _restart_child(self, message: RestartChild) -> Any:
        """A stopped child is forgotten here; one that runs can be restarted."""
        if message.running:
            return super()._restart_child(message)
        self._child(message.id)
        raise NotSupported("a dynamic supervisor forgets stopped children: start it anew with StartChild")

    @on(DeleteChild)
    def _delete_child(self, message: DeleteChild) -> Any:
        """A stopped child is forgotten here by itself; what was recorded of it is forgotten now."""
        path, keeper = f"{self.ctx.path}/{message.id}", self.ctx._cell.node.ports.keeper
        is_there = message.id in self._children or message.id in (self.ctx._cell.children or ())
        if not is_there:
            self._ended.pop(message.id, None)
        if not is_there and "/" not in message.id and message.erase and keeper.has_recorded(path):
            return self._answered(self._erase_below(path))  # If the store refuses, it can be deleted again.
        self._child(message.id)
        raise NotSupported(
            f"{message.id} has not ended: stop it with TerminateChild, then DeleteChild erases what it has"
        )


async def stop_together(cells: list[Cell]) -> None:
    """Stop children side by side: one timer for each shutdown time that occurs, however many they are."""
    waiting: list[tuple[Cell, asyncio.Future[ExitReason]]] = []
    late: dict[float, list[Cell]] = {}
    for cell in cells:
        spec: ChildSpec | None = cell.spec
        if cell.state in (DOWN, GONE):
            lifecycle.retire_with_parent(cell)
            continue
        waiting.append((cell, lifecycle.stop_and_wait(cell) if spec is None else spec.begin_stop(cell)))
        patience = lifecycle.PATIENCE if spec is None else spec.shutdown
        if not isinstance(patience, str):
            late.setdefault(patience, []).append(cell)
    timers = [cells[0].node.loop.call_later(seconds, _kill_all, those) for seconds, those in late.items()]
    try:
        for cell, gone in waiting:
            above = cell.parent
            ended = await gone
            if cell.spec is not None:
                cell.spec.judge(cell, SHUTDOWN, ended)
            if above is not None:
                tell_stopped(cell, above.path, WITH_SUPERVISOR)
            lifecycle.retire_with_parent(cell)
    finally:
        for timer in timers:
            timer.cancel()


def _kill_all(cells: list[Cell]) -> None:
    for cell in cells:
        if cell.state not in (DOWN, GONE):
            cell.kill()


def check_dynamic(where: str, plan: Plan) -> None:
    """Whether a plan is one for a dynamic supervisor.

    Raises:
        SpecError: naming what does not go together.
    """
    flags = plan.flags
    if flags.strategy != "one_for_one":
        raise SpecError(
            where, f"a dynamic supervisor is one_for_one, not {flags.strategy!r}: its children have no order"
        )
    if flags.auto_shutdown != "never":
        raise SpecError(
            where, f"a dynamic supervisor has no significant children: auto_shutdown {flags.auto_shutdown!r}"
        )
    if len(plan.children) > 1:
        raise SpecError(where, "a dynamic supervisor starts empty: it takes one template at most")


def dynamic(
    name: str,
    *,
    template: ChildSpec | None = None,
    max_children: int | None = None,
    journal: bool = False,
    intensity: int = 1,
    period: float = 5.0,
    restart: Restart = "permanent",
    shutdown: Shutdown = "infinity",
    isolation: Isolation = "task",
    limits: Limits | None = None,
    significant: bool = False,
    rules: tuple[Rule, ...] = (),
) -> ChildSpec:
    """Describe a supervisor that starts empty and takes children by `StartChild`, as a spec.

    Args:
        name: the last part of its address.
        template: `child(None, start(Class, ...))`: every child is one of these, and `StartChild(args=...)` adds the
            rest of its arguments; without one `StartChild` takes any child spec, or a bare `start(...)`.
        max_children: how many there may be, those that are being restarted among them; None sets no limit.
        journal: when it is started again, it brings its children back: those that were started by request and not ended
            for good since; with a store that lasts also after the end of the program. Their arguments must be such as
            can be saved, and their classes importable.
        intensity: restarts allowed within `period` seconds; one more and it gives up.
        period: seconds, > 0.
        restart, shutdown, isolation, limits, significant, rules: as a child of its own supervisor; see `supervisor`.

    Raises:
        SpecError: naming the option and what it may be.
    """
    where = f"dynamic {name!r}"
    try:
        flags = Flags("one_for_one", intensity, period, "never", max_children, journal)
    except SpecError as error:
        raise SpecError(where, error.problem) from None
    if template is not None:
        check_spec(where, template, "never", nameless=True)
        if isolation == "process":
            check_subtree(where, (template,))
    return ChildSpec(
        name,
        Start(DynamicSupervisor, (flags, template)),
        restart,
        shutdown,
        isolation,
        limits=limits,
        is_supervisor=True,
        significant=significant,
        rules=tuple(rules),
    )
