"""The specification in force, kept in the store, so that the next root has the tree that transactions made.

The program says what it starts below the root, and each such spec has a note here as soon as a transaction has made
another one of it: of which the change was made, and what has become of it. The next root that starts that very spec
starts the changed one, or nothing, if it was removed or lives below a supervisor now: then the note is an address, or
"". If the program has changed, its word is newer. Mechanisms have notes of their own
(`mechanism_notes.py`), for they are on trial at first; the specs here are as if those were still to be attached.
"""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import hashlib
from collections.abc import Awaitable, Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, TypeVar, cast

import msgspec

from ..actors.errors import HoldfastError, SpecError, UnsavableValue, type_name
from ..actors.events import Event
from ..actors.kernel.actor import Start
from ..actors.process.wire.start_codec import pack_data, unpack_data
from ..checkpoint.addresses import is_at
from ..supervision.awaited import not_there
from ..supervision.children import Child
from ..supervision.respec import rebuilt
from ..supervision.spec import ChildSpec, Flags
from ..supervision.supervisor import Supervisor, listed_at
from .script import find_only_here

if TYPE_CHECKING:
    from ..checkpoint.home.homes import Homes
    from .transaction.draft import DraftPlace

T = TypeVar("T")

KEPT = "specification "
"""How the notes begin; the address of a child of the root follows, or that of the root itself."""
FEW = 100
"""Specs of children that may have ended, before it is looked which have."""
TOGETHER = 50
"""So many specs are packed before others have their turn."""
GONE = (
    "put what is missing back where the program can import it, and nothing is lost; without it, change any option of "
    "this child's spec in the program (say `shutdown`): its spec counts then, what transactions have changed at this "
    "address and below is void, and all recorded states stay (`system.start(spec, fresh=True)` would erase those too)"
)
"""What to do when a kept spec cannot be had any more."""


class SpecificationSuperseded(Event, frozen=True, eq=False):
    """The program starts another spec here than the one that transactions had changed: what they made of it is void."""


class SpecificationNotKept(Event, frozen=True, eq=False):
    """A spec that transactions have made cannot be stored, or not be had any more: the next root goes without it."""

    why: str


