"""The choices of a run: each point at which a simulated run may go one way or another, and which way it took.

A choice is a number below the number of its options. 0 is what production would most likely do: the next in line runs,
no fault strikes, a delay is as short as it may be. A run is kept as its choices other than 0, which is what repeats it,
and what shrinking makes fewer.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Final

from ...actors.errors import HoldfastError

Keys = Callable[[], Sequence[Hashable]]
"""Who the options are, in order. Few strategies ask."""
Taken = dict[str, dict[int, int]]
"""By kind of choice, then by its number in the run (from 1): what was chosen, if that was not 0."""

TURN: Final = "turn"
"""The kind of choice that says which actor or task runs next."""
HOLD: Final = "hold"
"""The same as how many of those in front are held up: they come again when nobody else could run."""
PATIENCE: Final = 1000
"""Choices after which nobody is held up any more: whoever runs may be waiting for them."""
FAULT: Final = "fault"
DELAY: Final = "delay"
"""How long a fault lasts."""
LATENCY: Final = "latency"
"""How long what is written takes until it arrives, or is safe."""
MOMENT: Final = "moment"
"""After how many turns something happens that the test does."""
LOSS: Final = "loss"
"""How many of the writes that were not synced a power cut takes."""
ROUNDS: Final = "rounds"
"""How long the system goes on after a step of a machine."""
KINDS: Final = (TURN, HOLD, FAULT, DELAY, LATENCY, MOMENT, LOSS, ROUNDS)
LEVELS: Final = 64
"""So many different delays can be drawn of one range."""


class NotRepeatable(HoldfastError, AssertionError):
    """The same choices gave another run: something decides that no seed has in its hand.

    Attributes:
        turn: the number of the turn at which they part.
        first, again: what that was in each.
        field: of which message or reply a field has another value, if that is what differs.
    """

    seed: int
    turn: int
    first: str
    again: str
    escaped: tuple[str, ...]
    field: str = ""

    def __str__(self) -> str:
        where = f"in turn {self.turn} {self.field} was" if self.field else f"turn {self.turn} was"
        text = (
            f"the run of seed {self.seed} cannot be repeated: {where} {self.first}, and the same choices "
            f"then gave {self.again}. Something decides that is not the seed's"
        )
        if self.escaped:
            return f"{text}: {'; '.join(self.escaped)}"
        return (
            f"{text}: the addresses of objects (id(), a set of objects), what an "
            "earlier run has left in a global, or, between two processes, a set of strings (set PYTHONHASHSEED=0)"
        )


class BadSchedule(HoldfastError, ValueError, text="not a schedule: {text!r}: {why}"):
    """A text that should repeat a run is none."""

    text: str
    why: str


class UnfitSchedule(
    HoldfastError, AssertionError, text="the schedule {text!r} is of another run than this one, which has passed: {why}"
):
    """A run was to be repeated, and its choices are not those that this test has: what passed is something else.

    It may be of another test, of another seed, or from before the test or its actors were changed.
    """

    text: str
    why: str


class Choices:
    """Decides a run and keeps what it has decided. Subclasses say how.

    Attributes:
        seed: of `random`, of the actors' random numbers, and of what the strategy draws.
        steps: choices of who runs next, so far.
        taken: the turns' choices other than 0, as (number, choice).
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.steps = 0
        self.taken: list[tuple[int, int]] = []
        self.drawn: dict[str, list[tuple[int, int]]] = {}
        self._counts: dict[str, int] = {}

    def turn(self, count: int, keys: Keys) -> int:
        """Which of `count` (2 or more) runs next."""
        self.steps += 1
        chosen = self.choose(count, keys)
        if chosen:
            self.taken.append((self.steps, chosen))
        return chosen

    def choose(self, count: int, keys: Keys) -> int:
        """What a subclass decides; the next in line if it says nothing."""
        return 0

    def end(self) -> None:
        """The test is over: what follows is the end of its system."""

    def draw(self, kind: str, count: int, proposed: int) -> int:
        """A choice that was drawn by odds of its own, if nothing else is to be repeated."""
        number = self._counts[kind] = self._counts.get(kind, 0) + 1
        chosen = self.redrawn(kind, number, count, proposed)
        if chosen:
            self.drawn.setdefault(kind, []).append((number, chosen))
        return chosen

    def redrawn(self, kind: str, number: int, count: int, proposed: int) -> int:
        """What becomes of a drawn choice."""
        return proposed

    def made(self, kind: str) -> int:
        """How many choices of a kind there have been."""
        return self.steps if kind in (TURN, HOLD) else self._counts.get(kind, 0)

    def kept(self) -> Taken:
        """What repeats the run so far."""
        found = {TURN: dict(self.taken), **{kind: dict(drawn) for kind, drawn in self.drawn.items()}}
        return {kind: chosen for kind, chosen in found.items() if chosen}


