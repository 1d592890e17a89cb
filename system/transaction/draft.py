"""The draft of the tree: each operation is checked against it, and changes it as it will change the tree."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.control.orders import GiveAccount
from ...actors.control.orders_lane import order
from ...actors.errors import ActorRestarting, NoSuchActor
from ...actors.kernel.cell import GONE, Cell
from ...actors.kernel.node import Node, cell_kind
from ...actors.kernel.ref import ActorRef, Target
from ...actors.process.process_host import WorkerPlace
from ...actors.process.wire.peer import OutsidePlace
from ...checkpoint.method import Method
from ...supervision.children import STOPPED, Child
from ...supervision.dynamic import DynamicSupervisor
from ...supervision.respec import recipe_spec
from ...supervision.services.partition import PartitionSupervisor, UniformSupervisor
from ...supervision.spec import ChildSpec, Flags
from ...supervision.supervisor import Supervisor
from ...supervision.supervisor_changes import Account, heard
from ..mechanism_notes import part_of
from ..recovery import RecoverySupervisor
from .lasting import recipe_flags, recipe_specs
from .operation import wrong

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor, Start
    from .arrangement import Arrangement
    from .relocation import Relocation
    from .rework import Rework

START_TIMEOUT = 3600.0
"""Seconds a child may take to start; the transaction's own time limit is shorter."""


@dataclass(slots=True)
class PlaceBefore:
    """What a place was before the transaction."""

    below: DraftPlace | None
    """Its supervisor."""
    children: frozenset[str] = frozenset()
    """The names of those that were below it."""
    start: Start[Any] | None = None
    """Of a supervisor whose place another one takes: what the next life there begins with; None: nobody takes it."""
    brought_back: bool = False
    """Whether its supervisor starts it when that is restarted itself: its recipe says so."""
    told: dict[str, ChildSpec] = field(default_factory=dict[str, "ChildSpec"])
    """The specs of its children, as a supervisor in another process has told them."""
    bound: dict[str, DraftPlace] = field(default_factory=dict[str, "DraftPlace"])
    """To whom its spec binds its ports."""