class Specifications:
    """What transactions have made of the children of the root, for this root and the next one."""

    def __init__(self, homes: Homes, *, is_kept: bool) -> None:
        self._homes, self._is_kept = homes, is_kept
        self._kept = {key.removeprefix(KEPT): value for key, value in homes.notes(KEPT).items()}
        self._loaded: dict[str, tuple[bytes | None, bytes]] = {
            address: msgspec.msgpack.decode(value, type=tuple[bytes | None, bytes])
            for address, value in self._kept.items()
        }
        self._declared: dict[str, ChildSpec] = {}  # as the program says
        self._most_declared = FEW
        self._seen: dict[str, ChildSpec] = {}  # the specs of which it is known what is to be kept
        self._packer = Packer()
        self._root, self._root_flags = "", Flags()  # as the program says
        self._order: list[str] = []  # of the children of the root, if that is not the one in which they are started
        self._away: dict[str, str] = {}  # where those live now that were moved away from the root; "": removed
        self._added: set[str] = set()  # children of the root that no program has started
        self.brought: set[str] = set()
        """Those of them that were brought back; a program that starts one itself means another one."""

    def root_in_force(self, address: str, declared: Flags) -> Flags:
        """The flags with which the root is to begin, where the program says `declared`."""
        self._root, self._root_flags = address, declared
        digest, data = self._loaded.pop(address, (None, b""))
        if digest is None:
            return declared
        flags, self._order = unpack_data(data)
        if digest == _digest(pack_data(declared, address)):
            return cast("Flags", flags)
        self._keep_root(declared, self._order)
        if flags != declared:
            self._homes.node.emit(SpecificationSuperseded(address))
        return declared

    def _keep_root(self, flags: Flags, order: list[str]) -> None:
        self._order = order
        if flags == self._root_flags and not order:
            self._keep(self._root, None)
            return
        digest = _digest(pack_data(self._root_flags, self._root))
        self._keep(self._root, msgspec.msgpack.encode((digest, pack_data((flags, order), self._root))))

    def _arrange(self) -> None:
        """Have the children of the root stand as transactions have ordered them, as far as they are there."""
        cell = self._homes.node.root
        supervisor = cell.actor if cell is not None else None
        if cell is not None and isinstance(supervisor, Supervisor) and self._order:
            supervisor._children = in_order(supervisor._listed(), self._order)
            cell.children = in_order(cell.children or {}, self._order)

    def in_force(self, address: str, declared: ChildSpec, *, fresh: bool) -> ChildSpec:
        """What is to be started where the program starts `declared`.

        Raises:
            SpecError: what transactions have made of it cannot be had any more.
        """
        digest, data = self._loaded.get(address, (None, b""))
        if digest is None or fresh or digest != _digest(self._packed(declared)[0]):
            return declared
        return self._revived(address, data)

    def elsewhere(self, address: str, declared: ChildSpec, *, fresh: bool) -> str | None:
        """The address at which that lives which the program starts as `declared`, if it is a child of the root no more.

        `None`: it is to be started. Where it was removed, nobody lives at the address that is returned.
        """
        digest, data = self._loaded.get(address, (None, b""))
        if digest is None or fresh or digest != _digest(self._packed(declared)[0]):
            return None
        where = msgspec.msgpack.decode(data)
        if not isinstance(where, str):
            return None
        del self._loaded[address]
        self._declared[address], self._away[address] = declared, where
        return where or address

    def void_below(self, address: str) -> list[ChildSpec]:
        """What was moved away from the root to below an address where the program says something else now.

        It is there no more. Those that the program has started are returned, to be started where it says.
        """
        back: list[ChildSpec] = []
        for one in [one for one, where in self._away.items() if is_at(where, address)]:
            del self._away[one]
            self._lapse(one)
            back.append(self._declared[one])
        for one, (digest, data) in list(self._loaded.items()):
            noted = msgspec.msgpack.decode(data) if digest is not None else None
            if isinstance(noted, str) and is_at(noted, address):
                del self._loaded[one]
                self._lapse(one)
        return back

    def _lapse(self, address: str) -> None:
        self._keep(address, None)
        self._homes.node.emit(SpecificationSuperseded(address))

    def started(self, address: str, declared: ChildSpec, wanted: ChildSpec, *, fresh: bool) -> list[ChildSpec]:
        """What the program wanted is there: what is said of it from now on is a change.

        Return what is to be started where the program says, for what it has started here is newer (`void_below`).
        """
        is_newer = address in self._loaded and wanted is declared
        self._loaded.pop(address, None)
        self._away.pop(address, None)
        self._added.discard(address)
        if self._is_kept:
            self._declared[address] = declared
            self._forget_ended()
        if wanted is declared:
            self._keep(address, None)
        if is_newer and not fresh:
            self._homes.node.emit(SpecificationSuperseded(address))
        back = self.void_below(address) if is_newer else []
        if self._is_kept:
            self._see(address)
        self._arrange()
        return back

    def _forget_ended(self) -> None:
        """Forget children that have gone for good, now and then: a program may start others without end."""
        if len(self._declared) > self._most_declared:
            there = self._there()
            for address in [one for one in self._declared if one not in there and one not in self._kept]:
                del self._declared[address]
                self._seen.pop(address, None)
            self._most_declared = 2 * len(self._declared) + FEW

    def _see(self, address: str) -> None:
        one = self._children().get(address.rpartition("/")[2])
        if one is not None:
            self._seen[address] = one.spec

    def _children(self) -> dict[str, Child]:
        root = self._homes.node.root
        supervisor = root.actor if root is not None else None
        return supervisor._listed() if isinstance(supervisor, Supervisor) else {}

    def _there(self) -> dict[str, ChildSpec]:
        root = self._homes.node.root
        return {f"{root.path}/{name}": one.spec for name, one in self._children().items()} if root is not None else {}

    def _revived(self, address: str, data: bytes) -> ChildSpec:
        try:
            return unpack(data)
        except HoldfastError as error:
            raise SpecError(
                address, f"what transactions have made of it cannot be had any more: {error}; {GONE}"
            ) from error

    def added(self) -> dict[str, ChildSpec]:
        """Those that transactions have added below the root, and that are not started yet, by address.

        Raises:
            SpecError: one cannot be had any more.
        """
        return {address: self._revived(address, data) for address, (digest, data) in self._loaded.items() if not digest}

    async def start_added(self, start: Callable[[ChildSpec], Awaitable[Any]]) -> None:
        """Start those that transactions have added below the root, as soon as all are there to whom they are bound."""
        while await self._start_some(start):
            continue

    async def _start_some(self, start: Callable[[ChildSpec], Awaitable[Any]]) -> bool:
        node, has_started = self._homes.node, False
        for address, (digest, data) in list(self._loaded.items()):
            if digest is not None or address not in self._loaded:
                continue
            try:
                spec = self._revived(address, data)
            except SpecError as error:
                del self._loaded[address]  # It stays in the store: its class may come back.
                node.emit(SpecificationNotKept(address, str(error)))
                continue
            if not not_there(node, listed_at, address, spec):
                del self._loaded[address]
                self._added.add(address)
                self.brought.add(address)
                try:
                    await start(spec)
                except HoldfastError:
                    continue  # Its supervisor has told so; the others are started all the same.
                self._see(address)
                self._arrange()
                has_started = True
        return has_started

    def check(self, root: DraftPlace) -> None:
        """Whether the next root could start the tree as it would be.

        Raises:
            SpecError: somebody would be bound by its spec to one whom the next root starts later, or be of a class
                that the next root does not find.
        """
        if not self._is_kept:
            return
        tops = [one for one in root.children.values() if not one.is_leaving]
        new = [one for one in tops if one.is_planned or one.has_moved or one.path in self._added]
        added = [one for one in new if one.is_planned or self._away.get(one.path) != one.path_before]  # not back
        by_path = {one.path: one for one in tops if one not in added}
        declared = [by_path[path] for path in self._declared if path in by_path]
        for one in (*declared, *added):
            _refuse_of_scripts(one)
        led = [one for top in (*declared, *added) for one in _led_outside(top) if one[2] in (*declared, *added)]
        order: list[DraftPlace] = []
        waiting = list(added)
        for top in (None, *declared):  # As `system.start` and `start_added` will do it.
            if top is not None:
                order.append(top)
            while (
                come := next(
                    (one for one in waiting if all(to in order for owner, _, to in led if _top(owner) is one)), None
                )
            ) is not None:
                order.append(come)
                waiting.remove(come)
        for owner, port, to in led:
            top = _top(owner)
            if top in order and (to not in order or order.index(to) > order.index(top)):
                why = f"the next root would start it before the one to which its spec binds {port!r}"
                raise SpecError(owner.path, f"{why}, which is below {to.path}")

    async def prepare(self) -> None:
        """Make ready what takes long with many children, so that the commit does not."""
        if not self._is_kept:
            return
        there = self._there()
        for address, declared in self._declared.items():
            waiting, count = [declared], 0
            if address in there:
                waiting.append(there[address])
            while waiting:
                spec = waiting.pop()
                below = _children(spec)
                waiting.extend(below)
                count += 1
                if count % TOGETHER == 0:
                    await asyncio.sleep(0)
                if not below:
                    self._packed(spec)

    def changed(self, added: set[str], removed: set[str], gone: Mapping[str, str], before: Mapping[str, Any]) -> None:
        """A transaction is in force: keep what it has made of the children of the root.

        Args:
            added: the children of the root that it has added or moved there.
            removed: those that it is about to stop.
            gone: the new address of each that it has moved, by the one before, and "" for each that it has removed.
            before: which mechanisms the store says, or will say, that addresses have besides what is kept here.
        """
        if not self._is_kept:
            return
        there = self._there()
        for address, where in {**{one: one for one in gone if one in self._declared}, **self._away}.items():
            self._away[address] = _now_at(where, gone)
        self._added |= {one for one in added if self._away.get(one) != one}  # The others are back.
        for address in sorted({*self._added, *self._declared}):
            spec = there.get(address) if address not in removed else None
            if spec is None:
                self._added.discard(address)
                if address not in self._away:
                    self._keep(address, None)
            elif self._away.pop(address, None) is not None or spec is not self._seen.get(address):
                self._seen[address] = spec
                self._note(address, spec, before)
        for address in list(self._away):
            self._note_away(address, there)
        self._note_root(removed)
        self._packer.forget()

    def _note_root(self, removed: set[str]) -> None:
        root = self._homes.node.root
        supervisor = root.actor if root is not None else None
        if isinstance(supervisor, Supervisor):
            known = {address.rpartition("/")[2]: None for address in self._declared if address not in removed}
            added = {address.rpartition("/")[2] for address in self._added - removed}
            order = [name for name in supervisor._listed() if name in known or name in added]
            started = [name for name in known if name in order]
            self._keep_root(supervisor._flags, order if order != started else [])

    def _note_away(self, address: str, there: Mapping[str, ChildSpec]) -> None:
        where = self._away[address]
        was, why = self._packed(self._declared[address])
        if not why and where and not self._comes_back(where, there):
            why = f"it was moved to {where}, where the next root starts nobody: it is where the program says then"
        if why:
            del self._away[address]
            self._keep(address, None)
            self._homes.node.emit(SpecificationNotKept(address, why))
        else:
            self._keep(address, msgspec.msgpack.encode((_digest(was), msgspec.msgpack.encode(where))))

    def _comes_back(self, address: str, there: Mapping[str, ChildSpec]) -> bool:
        """Whether the next root has somebody at an address below one of its children: by a spec, or by a journal."""
        name, *below = address.removeprefix(f"{self._root}/").split("/")
        top = f"{self._root}/{name}"
        spec = there.get(top) if top in self._kept else self._declared.get(top)
        for name in below:
            if spec is None or _is_journaled(spec):
                break
            spec = next((one for one in _children(spec) if one.id == name), None)
        return spec is not None

    def _note(self, address: str, spec: ChildSpec, before: Mapping[str, Any]) -> None:
        declared = None if address in self._added else self._declared[address]
        was, why = self._packed(declared)
        now, problem = self._packed(_with_mechanisms(address, spec, before))
        if why or problem:
            self._keep(address, None)
            self._homes.node.emit(SpecificationNotKept(address, why or problem))
        elif now is None or was == now:
            self._keep(address, None)
        else:
            self._keep(address, msgspec.msgpack.encode((_digest(was), now)))

    def _packed(self, spec: ChildSpec | None) -> tuple[bytes | None, str]:
        """A spec as bytes, or why it cannot be stored."""
        try:
            return (None if spec is None else self._packer.pack(spec)), ""
        except UnsavableValue as error:  # Its own text is for the state of an actor.
            return None, f"{error.where}: {error.problem} cannot be stored; give the actor what it is made from"
        except HoldfastError as error:
            return None, str(error)

    def forget_below(self, top: str, dry_run: bool = False) -> int:
        """Forget what was noted of an address, and of those below it: how many notes that were, or (`dry_run`) are."""
        noted = [address for address in self._kept if is_at(address, top)]
        for address in [] if dry_run else noted:
            self._keep(address, None)
        return len(noted)

    def _keep(self, address: str, value: bytes | None) -> None:
        if self._kept.get(address) == value:
            return
        self._homes.note(KEPT + address, value)
        if value is None:
            del self._kept[address]
        else:
            self._kept[address] = value