class Dice:
    """Draws what happens in a run beside its order, by one seed.

    Args:
        what: the name of what is drawn for.
        seed: decides it.
        choices: of a simulated run: keeps what was drawn, and repeats it.

    Attributes:
        random: for what is not kept.
    """

    def __init__(self, what: str, seed: int, choices: Choices | None = None) -> None:
        self.random = random.Random(f"{what} {seed}")
        self._choices = choices

    def strikes(self, share: float) -> bool:
        """Draw whether a fault strikes of which this share does."""
        if share <= 0.0:
            return False
        drawn = self.random.random() < share
        return drawn if self._choices is None else bool(self._choices.draw(FAULT, 2, int(drawn)))

    def seconds(self, least: float, longest: float) -> float:
        """Draw how long something takes."""
        if least == longest:
            return least
        if self._choices is None:
            return self.random.uniform(least, longest)
        level = self._choices.draw(LATENCY, LEVELS, int(self.random.random() * LEVELS))
        return least + (longest - least) * level / (LEVELS - 1)


class Production(Choices):
    """As production does: in order of arrival."""


class Replay(Choices):
    """Repeats a run by its choices; where there is none, as production does."""

    def __init__(self, seed: int, taken: Mapping[str, Mapping[int, int]]) -> None:
        super().__init__(seed)
        self._turns = taken.get(TURN, {})
        self._given = taken

    def choose(self, count: int, keys: Keys) -> int:
        return min(self._turns.get(self.steps, 0), count - 1)

    def redrawn(self, kind: str, number: int, count: int, proposed: int) -> int:
        return min(self._given.get(kind, {}).get(number, 0), count - 1)


class RepeatHolds(Choices):
    """Repeats a run by who was held up in it: a bug that shows when one actor is slow takes one choice, not many."""

    def __init__(self, seed: int, taken: Mapping[str, Mapping[int, int]]) -> None:
        super().__init__(seed)
        self.holds: list[tuple[int, int]] = []
        self._holds = taken.get(HOLD, {})
        self._given = taken
        self._held: dict[Hashable, int] = {}  # since which choice; the longest first

    def choose(self, count: int, keys: Keys) -> int:
        options, held = keys(), self._held
        while held and self.steps - next(iter(held.values())) > PATIENCE:
            del held[next(iter(held))]
        order = list(range(count))
        if held:
            places = {key: place for place, key in enumerate(held, 1)}
            order.sort(key=lambda index: places.get(options[index], 0))
        rank = self.rank(order)
        for index in order[:rank]:
            held.pop(options[index], None)
            held[options[index]] = self.steps
        held.pop(options[order[rank]], None)
        if rank:
            self.holds.append((self.steps, rank))
        return order[rank]

    def rank(self, order: Sequence[int]) -> int:
        """How many of those in front are held up now."""
        return min(self._holds.get(self.steps, 0), len(order) - 1)

    def redrawn(self, kind: str, number: int, count: int, proposed: int) -> int:
        return min(self._given.get(kind, {}).get(number, 0), count - 1)

    def kept(self) -> Taken:
        found = {**super().kept(), TURN: {}, HOLD: dict(self.holds)}
        return {kind: chosen for kind, chosen in found.items() if chosen}