class DraftPlace:
    """One address in the draft. `cell` is None while nobody has lived there: it is to be added."""

    __slots__ = (
        "bindings",
        "candidate",
        "cell",
        "children",
        "flags",
        "is_leaving",
        "is_moved",
        "is_planned",
        "is_stopped",
        "is_suspended",
        "is_switched",
        "kind",
        "name",
        "names",
        "parent",
        "relocation",
        "rework",
        "spec",
        "wanted",
        "was",
    )

    def __init__(self, name: str, parent: DraftPlace | None, cell: Cell | None, spec: ChildSpec | None) -> None:
        self.name, self.parent, self.cell, self.spec = name, parent, cell, spec
        self.children: dict[str, DraftPlace] = {}
        self.flags: Flags | None = None
        self.kind: type[Actor] | None = spec.start.kind if spec is not None else None
        self.is_leaving = False  # removed by an earlier step; it goes when all is done
        self.is_moved = False  # to another supervisor, perhaps back again
        self.is_planned = False  # added by an earlier step
        self.is_stopped = cell is None or cell.is_dead  # a child whose spec stays, and which does not run
        self.is_suspended = cell is not None and cell.more is not None and cell.more.suspended
        self.bindings: dict[str, DraftPlace] = {}
        self.names: list[str] = []
        self.was = PlaceBefore(parent)
        self.is_switched = False  # its spec says otherwise whether it is started with the others
        self.candidate = 0  # as which it is started, if it is added
        self.wanted: dict[str, Any] = {}  # flags that change
        self.rework: Rework | None = None  # what is changed in the actor itself
        self.relocation: Relocation | None = None  # and where it lives

    @property
    def path(self) -> str:
        """The address at this point."""
        return self.name if self.parent is None else f"{self.parent.path}/{self.name}"

    @property
    def path_before(self) -> str:
        """The address before the transaction; only of one who was there."""
        below = self.was.below
        return self.name if below is None else f"{below.path_before}/{self.name}"

    @property
    def has_moved(self) -> bool:
        """Whether it is below another supervisor than before."""
        return not self.is_planned and self.parent is not self.was.below

    @property
    def is_given_away(self) -> bool:
        """Whether one supervisor gives it to another, and one of them lives in another process, or will."""
        old, new = self.was.below, self.parent
        return self.has_moved and old is not None and new is not None and (old.is_far or new.is_far)

    @property
    def is_far(self) -> bool:
        """Whether a supervisor lives, or will live, in another process."""
        for one in self.upwards():
            if not one.is_planned:
                return one.cell is not None and is_elsewhere(one.cell)
            if one.spec is not None and one.spec.isolation == "process":
                return True
        return False

    @property
    def is_moved_to(self) -> bool:
        """Whether somebody else's child comes here."""
        return any(child.has_moved for child in self.children.values())

    @property
    def comes_last(self) -> bool:
        """Whether it is added where somebody lives until the transaction is in force: it is started then.

        So is who is added with a binding to such a one.
        """
        waiting, seen = [self], set[DraftPlace]()
        while waiting:
            place = waiting.pop()
            if not place.is_planned or place in seen:
                continue
            above = place.parent
            if above is not None and not above.is_planned and place.name in above.was.children:
                return True
            seen.add(place)
            waiting += [
                to for port, to in place.bindings.items() if place.spec is not None and port in place.spec.bindings
            ]
        return False

    @property
    def ends_or_begins_last(self) -> bool:
        """Whether its supervisor has to stop or start it when all is in force."""
        return self.is_leaving or (self.is_switched and self.is_stopped) or self.comes_last

    @property
    def is_supervisor(self) -> bool:
        """Whether it looks after its children."""
        return self.kind is not None and issubclass(self.kind, Supervisor)

    @property
    def begins_anew(self) -> bool:
        """Whether another one takes its place where its supervisor's place is taken."""
        return self.kind is not None and self.kind._with_successor == "anew"

    @property
    def is_awaited(self) -> bool:
        """Whether its supervisor's place is not taken before it has ended."""
        return self.kind is not None and self.kind._with_successor == "awaited"

    @property
    def is_idle(self) -> bool:
        """Whether it does not run, and goes along as a spec where its supervisor's place is taken."""
        below = self.was.below
        return self.is_stopped and below is not None and below.was.start is not None

    @property
    def is_dynamic(self) -> bool:
        """Whether its children have no order."""
        return self.kind is not None and issubclass(self.kind, DynamicSupervisor)

    @property
    def is_noted(self) -> bool:
        """Whether a journal says which children it has; one that begins anew comes to that of the other one."""
        return self.flags is not None and self.flags.journal and self.was.start is None

    @property
    def is_partitioned(self) -> bool:
        """Whether its children are all alike, and not ours to give."""
        return self.kind is not None and issubclass(self.kind, PartitionSupervisor)

    @property
    def is_uniform(self) -> bool:
        """Whether its children are all alike, so that none of them comes or goes alone."""
        return self.kind is not None and issubclass(self.kind, UniformSupervisor)

    @property
    def actor(self) -> Supervisor | None:
        """The supervisor itself, if it lives in this process now."""
        actor = self.cell.actor if self.cell is not None else None
        return actor if isinstance(actor, Supervisor) and "_children" in actor.__dict__ else None

    @property
    def is_protected(self) -> bool:
        """Whether it lives as a group of replicas now."""
        spec = self.cell.spec if self.cell is not None else None
        return isinstance(spec, ChildSpec) and spec.mechanism is not None

    def know_spec(self) -> ChildSpec | None:
        """Its spec; one that is not known here is that in a recipe of the root, else what its supervisor has told."""
        if self.spec is None and self.cell is not None:
            self.spec = recipe_spec(self.cell)
        if self.spec is None and self.parent is not None:
            specs = (recipe_specs(self.parent.cell) or ()) if self.parent.cell is not None else ()
            self.spec = next((one for one in specs if one.id == self.name), None) or self.parent.was.told.get(self.name)
        if self.kind is None and self.spec is not None:
            self.kind = self.spec.start.kind
        return self.spec

    def rework_of(self) -> Rework:
        """What is changed in the actor itself; a step has asked for it."""
        assert self.rework is not None
        return self.rework

    def walk(self) -> Iterator[DraftPlace]:
        """This place, and all below it."""
        yield self
        for child in self.children.values():
            yield from child.walk()

    def upwards(self) -> Iterator[DraftPlace]:
        """This place, and all above it."""
        at: DraftPlace | None = self
        while at is not None:
            yield at
            at = at.parent

    def comes_back_with(self, supervisor: DraftPlace) -> bool:
        """Whether it is started when a supervisor above it is."""
        one = self
        while one is not supervisor and one.parent is not None:
            is_new = one.is_planned or one.has_moved
            is_kept = one.spec is not None and one.spec.restart != "temporary" and not one.parent.is_dynamic
            if not (is_kept if is_new else one.was.brought_back):
                return False
            one = one.parent
        return True

    def now(self, node: Node) -> Cell | None:
        """The cell that lives here now, if one does: that of before, or the one that has followed it."""
        if self.cell is not None and self.cell.state is GONE:
            self.cell = self.cell.living
        return None if self.cell is None or self.cell.is_dead else self.cell

    def living(self, node: Node) -> Cell:
        """The cell that lives here now. Raises NoSuchActor."""
        cell = self.now(node)
        if cell is None:
            raise NoSuchActor(self.path)
        return cell

    def check_up(self, path: str) -> None:
        """Whether this is no supervisor that was stopped before: then nobody is below it, of whom a step could be.

        Raises:
            SpecError: it is; `path` is what the step is about.
        """
        if self.is_supervisor and not self.is_planned and (self.cell is None or self.cell.is_dead):
            whose = "it" if path == self.path else f"its supervisor {self.path}"
            raise wrong(path, f"{whose} is stopped: start that in a transaction of its own first")

    def check_lived_in(self, node: Node, *, before_commit: bool = True) -> None:
        """Whether somebody lives here at this point, and also before the transaction is in force.

        Raises:
            SpecError: nobody does: it was stopped, or a step before stops it, or it starts when all is in force.
        """
        if self.comes_last and before_commit:
            raise wrong(
                self.path, "its address is free only when this transaction is in force: do this in the next one"
            )
        if not self.is_stopped:
            return
        if self.now(node) is None:
            raise wrong(self.path, "it is stopped: start it first")
        raise wrong(self.path, "it is stopped by this very transaction")

    def line(self) -> str:
        """The place in one line of text."""
        said = [self.kind.__name__ if self.kind is not None else "actor"]
        if self.spec is not None:
            said += [self.spec.restart, self.spec.isolation]
            if not self.spec.autostart:
                said.append("stopped")
            recovery = self.spec.recovery
            if recovery is not None:
                said.append(recovery.name if isinstance(recovery, Method) else type(recovery).__name__.lower())
            if self.spec.mechanism is not None:
                said.append(f"protected by {rules().names_of(self.spec.mechanism)}")
        if self.flags is not None:
            said.append(f"{self.flags.strategy} {self.flags.intensity} in {self.flags.period:g} s")
        said += [f"{port} -> {target.path}" for port, target in sorted(self.bindings.items())]
        said += [f"named {name!r}" for name in sorted(self.names)]
        return f"{self.path}: {', '.join(said)}"

    def brick_lines(self) -> list[str]:
        """The bricks of its mechanism that are its own, a line for each."""
        if self.spec is None or self.spec.mechanism is None:
            return []
        return list(rules().lines_of(self.path, self.spec.mechanism))