def _now_at(address: str, gone: Mapping[str, str]) -> str:
    """Where somebody lives who lived there, if these were moved or removed, with all that is below them.

    >>> _now_at("/app/a/b/c", {"/app/a": "/app/x", "/app/a/b": "/app/b"})
    '/app/b/c'
    >>> _now_at("/app/a/b/c", {"/app/a": ""})
    ''
    """
    top, rest = address, ""
    while top and top not in gone:
        top, _, name = top.rpartition("/")
        rest = f"/{name}{rest}"
    if not top:
        return address
    return gone[top] and gone[top] + rest


def _refuse_of_scripts(top: DraftPlace) -> None:
    """Refuse a tree of which the store would keep what only a script can define: the next root runs none.

    Raises:
        SpecError: naming who would be of such a class, or be made from an instance of one.
    """
    found: dict[type, DraftPlace] = {}
    for place in top.walk():
        is_noted = place.parent is not None and place.parent.is_noted
        if place.spec is not None and not place.is_leaving and (is_noted or place.comes_back_with(top)):
            for kind in (place.kind, *_classes(place.spec.start if place.is_planned else ())):
                if kind is not None:
                    found.setdefault(kind, place)
    for kind, place in found.items():
        file = find_only_here(kind)
        if file:
            why = f"{type_name(kind)} is defined in {file}, which is there only while the script is"
            what = "the store would keep a spec that the next start of the program cannot have"
            raise SpecError(place.path, f"{why}: {what}; put the class into a module that the program can import")


