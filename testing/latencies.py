"""Latencies of a simulated run: how many seconds something takes, drawn by the seed each time.

Whatever a latency is said as, it is made into a row of seconds, the shortest first. Which of them it is each time is a
choice of the run: so it is repeated with the run, and shrinking makes it as short as the failure allows.
"""

from __future__ import annotations

import asyncio
import functools
import math
import random
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextvars import Context
from numbers import Real
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, get_args

from ..actors.errors import SpecError
from ..actors.kernel.envelope import ReplyHandle
from .library_code import is_module_of_library
from .schedules.choices import LATENCY, LEVELS

if TYPE_CHECKING:
    from .schedules.choices import Choices

FINE: Final = 1024
"""How many seconds the row of a distribution has: what is rarer than one in so many is not drawn."""
SAMPLES: Final = 256
"""How often a function is called for the row of a run."""

What = Literal["frames", "starts", "reads", "writes", "syncs", "replies", "timers"]
WHAT: Final[tuple[What, ...]] = get_args(What)
"""What takes time in a simulated run if that is said."""


class Distribution:
    """A latency by the seconds that are drawn, each as likely as any other.

    Args:
        text: how it was made.
        row: the seconds, finite and >= 0, in any order.

    Raises:
        SpecError: there are none, or not such.
    """

    __slots__ = ("_text", "row")

    def __init__(self, text: str, row: Sequence[float]) -> None:
        self._text, self.row = text, _checked(text, row)

    def __repr__(self) -> str:
        return self._text


Latency: TypeAlias = "float | tuple[float, float] | Distribution | Callable[[random.Random], float]"
"""Seconds: a number; (least, longest), each as likely as any other between; a distribution; or a function that draws
them from the random numbers that it is given, and is called 256 times at the beginning of a run."""


def exponential(mean: float) -> Distribution:
    """Seconds with this mean, as of independent events: many are short, and one in a hundred is 4.6 times the mean.

    Raises:
        SpecError: `mean` is not finite and > 0.

    >>> round(exponential(1.0).row[FINE // 2], 2)
    0.69
    """
    _require(mean, "exponential", "mean")
    return Distribution(f"exponential({mean!r})", [-mean * math.log1p(-share) for share in _shares(FINE)])


def log_normal(median: float, spread: float = 2.0) -> Distribution:
    """Seconds whose logarithm is normal, as of many services.

    Args:
        median: half of them are longer, > 0.
        spread: a factor, >= 1: two of three lie between median / spread and median * spread.

    Raises:
        SpecError: `median` is not finite and > 0, or `spread` not finite and >= 1.

    >>> [round(seconds, 2) for seconds in log_normal(1.0, spread=2.0).row[:: FINE // 4]]
    [0.1, 0.63, 1.0, 1.6]
    """
    _require(median, "log_normal", "median")
    _require(spread, "log_normal", "spread", least=1.0)
    normal = NormalDist()
    row = [median * _power(spread, normal.inv_cdf(share)) for share in _shares(FINE)]
    return Distribution(f"log_normal({median!r}, spread={spread!r})", row)


def long_tail(least: float, exponent: float = 1.5) -> Distribution:
    """Seconds of a Pareto distribution: half of them are close to the least, and a few are very long.

    Args:
        least: the shortest, > 0.
        exponent: how quickly the long ones get rare, > 0: (least / seconds) ** exponent are longer than `seconds`.

    Raises:
        SpecError: one of them is not such a number.

    >>> [round(seconds, 1) for seconds in long_tail(1.0).row[:: FINE // 2]], round(long_tail(1.0).row[-1])
    ([1.0, 1.6], 161)
    """
    _require(least, "long_tail", "least")
    _require(exponent, "long_tail", "exponent")
    row = [least * _power(1.0 - share, -1.0 / exponent) for share in _shares(FINE)]
    return Distribution(f"long_tail({least!r}, exponent={exponent!r})", row)


