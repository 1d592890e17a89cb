"""The tree that a transaction leads to: children of each supervisor, their order, flags and names.

The steps say so in the draft. At the commit all supervisors that they are about follow it at once, and their recipes
with them, so that a restart of a supervisor keeps it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from ...actors.errors import HoldfastError, NameTaken
from ...actors.kernel.actor import Start
from ...actors.kernel.cell import GONE, RUNNING, Cell
from ...actors.kernel.ref import ActorRef
from ...actors.persistence import child_key
from ...actors.process.wire.peer import OutsidePlace
from ...actors.process.wire.start_codec import pack_data, pack_recipe
from ...checkpoint.addresses import renamed
from ...supervision.admin import ChangeSupervisor
from ...supervision.children import UP, Child, complete, new_cell
from ...supervision.respec import recipe_spec, respec
from ...supervision.spec import ChildSpec, Flags
from ...supervision.supervisor import Supervisor
from .draft import START_TIMEOUT, DraftPlace, is_elsewhere
from .lasting import Renamed, Specs, keep, recipe, recipe_flags, recipe_parts, recipe_specs
from .operation import Operation, wrong

if TYPE_CHECKING:
    from typing import Any

    from ...actors.kernel.node import Node
    from ..system import ActorSystem
    from .handing import Handing
    from .senders import OtherSenders
    from .succession import Succession


class Arrangement:
    """The supervisors and names that change, and the steps that say so."""

    def __init__(self) -> None:
        self._steps: dict[DraftPlace, Operation] = {}  # the first one about each
        self._rearranged: set[DraftPlace] = set()  # whose children, as they live now, change too
        self._told: set[DraftPlace] = set()  # to be told, if they live in another process
        self._names: dict[
            str, tuple[Operation, DraftPlace | None, DraftPlace | None]
        ] = {}  # the step; who had it, who has it
        self.handings: dict[DraftPlace, Handing] = {}
        """Of each child that is moved, how it is given to a supervisor, or by one, in another process."""
        self.successions: list[Succession] = []
        """The supervisors that begin anew, from above."""
        self.regrouped: list[DraftPlace] = []
        """Those that get another supervisor, or whose own begin anew, with all below them."""
        self.senders: OtherSenders | None = None
        """Who is held because it goes on sending; None: no address changes."""
        self.step = ""
        """The step that is in the way, or has failed."""

    def touch(self, place: DraftPlace, step: Operation, *, only_recipe: bool = False, is_told: bool = False) -> None:
        """A step is about this supervisor."""
        self._steps.setdefault(place, step)
        if not only_recipe:
            self._rearranged.add(place)
        if is_told:
            self._told.add(place)

    def name(self, name: str, step: Operation, before: DraftPlace | None, after: DraftPlace | None) -> None:
        """A step gives this name to somebody, or to nobody any more."""
        self._names[name] = (step, before, after)

    @property
    def _places(self) -> list[DraftPlace]:
        """Those that change, from above. What is added begins as its spec says, but others may come there."""
        there = [place for place in self._steps if not place.is_planned or place.is_moved_to]
        return sorted(there, key=lambda one: one.path.count("/"))

    def ready(self, system: ActorSystem) -> str:
        """What is in the way of a commit at this very instant, in words; "" if nothing is.

        Raises:
            HoldfastError: it cannot be done any more.
        """
        for place in self._places:
            self.step = self._steps[place].text
            cell = place.living(system._node)
            if is_elsewhere(cell) or place not in self._rearranged:
                continue
            if why := busy(cell):
                return why
            for name, child in place.children.items():
                is_taken = child_of(cell, name) is not None or name in (cell.children or {})
                if child.has_moved and is_taken and name not in place.was.children:
                    raise wrong(place.path, f"it has a child {name!r} already")
        return self._names_ready(system._node)

    def _names_ready(self, node: Node) -> str:
        for name, (step, before, after) in self._names.items():
            self.step = step.text
            holder = node.names.get(name)
            cell = after.living(node) if after is not None else None
            if holder is not None and holder is not cell and (before is None or holder is not before.now(node)):
                raise NameTaken(name)  # Its holder has ended meanwhile, and another one has it: that one keeps it.
            if cell is not None and cell.state is not RUNNING:
                return f"{cell.path} is being restarted"
        return ""

    def commit(self, system: ActorSystem) -> None:
        """Have the tree and the names be as the steps say, at once."""
        self._arrange(system)
        node, after = system._node, {name: place for name, (_, _, place) in self._names.items()}
        for name, place in after.items():
            if place is None or node.names.get(name) is not place.living(node):
                node.unregister(name)
        for name, place in after.items():
            if place is not None:
                node.register(name, place.living(node))

    def _arrange(self, system: ActorSystem) -> None:
        cells = {place: place.living(system._node) for place in self._places}
        here = {
            place: cell.actor
            for place, cell in cells.items()
            if place in self._rearranged and isinstance(cell.actor, Supervisor)
        }
        changed = [place for place in cells if place in self._rearranged]
        moved = [
            child
            for place in changed
            for child in place.children.values()
            if child.has_moved and child in self.handings
        ]
        was = {child: f"{cells[_left(child)].path}/{child.name}" for child in moved}
        if moved or self.successions:
            settle_bindings(system._node.root)
        taken = {child: _taken(child, self.handings[child], here, cells) for child in moved}
        notes = system._mechanism_notes
        declared = {child: notes.as_declared(taken[child].spec, path) for child, path in was.items()}
        for place, supervisor in here.items():
            _arrange(place, supervisor, taken, declared)
        _readdress(cells, here, taken)
        now = {path: f"{cells[_below(child)].path}/{child.name}" for child, path in was.items()}
        now |= dict(one.leave_tree(system) for one in reversed(self.successions))
        now = {old: new for old, new in now.items() if old != new}
        left = {one.left for one in self.successions}
        renamed = Renamed(now)
        if now and system._node.root is not None:  # First: what comes now is called by addresses as they are now.
            renamed.keep(system._node.root)
        for place in (one.place for one in reversed(self.successions)):
            place.was.start = _start_after(place, renamed.start(_start_before(place)), taken)
        for place, supervisor in here.items():
            _respecify(place, supervisor)
        for place, cell in [(place, cell) for place, cell in cells.items() if place not in left]:
            if place.was.start is None:
                keep(cell, lambda flags, specs, place=place: _edited(place, flags, specs, taken))  # type: ignore[misc]
            elif not isinstance(cell.host.place, OutsidePlace):  # Else it stands in the recipe of one above it.
                respec(cell, place.was.start)
        if now:
            system._homes.move(now)
            system._mechanism_notes.moved(now)
        for place, cell in cells.items():
            if place.is_noted and is_elsewhere(cell):  # It hears of it later, and may die before.
                for child in place.children.values():
                    spec = (
                        taken[child].spec if child in taken else child.was.start and planned_spec(child, in_force=True)
                    )
                    if spec is not None:
                        system._homes.note(child_key(cell.path, child.name), pack_data(spec, f"child {child.name!r}"))
        for child in moved:  # Before anything else is said to their processes.
            for cell in every_cell(taken[child].cell) if was[child] in now else ():
                cell.host.place.readdress(cell, was[child], now[was[child]])
            top = taken[child].cell
            if top is not None:
                self.handings[child].commit(top)
        for one in reversed(self.successions):
            one.commit(system)
        for place, cell in [(place, cells[place]) for place in changed if place not in left]:
            # Its next life may begin in the process that it is in.
            start = place.was.start or recipe(cell)
            if start is not None and isinstance(cell.host.place, OutsidePlace):
                cell.host.told(cell, "recipe", {"start": pack_recipe(start, cell.path)})
        if now:
            tell_bindings(system._node.root, {new: old for old, new in now.items()})

    async def finish(self, system: ActorSystem) -> None:
        """Tell those that live in other processes."""
        for place in self._told:
            cell = place.living(system._node) if not place.is_planned else None
            if cell is not None and is_elsewhere(cell):
                ref: ActorRef[Supervisor] = ActorRef(cell)
                come = {
                    one.name: self.handings[one]
                    for one in place.children.values()
                    if one in self.handings and one.is_given_away
                }
                specs = [
                    come[spec.id].spec_on_the_way(spec) if spec.id in come else spec
                    for spec in recipe_specs(cell) or ()
                ]
                children = None if place.is_dynamic else specs
                await ref.ask(ChangeSupervisor(flags=recipe_flags(cell), children=children), START_TIMEOUT)


def every_cell(top: Cell | None) -> Iterator[Cell]:
    """An actor, if there is one, and all below it."""
    waiting = [] if top is None else [top]
    while waiting:
        cell = waiting.pop()
        waiting.extend((cell.children or {}).values())
        yield cell


def busy(supervisor: Cell) -> str:
    """Why a supervisor of this process is not between two turns; "" if it is."""
    actor, more = supervisor.actor, supervisor.more
    if not isinstance(actor, Supervisor) or "_children" not in actor.__dict__ or (more is not None and more.turn):
        return f"{supervisor.path} is in the middle of something"
    return ""


def child_of(supervisor: Cell, name: str) -> Child | None:
    """A child as its supervisor has it, if that lives in this process."""
    actor = supervisor.actor
    return actor._listed().get(name) if isinstance(actor, Supervisor) else None


def settle_bindings(root: Cell | None) -> None:
    """Who is bound to a life that is over is bound to the one that has followed it, wherever that goes now."""
    for cell in every_cell(root):
        if cell.more is None:
            continue
        for bindings in (cell.more.bindings, cell.more.turn.rebinds if cell.more.turn is not None else None):
            for port, target in (bindings or {}).items():
                lives = cell.node.successor(target) if target.state is GONE else None
                if bindings is not None and lives is not None:
                    bindings[port] = lives


def tell_bindings(root: Cell | None, was: dict[str, str]) -> None:
    """Have processes bind their actors to those that have moved by the addresses that these have now."""
    for cell in every_cell(root):
        for port, target in (cell.more.bindings if cell.more is not None else {}).items():
            if renamed(was, target.path) != target.path:
                cell.node.tell_binding(cell, port)


def planned_spec(place: DraftPlace, *, in_force: bool) -> ChildSpec:
    """The spec of a child that is added, with all that the transaction says of it and of those below it.

    Its bindings are those that its start finds, or those that are in force with the transaction.
    """
    spec = place.spec
    assert spec is not None
    bound = {port: to for port, to in place.bindings.items() if port in spec.bindings}
    paths = {port: to.path if in_force or to.cell is None else to.cell.path for port, to in bound.items()}
    changes: dict[str, Any] = {}
    if any(spec.bindings[port] != path for port, path in paths.items()):
        changes["bindings"] = {**spec.bindings, **paths}
    if place.was.start is not None:  # It takes the place of another one.
        start, begins_with = place.was.start, None
        if not in_force and place.is_supervisor:
            planned = (one for one in place.children.values() if one.is_planned)
            begins_with = place.flags, tuple(planned_spec(one, in_force=in_force) for one in planned)
        changes["start"] = Start(start.kind, start.args, start.kwargs, begins_with)
    elif place.flags is not None and len(spec.start.args) == 2 and not place.is_dynamic:
        below = tuple(
            planned_spec(one, in_force=in_force)
            for one in place.children.values()
            if one.is_planned and one.spec is not None and not one.is_leaving
        )
        changes["start"] = Start(spec.start.kind, (place.flags, below), spec.start.kwargs)
    elif place.flags is not None and len(spec.start.args) == 2:
        changes["start"] = Start(spec.start.kind, (place.flags, spec.start.args[1]), spec.start.kwargs)
    # A copy is checked anew, and a commit makes one for each child that is added, with no pause in between.
    return dataclasses.replace(spec, **changes) if changes else spec


def _start_before(place: DraftPlace) -> Start[Any]:
    """What the next life of one whose place is taken would have begun with."""
    assert place.was.start is not None
    return place.was.start


def _start_after(place: DraftPlace, start: Start[Any], taken: dict[DraftPlace, Child]) -> Start[Any]:
    """The same of the one that takes the place, with the children that the transaction gives it."""
    flags, specs = recipe_parts(start)
    if flags is None or specs is None:
        return start
    flags, specs = _edited(place, flags, specs, taken)
    return Start(start.kind, (flags, start.args[1] if place.is_dynamic else specs), start.kwargs)


def _below(place: DraftPlace) -> DraftPlace:
    """Whose child it is now."""
    assert place.parent is not None
    return place.parent


def _left(place: DraftPlace) -> DraftPlace:
    """Whose child it was before the transaction."""
    assert place.was.below is not None
    return place.was.below


def _taken(
    child: DraftPlace, handing: Handing, here: dict[DraftPlace, Supervisor], cells: dict[DraftPlace, Cell]
) -> Child:
    """The child as its new supervisor has it from now on; the old one, if it lives in this process, has it no more."""
    if _left(child) in here:
        one = lose_child(here[_left(child)], child.name, _left(child))
        one.spec = handing.spec(one.spec)
        return one
    cell, above = child.cell, cells[_below(child)]
    assert cell is not None
    known = recipe_spec(cell) or child.spec
    assert known is not None
    spec = handing.spec(known)
    if _below(child) in here:
        spec = complete(above, spec)
    cell.spec, cell.extra().start = spec, spec.start
    return Child(spec, cell, UP, up_since=cell.node.loop.time())


def lose_child(supervisor: Supervisor, name: str, place: DraftPlace | None) -> Child:
    """A supervisor of this process has a child no more. Whoever takes its place comes to what it has noted."""
    if place is not None and place.was.start is not None:
        return supervisor._children.pop(name)
    return supervisor._give_away(name)


def _arrange(
    place: DraftPlace,
    supervisor: Supervisor,
    taken: dict[DraftPlace, Child],
    declared: dict[DraftPlace, ChildSpec],
) -> None:
    """The children in the order of the draft; those that came meanwhile, and are not known there, behind them."""
    known, children = supervisor._children, dict[str, Child]()
    for child in place.children.values():
        if child in taken:
            supervisor._welcome(taken[child], declared[child])
    for name, child in place.children.items():
        one = taken.get(child) or known.get(name)
        if one is None and child.comes_last:
            one = Child(planned_spec(child, in_force=True), candidate=child.candidate)
        if one is not None:
            children[name] = one
    supervisor._children = {**children, **{name: one for name, one in known.items() if name not in children}}
    if place.wanted:
        supervisor._set_flags(dataclasses.replace(supervisor._flags, **place.wanted))


def _readdress(
    cells: dict[DraftPlace, Cell], here: dict[DraftPlace, Supervisor], taken: dict[DraftPlace, Child]
) -> None:
    """Each cell below the supervisor that has it now, in the order of the children."""
    moved: dict[DraftPlace, Cell] = {}
    for child, one in taken.items():
        if one.cell is not None and one.cell.state is not GONE and one.cell.parent is not None:
            (one.cell.parent.children or {}).pop(child.name, None)
            moved[child] = one.cell
    for child, cell in moved.items():  # If it is between two lives, the old supervisor hands on what it hears of it.
        above = cells[_below(child)]
        above.children = {**(above.children or {}), child.name: cell}
        cell.parent = above
    for supervisor in here.values():
        cell = supervisor.ctx._cell
        below = cell.children or {}
        first = {name: below[name] for name in supervisor._children if name in below}
        cell.children = {**first, **below}


def _respecify(place: DraftPlace, supervisor: Supervisor) -> None:
    """What the specs say from now on; who comes now has an address, at which messages wait for its start."""
    for name, child in place.children.items():
        one = supervisor._children.get(name)
        if one is None:
            continue
        if child.is_planned:
            before, one.spec = one.spec, planned_spec(child, in_force=True)
            supervisor._respecified(one, before)
        elif child.is_switched and child.spec is not None:
            one.spec = dataclasses.replace(one.spec, autostart=child.spec.autostart)
        else:
            continue
        if child.comes_last:
            try:
                child.cell = one.cell = new_cell(supervisor.ctx._cell, one)
            except HoldfastError:
                pass  # Its start will say so.
        elif one.cell is not None:
            one.cell.spec, one.cell.extra().start = one.spec, one.spec.start


def _edited(place: DraftPlace, flags: Flags, specs: Specs, taken: dict[DraftPlace, Child]) -> tuple[Flags, Specs]:
    """A supervisor's recipe as it is from now on."""
    known = {spec.id: spec for spec in specs}
    left = place.was.children - place.children.keys()
    after: list[ChildSpec] = []
    children: Iterable[DraftPlace] = place.children.values()
    if place.is_uniform:  # It begins with as many as its recipe says, in that order.
        children = [place.children[name] for name in known if name in place.children]
    for child in children:
        was = known.pop(child.name, None)
        spec, is_new = was, child.is_planned or child in taken
        if child.is_planned:
            spec = planned_spec(child, in_force=True)
        elif child in taken:
            spec = taken[child].spec
        elif spec is not None and child.is_switched and child.spec is not None:
            spec = dataclasses.replace(spec, autostart=child.spec.autostart)
        is_known = was is not None and place.was.start is not None
        if spec is not None and not child.is_leaving and (is_known or not (is_new and spec.restart == "temporary")):
            after.append(spec)
    after += [spec for name, spec in known.items() if name not in left]
    return dataclasses.replace(flags, **place.wanted), tuple(after)
