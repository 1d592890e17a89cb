"""What is read from a running system at a scrape: actors, mailboxes, journals and mechanisms, a bit at a time.

Nothing is counted per message for it. The walk gives the event loop back after `SLICE` seconds, so a scrape of many
actors does not hold anybody up; what it finds is then not of one instant.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections import Counter, defaultdict
from collections.abc import Awaitable, Callable, Sequence
from time import perf_counter
from typing import NamedTuple

from ...actors.errors import type_name
from ...actors.kernel.cell import GONE, Cell
from ...actors.kernel.node import cell_kind
from ...checkpoint.home.homes import Homes
from ...ftm.group.protected import protection_of
from .series import Labels

SLICE = 0.001
"""Seconds of walking after which the loop lets others run."""
RUNTIME = __name__.partition(".")[0]
"""The label of all classes of the library itself."""
STRIDE = 16
"""Actors between two looks at the clock."""


class Queued(NamedTuple):
    """Messages that wait at the actors of one class, or are in hand: of all together, and of the one with most."""

    total: int = 0
    longest: int = 0

    def __add__(self, count: object) -> Queued:
        """Take in the messages of one more actor."""
        assert isinstance(count, int)
        return Queued(self.total + count, max(self.longest, count))


@dataclasses.dataclass(slots=True)
class Survey:
    """What a walk over the tree has found."""

    actors: Counter[tuple[str, ...]] = dataclasses.field(default_factory=Counter[tuple[str, ...]])
    """By place ("task", "process", "replicas", "elsewhere") and state."""
    queued: defaultdict[str, Queued] = dataclasses.field(default_factory=lambda: defaultdict[str, Queued](Queued))
    """By class."""
    of_address: dict[str, int] = dataclasses.field(default_factory=dict[str, int])
    """Messages at each address that was chosen."""
    watched: list[Cell] = dataclasses.field(default_factory=list[Cell])
    """Actors whose statistics are on."""
    protected: Counter[tuple[str, bool]] = dataclasses.field(default_factory=Counter[tuple[str, bool]])
    """By mechanisms, outermost first, and whether all replicas are there."""
    no_room: Counter[tuple[str, ...]] = dataclasses.field(default_factory=Counter[tuple[str, ...]])
    """Messages and children for which there was no room so far, by what was full and class."""
    recorded: int = 0
    journal_bytes: int = 0
    journal_inputs: int = 0
    quarantined: int = 0
    asks: int = 0
    seconds: float = 0.0
    """Time that the walk itself took on the loop."""
    longest_slice: float = 0.0
    """The longest time for which it held the loop, in seconds."""


class _Classes:
    """The labels of classes, each found once per walk."""

    def __init__(self, labels: Labels) -> None:
        self._labels = labels
        self._known: dict[type | None, str] = {None: RUNTIME}

    def of(self, kind: type | None) -> str:
        """The label of a class."""
        label = self._known.get(kind)
        if label is None:
            assert kind is not None
            is_ours = kind.__module__.startswith(f"{RUNTIME}.")
            label = self._known[kind] = RUNTIME if is_ours else self._labels.of(type_name(kind))
        return label


class _Pace:
    """Says when to give the loop back, and what the walk has taken of it."""

    def __init__(self, survey: Survey, rest: Callable[[], Awaitable[None]]) -> None:
        self._survey, self._rest = survey, rest
        self._steps = 0
        self._begin = perf_counter()

    async def step(self) -> None:
        """One more is done: rest, if it is time to."""
        self._steps += 1
        if self._steps % STRIDE == 0 and perf_counter() - self._begin > SLICE:
            self.pause()
            await self._rest()
            self._begin = perf_counter()

    def pause(self) -> None:
        """Count what the slice has taken."""
        seconds = perf_counter() - self._begin
        self._survey.seconds += seconds
        self._survey.longest_slice = max(self._survey.longest_slice, seconds)


async def survey(root: Cell, homes: Homes, classes: Labels, chosen: Sequence[str]) -> Survey:
    """Walk over all actors that the root process knows, and all that is recorded.

    Args:
        root: of the tree.
        homes: of its recorded actors.
        classes: the labels of actors' classes.
        chosen: addresses whose mailboxes are told one by one.
    """
    found, wanted, named = Survey(), set(chosen), _Classes(classes)
    pace = _Pace(found, lambda: asyncio.sleep(0))
    waiting = [root]
    while waiting:
        cell = waiting.pop()
        waiting.extend((cell.children or {}).values())
        if cell.state is not GONE:
            _count(found, cell, named, wanted)
        await pace.step()
    for switch in list(homes):
        found.recorded += 1
        found.journal_bytes += switch.ledger.journal_bytes
        found.journal_inputs += len(switch.ledger.open)
        await pace.step()
    found.quarantined = homes.quarantine.count
    for (where, kind), count in root.node.numbers.no_room.items():
        found.no_room[where, named.of(kind)] += count
    found.asks = len(root.node.deadlines.waiting())
    pace.pause()
    return found


def _count(found: Survey, cell: Cell, classes: _Classes, wanted: set[str]) -> None:
    place = cell.host.place
    found.actors[place.kind, cell.state] += 1
    kind = cell_kind(cell)
    label = classes.of(kind)
    count = cell.host.load(cell)
    found.queued[label] += count
    if wanted and cell.path in wanted:
        found.of_address[cell.path] = count
    if cell.more is not None and cell.more.tap is not None and cell.more.tap.counting:
        found.watched.append(cell)
    if place.kind == "replicas":
        status = protection_of(cell)
        found.protected["+".join(status.stack), status.is_whole] += 1
