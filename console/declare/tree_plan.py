"""The smallest change from what runs to what a file wants, as the steps of one transaction."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from typing import TYPE_CHECKING, Any

from ...actors.errors import SpecError, type_name
from ...actors.kernel.actor import Actor, Start
from ...checkpoint.method import Method
from ...ftm.model.mechanism import compose
from ...supervision.spec import ChildSpec
from ...system.recovery import RecoverySupervisor
from ...system.transaction.arrangement import Arrangement
from ...system.transaction.change import Change
from ...system.transaction.draft import Draft, DraftPlace, is_elsewhere
from ...system.transaction.living import Bind, RegisterName, ReplaceActorCode, Unbind, UnregisterName
from ...system.transaction.mechanisms import Isolate, Protect
from ...system.transaction.operation import Operation
from ...system.transaction.reparenting import Reparent
from ...system.transaction.running import Respecify, StartAgain, StopChild
from ...system.transaction.structure import AddChild, RemoveActor, Reorder, SetFlags
from ..overview import is_far
from ..trust import Needed, trusted_imports
from .tree_file import TreeFile
from .wanted_tree import WantedActor, WantedTree

if TYPE_CHECKING:
    from ...system.system import ActorSystem

CHANGEABLE = ("restart", "shutdown", "backoff", "significant", "start_timeout")
FIXED = ("recovery", "mailbox", "limits")
FIXED_FLAGS = ("auto_shutdown", "max_children", "journal")
ANEW = "cannot be another while it runs: take its table out, apply, and put it in again"


async def declare(
    system: ActorSystem, text: str, name: str, *, dry_run: bool = False, keep_all: bool = False, timeout: float = 60.0
) -> Change | None:
    """Have the tree of a running system be as a file says, by one transaction; None: it is so already.

    Args:
        system: the system.
        text: what is in the file.
        name: the name of the file, for errors.
        dry_run: only check, and say what would be done.
        keep_all: refuse to leave a recorded state behind.
        timeout: seconds that the transaction may take.

    Raises:
        SpecError: naming file, line and key. UntrustedFile: a module of it could have been written by somebody else.
        TransactionRefused, TransactionFailed: as any transaction.
    """
    with trusted_imports(system._node, Needed(None, [])):
        wanted = TreeFile(text, name)
    return await change_to(system, wanted, dry_run=dry_run, keep_all=keep_all, timeout=timeout)


async def change_to(
    system: ActorSystem, wanted: WantedTree, *, dry_run: bool = False, keep_all: bool = False, timeout: float = 60.0
) -> Change | None:
    """Have the tree of a running system be as it is wanted, by one transaction; None: it is so already.

    Raises:
        SpecError: it cannot be so while all runs, or would leave something behind.
        TransactionRefused, TransactionFailed: as any transaction.
    """
    plan = TreePlan(system, wanted, timeout)
    steps = await plan.steps()
    if not steps:
        return None
    lost = list(plan.left_behind())
    if keep_all and lost:
        raise SpecError(system.name, "; ".join(lost))
    async with system.transaction(dry_run=dry_run, timeout=timeout) as change:
        change.lose(lost)
        for step in steps:
            change.step(step)
    return change


def keep_state(state: Any) -> Any:
    """The state as it is: only the arguments of the next lives are others."""
    return state


def actor_places(system: ActorSystem) -> Iterator[DraftPlace]:
    """All actors that run, and are no supervisors and no parts of the runtime."""
    waiting = [Draft(system._node, Arrangement(), 1.0).root]
    while waiting:
        place = waiting.pop()
        if place.kind is RecoverySupervisor:
            continue
        if place.kind is not None and not place.is_supervisor and not place.is_stopped:
            yield place
        if not place.is_protected:
            waiting.extend(place.children.values())


def other_code(place: DraftPlace, start: Start[Any], path: str) -> ReplaceActorCode:
    """The step that has an actor go on as another class, or with other arguments.

    Raises:
        SpecError: the class is a reloaded one, and the actor's process has the old module.
    """
    old, new = place.kind, start.kind
    if old is new:
        return ReplaceActorCode(path, start, keep_state)
    is_reloaded = old is not None and type_name(old) == type_name(new)
    if is_reloaded and place.cell is not None and is_far(place.cell):
        raise SpecError(
            path, f"its process has the old module of {type_name(new)}: restart the program for its new code"
        )
    return ReplaceActorCode(path, start, None)


class TreePlan:
    """Compares what runs with what is wanted."""

    def __init__(self, system: ActorSystem, wanted: WantedTree, timeout: float) -> None:
        self._system, self._wanted = system, wanted
        self._draft = Draft(system._node, Arrangement(), timeout)
        self._there: dict[str, DraftPlace] = {}  # who is at each address of the file already, or comes there
        self._moved: list[str] = []  # the addresses of those that come
        self._gone: list[DraftPlace] = []

    async def steps(self) -> list[Operation]:
        """What is to be done, in order. Raises SpecError: it cannot be done while all runs."""
        top = self._draft.find(self._wanted.below)
        gone = [place async for place in self._managed(top)]
        self._there = {place.path: place for place in (top, *gone) if place.path in self._wanted.actors}
        gone = [place for place in gone if place.path not in self._there and not self._is_kept(place.path)]
        self._find_moves(gone)
        self._gone = [place for place in gone if place not in set(self._there.values())]
        for one in self._wanted.actors.values():
            if one.is_kept and one.path not in self._there:
                raise self._wanted.error(one.path, "nobody is there who could be kept", "keep")
        return [
            *self._freed_names(),
            *self._moves(),
            *self._added(),
            *(step for path in self._there for step in self._changed(path)),
            *self._started(),
            *self._ties(),
            *self._stopped(),
            *self._removed(),
            *self._reordered(),
        ]

    # -- what there is ------------------------------------------------------------------------------------------------

    async def _managed(self, top: DraftPlace) -> AsyncIterator[DraftPlace]:
        """All below an address that supervisors look after by their specs, parents first; and those the file names."""
        waiting = [top]
        while waiting:
            place = waiting.pop()
            if place.spec is not None and place.spec.mechanism is not None:
                continue
            if place.is_supervisor and not place.is_stopped:
                await self._draft.supervisor(place.path)
            wanted = self._wanted.actors.get(place.path)
            free = place.is_dynamic or place.is_uniform or place.is_partitioned
            free = free or (wanted is not None and wanted.keeps_below)
            for child in place.children.values():
                is_named = child.path in self._wanted.actors
                if child.kind is RecoverySupervisor or child.know_spec() is None or (free and not is_named):
                    continue
                yield child
                waiting.append(child)

    def _is_kept(self, path: str) -> bool:
        return any(one.keeps_below and path.startswith(f"{one.path}/") for one in self._wanted.actors.values())

    def _new(self) -> list[WantedActor]:
        return [one for one in self._wanted.actors.values() if one.spec is not None and one.path not in self._there]

    def _find_moves(self, gone: list[DraftPlace]) -> None:
        """An actor that is gone here and new there, with the same id and class, and alone with these, is moved."""
        kinds = Counter((place.name, place.kind) for place in gone)
        new = self._new()
        wanted = Counter((one.id, _kind(one)) for one in new)
        by_kind = {(place.name, place.kind): place for place in gone}
        for one in new:
            key = (one.id, _kind(one))
            if one.path in self._there or kinds[key] != 1 or wanted[key] != 1:
                continue
            place = by_kind[key]
            if place in self._there.values():
                continue
            self._moved.append(one.path)
            for inner in place.walk():
                path = one.path + inner.path[len(place.path) :]
                if path in self._wanted.actors:
                    self._there.setdefault(path, inner)

    def left_behind(self) -> Iterator[str]:
        """Recorded states that do not come along: their actor is gone here, and new there as another class."""
        gone = {place.name: place for place in self._gone if _is_recorded(place.spec)}
        for one in self._new():
            place = gone.get(one.id)
            if place is not None and place.kind is not None and one.spec is not None:
                old, new = place.kind.__name__, one.spec.start.kind.__name__
                yield (
                    f"{one.path} begins anew as {new}, and what is recorded of {place.path} ({old}) is left behind: "
                    "apply the move and the other class one after the other to keep it"
                )

    # -- the steps ----------------------------------------------------------------------------------------------------

    def _freed_names(self) -> Iterator[Operation]:
        for path, place in self._there.items():
            wanted = self._wanted.actors[path]
            if wanted.names is not None and not place.is_stopped:
                yield from (UnregisterName(name) for name in place.names if name not in wanted.names)

    def _moves(self) -> Iterator[Operation]:
        fresh = {one.path for one in self._new()}
        for path in self._moved:
            above = self._wanted.actors[path].above
            if above in fresh:
                raise self._wanted.error(path, f"it cannot be moved below {above} before that is there: apply twice")
            yield Reparent(self._there[path].path, above)

    def _added(self) -> Iterator[Operation]:
        fresh = {one.path: one for one in self._new()}
        for path, one in fresh.items():
            if one.above not in fresh:
                yield AddChild(one.above, self._spec_of(one, fresh))
            if not one.is_running and one.above not in fresh:
                raise self._wanted.error(path, "it is not there yet: add it first, and stop it then", "running")

    def _spec_of(self, one: WantedActor, fresh: dict[str, WantedActor]) -> ChildSpec:
        """The spec of one that is new, with all that is new below it."""
        assert one.spec is not None
        spec = dataclasses.replace(one.spec, bindings=self._bound_early(one, fresh))
        below = [inner for inner in fresh.values() if inner.above == one.path]
        if not spec.is_supervisor or not below or len(spec.start.args) != 2:
            return spec
        children = tuple(self._spec_of(inner, fresh) for inner in below)
        return dataclasses.replace(spec, start=Start(spec.start.kind, (spec.start.args[0], children)))

    def _changed(self, path: str) -> Iterator[Operation]:
        wanted, place = self._wanted.actors[path], self._there[path]
        if wanted.is_kept:
            return
        yield from self._changed_flags(wanted, place)
        spec, now = wanted.spec, place.spec
        if spec is None or now is None:
            return
        if spec.is_supervisor != place.is_supervisor or (spec.is_supervisor and place.kind is not spec.start.kind):
            raise self._wanted.error(path, f"{place.kind and place.kind.__name__} runs there: its class {ANEW}")
        is_other = place.kind is not spec.start.kind
        if not spec.is_supervisor and (
            is_other or (spec.start.args, spec.start.kwargs) != (now.start.args, now.start.kwargs)
        ):
            yield other_code(place, spec.start, path)
        options = {name: getattr(spec, name) for name in CHANGEABLE if getattr(spec, name) != getattr(now, name)}
        if self._renamed(wanted, place):
            options["register"] = spec.register
        if options:
            yield Respecify(path, options)
        file = self._system._homes.file
        full = spec if file is None else file.complete(spec, path)
        for name in FIXED:
            if not _same(getattr(full, name), getattr(now, name)):
                raise self._wanted.error(path, f"it is {getattr(now, name)!r} now, and {ANEW}", name)
        if spec.isolation != now.isolation:
            yield Isolate(path, spec.isolation)
        if not _same_stack(spec.mechanism, now.mechanism):
            yield Protect(path, spec.mechanism)

    @staticmethod
    def _renamed(wanted: WantedActor, place: DraftPlace) -> bool:
        """Whether its next lives are to have another name, which its supervisor gives them.

        A file does not say who finds an actor by its name: that stays. Nor is the spec of a child another by it whose
        supervisor is in another process: only the present life has other names then.
        """
        assert wanted.spec is not None
        assert place.spec is not None
        new, now = wanted.spec.register, place.spec.register
        if place.parent is not None and place.parent.cell is not None and is_elsewhere(place.parent.cell):
            return False
        if wanted.names is not None and new is not None and now is not None:
            return new.text != now.text
        return new != now

    def _changed_flags(self, wanted: WantedActor, place: DraftPlace) -> Iterator[Operation]:
        now, flags, path = place.flags, wanted.flags, wanted.path
        if flags is None or now is None:
            return
        for name in FIXED_FLAGS:
            if getattr(flags, name) != getattr(now, name):
                raise self._wanted.error(path, f"it is {getattr(now, name)!r} now, and {ANEW}", name)
        if flags.strategy != now.strategy:
            yield SetFlags(path, strategy=flags.strategy)
        if (flags.intensity, flags.period) != (now.intensity, now.period):
            yield SetFlags(path, intensity=flags.intensity, period=flags.period)

    def _started(self) -> Iterator[Operation]:
        for path, place in self._there.items():
            one = self._wanted.actors[path]
            if one.spec is not None and one.is_running and place.is_stopped:
                yield StartAgain(one.above, one.id)

    def _stopped(self) -> Iterator[Operation]:
        for path, place in self._there.items():
            if not self._wanted.actors[path].is_running and not place.is_stopped:
                yield StopChild(path)

    def _ties(self) -> Iterator[Operation]:
        """Bindings and names, of those that are there and of those that come."""
        fresh = {one.path: one for one in self._new()}
        for path, one in self._wanted.actors.items():
            if one.spec is None or not one.is_running:
                continue
            place = self._there.get(path)
            bound = self._bound(place) if place is not None else self._bound_early(one, fresh)
            for port, to in one.bindings.items():
                if bound.get(port) != to:
                    yield Bind(path, port, to)
            for port in bound.keys() - one.bindings.keys():
                if one.names is not None or (
                    place is not None and place.spec is not None and port in place.spec.bindings
                ):
                    yield Unbind(path, port)  # A program binds by calls, too; a file says all of it.
            names = one.names or ()
            for name in names if place is not None else names[1:]:
                if place is None or name not in place.names:
                    yield RegisterName(name, path)

    def _bound(self, place: DraftPlace) -> dict[str, str]:
        """Where the ports of an actor lead, by the addresses that the targets have behind the change."""
        now = {target: path for path, target in self._there.items()}
        if place.is_stopped and place.spec is not None:
            return dict(place.spec.bindings)
        return {port: now.get(target, target.path) for port, target in place.bindings.items()}

    def _bound_early(self, one: WantedActor, fresh: dict[str, WantedActor]) -> dict[str, str]:
        """The bindings with which one that is new is started: those to whom is there by then."""
        order = list(fresh)
        earlier = set(order[: order.index(one.path)])
        return {
            port: to
            for port, to in one.bindings.items()
            if to in earlier or (to not in fresh and to not in self._moved)
        }

    def _removed(self) -> Iterator[Operation]:
        gone = set(self._gone)
        for place in self._gone:
            if place.parent not in gone:
                yield RemoveActor(self._path_of(place))

    def _path_of(self, place: DraftPlace) -> str:
        """Where one of those that go is when the others have moved."""
        for path in self._moved:
            was = self._there[path].path
            if place.path.startswith(f"{was}/"):
                return path + place.path[len(was) :]
        return place.path

    def _reordered(self) -> Iterator[Operation]:
        """Supervisors whose children are started in another order than that of the file."""
        new = [one.path for one in self._new()]
        for path in dict.fromkeys(one.above for one in self._wanted.actors.values() if one.above):
            place = self._there.get(path) or (self._draft.find(path) if path == self._wanted.below else None)
            if place is None or place.is_dynamic:
                continue
            wanted = [one.id for one in self._wanted.actors.values() if one.above == path]
            stays = [name for name, child in place.children.items() if self._there.get(f"{path}/{name}") is child]
            come = [one.rpartition("/")[2] for one in (*self._moved, *new) if one.rpartition("/")[0] == path]
            if [name for name in (*stays, *come) if name in wanted] != wanted:
                yield Reorder(path, wanted)


def _kind(one: WantedActor) -> type[Actor] | None:
    return one.spec.start.kind if one.spec is not None else None


def _is_recorded(spec: ChildSpec | None) -> bool:
    return spec is not None and spec.recovery is not None and spec.recovery.records


def _same(one: Any, other: Any) -> bool:
    """Whether two options are the same; where a recovery method was said does not count."""
    if isinstance(one, Method) and isinstance(other, Method):
        return dataclasses.replace(one, origin="") == dataclasses.replace(other, origin="")
    return bool(one == other)


def _same_stack(one: Any, other: Any) -> bool:
    if one is None or other is None:
        return one is other
    return compose(one if isinstance(one, tuple) else (one,)) == compose(
        other if isinstance(other, tuple) else (other,)
    )