class Translated(RepeatHolds):
    """Repeats a run by its turns, and keeps who was held up."""

    def rank(self, order: Sequence[int]) -> int:
        turns = self._given.get(TURN, {})
        return order.index(min(turns.get(self.steps, 0), len(order) - 1))


def repeated(seed: int, taken: Mapping[str, Mapping[int, int]]) -> Choices:
    """What repeats a run by what was kept of it."""
    return Replay(seed, taken) if TURN in taken else RepeatHolds(seed, taken)


def require_fit(text: str, choices: Choices) -> None:
    """Make sure that a run has taken the choices of the schedule that it was to repeat.

    Raises:
        UnfitSchedule: it could not, and says which.
    """
    kept, unfit = choices.kept(), list[str]()
    for kind, chosen in from_text(text)[1].items():
        made = choices.made(kind)
        for number, choice in chosen.items():
            if number > made:
                unfit.append(f"{kind}={number}:{choice} was not come to, for the run has {made} such choices")
            elif (done := kept.get(kind, {}).get(number, 0)) != choice:
                unfit.append(f"{kind}={number}:{choice} is not among the options there, and {done} was taken")
    if unfit:
        raise UnfitSchedule(text, "; ".join(unfit))


class Walk(Choices):
    """A random walk: whoever could run is as likely as any other, or the next in line is likelier.

    Args:
        seed: what it draws from.
        order: the probability of a step at which the next in line runs without a draw.
    """

    def __init__(self, seed: int, order: float = 0.0) -> None:
        super().__init__(seed)
        self._random = random.Random(f"walk {seed}").random
        self._order = order

    def turn(self, count: int, keys: Keys) -> int:  # Without a call to `choose`: this is the quick one.
        self.steps += 1
        drawn = self._random()
        if self._order:
            if drawn < self._order:
                return 0
            drawn = (drawn - self._order) / (1.0 - self._order)
        chosen = int(drawn * count)
        if chosen:
            self.taken.append((self.steps, chosen))
        return chosen


def as_text(seed: int, taken: Mapping[str, Mapping[int, int]]) -> str:
    """A schedule in a line.

    >>> as_text(7, {"turn": {3: 1, 9: 2}, "fault": {}})
    'seed=7 turn=3:1,9:2'
    """
    parts = [f"seed={seed}"]
    for kind, chosen in taken.items():
        if chosen:
            parts.append(f"{kind}={','.join(f'{number}:{choice}' for number, choice in sorted(chosen.items()))}")
    return " ".join(parts)


def from_text(text: str) -> tuple[int, Taken]:
    """The seed and the choices of a schedule in a line.

    Raises:
        BadSchedule: it is none.

    >>> from_text("seed=7 turn=3:1,9:2")
    (7, {'turn': {3: 1, 9: 2}})
    """
    seed: int | None = None
    taken: Taken = {}
    for part in text.split():
        name, equals, value = part.partition("=")
        try:
            if name == "seed" and equals:
                seed = int(value)
            elif name in KINDS and equals:
                pairs = (pair.split(":") for pair in value.split(","))
                taken[name] = {int(number): int(choice) for number, choice in pairs}
            else:
                raise BadSchedule(text, f"{part!r} is none of seed=, {', '.join(f'{kind}=' for kind in KINDS)}")
        except ValueError as error:
            if isinstance(error, BadSchedule):
                raise
            raise BadSchedule(text, f"{part!r} is not made of numbers") from None
    if seed is None:
        raise BadSchedule(text, "it names no seed")
    return seed, taken


def size(taken: Mapping[str, Mapping[int, int]]) -> int:
    """How many choices are other than what production would most likely do."""
    return sum(map(len, taken.values()))