def mixture(*parts: tuple[float, float | tuple[float, float] | Distribution]) -> Distribution:
    """One latency or another: `mixture((0.95, 0.001), (0.05, exponential(0.5)))` is mostly fast, sometimes slow.

    Args:
        parts: each a share, from 1/1024 to 1, and the latency of that share. The shares make 1 together.

    Raises:
        SpecError: they do not, or a part is no such pair.

    >>> [round(seconds, 3) for seconds in mixture((0.75, 0.001), (0.25, (1.0, 2.0))).row[:: FINE // 8]]
    [0.001, 0.001, 0.001, 0.001, 0.001, 0.001, 1.0, 1.508]
    """
    text = f"mixture({', '.join(map(repr, parts))})"
    if not all(isinstance(part, tuple) and len(part) == 2 and _is_number(part[0]) for part in parts):
        raise SpecError(text, "each part is a pair of a share and a latency")
    shares = [float(share) for share, _ in parts]
    if any(not 1 / FINE <= share <= 1 for share in shares) or abs(sum(shares) - 1.0) > 1e-9:
        raise SpecError(text, f"each share must be from 1/{FINE} to 1, together they make 1")
    row: list[float] = []
    for number, (_, said) in enumerate(parts, 1):
        if callable(said):
            raise SpecError(text, "a function is a latency by itself, and no part of one")
        part = row_of(text, "a part", said, random.Random(0))
        count = round(sum(shares[:number]) * FINE) - len(row)
        row += [part[int(share * len(part))] for share in _shares(count)]
    return Distribution(text, row)


def _shares(count: int) -> list[float]:
    """The middles of so many equal parts of 0 to 1."""
    return [(number + 0.5) / count for number in range(count)]


def _power(base: float, exponent: float) -> float:
    try:
        return math.pow(base, exponent)
    except OverflowError:
        return math.inf


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _require(value: float, where: str, name: str, least: float = 0.0) -> None:
    if not _is_number(value) or not (least <= value < math.inf and value > 0):
        kind = f">= {least:g}" if least else "> 0"
        raise SpecError(where, f"{name} must be finite and {kind}, not {value!r}")


def _checked(text: str, row: Sequence[float]) -> tuple[float, ...]:
    wrong = [seconds for seconds in row if not (_is_number(seconds) and 0 <= seconds < math.inf)]
    if wrong or not row:
        raise SpecError(text, f"seconds must be finite and >= 0, not {wrong[0]!r}" if wrong else "it has no seconds")
    return tuple(sorted(map(float, row)))


def row_of(where: str, name: str, said: Latency, draw: random.Random) -> tuple[float, ...]:
    """The seconds that are drawn of a latency, the shortest first.

    Args:
        where: what was called with it; `name` is that of its argument.
        draw: what a function draws from.

    Raises:
        SpecError: it is none.
    """
    if isinstance(said, Distribution):
        return said.row
    if callable(said):
        return _checked(f"{where}, {name}", [said(draw) for _ in range(SAMPLES)])
    bounds: tuple[Any, ...] = said if isinstance(said, tuple) else (said, said)
    if len(bounds) == 2 and all(map(_is_number, bounds)):
        least, longest = map(float, bounds)
        if least == longest and 0 <= least < math.inf:
            return (least,)
        if 0 <= least < longest < math.inf:
            return tuple(least + (longest - least) * level / (LEVELS - 1) for level in range(LEVELS))
    raise SpecError(
        where,
        f"{name} must be >= 0 seconds, (least, longest), a distribution of holdfast.testing.latencies, or a function "
        f"of random numbers, not {said!r}",
    )


class DrawnSeconds:
    """Seconds that something takes, drawn anew each time.

    Args:
        choices: of the run.
        what: the name of what takes them.
        said: how many.
    """

    def __init__(self, choices: Choices, what: str, said: Latency) -> None:
        self._choices = choices
        self._row = row_of("simulate", what, said, random.Random(f"row of {what} {choices.seed}"))
        self._draw = random.Random(f"{what} {choices.seed}").random

    def __call__(self) -> float:
        """The seconds that it takes this time."""
        row = self._row
        if len(row) == 1:
            return row[0]
        return row[self._choices.draw(LATENCY, len(row), int(self._draw() * len(row)))]


