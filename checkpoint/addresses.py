"""Addresses that actors have left: where each actor is now, and under which key the store keeps its data.

What is recorded of an actor stays under the key that it was first kept under, whatever its address becomes: a move to
another supervisor writes one note instead of a journal. Both tables are in the store, so the next root has them too:
who kept only an old address, in a state or in a message that waits, still reaches the actor.

What recorded actors hold in registries is noted by both addresses, and moves along. A tree of addresses tells which of
them are below another one, without a look at all the others.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import msgspec

from ..actors.errors import HoldfastError
from ..actors.kernel.cell import Cell
from ..actors.persistence import ENTRIES, entries_key
from .engine_calls import Called

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from ..actors.kernel.node import Node
    from .absentees import Absentees
    from .journal import Journal

LEFT = "moved from "
"""How the note begins that an address was left; the address follows, and the note is where its actor lives now."""
LED = "bound to "
"""How the note begins of where an actor's bindings have led; the actor's key follows."""
FORMER = 16
"""Addresses that a binding led to before the last snapshot that are remembered."""
KEY = "recorded under "
"""How the note begins of an actor whose key is not its address; the address follows, and the note is the key."""


def is_of_actor(key: str) -> bool:
    """Whether a key of a store is that of an actor: those of the root's own lists (`quarantine`, `far`) have no slash.

    Snapshots of actors are a `Meta` each. Those of a list are the list itself, and refer to nothing else.

    >>> is_of_actor("/app/a"), is_of_actor("quarantine")
    (True, False)
    """
    return key.startswith("/")


def is_at(path: str, top: str) -> bool:
    """Whether an address is another one, or below it.

    >>> is_at("/app/a/b", "/app/a"), is_at("/app/ab", "/app/a")
    (True, False)
    """
    return path == top or path.startswith(f"{top}/")


class Addresses:
    """Where those live who were moved. An address that was left is forgotten when somebody else comes to live there."""

    def __init__(
        self, node: Node, journal: Journal, recorded: Callable[[str], Cell | None], absentees: Absentees
    ) -> None:
        self._node, self._journal, self._recorded, self.absentees = node, journal, recorded, absentees
        self._left = {at.removeprefix(LEFT): now.decode() for at, now in journal.notes(LEFT).items()}
        keys = {at.removeprefix(KEY): key.decode() for at, key in journal.notes(KEY).items()}
        self._keys = journal.keys if isinstance(journal, Called) else {}  # Of what is in memory only, nothing is read.
        self._keys.update(keys)
        self.registered, self.led = RegisteredKeys(journal), FormerTargets(journal)
        self._watched: set[str] = set()
        for path in self._left:
            self._watch(path)

    # -- where they are -----------------------------------------------------------------------------------------------

    def now(self, path: str) -> str:
        """The address that an actor has now which is known by this one: the same, unless it has moved."""
        return renamed(self._left, path) if self._left else path

    def known_as(self, path: str) -> Iterator[str]:
        """All addresses that lead to whom this one leads to."""
        now = self.now(path)
        yield now
        for was, at in self._left.items():
            if is_at(now, at):
                yield was + now[len(at) :]

    def left_below(self, above: str) -> list[str]:
        """The addresses below another one whose actors live elsewhere now."""
        return [path for path in self._left if path.startswith(f"{above}/")]

    def left(self, top: str) -> dict[str, str]:
        """Where those live now who have left an address, or one below it."""
        return {path: now for path, now in self._left.items() if path == top or path.startswith(f"{top}/")}

    def put_back(self, left: Mapping[str, str]) -> None:
        """Whoever came to live at these addresses has not stayed: those are meant again who had left them.

        Raises:
            HoldfastError: the store refused.
        """
        for path, now in left.items():
            if self._at(path) is None:
                self._put(path, now)

    def find(self, path: str) -> Cell | None:
        """Who lives at an address where the node has nobody: one that waits for its next life, or has moved."""
        found = self._recorded(path)
        if found is not None or not self._left:
            return found
        now = self.now(path)
        return None if now == path else self._at(now) or self._recorded(now)

    def _at(self, path: str) -> Cell | None:
        at: Cell | None = self._node.root
        for name in path.split("/")[2:]:
            at = (at.children or {}).get(name) if at is not None else None
        return at

    def forget(self, top: str, dry_run: bool = False) -> int:
        """Forget which addresses lead to one, or to those below it, where nothing is any more; how many they are.

        Raises:
            HoldfastError: the store refused.
        """
        found = [path for path, now in self._left.items() if is_at(now, top)]
        for path in [] if dry_run else found:
            self._put(path, None)
        return len(found)

    # -- moves --------------------------------------------------------------------------------------------------------

    def moved(self, names: Mapping[str, str]) -> None:
        """Actors have other addresses from now on, and all below them: where they live now, by where they did.

        Raises:
            HoldfastError: the store refused.
        """
        left = dict(self._left)
        for old, now in left.items():
            self._put(old, renamed(names, now))
            if (again := renamed(names, old)) != old:  # Refs to who had left an address below know it by this now.
                self._put(again, renamed(names, now))
        for was, now in names.items():
            self._put(was, now)
        for path in list(self._left):
            if self._at(path) is not None or self._left[path] == path:
                self._put(path, None)

    def _put(self, path: str, now: str | None) -> None:
        if self._left.get(path) == now:
            return
        if now is None:
            del self._left[path]
        else:
            self._left[path] = now
            self._watch(path)
        self._journal.note(LEFT + path, None if now is None else now.encode())

    def _watch(self, path: str) -> None:
        if path not in self._watched:
            self._watched.add(path)
            self._node.awaited.setdefault(path, []).append(functools.partial(self._come, path))

    def _come(self, path: str) -> None:
        """Somebody else lives there now."""
        self._watched.discard(path)
        if path in self._left:
            try:
                self._put(path, None)
            except HoldfastError:
                pass  # The next root forgets it in the same way.

    # -- keys ---------------------------------------------------------------------------------------------------------

    def key(self, path: str) -> str:
        """Under which name the store has what is recorded at an address."""
        return self._keys.get(path, path)

    def rename(self, names: Mapping[str, str]) -> None:
        """What is recorded at these addresses, by name, is that of other ones now: the new one, by the old one.

        Raises:
            HoldfastError: the store refused.
        """
        keys = {now: self.key(was) for was, now in names.items()}
        for was in names:
            self._name(was, None)
        for now, key in keys.items():
            self._name(now, key)

    def settle(self, path: str) -> None:
        """Something is about to be recorded at an address; one that was left has its key no more.

        Raises:
            HoldfastError: the store refused.
        """
        taken = self._keys.values()
        if path in self._keys or path not in taken:
            return
        number = next(n for n in range(1, len(self._keys) + 2) if f"{path}//{n}" not in taken)
        self._name(path, f"{path}//{number}")  # No actor's name is empty.

    def is_lent(self, path: str) -> bool:
        """Whether the store has, under the name of this address, what is recorded at another one."""
        return path not in self._keys and path in self._keys.values()

    def erased(self, path: str) -> None:
        """Nothing is recorded at an address any more.

        Raises:
            HoldfastError: the store refused.
        """
        self.led.erased(self.key(path))
        self._name(path, None)

    def _name(self, path: str, key: str | None) -> None:
        key = None if key == path else key
        if self._keys.get(path) == key:
            return
        self._journal.note(KEY + path, None if key is None else key.encode())
        if key is None:
            del self._keys[path]
        else:
            self._keys[path] = key


def renamed(names: Mapping[str, str], path: str) -> str:
    """What an address is now, if it, or one above it, is among these names."""
    above, below = path, ""
    while above and above not in names:
        above, _, name = above.rpartition("/")
        below = f"/{name}{below}"
    return names[above] + below if above else path


class FormerTargets:
    """Where the bindings of recorded actors lead, and have led: all since the last snapshot, and a few before it.

    What a turn has sent through a binding comes out of its replay for whoever the binding leads to now. The next root
    has to know that too, whether it was bound anew while the last one worked, or the program says something else now.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._led: dict[str, dict[str, list[str]]] = {
            key.removeprefix(LED): msgspec.msgpack.decode(value, type=dict[str, list[str]])
            for key, value in journal.notes(LED).items()
        }

    def bound(self, key: str, targets: Mapping[str, str], *, is_saved: bool) -> None:
        """These ports of an actor lead to these addresses now.

        `is_saved`: no turn that was before is handled again, but from an older snapshot, if the newest is damaged.

        Raises:
            HoldfastError: the store refused.
        """
        known, led = self._led.get(key, {}), dict[str, list[str]]()
        for port, to in targets.items():
            before = [one for one in known.get(port, ()) if one != to]
            led[port] = [*(before[-FORMER:] if is_saved else before), to]
        led = {**known, **led}
        if led == known:
            return
        self._led[key] = led
        self._journal.note(LED + key, msgspec.msgpack.encode(led))

    def alike(self, key: str, to: str) -> set[str]:
        """The addresses that a binding has led to which leads, or has led, to this one."""
        return {one for led in self._led.get(key, {}).values() if to in led for one in led}

    def erased(self, key: str) -> None:
        """Nothing is recorded of an actor any more. Raises HoldfastError: the store refused."""
        if self._led.pop(key, None) is not None:
            self._journal.note(LED + key, None)