def _classes(value: Any) -> Iterator[type]:
    """The classes in a recipe, except those of mechanisms, which are found by file; of the children in it too."""
    if isinstance(value, Start):
        yield value.kind
        value = (value.args, value.kwargs, value.begins_with)
    elif isinstance(value, ChildSpec):
        value = value.start
    if isinstance(value, (list, tuple)):
        for one in value:
            yield from _classes(one)
    elif isinstance(value, dict):
        for one in value.values():
            yield from _classes(one)
    elif isinstance(value, Start):
        yield from _classes(value)
    else:
        yield type(value)


def _led_outside(top: DraftPlace) -> list[tuple[DraftPlace, str, DraftPlace]]:
    """The bindings in specs that lead from a child of the root, or from below it, to another: owner, port, that one."""
    found: list[tuple[DraftPlace, str, DraftPlace]] = []
    for place in top.walk():
        if place.spec is None or place.is_leaving or (place is not top and not place.comes_back_with(top)):
            continue
        for port in place.spec.bindings.keys() - place.spec.late:
            target = (place.bindings if place.is_planned else place.was.bound).get(port)
            if target is not None and _top(target) is not top:
                found.append((place, port, _top(target)))
    return found


def _top(place: DraftPlace) -> DraftPlace:
    """The child of the root that it is, or is below."""
    while place.parent is not None and place.parent.parent is not None:
        place = place.parent
    return place


