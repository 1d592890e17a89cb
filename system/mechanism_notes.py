"""Notes in the store of mechanisms that differ from the specs, for the next root.

One note holds all of them, so that a transaction that changes several is there as a whole or not at all: a root that
dies in the middle of one leaves everything as it was. Another note says what was under way then.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import msgspec

from ..actors.errors import SpecError
from ..actors.events import Event
from ..checkpoint.addresses import is_at, renamed
from ..supervision.respec import rebuilt, spec_below
from ..supervision.spec import ChildSpec

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ..actors.kernel.cell import Cell
    from ..checkpoint.home.homes import Homes

KEPT = "mechanisms"
"""The note with what there is."""
UNDER_WAY = "adapting "
"""How the notes begin that say at which address a change was under way."""


def part_of(address: str) -> str:
    """Why something is not done to what the mechanism of this address has below it."""
    how = "protect or update"
    return f"it is a part of the mechanism of {address}, whose replicas must stay alike: change that by {how}"


def check_no_part(cell: Cell) -> None:
    """Whether an actor is not what a mechanism has below the address that it protects. Raises SpecError."""
    above = cell.parent
    while above is not None:
        if isinstance(above.spec, ChildSpec) and above.spec.mechanism is not None:
            raise SpecError(cell.path, part_of(above.path))
        above = above.parent


class AdaptationUndone(Event, frozen=True, eq=False):
    """The last root has died while it changed the mechanism of this address: it is as it was before."""

    step: str


class MechanismNotes:
    """What the mechanisms of addresses have become; `completed` gives them to the specs of this root."""

    def __init__(self, homes: Homes) -> None:
        self._homes = homes
        found = homes.notes(KEPT).get(KEPT)
        self._kept: dict[str, tuple[Any, ...]] = msgspec.msgpack.decode(found) if found else {}
        self._loaded = set(self._kept)  # those that no spec of this root has got yet
        self._is_dirty = False
        homes.on_dismissed.append(self.gone)
        for key, step in homes.notes(UNDER_WAY).items():
            homes.note(key, None)
            homes.node.emit(AdaptationUndone(key.removeprefix(UNDER_WAY), step.decode()))

    def completed(self, spec: ChildSpec, address: str) -> ChildSpec:
        """A spec with the mechanism that the address has: each time it is started as the program says.

        Raises:
            SpecError: that mechanism cannot be had any more.
        """
        if spec.is_supervisor and spec.isolation == "process":
            spec = self._completed_below(spec, address)
        said = self._kept.get(address)
        if said is None:
            return spec
        from ..ftm.model.mechanism import MechanismRefused

        is_first = address in self._loaded
        self._loaded.discard(address)
        declared, current, *before = said
        if _data(spec.mechanism) != declared:  # It is in force already, or the program says something else now,
            if is_first:  # which is newer.
                self.forget(address)
            return spec
        if before and is_first:  # The last root has not lived to see whether it stays.
            (current,) = before
            self._keep(address, declared, current)
            self.flush()
            self._homes.node.emit(AdaptationUndone(address, "probation"))
        try:
            mechanism = _mechanism(current)
        except MechanismRefused as error:
            raise SpecError(address, f"the mechanism that it had cannot be had any more: {error}") from error
        return dataclasses.replace(spec, mechanism=mechanism)

    def as_declared(self, spec: ChildSpec, address: str) -> ChildSpec:
        """A spec in force with the mechanism that is declared for the address."""
        said = self._kept.get(address)
        return spec if said is None else dataclasses.replace(spec, mechanism=_mechanism(said[0]))

    def _completed_below(self, spec: ChildSpec, address: str) -> ChildSpec:
        """The same for all that its process will start, which does not ask here."""
        above = f"{address}/"
        for path in [path for path in self._kept if path.startswith(above)]:
            names = path.removeprefix(above).split("/")
            child = spec_below(spec.start, names)
            if child is not None:
                other = self.completed(child, path)
                spec = dataclasses.replace(spec, start=rebuilt(spec.start, names, functools.partial(_instead, other)))
        return spec

    def declared(self) -> dict[str, Any]:
        """Which mechanisms the specs of addresses declare, of all that have others now."""
        return {address: _mechanism(declared) for address, (declared, *_) in self._kept.items()}

    def put(self, address: str, before: Any, after: Any, *, is_trusted: bool = True) -> None:
        """The address has another mechanism from now on; kept with all others by the next `flush`.

        If that `is_trusted` only when it is `settled`, the next root has the last one that was.
        """
        declared, _, *last = self._kept.get(address, (_data(before), None))
        self._keep(address, declared, _data(after), *([] if is_trusted else last or [_data(before)]))

    def settled(self, address: str, mechanism: Any) -> None:
        """A mechanism that was put there is trusted from now on."""
        declared, current, *last = self._kept.get(address, (None, None))
        if last:
            self._keep(address, declared, current, _data(mechanism))

    def _keep(self, address: str, declared: Any, current: Any, *last: Any) -> None:
        self._kept.pop(address, None)
        last = tuple(one for one in last if one != current)
        if current != declared or last:
            self._kept[address] = (declared, current, *last)
        self._is_dirty = True

    def forget(self, address: str) -> None:
        """Whoever lives there next has what its spec says."""
        if self._kept.pop(address, None) is not None:
            self._is_dirty = True
            self._loaded.discard(address)
            self.flush()

    def gone(self, address: str) -> None:
        """Who lives there, and below it, is removed for good: whoever is started there next is another one."""
        below = f"{address}/"
        for one in [one for one in self._kept if one == address or one.startswith(below)]:
            self.forget(one)

    def forget_below(self, top: str, dry_run: bool = False) -> int:
        """Forget what was noted of an address, and of those below it: how many notes that were, or (`dry_run`) are."""
        noted = sum(is_at(address, top) for address in self._kept)
        if not dry_run:
            self.gone(top)
        return noted

    def moved(self, names: Mapping[str, str]) -> None:
        """Actors have other addresses from now on, and all below them: where they live now, by where they did."""
        kept = {renamed(names, address): said for address, said in self._kept.items()}
        self._loaded = {renamed(names, address) for address in self._loaded}
        self._is_dirty = self._is_dirty or kept.keys() != self._kept.keys()
        self._kept = kept
        self.flush()

    def flush(self) -> None:
        """Write what has changed to the store."""
        if self._is_dirty:
            self._is_dirty = False
            self._homes.note(KEPT, msgspec.msgpack.encode(self._kept) if self._kept else None)

    def begun(self, address: str, step: str) -> None:
        """A change is under way."""
        self._homes.note(UNDER_WAY + address, step.encode())

    def over(self, address: str) -> None:
        """It is over, either way."""
        if UNDER_WAY + address in self._homes.notes(UNDER_WAY + address):
            self._homes.note(UNDER_WAY + address, None)


def _instead(other: ChildSpec, spec: ChildSpec) -> ChildSpec:
    return other


def _mechanism(data: Any) -> Any:
    """Layers from plain data. Raises MechanismRefused: they cannot be had any more."""
    from ..ftm.model.mechanism import Description, revive

    layers = tuple(map(revive, msgspec.convert(data or [], list[Description])))
    return None if not layers else layers[0] if len(layers) == 1 else layers


def _data(mechanism: Any) -> Any:
    """Layers as plain data; None if there are none."""
    if mechanism is None:
        return None
    layers = mechanism if isinstance(mechanism, tuple) else (mechanism,)
    return msgspec.msgpack.decode(msgspec.msgpack.encode([layer.describe() for layer in layers]))
