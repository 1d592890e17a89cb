"""Faults injected at named points from a seed: crash, hang, delay, duplicate, reorder, damage or loss.

A fault is installed on one actor (or one system) by exchanging the function that stands at that point, for as long as
the context is open. Production code has no hooks for it and pays nothing.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

from ..actors.errors import HoldfastError, SpecError
from ..actors.kernel.ref import ActorRef
from ..system.system import ActorSystem
from .latencies import Latency, row_of
from .schedules.choices import DELAY, FAULT, Choices

if TYPE_CHECKING:
    from .fleet.sim_fleet import SimFleet, SimProgram

Kind = Literal["crash", "hang", "delay", "drop", "duplicate", "reorder", "corrupt", "fail", "cut", "split"]
KINDS: tuple[str, ...] = get_args(Kind)


class Point(NamedTuple):
    """A place where faults strike.

    Attributes:
        name: as in `on(..., at=name)`.
        where: what passes there.
        kinds: the faults that can strike there.
        guarantee: what holds all the same.
    """

    name: str
    where: str
    kinds: tuple[Kind, ...]
    guarantee: str


POINTS: dict[str, Point] = {
    point.name: point
    for point in (
        Point(
            "admit",
            "a message on its way into the mailbox",
            ("drop", "delay", "duplicate", "reorder", "corrupt"),
            "an ask that is lost ends at its deadline, surely not handled; a doubled one has one outcome",
        ),
        Point(
            "turn begin",
            "a message's turn in this process, before its handler",
            ("crash", "hang", "delay"),
            "the asker gets RemoteCrash, the state is as before, what is queued is kept",
        ),
        Point(
            "turn end",
            "the same, when the handler has returned and nothing has left yet",
            ("crash", "hang", "delay"),
            "the asker gets RemoteCrash and no reply; what is queued is kept",
        ),
        Point(
            "reply",
            "a reply on its way to an ask made in this process",
            ("drop", "delay", "duplicate", "corrupt"),
            "the ask ends once: by the reply, or at its deadline, which cannot tell whether it was handled",
        ),
        Point(
            "frame out",
            "a message on its way to an actor's own process",
            ("crash", "delay", "drop", "corrupt"),
            "crash, corrupt: its process ends and is started again; with recovery every ask is answered, once",
        ),
        Point(
            "frame in",
            "a message or reply on its way back from there",
            ("crash", "delay", "drop", "corrupt"),
            "as frame out; what the actor has released is not released twice",
        ),
        Point(
            "journal append",
            "a recorded actor's append to a durable store",
            ("fail",),
            "what is not in the journal is not accepted: its sender hears of it, and it is never applied",
        ),
        Point(
            "snapshot write",
            "a recorded actor's snapshot on its way into a durable store",
            ("fail",),
            "the older snapshot and the whole journal stay, and bring everything back",
        ),
        Point(
            "process start",
            "a system's next process for an actor",
            ("fail", "crash", "delay"),
            "the start fails and is tried again within the supervisor's intensity",
        ),
        Point(
            "post",
            "what a program of a simulated fleet sends another program, or a client",
            ("crash", "cut", "split", "drop", "delay", "duplicate"),
            "crash, cut, split: another program leads; an ask to a recorded actor has one outcome",
        ),
        Point(
            "request",
            "what such a program asks of the servers of its system: for the log, the lease and large values",
            ("crash", "cut", "split", "drop"),
            "what was acknowledged stands in the log, and whoever leads next has it",
        ),
    )
}
"""Every point, by name."""
TURNS = ("turn begin", "turn end")
"""The points that the turns of a replay pass, too."""


class InjectedCrash(HoldfastError, text="injected crash at {at!r}, chance {number} (seed {seed})"):
    """Raised in a turn by a fault, as if the handler had."""

    at: str
    number: int
    seed: int


class Strike(NamedTuple):
    """One fault that struck: at the how manieth chance, counted from 1, and what it hit."""

    at: str
    path: str
    kind: Kind
    number: int
    what: str

    def __str__(self) -> str:
        return f"{self.kind} at {self.at!r} of {self.path}, chance {self.number}: {self.what}"


class Strikes:
    """The faults of one point of one target, from `on` to the end of the context."""

    def __init__(
        self,
        faults: Faults,
        path: str,
        point: Point,
        odds: dict[Kind, float],
        seconds: Latency,
        after: int,
        times: int | None,
        *,
        replays: bool,
    ) -> None:
        self.at, self.path, self.seed = point.name, path, faults.seed
        self.replays = replays
        self.chances = 0
        self.is_over = False
        self.struck: list[Strike] = []
        named = f"{faults.seed}|{path}|{point.name}|{len(faults.installed)}"
        self.draw, self._row = random.Random(named), row_of("faults", "seconds", seconds, random.Random(f"row {named}"))
        self._faults, self._odds, self._after, self._times = faults, odds, after, times
        self._undo: list[Callable[[], None]] = []

    def next(self, what: object) -> Kind | None:
        """Take one chance, and return the fault that strikes now, if any. `what` passes the point."""
        if self.is_over:  # Other faults, which strike longer, still lead here.
            return None
        self.chances += 1
        drawn = self.draw.random()  # At each chance, so that the next ones do not depend on what this one does.
        if self.chances <= self._after or (self._times is not None and len(self.struck) >= self._times):
            return None
        index, kinds = 0, list(self._odds)
        for number, kind in enumerate(kinds, 1):
            if drawn < self._odds[kind]:
                index = number
                break
            drawn -= self._odds[kind]
        if self._faults.choices is not None:
            index = self._faults.choices.draw(FAULT, len(kinds) + 1, index)
        if not index:
            return None
        strike = Strike(self.at, self.path, kinds[index - 1], self.chances, repr(what)[:200])
        self.struck.append(strike)
        self._faults.strikes.append(strike)
        return strike.kind

    def delay(self) -> float:
        """Return how long the delay that strikes now is, in seconds."""
        count = len(self._row)
        level = self.draw.randrange(count) if count > 1 else 0
        if self._faults.choices is not None and count > 1:
            level = self._faults.choices.draw(DELAY, count, level)
        return self._row[level]

    def tell(self, what: str) -> None:
        """Say more of what the last fault has hit."""
        told = self.struck[-1]._replace(what=what)
        self.struck[-1] = self._faults.strikes[-1] = told

    def is_hit(self) -> bool:
        """Draw whether one more is hit by a fault that strikes several: half of them are."""
        drawn = self.draw.random() < 0.5
        return drawn if self._faults.choices is None else bool(self._faults.choices.draw(FAULT, 2, int(drawn)))

    def crash(self) -> InjectedCrash:
        """Return the exception of a crash that strikes now."""
        return InjectedCrash(self.at, self.chances, self.seed)

    def at_end(self, undo: Callable[[], None]) -> None:
        """Call this when the faults end, last first."""
        self._undo.append(undo)

    def end(self) -> None:
        """Inject no more faults; what was exchanged is put back, what was held goes on. Twice is no error."""
        self.is_over = True
        while self._undo:
            self._undo.pop()()

    def __enter__(self) -> Strikes:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()
        if error is not None and self.struck:
            error.add_note("\n".join(["faults that struck:", *(f"  {strike}" for strike in self.struck)]))

    async def __aenter__(self) -> Strikes:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.__exit__(kind, error, trace)


class Faults:
    """Faults from one seed: the same seed strikes the same chances.

    Args:
        seed: what they are drawn from.
        choices: of a simulated run: keeps what was drawn, and repeats it.

    Attributes:
        strikes: everything that struck so far, oldest first.
    """

    def __init__(self, seed: int, choices: Choices | None = None) -> None:
        self.seed, self.choices = seed, choices
        self.strikes: list[Strike] = []
        self.installed: list[Strikes] = []

    def on(
        self,
        target: ActorRef[Any] | ActorSystem | SimFleet | SimProgram,
        *,
        at: str,
        seconds: Latency = 1.0,
        after: int = 0,
        times: int | None = None,
        replays: bool = False,
        **odds: float,
    ) -> Strikes:
        """Faults at one point, from now to the end of the context: `async with faults.on(ref, at="admit", drop=0.1):`.

        Args:
            target: the actor; for "process start" the system; for "post" and "request" a program of a simulated fleet,
                or the fleet, for all of its programs, also those that are started later.
            at: a name in POINTS.
            seconds: how long a delay is, on the loop's clock, or how long a program stays cut off, as a latency of
                `simulate` is said. What is reordered comes after the next message, or so much later if there is none.
            after: this many chances are let pass first.
            times: at most so many strikes; None: no limit.
            replays: at "turn begin" and "turn end": the turns of a replay are chances, too. Left out, only turns that
                no life has ended before are.
            odds: by kind of fault (crash, hang, delay, drop, duplicate, reorder, corrupt, fail, cut, split), the
                probability with which it strikes at each chance; together at most 1.

        Raises:
            SpecError: there is no such point, the fault cannot strike there, or the target has no such point.
        """
        from .injectors import INSTALL  # It needs the names above.

        point = POINTS.get(at)
        if point is None:
            raise SpecError("faults", f"at must be one of {', '.join(POINTS)}, not {at!r}")
        strikes = Strikes(self, _path(target), point, _checked(point, odds), seconds, after, times, replays=replays)
        if replays and at not in TURNS:
            raise SpecError("faults", f"replays=True is for {' and '.join(map(repr, TURNS))}, not for {at!r}")
        INSTALL[at](strikes, target)
        self.installed.append(strikes)
        return strikes

    def end(self) -> None:
        """End the injection: all faults are taken back, and none strikes any more."""
        for strikes in reversed(self.installed):
            strikes.end()

    def __repr__(self) -> str:
        return f"<Faults seed={self.seed}, {len(self.strikes)} struck>"


def _path(target: ActorRef[Any] | ActorSystem | SimFleet | SimProgram) -> str:
    if isinstance(target, ActorRef):
        return target.path
    return f"/{target.name}" if isinstance(target, ActorSystem) else target.name


def _checked(point: Point, odds: dict[str, float]) -> dict[Kind, float]:
    """The odds by kind, if they are any."""
    chosen: dict[Kind, float] = {}
    for kind in point.kinds:
        if kind in odds:
            chosen[kind] = odds[kind]
    unfit = sorted(set(odds) - set(chosen))
    if unfit:
        raise SpecError("faults", f"at {point.name!r} there can be {', '.join(point.kinds)}, not {unfit[0]!r}")
    if not chosen or any(not 0 <= one <= 1 for one in chosen.values()) or sum(chosen.values()) > 1 + 1e-9:
        raise SpecError("faults", f"give at least one probability, each from 0 to 1, together at most 1, not {odds!r}")
    return chosen