def in_order(children: dict[str, T], order: list[str]) -> dict[str, T]:
    """The same, those that are named in this order where they stand; all others stay at their places.

    >>> list(in_order({"first": 1, "a": 2, "new": 3, "b": 4}, ["b", "gone", "a"]))
    ['first', 'b', 'new', 'a']
    """
    wanted = set(order)
    named = iter([name for name in order if name in children])
    names = [next(named) if name in wanted else name for name in children]
    return {name: children[name] for name in names}


class Packer:
    """Specs as bytes. That of a child is packed once, as long as it stays what it is: a tree changes in few places."""

    def __init__(self) -> None:
        self._made: dict[int, tuple[ChildSpec, Any]] = {}  # by the identity of the spec
        self._used: dict[int, tuple[ChildSpec, Any]] = {}

    def pack(self, spec: ChildSpec) -> bytes:
        """A spec as bytes. Raises HoldfastError: it cannot be stored."""
        return msgspec.msgpack.encode(self.part(spec))

    def part(self, spec: ChildSpec) -> Any:
        """The same as data: its own bytes, and the parts of those below it."""
        known = self._used.get(id(spec)) or self._made.get(id(spec))
        if known is None:
            below = _children(spec)
            own = _with_children(spec, ()) if below else spec
            known = (spec, (pack_data(own, f"child {spec.id!r}"), [self.part(one) for one in below]))
        self._used[id(spec)] = known
        return known[1]

    def forget(self) -> None:
        """What was not asked for since the last time is not kept any longer."""
        self._made, self._used = self._used, {}


def unpack(data: bytes) -> ChildSpec:
    """The spec again. Raises HoldfastError: a class cannot be found, or these are no such bytes."""
    return _unpacked(msgspec.msgpack.decode(data))


def _unpacked(part: Any) -> ChildSpec:
    own, below = part
    spec: ChildSpec = unpack_data(own)
    if below:
        spec = _with_children(spec, tuple(map(_unpacked, below)))
    return spec


def _children(spec: ChildSpec) -> tuple[ChildSpec, ...]:
    """The children that stand in a supervisor's recipe one by one."""
    args = spec.start.args
    below = args[1] if spec.is_supervisor and len(args) == 2 and isinstance(args[1], tuple) else ()
    return below if all(isinstance(one, ChildSpec) for one in below) else ()


def _is_journaled(spec: ChildSpec) -> bool:
    """Whether it is a supervisor that has a journal of its children."""
    flags = spec.start.args[0] if spec.is_supervisor and spec.start.args else None
    return isinstance(flags, Flags) and flags.journal


def _with_children(spec: ChildSpec, below: tuple[ChildSpec, ...]) -> ChildSpec:
    start = spec.start
    return dataclasses.replace(spec, start=Start(start.kind, (start.args[0], below), start.kwargs))


def _digest(packed: bytes | None) -> bytes | None:
    return None if packed is None else hashlib.sha256(packed).digest()


def _with_mechanisms(address: str, spec: ChildSpec, mechanisms: Mapping[str, Any]) -> ChildSpec:
    """The spec with these mechanisms at these addresses, at and below its own."""
    for path, mechanism in mechanisms.items():
        put = functools.partial(_protected, mechanism)
        if path == address:
            spec = put(spec)
        elif path.startswith(f"{address}/"):
            names = path.removeprefix(f"{address}/").split("/")
            spec = dataclasses.replace(spec, start=rebuilt(spec.start, names, put))
    return spec


def _protected(mechanism: Any, spec: ChildSpec) -> ChildSpec:
    return dataclasses.replace(spec, mechanism=mechanism)
