"""Voters: what several runs of one request have in common.

A voter looks at ballots, one per run, and says `Agreed`, with the ballot that is taken, or `Undecided`, with the groups
there are. It never takes a ballot because it is the first. A ballot that is missing (`ABSENT`: a run that crashed or
came too late) counts among those that had to be won over.

Ballots are compared in a canonical form (`canonical`): the order of a dict does not count, not-a-number is equal to
itself, 3 is 3.0, no bool is a number, a time with a zone is the instant it means.

Source: Lyu and Avizienis, *Assuring Design Diversity in N-Version Software* (inexact voting); trap T44.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations
from typing import Any, Final, Generic, Protocol, TypeVar, runtime_checkable

import msgspec

from ...actors.errors import HoldfastError
from ...actors.process.wire.start_codec import imported
from .canonical import ABSENT, canonical, close

T = TypeVar("T")
Groups = tuple[tuple[int, ...], ...]

MOST_BALLOTS: Final = 15
"""With more, finding those that agree with each other could take for ever."""


class NoMajority(HoldfastError, text="the runs of {actor} do not agree: {why}; no answer is given rather than a guess"):
    """The runs of a request did not agree: nobody knows the right answer, so none is given."""

    actor: str
    why: str


class Agreed(msgspec.Struct, Generic[T], frozen=True):
    """There is a right answer: `value`, which is ballot `choice` (None: it was made of several).

    `agreeing` and `dissenting` are the numbers of the ballots for and against it; those that are absent are against.
    """

    value: T
    choice: int | None
    agreeing: tuple[int, ...]
    dissenting: tuple[int, ...] = ()

    @property
    def is_unanimous(self) -> bool:
        """Whether no ballot says anything else."""
        return not self.dissenting


class Undecided(msgspec.Struct, frozen=True):
    """There is no right answer. `groups` are ballots that agree among each other, largest first; none are absent."""

    why: str
    groups: Groups = ()

    def error(self, actor: str) -> NoMajority:
        """What those who have asked are told."""
        return NoMajority(actor, self.why)


@runtime_checkable
class Voter(Protocol):
    """What decides. Frozen and encodable, so that it can travel in the settings of a mechanism.

    `vote` gets ballots in canonical form, at least one, `ABSENT` for a missing one, and returns the numbers of those
    that agree on the answer (the first of them is taken), a value it has made of them (`Made`), or `Undecided`. It is a
    pure function: replicas that vote on the same ballots must come to the same result.
    """

    def vote(self, ballots: Sequence[object]) -> tuple[int, ...] | Made | Undecided: ...


class Made(msgspec.Struct, frozen=True):
    """An answer that is none of the ballots; `agreeing` are those it stands for."""

    value: Any
    agreeing: tuple[int, ...]


class Exact(msgspec.Struct, frozen=True, tag="exact"):
    """All ballots are there and equal."""

    def vote(self, ballots: Sequence[object]) -> tuple[int, ...] | Undecided:
        groups = _equal_groups(ballots)
        if len(groups) == 1 and len(groups[0]) == len(ballots):
            return groups[0]
        return Undecided(_split(groups, len(ballots), "all"), groups)


class Majority(msgspec.Struct, frozen=True, tag="majority"):
    """More than half of all ballots are equal; or at least `need` of them."""

    need: int = 0

    def vote(self, ballots: Sequence[object]) -> tuple[int, ...] | Undecided:
        groups = _equal_groups(ballots)
        need = self.need or len(ballots) // 2 + 1
        enough = [group for group in groups if len(group) >= need]
        if len(enough) == 1:  # With a small `need` there can be two, and then there is no answer.
            return enough[0]
        return Undecided(_split(groups, len(ballots), f"{need}"), groups)


class Tolerance(msgspec.Struct, frozen=True, tag="tolerance"):
    """As `Majority`, where numbers may differ a little, wherever they stand in the answers.

    Each of those that agree is near each other one: that A is near B and B is near C does not make A near C.

    Args:
        abs: how far two floats may be apart.
        rel: the same, as a part of the larger one.
        seconds: how far two times may be apart.
        integers: whether this holds for integers too, which otherwise are equal or not.
    """

    abs: float = 0.0
    rel: float = 0.0
    seconds: float = 0.0
    integers: bool = False
    need: int = 0

    def __post_init__(self) -> None:
        for name in ("abs", "rel", "seconds"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"a tolerance is a number >= 0, not {name}={getattr(self, name)!r}")

    def agree(self, one: object, other: object) -> bool:
        """Whether two canonical forms are near enough."""
        return close(one, other, self.abs, self.rel, self.seconds, self.integers)

    def vote(self, ballots: Sequence[object]) -> tuple[int, ...] | Undecided:
        return _largest(ballots, self.agree, self.need or len(ballots) // 2 + 1)


class Median(msgspec.Struct, frozen=True, tag="median"):
    """The middle one: of numbers, or of lists, dicts and structs of numbers, place by place.

    A ballot of another shape counts as absent. More than half of all must be there, and with an even number of them
    the two in the middle must not differ. With `abs` or `rel`, more than half must also be that near the middle.
    """

    abs: float | None = None
    rel: float = 0.0

    def vote(self, ballots: Sequence[object]) -> tuple[int, ...] | Made | Undecided:
        need = len(ballots) // 2 + 1
        shapes = _largest([_shape(ballot) for ballot in ballots], lambda a, b: a == b, need)
        if isinstance(shapes, Undecided):
            return Undecided("fewer than half are numbers, or of one shape", shapes.groups)
        rows = [_numbers(ballots[at]) for at in shapes]
        middle = [_middle(column) for column in zip(*rows, strict=True)]
        if any(number is None for number in middle):
            return Undecided(f"{len(rows)} of {len(ballots)} ballots are left, and the two in the middle differ")
        near = tuple(at for at, row in zip(shapes, rows, strict=True) if self._is_near(row, middle))
        if len(near) < need:
            return Undecided(f"only {len(near)} of {len(ballots)} are near the middle, {need} must be", (near,))
        same = [at for at in near if _numbers(ballots[at]) == middle]
        if same:
            return (same[0], *(at for at in near if at != same[0]))
        return Made(_with_numbers(ballots[near[0]], iter(middle)), near)

    def _is_near(self, row: list[Any], middle: list[Any]) -> bool:
        if self.abs is None and not self.rel:
            return True
        return all(close(a, b, self.abs or 0.0, self.rel, 0.0, True) for a, b in zip(row, middle, strict=True))


class Custom(msgspec.Struct, frozen=True, tag="custom"):
    """A user's own: a function, named "module:function", that does what `Voter.vote` does. See `custom`."""

    function: str

    def vote(self, ballots: Sequence[object]) -> tuple[int, ...] | Made | Undecided:
        return imported(self.function)(ballots)  # type: ignore[no-any-return] # checked by `decide`


