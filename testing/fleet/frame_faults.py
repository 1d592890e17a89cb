"""Faults of what programs send: a program is killed, or cut off, at the very frame that a seed has drawn."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple

from ..faults import Strikes

if TYPE_CHECKING:
    from .sim_fleet import SimProgram

POST, REQUEST = "post", "request"
"""The points: what a program sends to another one, or to a client; what it asks of the servers of its system."""


class Fate(NamedTuple):
    """What becomes of what is sent.

    Attributes:
        copies: how often it arrives: not at all, once, or twice.
        late: by how many seconds its last copy is late.
    """

    copies: int = 1
    late: float = 0.0


AS_USUAL: Final = Fate()
LOST: Final = Fate(0)


class SentFrame(NamedTuple):
    """What a program sends, as strikes show it."""

    program: str
    to: str

    def __repr__(self) -> str:
        return f"what {self.program} sends to {self.to}"


class SendFaults:
    """What strikes the programs of one fleet where they send something.

    Args:
        later: has something done so many seconds later, whoever has died meanwhile.
    """

    def __init__(self, later: Callable[[float, Callable[[], None]], None]) -> None:
        self._later = later
        self._installed: list[tuple[Strikes, SimProgram | None]] = []

    def add(self, strikes: Strikes, program: SimProgram | None) -> None:
        """Let these strike a program, or any that there is, until they end."""
        one = strikes, program
        self._installed.append(one)
        strikes.at_end(lambda: self._installed.remove(one))

    def fate(self, at: str, program: SimProgram | None, what: str) -> Fate:
        """Draw what becomes of something that a program sends; whatever strikes that program has struck then."""
        if program is None or program not in program.fleet.programs:  # It was stopped, or killed.
            return AS_USUAL
        for strikes, target in self._installed:
            if strikes.at != at or target not in (None, program):
                continue
            match strikes.next(SentFrame(program.name, what)):
                case None:
                    continue
                case "crash":
                    program.fleet.kill(program)
                    return LOST
                case "cut":
                    self._cut(strikes, program)
                    return LOST
                case "split":
                    self._split(strikes, program)
                    return LOST
                case "delay":
                    return Fate(1, strikes.delay())
                case "duplicate":
                    return Fate(2, strikes.delay())
                case _:
                    return LOST
        return AS_USUAL

    def _cut(self, strikes: Strikes, program: SimProgram) -> None:
        """Cut a program off where the fault has struck, until its seconds are over, or the faults are."""
        is_log, servers = strikes.at == REQUEST, program.servers
        servers.cut(log=is_log, lines=not is_log)

        def heal() -> None:
            if not program.is_killed:
                servers.heal(log=is_log, lines=not is_log)

        self._later(strikes.delay(), heal)
        strikes.at_end(heal)

    def _split(self, strikes: Strikes, program: SimProgram) -> None:
        """Leave a program behind, with others that are drawn, until its seconds are over, or the faults are."""
        fleet = program.fleet
        others = [one for one in fleet.parties if one is not program.servers]
        behind = [program.servers, *(one for one in others if strikes.is_hit())]
        strikes.tell(f"left behind: {', '.join(one.name for one in behind)}")
        heal = fleet.split(*behind)
        self._later(strikes.delay(), heal)
        strikes.at_end(heal)
