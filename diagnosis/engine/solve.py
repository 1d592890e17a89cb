"""All minimal diagnoses of one part, by clingo.

A Horn rule is a rule of the answer-set program as it stands. `domRec` with "rather false" for each component enumerates
the subset-minimal sets and no other, in no particular order.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import clingo
from clingo.backend import HeuristicType

from .cone import RulePart
from .reduce import reduce

_MINIMAL: Final = ("--heuristic=Domain", "--enum-mode=domRec", "--warn=none", "0")
_OPTIMISING: Final = "--opt-mode=optN"
_SMALLEST: Final = (_OPTIMISING, "--opt-strategy=usc", "--warn=none", "0")


_SHORT: Final = 5000
"""Conflicts of clingo, not of ours, that a short search may take: some tens of milliseconds."""


class SearchBudget:
    """How long, and whether still, to go on. `cancel` may be called from another thread.

    Searches run in the calling thread: to have clingo run them in one of its own costs more than most searches. Short
    ones look at the clock at each model; the first long one starts a timer that interrupts, so a budget is closed.

    Args:
        seconds: time from now.
    """

    def __init__(self, seconds: float) -> None:
        self._end = time.monotonic() + min(seconds, threading.TIMEOUT_MAX)
        self._lock = threading.Lock()
        self._control: clingo.Control | None = None
        self._timer: threading.Timer | None = None
        self._is_cancelled = False

    @property
    def left(self) -> float:
        """Seconds left, not below 0."""
        return 0.0 if self._is_cancelled else max(0.0, self._end - time.monotonic())

    def cancel(self) -> None:
        """Stop what runs, and let nothing more begin."""
        with self._lock:
            self._is_cancelled = True
            if self._control is not None:
                self._control.interrupt()

    def close(self) -> None:
        """Begin no more searches, and keep no more time."""
        self.cancel()
        if self._timer is not None:
            self._timer.cancel()

    def run(self, control: clingo.Control, take: Callable[[clingo.Model], bool], *, is_short: bool) -> bool:
        """Search; False if it was stopped, by time, by `cancel`, or by the limit of a short search."""
        with self._lock:
            if not self.left:
                return False
            if self._timer is None and not is_short:
                self._timer = threading.Timer(self.left, self.cancel)
                self._timer.daemon = True
                self._timer.start()
            self._control = control
        is_enough = False

        def take_in_time(model: clingo.Model) -> bool:
            nonlocal is_enough
            if not self.left:
                return False
            is_enough = not take(model)
            return not is_enough

        try:
            result = control.solve(on_model=take_in_time)  # clingo keeps an interruption that comes before this
        finally:
            with self._lock:
                self._control = None
        return is_enough or bool(result.exhausted)


class Solved(NamedTuple):
    """Sets of components, each sorted, and what kept further ones from being found.

    Each component of a set may be exchanged for any other of its class.
    """

    sets: list[tuple[int, ...]]
    classes: dict[int, tuple[int, ...]]
    by_count: bool = False
    by_time: bool = False

    @property
    def found(self) -> int:
        """How many sets there are when classes are written out."""
        return sum(math.prod(len(self.classes[member]) for member in members) for members in self.sets)


def solve(part: RulePart, limit: int, budget: SearchBudget) -> list[Solved]:
    """The minimal diagnoses of a part: the unions of one set of each of what it falls into.

    Of each at most `limit` are searched for, before classes are written out.
    """
    return [_solve(left, limit, budget)._replace(classes=classes) for left, classes in reduce(part)]


def _solve(part: RulePart, limit: int, budget: SearchBudget) -> Solved:
    """The minimal diagnoses of a part, at most `limit` of them.

    If there are more, the smallest of all are among those returned, as far as time and `limit` allow.
    """
    single = _only_conflict(part)
    if single is not None:
        return Solved([(component,) for component in single[:limit]], {}, by_count=len(single) > limit)
    if not budget.left:
        return Solved([], {}, by_time=True)
    found = _search(part, _MINIMAL, limit, budget)
    if not found.by_count:
        return found
    smallest = _search(part, _SMALLEST, limit, budget)
    sets = list(dict.fromkeys((*smallest.sets, *found.sets)))[:limit]
    return Solved(sets, {}, by_count=True, by_time=smallest.by_time)


def _only_conflict(part: RulePart) -> list[int] | None:
    """If just one rule leads to each atom and to the failure: its components, each of which alone explains it."""
    if len(part.denials) != 1 or len({step.head for step in part.steps}) != len(part.steps):
        return None
    return part.components


def _search(part: RulePart, options: Sequence[str], limit: int, budget: SearchBudget) -> Solved:
    """A short search, and if it is not short a long one from the beginning."""
    found, is_done = _searched(part, (*options, f"--solve-limit={_SHORT}"), limit, budget, is_short=True)
    if not is_done and budget.left:
        found, _ = _searched(part, options, limit, budget, is_short=False)
    return found


def _searched(
    part: RulePart, options: Sequence[str], limit: int, budget: SearchBudget, *, is_short: bool
) -> tuple[Solved, bool]:
    """What was found, and whether that is all that was asked for."""
    control = clingo.Control(list(options), logger=_say_nothing)
    is_optimising = _OPTIMISING in options
    components = _build(control, part, is_optimising=is_optimising)
    sets: list[tuple[int, ...]] = []
    is_more = False

    def take(model: clingo.Model) -> bool:
        nonlocal is_more
        if is_optimising and not model.optimality_proven:
            return True
        if len(sets) == limit:
            is_more = True
            return False
        sets.append(tuple(sorted(components[symbol] for symbol in model.symbols(atoms=True))))
        return True

    is_done = budget.run(control, take, is_short=is_short)
    return Solved(sets, {}, by_count=is_more, by_time=not is_done), is_done


def _say_nothing(code: clingo.MessageCode, text: str) -> None:
    """Keep clingo from writing to stderr: what it would say there (that it was interrupted) is in the result."""


def _build(control: clingo.Control, part: RulePart, *, is_optimising: bool) -> dict[clingo.Symbol, int]:
    """Write the program; the only atoms with names are those of components, true for faulty."""
    components: dict[clingo.Symbol, int] = {}
    faulty: dict[int, int] = {}
    with control.backend() as backend:
        for component in part.components:
            symbol = clingo.Function("ab", [clingo.Number(component)])
            components[symbol] = component
            faulty[component] = backend.add_atom(symbol)
        backend.add_rule(list(faulty.values()), [], choice=True)
        atoms = {head: backend.add_atom() for head in {step.head for step in part.steps}}
        for step in part.steps:
            backend.add_rule([atoms[step.head]], _body(step.needs, step.body, faulty, atoms))
        for denial in part.denials:
            backend.add_rule([], _body(denial.needs, denial.body, faulty, atoms))
        if is_optimising:
            backend.add_minimize(0, [(atom, 1) for atom in faulty.values()])
        else:
            for atom in faulty.values():
                backend.add_heuristic(atom, HeuristicType.False_, 1, 1, [])
    return components


def _body(needs: tuple[int, ...], body: tuple[int, ...], faulty: dict[int, int], atoms: dict[int, int]) -> list[int]:
    return [*(-faulty[component] for component in needs), *(atoms[atom] for atom in body)]
