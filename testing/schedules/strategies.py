"""Strategies: in which order the schedules of a test are tried.

- `mixed` (the default): a run as in production, then random walks of several tempers and PCT of several depths.
- `random`: whoever could run is as likely as any other.
- `pct`: random priorities and `depth - 1` moments at which one falls. Among n tasks and k choices it finds a bug that
  needs `depth` events in one order with a probability of at least 1 / (n k^(depth - 1)) in each run.
- `exhaustive`: every schedule, except those that differ only in the order of steps that have nothing to do with each
  other; or, with `holds`, every schedule in which at most so many times somebody is held up.
- `coverage`: random changes to schedules that brought a new order of messages.

Source: PCT: Burckhardt et al., ASPLOS 2010; mixing strategies and feedback: Coyote (Deligiannis et al., TACAS 2023)
and AFL; see `reduction` for the exhaustive searches.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Hashable, Sequence
from typing import Final, Literal, Protocol, get_args

from ...actors.errors import SpecError
from .choices import TURN, Choices, Keys, Production, Replay, Taken, Walk
from .reduction.bounded import HoldBound
from .reduction.search import Exhaustive

Name = Literal["mixed", "random", "pct", "exhaustive", "coverage"]
NAMES: Final = get_args(Name)
DEPTH: Final = 3
TEMPERS: Final = (0.0, 0.9)
"""How likely the next in line runs without a draw, in the random walks of `mixed`."""
LONG: Final = 14
"""PCT without a run to measure expects up to 2**LONG choices."""
FAIR: Final = 200
"""Choices in a row after which PCT puts whoever has had them behind all others: it may wait for one of them."""
CHANGES: Final = 8
"""At most so many choices are changed in a schedule that `coverage` builds on."""
FRESH: Final = 0.2
OTHERS: Final = 0.2
"""How likely `coverage` takes a run that builds on nothing, or builds on a mere new order of who came when."""

Trace = Sequence[tuple[str, str]]


class Strategy(Protocol):
    """Gives one schedule after the other, and may learn from each run."""

    def choices(self, seed: int) -> Choices | None:
        """Those of the next run; None: every schedule has been tried."""
        ...

    def learn(self, choices: Choices, trace: Trace) -> None:
        """The run is over."""
        ...

    def covered(self, runs: int) -> str:
        """What so many runs have covered, in words; "": nothing that could be said."""
        ...


class Drawing:
    """Never comes to an end."""

    def covered(self, runs: int) -> str:
        return ""


class EachSeed(Drawing):
    """A schedule per seed, whatever the runs before were like."""

    def __init__(self, made: Callable[[int], Choices]) -> None:
        self._made = made

    def choices(self, seed: int) -> Choices | None:
        return self._made(seed)

    def learn(self, choices: Choices, trace: Trace) -> None:
        """Nothing."""


def strategy(name: str, depth: int = DEPTH, holds: int | None = None) -> Strategy:
    """The strategy of that name.

    Raises:
        SpecError: there is none, `depth` is not 1 or more, or `holds` is not 0 or more, or for another strategy.
    """
    if depth < 1:
        raise SpecError("simulate", f"depth must be 1 or more, not {depth!r}")
    if holds is not None and (name != "exhaustive" or type(holds) is not int or holds < 0):
        raise SpecError("simulate", f"holds must be 0 or more, and is for strategy='exhaustive' alone, not {holds!r}")
    match name:
        case "mixed":
            return EachSeed(mixed)
        case "random":
            return EachSeed(Walk)
        case "pct":
            return Pct(depth)
        case "exhaustive":
            return Exhaustive() if holds is None else HoldBound(holds)
        case "coverage":
            return CoverageGuided()
        case _:
            raise SpecError("simulate", f"strategy must be one of {', '.join(NAMES)}, not {name!r}")


def mixed(seed: int) -> Choices:
    """By turns: production for seed 0, then walks and PCT."""
    if seed == 0:
        return Production(seed)
    number = seed % 6
    if number < len(TEMPERS):
        return Walk(seed, TEMPERS[number])
    draw = random.Random(f"pct of mixed {seed}")
    return Priorities(seed, 1 + draw.randrange(4), 2 ** draw.randint(3, LONG))


class Priorities(Choices):
    """PCT: whoever has the highest priority runs; at `depth - 1` moments it falls below all others.

    Args:
        length: how many choices the run is expected to have.
    """

    def __init__(self, seed: int, depth: int, length: int) -> None:
        super().__init__(seed)
        self._draw = draw = random.Random(f"pct {seed}")
        self._changes: dict[int, float] = {draw.randint(1, max(1, length)): -float(level) for level in range(1, depth)}
        self._priorities: dict[Hashable, float] = {}
        self._last: Hashable = None
        self._in_a_row = 0
        self._lowest = -float(depth)

    def choose(self, count: int, keys: Keys) -> int:
        options, priorities = keys(), self._priorities
        for key in options:
            if key not in priorities:
                priorities[key] = self._draw.random()
        best = max(range(count), key=lambda index: priorities[options[index]])
        falls_to = self._changes.pop(self.steps, None)
        self._in_a_row = self._in_a_row + 1 if options[best] == self._last else 1
        if falls_to is None and self._in_a_row > FAIR:
            self._lowest -= 1.0
            falls_to, self._in_a_row = self._lowest, 1
        if falls_to is not None:
            priorities[options[best]] = falls_to
            best = max(range(count), key=lambda index: priorities[options[index]])
        self._last = options[best]
        return best


class Pct(Drawing):
    """PCT of one depth. The first run measures how many choices there are."""

    def __init__(self, depth: int) -> None:
        self._depth, self._length = depth, 0

    def choices(self, seed: int) -> Choices | None:
        return Priorities(seed, self._depth, self._length) if self._length else Production(seed)

    def learn(self, choices: Choices, trace: Trace) -> None:
        self._length = max(self._length, choices.steps, 1)


class CoverageGuided(Drawing):
    """Changes at random what has brought something new: two messages next to each other at an actor in a new order.

    Who came when is something new, too, but hardly a run is without: what has brought only that is taken less often.
    """

    def __init__(self) -> None:
        self._seen: set[tuple[str, str, str]] = set()
        self._orders: set[tuple[str, ...]] = set()
        self._corpus: list[Taken] = []
        self._others: list[Taken] = []

    def choices(self, seed: int) -> Choices | None:
        draw = random.Random(f"coverage {seed}")
        if not self._corpus or draw.random() < FRESH:
            return mixed(seed)
        taken = self._others if self._others and draw.random() < OTHERS else self._corpus
        return Changed(seed, draw, taken[-1 - int(len(taken) * draw.random() ** 4)])

    def learn(self, choices: Choices, trace: Trace) -> None:
        last: dict[str, str] = {}
        new = False
        for path, what in trace:
            pair = (path, last.get(path, ""), what)
            last[path] = what
            if pair not in self._seen:
                self._seen.add(pair)
                new = True
        order = tuple(path for path, _ in trace[-64:])
        if new:
            self._corpus.append(choices.kept())
        elif order not in self._orders:
            self._others.append(choices.kept())
        self._orders.add(order)


class Changed(Replay):
    """A run that is repeated up to a point, with a few choices drawn anew, and goes on as a random walk."""

    def __init__(self, seed: int, draw: random.Random, taken: Taken) -> None:
        super().__init__(seed, taken)
        self._draw = draw
        steps = sorted(taken.get(TURN, {})) or [1]
        last = steps[-1] + 4
        if draw.random() < 0.5:  # another end, and more often a short one: what was new came late
            self._anew, self._until = set[int](), steps[-1 - int(len(steps) * draw.random() ** 2)]
        else:
            self._anew, self._until = {draw.randint(1, last) for _ in range(draw.randint(1, CHANGES))}, last

    def choose(self, count: int, keys: Keys) -> int:
        if self.steps in self._anew or self.steps > self._until:
            return self._draw.randrange(count)
        return super().choose(count, keys)

    def redrawn(self, kind: str, number: int, count: int, proposed: int) -> int:
        return proposed if self._draw.random() < 0.5 else super().redrawn(kind, number, count, proposed)