class RegisteredKeys:
    """By which facts the store knows what recorded actors hold in registries."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._registries: dict[str, set[str]] = {}  # by holder
        for key in journal.notes(ENTRIES):
            self._add(key)

    def _add(self, key: str) -> None:
        holder, registry = _addresses(key)
        self._registries.setdefault(holder, set()).add(registry)

    def noted(self, key: str, value: bytes | None) -> None:
        """Take note of a fact that was kept, or (None) forgotten."""
        if value is not None:
            self._add(key)
            return
        holder, registry = _addresses(key)
        left = self._registries.get(holder, set())
        left.discard(registry)
        if not left:
            self._registries.pop(holder, None)

    def erase(self, holder: str) -> None:
        """Forget what an actor holds. Raises HoldfastError: the store refused."""
        for registry in list(self._registries.get(holder, ())):
            key = entries_key(holder, registry)
            self._journal.note(key, None)
            self.noted(key, None)

    def rename(self, names: Mapping[str, str]) -> None:
        """Actors have moved, with all below them. Raises HoldfastError: the store refused."""
        moved: dict[str, bytes | None] = {}
        for holder, registries in self._registries.items():
            for registry in registries:
                was = entries_key(holder, registry)
                now = entries_key(renamed(names, holder), renamed(names, registry))
                if now != was:
                    moved.setdefault(was, None)
                    moved[now] = self._journal.noted(was)
        for key, value in moved.items():
            self._journal.note(key, value)
            self.noted(key, value)


def _addresses(key: str) -> tuple[str, str]:
    """The addresses of the holder and of the registry."""
    holder, _, registry = key.removeprefix(ENTRIES).partition("\n")
    return holder, registry


class AddressTree:
    """A set of addresses; what is asked of one costs what is at and below it.

    >>> tree = AddressTree(["/app/a", "/app/a/b/c", "/app/ab"])
    >>> sorted(tree.below("/app/a")), tree.has("/app/a/b"), "/app/a/b" in tree
    (['/app/a/b/c'], True, False)
    >>> sorted(tree.below("")) == ["/app/a", "/app/a/b/c", "/app/ab"]
    True
    """

    __slots__ = ("_below", "_paths")

    def __init__(self, paths: Iterable[str] = ()) -> None:
        self._paths: set[str] = set()
        self._below: dict[str, dict[str, None]] = {}  # by address, those directly below it that lead to one of ours
        for path in paths:
            self.add(path)

    def __contains__(self, path: str) -> bool:
        return path in self._paths

    def has(self, path: str) -> bool:
        """Whether this address, or one below it, is among them."""
        return path in self._paths or path in self._below

    def add(self, path: str) -> None:
        """Add an address; once is enough."""
        self._paths.add(path)
        while path and path not in self._below.get(above := path.rpartition("/")[0], ()):
            self._below.setdefault(above, {})[path] = None
            path = above

    def discard(self, path: str) -> None:
        """Take an address out, if it is there."""
        self._paths.discard(path)
        while path and not self.has(path):
            above = path.rpartition("/")[0]
            siblings = self._below.get(above, {})
            siblings.pop(path, None)
            if not siblings:
                self._below.pop(above, None)
            path = above

    def below(self, top: str) -> Iterator[str]:
        """Those below an address; none may come or go meanwhile."""
        waiting = [iter(self._below.get(top, ()))]
        while waiting:
            path = next(waiting[-1], None)
            if path is None:
                waiting.pop()
                continue
            if path in self._paths:
                yield path
            waiting.append(iter(self._below.get(path, ())))