Said: TypeAlias = "Latency | Mapping[What, Latency]"
"""A latency of frames, or each by what has it."""


class Latencies:
    """What takes time in one run, and how much.

    Args:
        choices: of the run.
        said: as `said_latencies` returns it.
    """

    def __init__(self, choices: Choices, said: Mapping[What, Latency]) -> None:
        self._drawn = {what: DrawnSeconds(choices, what, latency) for what, latency in said.items()}

    def of(self, what: What) -> Callable[[], float]:
        """What draws the seconds that this takes; they are 0 if nothing was said."""
        return self._drawn.get(what, float)

    def __contains__(self, what: What) -> bool:
        return what in self._drawn


def said_latencies(latency: Said = 0.0, sync: Latency = 0.0) -> dict[What, Latency]:
    """Each latency that is not 0, by what has it.

    Args:
        latency: of frames, or by what has it.
        sync: of syncs.

    Raises:
        SpecError: one is none, or of something that has none, or said twice.
    """
    said: dict[What, Latency] = dict(latency) if isinstance(latency, Mapping) else {"frames": latency}
    unknown: list[object] = [what for what in said if what not in WHAT]
    if unknown:
        raise SpecError("simulate", f"latency is of {', '.join(WHAT)}, and there are no {unknown[0]!r}")
    for what, one in said.items():
        name = f"latency of {what}" if isinstance(latency, Mapping) else "latency"
        row_of("simulate", name, one, random.Random(0))
    row_of("simulate", "sync", sync, random.Random(0))
    if sync != 0.0:
        if "syncs" in said:
            raise SpecError("simulate", "sync= and latency={'syncs': ...} are the same: give one")
        said["syncs"] = sync
    return {what: said[what] for what in WHAT if what in said and said[what] not in (0.0, (0.0, 0.0))}


class DelayLine:
    """What comes late, but in order.

    Args:
        loop: the loop of the run.
        seconds: how late the next thing comes.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, seconds: Callable[[], float]) -> None:
        self._loop, self.seconds = loop, seconds
        self._waiting: deque[tuple[float, Callable[[], None], Context | None]] = deque()

    def send(self, go: Callable[[], None], context: Context | None = None) -> None:
        """Call this later, in a context: behind what was sent before."""
        self._waiting.append((self._loop.time() + self.seconds(), go, context))
        if len(self._waiting) == 1:
            self._move()

    def times(self) -> list[float]:
        """When each thing arrives, at the soonest."""
        return [when for when, _, _ in self._waiting]

    def _move(self) -> None:
        """Have the first thing arrive: the next one never comes before it."""
        when, _, context = self._waiting[0]
        if when <= self._loop.time():
            self._loop.call_soon(self._arrive, context=context)
        else:
            self._loop.call_at(when, self._arrive, context=context)

    def _arrive(self) -> None:
        _, go, _ = self._waiting[0]
        go()
        self._waiting.popleft()
        if self._waiting:
            self._move()


class LateReplies:
    """Has what an actor answers come late, in the order in which it has answered.

    Args:
        loop: the loop of the run.
        seconds: how late the next reply is.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, seconds: Callable[[], float]) -> None:
        self._loop, self._seconds = loop, seconds
        self._lines: dict[object, DelayLine] = {}

    def delaying(self, answer: Callable[[Any, object], None]) -> Callable[[Any, object], None]:
        """What stands in place of `Ask.answer`: the same, but later."""

        def late(ask: Any, reply: object) -> None:
            is_local = ask.to is not None and isinstance(ask.future, asyncio.Future) and not ask.future.done()
            if not is_local or isinstance(reply, ReplyHandle) or is_module_of_library(type(ask.message).__module__):
                answer(ask, reply)
                return
            line = self._lines.get(ask.to)
            if line is None:
                line = self._lines[ask.to] = DelayLine(self._loop, self._seconds)
            line.send(functools.partial(answer, ask, reply))

        return late

    def times(self) -> list[float]:
        """When each reply that is on its way arrives, at the soonest."""
        return [when for line in self._lines.values() for when in line.times()]