def rules() -> Any:
    """`ftm.adaptation_rules`, which most transactions do not need."""
    from ...ftm.model import composition

    return composition


class Draft:
    """All places, as they are at this point of the transaction."""

    def __init__(self, node: Node, arrangement: Arrangement, timeout: float) -> None:
        root = node.root
        assert root is not None
        self.node = node
        self.by_cell: dict[Cell, DraftPlace] = {}
        self._asked: set[DraftPlace] = set()  # supervisors of other processes that have told us whom they have
        self.arrangement = arrangement
        self.timeout = timeout
        """Seconds that the transaction may take."""
        self.root = self._survey(root, root.path, None, None)
        for cell, place in list(self.by_cell.items()):
            for port, target in (cell.more.bindings if cell.more is not None else {}).items():
                lives = node.successor(target) if target.state is GONE else target
                if lives is not None and lives in self.by_cell:
                    place.bindings[port] = self.by_cell[lives]
            for port, path in place.spec.bindings.items() if place.spec is not None else ():
                lives = node.find(path)
                if lives is not None and lives in self.by_cell:
                    place.was.bound[port] = self.by_cell[lives]
        self.named: dict[str, DraftPlace] = {}
        """Who has which name before the transaction."""
        for name, cell in node.names.items():
            if cell in self.by_cell:
                self.by_cell[cell].names.append(name)
                self.named[name] = self.by_cell[cell]
        self._early = self._started_too_early()

    def _survey(self, cell: Cell | None, name: str, parent: DraftPlace | None, spec: ChildSpec | None) -> DraftPlace:
        place = DraftPlace(name, parent, cell, spec)
        if cell is None:
            return place
        self.by_cell[cell] = place
        place.kind = cell_kind(cell) or place.kind
        actor = place.actor
        if place.is_supervisor or place.kind is None:  # Else nobody says anything of children.
            place.flags = actor._flags if actor is not None else recipe_flags(cell)
            recipe = {spec.id for spec in recipe_specs(cell) or ()}
        else:
            recipe = set[str]()
        below = dict(cell.children or {})
        known: list[Child] = list(actor._children.values()) if actor is not None else []
        planned = recipe | (actor._planned if actor is not None else set[str]())
        for one in known:
            child = below.pop(one.spec.id, None)
            place.children[one.spec.id] = self._survey(child, one.spec.id, place, one.spec)
            place.children[one.spec.id].was.brought_back = one.spec.id in planned and not place.is_dynamic
        for child in below.values():
            own = child.spec if isinstance(child.spec, ChildSpec) else None
            place.children[child.name] = self._survey(child, child.name, place, own)
        place.was.children = frozenset(place.children)
        return place

    def find(self, target: Target, *, parts: bool = False) -> DraftPlace:
        """The place a step is about.

        Args:
            target: who.
            parts: whether it may be a part of a mechanism, which the step does not change.

        Raises:
            NoSuchActor: there will be nobody at that point. SpecError: a step before removes it, or it is such a part.
        """
        place = self._of(target._cell) if isinstance(target, ActorRef) else None
        if place is None:
            place = self._at(target if isinstance(target, str) else target.path)
        for at in place.upwards():
            if at.is_leaving:
                raise wrong(place.path, f"{at.path} is removed by this very transaction")
            if at.kind is RecoverySupervisor:
                raise wrong(place.path, "it is a part of the system itself, which no transaction changes")
        if not parts:
            self._check_no_part(place.path, place.parent)
        return place

    def _of(self, cell: Cell) -> DraftPlace | None:
        """Where an actor is at this point, whose life may be over: then it is who has followed it before all steps."""
        return self.by_cell.get(cell) or self.by_cell.get(cell.living)

    def _check_no_part(self, path: str, above: DraftPlace | None) -> None:
        """Whether what is below `above` is nobody's mechanism. Raises SpecError."""
        while above is not None:
            if above.spec is not None and above.spec.mechanism is not None:
                raise wrong(path, part_of(above.path))
            above = above.parent

    def _at(self, path: str) -> DraftPlace:
        top = self.root.path
        if path != top and not path.startswith(f"{top}/"):
            raise NoSuchActor(path)
        place = self.root
        for name in path[len(top) :].split("/")[1:]:
            if name not in place.children:
                moved = self.node.find(path)  # It may have had this address before.
                if moved is not None and moved in self.by_cell:
                    return self.by_cell[moved]
                self._check_no_part(path, place)
                place.check_up(path)
                raise NoSuchActor(path)
            place = place.children[name]
        return place

    async def supervisor(self, target: Target) -> DraftPlace:
        """The supervisor a step is about, its children known.

        Raises:
            NoSuchActor: nobody is there. SpecError: it is no supervisor. ActorRestarting: it is not up.
        """
        place = self.find(target)
        if not place.is_supervisor:
            raise wrong(place.path, "this is no supervisor")
        cell = place.cell
        if place.is_planned:
            return place  # It will have what its spec says.
        place.check_up(place.path)
        if cell is None:
            raise NoSuchActor(place.path)
        if place.actor is None:
            if not is_elsewhere(cell):
                raise ActorRestarting(place.path)
            if place not in self._asked:  # It is in another process, and knows best.
                self._asked.add(place)
                account = heard_account(place.path, await order(cell, GiveAccount(), START_TIMEOUT))
                self._learn(place, account)
        return place

    @staticmethod
    def _learn(place: DraftPlace, account: Account) -> None:
        """What a supervisor in another process says of itself and its children."""
        known = place.children
        told = {heir.id: known.get(heir.id) or DraftPlace(heir.id, place, None, None) for heir in account.children}
        for heir in account.children:
            told[heir.id].is_stopped = heir.state == STOPPED
        place.was.told = {heir.id: heir.spec.value for heir in account.children if heir.spec is not None}
        place.children = {**told, **{name: one for name, one in known.items() if name not in told}}
        place.was.children = frozenset(place.children)
        place.is_suspended = account.is_suspended
        if place.flags is None:
            place.flags = account.flags

    def check(self) -> None:
        """What must hold when all is done.

        Raises:
            SpecError: a binding would point at nobody, also when a supervisor is restarted; a suspended supervisor
                would have to stop or start a child; or an actor that is given away is changed as well.
        """
        for place, port in self._started_too_early() - self._early:
            why = f"it is started before the one to which its spec binds {port!r}"
            raise wrong(place.path, f"{why}: a restart of a supervisor of both would fail")
        for handing in self.arrangement.handings.values():
            handing.check()
        for succession in self.arrangement.successions:
            succession.check()
        for place in self.staying():
            if place.is_suspended and any(child.ends_or_begins_last for child in place.children.values()):
                check_awake(place)
            for port, target in place.bindings.items():
                if any(above.is_leaving for above in target.upwards()):
                    raise wrong(place.path, f"its binding {port!r} would point at {target.path}, which is removed")

    def _started_too_early(self) -> set[tuple[DraftPlace, str]]:
        """Whose spec binds a port to somebody whom a supervisor of both, below the root, starts later."""
        found: set[tuple[DraftPlace, str]] = set()
        seen: set[DraftPlace] = set()
        for place in self.staying():
            seen.add(place)
            for port in place.spec.bindings.keys() - place.spec.late if place.spec is not None else ():
                target = (place.bindings if place.is_planned else place.was.bound).get(port)
                if target is not None and target not in seen:
                    both = next((above for above in target.upwards() if above in set(place.upwards())), self.root)
                    if both is not self.root and place.comes_back_with(both):
                        found.add((place, port))
        return found

    def places(self) -> Iterator[DraftPlace]:
        """All places that are in the draft at this point, parents first."""
        return self.root.walk()

    def staying(self) -> Iterator[DraftPlace]:
        """All that is there when all is done, parents first."""
        waiting = [self.root]
        while waiting:
            place = waiting.pop()
            if not place.is_leaving:
                yield place
                waiting.extend(reversed(list(place.children.values())))

    def below_root(self) -> tuple[set[str], set[str]]:
        """The addresses of those that come to the root from elsewhere, and of those of its children that go."""
        top = self.root.children.values()
        come = {one.path for one in top if one.is_planned or one.has_moved}
        return come, {one.path for one in top if one.is_leaving}

    def gone(self) -> dict[str, str]:
        """The new address of each that was moved, by the one before, and "" for each that was removed."""
        return {
            place.path_before: "" if place.is_leaving else place.path
            for place in self.root.walk()
            if not place.is_planned and (place.is_leaving or place.has_moved)
        }

    def mechanisms(self) -> dict[str, Any]:
        """Which mechanisms those have, at this instant, that are to have others."""
        return {
            place.path: place.relocation.before.mechanism
            for place in self.staying()
            if place.relocation is not None and not place.is_planned
        }

    def lines(self) -> list[str]:
        """The tree when all is done, a line for each address."""
        return [line for place in self.staying() for line in (place.line(), *place.brick_lines())]