AnyVoter = Exact | Majority | Tolerance | Median | Custom
"""What a mechanism can have in its settings: it is told apart by its tag."""

MAJORITY: Final = Majority()
"""What most agree on; of two, both."""


def custom(function: Callable[[Sequence[object]], Any]) -> Custom:
    """A voter from a function, which every replica finds by its name.

    Raises:
        ValueError: the function cannot be found by a name (it is a lambda, or was made inside another function).
    """
    name = getattr(function, "__qualname__", "")
    if not name or "<" in name:
        raise ValueError(f"{function!r} has no name by which replicas could import it: define it in a module")
    return Custom(f"{function.__module__}:{name}")


def decide(voter: Voter, ballots: Sequence[T]) -> Agreed[T] | Undecided:
    """Vote on decoded values, `ABSENT` for a missing one. Never raises for what voter or values do: that is Undecided.

    >>> decide(Majority(), [{"x": 1, "y": 2}, {"y": 2, "x": 1.0}, {"x": 1}])
    Agreed(value={'x': 1, 'y': 2}, choice=0, agreeing=(0, 1), dissenting=(2,))
    >>> decide(Majority(), [1, 2, 3]).why
    '3 ballots in groups of 1, 1, 1, and 2 must agree'
    >>> decide(Tolerance(abs=0.1), [0.3, 0.1 + 0.2, 9.0]).agreeing
    (0, 1)
    """
    decided = decide_by(voter, [_Ballot(ballot) for ballot in ballots], lambda ballot: canonical(ballot.value))
    if isinstance(decided, Undecided):
        return decided
    if decided.choice is not None:
        return Agreed(ballots[decided.choice], decided.choice, decided.agreeing, decided.dissenting)
    try:
        return Agreed(_plain(decided.value), None, decided.agreeing, decided.dissenting)
    except TypeError as error:
        return Undecided(str(error))


class _Ballot:
    """A value on which is voted; None is one, too."""

    __slots__ = ("value",)

    def __init__(self, value: object) -> None:
        self.value = value


def decide_by(voter: Voter, ballots: Sequence[Any], form: Callable[[Any], object]) -> Agreed[Any] | Undecided:
    """Vote on ballots by their canonical `form`; None is an absent one. An answer that was made is in that form."""
    if not 0 < len(ballots) <= MOST_BALLOTS:
        return Undecided(f"{len(ballots)} ballots: between 1 and {MOST_BALLOTS} can be compared")
    try:
        forms = [ABSENT if _is_absent(ballot) else form(ballot) for ballot in ballots]
        won = voter.vote(forms)
    except Exception as error:
        return Undecided(f"{type(voter).__name__} cannot compare them: {type(error).__name__}: {error}")
    if isinstance(won, Undecided):
        return won
    agreeing = won.agreeing if isinstance(won, Made) else won
    if not _is_choice(agreeing, forms):
        return Undecided(f"{type(voter).__name__} has chosen {agreeing!r}, which are no ballots")
    rest = tuple(at for at in range(len(ballots)) if at not in agreeing)
    if isinstance(won, Made):
        return Agreed(won.value, None, tuple(sorted(agreeing)), rest)
    return Agreed(ballots[agreeing[0]], agreeing[0], tuple(sorted(agreeing)), rest)


