"""The memory of last lines: the newest ones of each address, within bounds for one address and for all together."""

from __future__ import annotations

import dataclasses
import sys
from collections import OrderedDict
from collections.abc import Callable, Iterator
from heapq import merge
from typing import Final, Literal, TypeAlias

import msgspec

from ..history.past_event import shortened
from ..history.ring import EventRing, GoneNumbers
from .followers import Followers

LineLevel: TypeAlias = Literal["debug", "info", "warning", "error", "critical"]
"""How grave a line is, in the words of logging."""
LineSource: TypeAlias = Literal["stdout", "stderr", "holdfast"]
"""Where a line is from: an output of a process, or the log of holdfast itself."""
LEVELS: Final[tuple[LineLevel, ...]] = ("debug", "info", "warning", "error", "critical")
PRINTED: Final[dict[str, LineLevel]] = {"stdout": "info", "stderr": "warning"}
"""What a line counts as that a process prints: it says no level itself."""
LINE_BYTES: Final = 220
"""Bytes that a line takes in memory besides its text, about."""
ADDRESS_BYTES: Final = 3_500
"""Bytes that an address takes in memory besides its lines, at most, with the runs of lines that are gone."""
FILLED: Final = 0.95
"""The part of the memory that is left in use when room has to be made: it is made seldom, for many lines at once."""
LEAST_SHARE: Final = 1_024
"""Bytes of each address that are spared as long as there are addresses with more."""


@dataclasses.dataclass(frozen=True, slots=True)
class LineLimits:
    """How much is kept of the last lines; the oldest give way first.

    Attributes:
        characters: of a line; of a longer one its beginning and its end are kept.
        lines: of one address.
        address_bytes: bytes that the lines of one address may take in memory, about.
        addresses: whose lines are kept; whoever has said nothing for the longest time is forgotten first.
        all_bytes: bytes that all together may take in memory, about. Those with the most lines give way first.
    """

    characters: int = 4_000
    lines: int = 1_000
    address_bytes: int = 256 * 1024
    addresses: int = 500
    all_bytes: int = 4 * 1024 * 1024


class LoggedLine(msgspec.Struct, frozen=True, gc=False):
    """A line that a process of an actor has printed, or that holdfast has logged about an actor.

    Attributes:
        number: rises by one with each line of the system, from 1 in each program.
        at: Unix time at which the root has got it.
        address: whose line it is.
        source: "stdout" or "stderr" of a process, or "holdfast".
        level: in words of logging. A process says none: what it prints to stdout counts as "info", to stderr "warning".
        text: the line, without its end. Control characters are in it as they were printed.
        life: the number of the life that has printed it; 0 if it is not known.
    """

    number: int
    at: float
    address: str
    source: LineSource
    level: LineLevel
    text: str
    life: int = 0

    @property
    def size_bytes(self) -> int:
        """The memory that the line takes, about."""
        return LINE_BYTES + sys.getsizeof(self.text)


class LineMemory:
    """Keeps the last lines of a system.

    Args:
        wall: the clock that says when a line has come, in Unix time.
        limits: how much is kept.

    Attributes:
        last: the number of the newest line; 0 if there was none.
        followers: those who wait for the next line.
    """

    def __init__(self, wall: Callable[[], float], limits: LineLimits | None = None) -> None:
        self._wall, self._limits = wall, limits or LineLimits()
        self._rings: OrderedDict[str, EventRing[LoggedLine]] = OrderedDict()  # whoever has spoken last stands last
        self._forgotten = GoneNumbers()
        self._bytes = 0
        self.last = 0
        self.followers = Followers()

    def add(self, address: str, source: LineSource, level: LineLevel, text: str, life: int = 0) -> None:
        """Keep one more line; others give way to it if there are too many."""
        rings = self._rings
        ring = rings.get(address)
        if ring is None:
            ring = rings[address] = EventRing(self._limits.lines, self._limits.address_bytes)
            self._bytes += ADDRESS_BYTES
        else:
            rings.move_to_end(address)
        before = ring.bytes
        self.last += 1
        ring.add(LoggedLine(self.last, self._wall(), address, source, level, self._short(text), life))
        self._bytes += ring.bytes - before
        if self._bytes > self._limits.all_bytes or len(rings) > self._limits.addresses:
            self._make_room()
        if self.followers:
            self.followers.tell()

    def add_printed(self, address: str, stream: str, text: str, life: int) -> None:
        """Keep a line that a process has printed to this output."""
        self.add(address, "stderr" if stream == "stderr" else "stdout", PRINTED.get(stream, "info"), text, life)

    def _short(self, text: str) -> str:
        return shortened(text, self._limits.characters)

    def _make_room(self) -> None:
        """Have those with the most lines give some; if that does not do, forget who has been silent the longest."""
        rings, limits = self._rings, self._limits
        most = FILLED * limits.all_bytes
        sizes = [ring.bytes for ring in rings.values()]
        share, room = max(sizes), most - ADDRESS_BYTES * len(rings)
        while share > LEAST_SHARE and sum(min(size, share) for size in sizes) > room:
            share = share * 7 // 8
        for ring in rings.values():
            before = ring.bytes
            if before > share:
                ring.shrink(share)
                self._bytes += ring.bytes - before
        fewest = limits.addresses if len(rings) <= limits.addresses else FILLED * limits.addresses
        while (self._bytes > most or len(rings) > fewest) and len(rings) > 1:
            self._forget(next(iter(rings)))

    def forget(self, top: str) -> None:
        """Forget the lines of an address, and of those below it."""
        for address in [one for one in self._rings if one == top or one.startswith(f"{top}/")]:
            self._forget(address)

    def _forget(self, address: str) -> None:
        ring = self._rings.pop(address)
        self._bytes -= ring.bytes + ADDRESS_BYTES
        self._forgotten.add(ring.oldest, ring.newest, ring.gone.count + len(ring))

    # -- giving out -------------------------------------------------------------------------------------------------

    @property
    def bytes(self) -> int:
        """The memory that all lines take together, about."""
        return self._bytes

    def after(self, number: int, is_meant: Callable[[str], bool]) -> Iterator[LoggedLine]:
        """The lines with larger numbers of the addresses that are meant, oldest first."""
        found: list[Iterator[LoggedLine]] = []
        for address, ring in reversed(self._rings.items()):
            if ring.newest <= number:  # Whoever stands before it has been silent for even longer.
                break
            if is_meant(address):
                found.append(ring.after(number))
        return merge(*found, key=lambda line: line.number)

    def dropped(self, after: int, until: int, is_meant: Callable[[str], bool]) -> int:
        """How many lines with numbers behind `after`, up to `until`, have given way to newer ones.

        They are those of the addresses that are meant, and those of addresses that are forgotten altogether.
        """
        gone = [self._forgotten, *(ring.gone for address, ring in self._rings.items() if is_meant(address))]
        return sum(one.after(after) - one.after(until) for one in gone)

    def close(self) -> None:
        """The system has ended: whoever waits for the next line is cancelled."""
        self.followers.close()