def heard_account(path: str, told: Any) -> Account:
    """What a supervisor in another process leaves, as that says.

    Raises:
        SpecError: that is no such account.
    """
    try:
        return heard(told)
    except msgspec.ValidationError as error:
        raise wrong(path, f"its process gives no account of it: {error}") from error


def check_awake(place: DraftPlace) -> None:
    """Whether a supervisor takes requests. Raises SpecError: it is suspended."""
    if place.is_suspended:
        raise wrong(place.path, "it is suspended, and starts and stops nobody: resume it first")


def is_elsewhere(cell: Cell) -> bool:
    """Whether an actor lives in another process than the root's."""
    return isinstance(cell.host.place, (WorkerPlace, OutsidePlace))


def difference(before: list[str], after: list[str]) -> list[str]:
    """What changes from one description to another: lines with `-` go, lines with `+` come.

    What is said of one address stands together, if it changes where it is.

    >>> difference(["a", "b: 1", "c: 1"], ["a", "b: 2", "c: 2"])
    ['- b: 1', '+ b: 2', '- c: 1', '+ c: 2']
    """
    import difflib  # only now: most programs never ask

    told: list[str] = []
    for _, begin, end, begins, ends in difflib.SequenceMatcher(None, before, after, autojunk=False).get_opcodes():
        old, new = before[begin:end], after[begins:ends]
        if old == new:
            continue
        come = {line.partition(":")[0]: line for line in new}
        for line in old:
            told.append(f"- {line}")
            if (now := come.pop(line.partition(":")[0], None)) is not None:
                told.append(f"+ {now}")
        told += [f"+ {line}" for line in come.values()]
    return [line.rstrip() for line in told]