def _is_absent(ballot: Any) -> bool:
    return ballot is None or (isinstance(ballot, _Ballot) and ballot.value is ABSENT)


def _is_choice(agreeing: object, forms: list[object]) -> bool:
    return (
        isinstance(agreeing, tuple)
        and len(agreeing) > 0
        and len(set(agreeing)) == len(agreeing)
        and all(type(at) is int and 0 <= at < len(forms) and forms[at] is not ABSENT for at in agreeing)
    )


def _plain(form: Any) -> Any:
    """The value that a canonical form of lists, dicts, numbers and text stands for."""
    if not isinstance(form, tuple):
        return form
    match form[0]:
        case "list":
            return [_plain(item) for item in form[1:]]
        case "dict":
            return {_plain(key): _plain(value) for key, value in form[1:]}
        case "bool":
            return form[1]
        case other:
            raise TypeError(f"no ballot is in the middle, and a {other} cannot be made of several")


# -- groups ----------------------------------------------------------------------------------------------------------


def _equal_groups(ballots: Sequence[object]) -> Groups:
    groups: dict[object, list[int]] = {}
    for at, ballot in enumerate(ballots):
        if ballot is not ABSENT:
            groups.setdefault(ballot, []).append(at)
    return tuple(sorted((tuple(group) for group in groups.values()), key=lambda group: (-len(group), group)))


def _split(groups: Groups, count: int, need: str) -> str:
    sizes = ", ".join(str(len(group)) for group in groups)
    absent = count - sum(map(len, groups))
    missing = f", {absent} absent" if absent else ""
    return f"{count} ballots in groups of {sizes or '0'}{missing}, and {need} must agree"


def _largest(ballots: Sequence[object], agree: Callable[[Any, Any], bool], need: int) -> tuple[int, ...] | Undecided:
    """The largest set of ballots that all agree with each other, the one in the middle of them first."""
    present = [at for at, ballot in enumerate(ballots) if ballot is not ABSENT]
    friends = {at: {other for other in present if other == at or agree(ballots[at], ballots[other])} for at in present}
    for size in range(len(present), 0, -1):
        cliques = [group for group in combinations(present, size) if all(friends[at].issuperset(group) for at in group)]
        if not cliques:
            continue
        if size < need or (size * 2 <= len(ballots) and len(cliques) > 1):
            return Undecided(_split(tuple(cliques[:1]), size, f"{need} of {len(ballots)}"), tuple(cliques))
        # Of several majorities, each right, the one that more ballots support.
        best = max(cliques, key=lambda group: (sum(len(friends[at]) for at in group), [-at for at in group]))
        first = max(best, key=lambda at: (len(friends[at]), -at))
        return (first, *(at for at in best if at != first))
    return Undecided(f"all {len(ballots)} ballots are absent")


# -- medians ---------------------------------------------------------------------------------------------------------


def _is_number(form: object) -> bool:
    return isinstance(form, int | float) and not isinstance(form, bool)


def _shape(form: Any) -> object:
    """The form with its numbers left out; ABSENT if there are none, or one is not-a-number."""
    if form is ABSENT or not _numbers(form) or _has_nan(form):
        return ABSENT
    return _with_numbers(form, None)


def _has_nan(form: Any) -> bool:
    return isinstance(form, tuple) and (form == ("nan",) or any(map(_has_nan, form)))


def _numbers(form: Any) -> list[Any]:
    if isinstance(form, tuple):
        return [number for part in _values(form) for number in _numbers(part)]
    return [form] if _is_number(form) else []


def _values(form: tuple[Any, ...]) -> tuple[Any, ...]:
    """The parts in which numbers are values: the keys of a dict are names."""
    return tuple(value for _, value in form[1:]) if form and form[0] == "dict" else form


def _with_numbers(form: Any, numbers: Iterator[Any] | None) -> Any:
    """The form with other numbers, or with none."""
    if not isinstance(form, tuple):
        return (next(numbers) if numbers else "number") if _is_number(form) else form
    if form and form[0] == "dict":
        return ("dict", *((key, _with_numbers(value, numbers)) for key, value in form[1:]))
    return tuple(_with_numbers(part, numbers) for part in form)


def _middle(column: tuple[Any, ...]) -> Any:
    ordered = sorted(column)
    low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return low if low == high else None
