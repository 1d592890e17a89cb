"""Checks whether a history is linearizable: whether its operations could have taken effect one after the other.

There must be an order of them that the model allows, in which no operation stands before one whose outcome was there
before it was invoked. An operation whose outcome nobody knows may stand anywhere after its invocation, or nowhere.

The search goes through the history in the order of time and decides only where it has to: when an operation comes back
that has no place yet, some of those that are under way take effect, and it the last. What was reached in vain once (how
far in time, who has taken effect, which state) is not tried again.

Source: Wing and Gong, Testing and Verifying Concurrent Objects (1993); just-in-time linearization and the memo of
configurations: Lowe, Testing for Linearizability (2017); the same for each key by itself: Herlihy and Wing's locality
(1990), as Horn and Kroening use it (P-compositionality, 2015), and the tool Porcupine.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from types import NoneType
from typing import Any, Final, Literal, cast

import msgspec

from ...actors.errors import HoldfastError
from ...actors.kernel.message import Refusal
from .history import UNKNOWN, History, Model, Operation
from .history_chart import as_chart

MOST_STEPS: Final = 2_000_000
"""Steps of the model that a search may take."""
EXPLAINING: Final = 4
"""What explains a violation may take so many times the steps that found it, and `LEAST` at least."""
LEAST: Final = 200_000


ATOMS: Final = frozenset({int, str, float, bool, bytes, NoneType})
"""Kinds of states that are compared as they are."""


class NotLinearizable(HoldfastError, AssertionError, text="{violation}"):
    """No order of the operations of a history gives what was heard."""

    violation: str


class TooHard(
    HoldfastError,
    text="{operations} operations took more than {steps} steps of the model, and nobody knows whether they are "
    "linearizable. Give the model a key, ask in smaller histories, have fewer operations whose outcome is unknown, or "
    "raise most_steps",
):
    """The search took more steps than it may."""

    operations: int
    steps: int


class ImpureModel(HoldfastError, text="the model changes the state that it is given, in {message}: return a new one"):
    """The step of a model changes its argument, so that no other order could be tried."""

    message: str


@dataclass(frozen=True)
class Linearization:
    """The history is linearizable: it could have happened in this order (of one key after the other)."""

    order: tuple[Operation, ...]

    def __bool__(self) -> Literal[True]:
        return True

    def verify(self) -> None:
        """Do nothing, for the history is as it should be."""


@dataclass(frozen=True)
class Violation:
    """The history is not linearizable. False where a truth value is asked for; `str` is a chart.

    Attributes:
        key: of the part that is not.
        operations: the shortest beginning of it that is not: those that were invoked before the outcome of one of them
            was there which no order explains.
        conflict: those of them whose outcomes contradict each other. Whatever the others had heard, no order would do.
        reached: the longest order that there is for the others; after it none of `stuck` can be next.
    """

    key: Hashable
    operations: tuple[Operation, ...]
    conflict: tuple[Operation, ...]
    reached: tuple[Operation, ...]
    stuck: tuple[Operation, ...]

    def __bool__(self) -> Literal[False]:
        return False

    def verify(self) -> None:
        """Raise NotLinearizable, with the chart."""
        raise NotLinearizable(str(self))

    def __str__(self) -> str:
        where = "" if self.key is None else f" of {self.key!r}"
        head = f"the history{where} is not linearizable: no order gives the outcomes marked with *"
        return "\n".join([head, as_chart(self.operations, self.conflict, self.reached)])

    __repr__ = __str__


def linearizable(
    history: History | Iterable[Operation], model: Model[Any], *, most_steps: int = MOST_STEPS
) -> Linearization | Violation:
    """Check whether the history could have happened one operation after the other, as the model allows.

    Args:
        history: what was asked and heard, or operations with times of your own.
        model: what the system should do.
        most_steps: of the model, for all keys together.

    Returns:
        A Linearization, which is true, or a Violation, which is false and whose text shows why.

    Raises:
        TooHard: it took too long to find out. ImpureModel: the model changes states in place. ValueError: an operation
        comes back before it is invoked, or has either an end or an outcome. TypeError: a state of the model cannot be
        compared with others. What the model raises, but Refusals.

    >>> def counter(state: int, amount: int) -> tuple[int, int]:
    ...     return state + amount, state + amount
    >>> first, second = Operation("a", 1, start=0, end=3, outcome=2), Operation("b", 1, start=1, end=2, outcome=1)
    >>> [one.client for one in linearizable([first, second], Model(0, counter)).order]
    ['b', 'a']
    >>> bool(linearizable([first], Model(0, counter)))
    False
    """
    operations = history.operations if isinstance(history, History) else list(history)
    for operation in operations:
        if not operation.start < operation.end:
            raise ValueError(f"it ends before it begins: {operation}")
        if (operation.outcome is UNKNOWN) != math.isinf(operation.end):
            raise ValueError(f"it has either an outcome and an end, or neither: {operation}")
    order: list[Operation] = []
    steps = Steps(most_steps, len(operations))
    for key, part in _parts(operations, model):
        search = Search(part, model, steps)
        if not search.succeeds():
            return _violation(key, search, model, steps)
        order += [part[index] for index in search.best]
    return Linearization(tuple(order))


def _parts(operations: list[Operation], model: Model[Any]) -> list[tuple[Hashable, list[Operation]]]:
    if model.key is None:
        return [(None, operations)]
    parts: dict[Hashable, list[Operation]] = {}
    for operation in operations:
        parts.setdefault(model.key(operation), []).append(operation)
    return list(parts.items())


class Steps:
    """How many steps of the model a search may take."""

    def __init__(self, most: int, operations: int) -> None:
        self.left = self._most = most
        self._operations = operations

    @property
    def taken(self) -> int:
        """So far."""
        return self._most - self.left

    def refuse(self) -> TooHard:
        """The error that says that there are none left."""
        return TooHard(self._operations, self._most)


class Return:
    """An outcome is there: by then the operation must have taken effect.

    Attributes:
        index: of the operation.
        bit: its place among those that are under way.
        pending: (index, bit) of those under way, which may take effect now: the first to come back come first.
        opened: how many that never come back have been invoked before it; they may take effect, too.
    """

    __slots__ = ("bit", "index", "opened", "pending")

    def __init__(self, index: int, bit: int, pending: list[tuple[int, int]], opened: int) -> None:
        self.index, self.bit, self.pending, self.opened = index, bit, pending, opened


Node = tuple[int, int, int, Any, Hashable]
"""(returns passed, bits of those that have taken effect before their return, of those that never come back, state,
frozen state)"""


class Search:
    """The search through one history.

    Args:
        operations: of one key.
        model: what they have to obey.
        steps: how many it may take.
        free: indexes of those whose outcome is left out of account.

    Attributes:
        best: indexes of the longest order that was found.
        furthest: the number of returns that could be passed at most.
        returns: all of them, in order.
    """

    def __init__(
        self, operations: Sequence[Operation], model: Model[Any], steps: Steps, free: AbstractSet[int] = frozenset()
    ) -> None:
        self._operations, self._model, self._steps = operations, model, steps
        self._known = [
            operation.outcome is not UNKNOWN and index not in free for index, operation in enumerate(operations)
        ]
        self._is_open = [math.isinf(operation.end) for operation in operations]
        self._opened: list[tuple[int, int]] = []
        self._kinds = self._alike()
        self.returns = self._in_order()
        self.best: list[int] = []
        self.furthest = 0

    def _alike(self) -> list[Hashable]:
        """A number for each operation, the same for those that only their times tell apart."""
        numbers: dict[Hashable, int] = {}
        kinds: list[Hashable] = []
        for index, operation in enumerate(self._operations):
            outcome = operation.outcome if self._known[index] else UNKNOWN
            message = operation.message
            kind = (type(message), message, type(outcome), outcome, self._is_open[index])
            try:
                kinds.append(numbers.setdefault(kind, index))
            except TypeError:  # It cannot be hashed: it is like no other.
                kinds.append(index)
        return kinds

    def _in_order(self) -> list[Return]:
        # At the same time: what comes back does so after what is invoked, so that they overlap.
        ends = [one.end for one in self._operations]
        events = [(one.start, 0, index) for index, one in enumerate(self._operations)]
        events += [(end, 1, index) for index, end in enumerate(ends) if not self._is_open[index]]
        events.sort()
        bits: dict[int, int] = {}
        unused: list[int] = []
        found: list[Return] = []
        for _, is_return, index in events:
            if is_return:
                pending = sorted(bits.items(), key=lambda item: (ends[item[0]], item[0]))
                found.append(Return(index, bits[index], pending, len(self._opened)))
                unused.append(bits.pop(index))
                continue
            if self._is_open[index]:
                self._opened.append((index, 1 << len(self._opened)))
            else:
                bits[index] = unused.pop() if unused else 1 << len(bits)
        return found

    def succeeds(self) -> bool:
        """Whether there is an order.

        Raises:
            as `linearizable`.
        """
        first = self._passed(0, 0, 0, self._model.initial, frozen(self._model.initial))
        ways = [self._next(first)]
        reached = [first[0]]
        seen: dict[tuple[int, int, Hashable], list[int]] = {}
        order: list[int] = []
        while ways and reached[-1] < len(self.returns):
            for index, node in ways[-1]:
                at, done, used, _, key = node
                before = seen.setdefault((at, done, key), [])
                for other in before:
                    if other & used == other:
                        break  # The same was reached with less: whatever follows here follows there.
                else:
                    before.append(used)
                    order.append(index)
                    reached.append(at)
                    ways.append(self._next(node))
                    break
            else:
                if (reached[-1], len(order)) > (self.furthest, len(self.best)):
                    self.furthest, self.best = reached[-1], order.copy()
                ways.pop()
                reached.pop()
                del order[-1:]
        if ways:
            self.best = order
        return bool(ways)

    def _next(self, node: Node) -> Iterator[tuple[int, Node]]:
        """What may take effect next, with what follows."""
        at, done, used, state, key = node
        back, kinds = self.returns[at], self._kinds
        tried: set[Hashable] = set()
        for index, bit in back.pending:
            # Of those that only their times tell apart the first to come back may as well be the first.
            if done & bit or kinds[index] in tried:
                continue
            tried.add(kinds[index])
            after, outcome = self._step(index, state, key)
            if self._known[index] and not self._model.same(self._operations[index].outcome, outcome):
                continue
            after_key = key if after is state else frozen(after)
            if index == back.index:
                yield index, self._passed(at, done | bit, used, after, after_key)
            else:
                yield index, (at, done | bit, used, after, after_key)
        for index, bit in itertools.islice(self._opened, back.opened):
            if used & bit or kinds[index] in tried:
                continue
            tried.add(kinds[index])
            after, _ = self._step(index, state, key)
            after_key = key if after is state else frozen(after)
            if after_key != key:  # Else it may as well never take effect.
                yield index, (at, done, used | bit, after, after_key)

    def _passed(self, at: int, done: int, used: int, state: Any, key: Hashable) -> Node:
        """Pass the returns of all that have taken effect."""
        returns = self.returns
        while at < len(returns) and done & returns[at].bit:
            done ^= returns[at].bit
            at += 1
        return at, done, used, state, key

    def _step(self, index: int, state: Any, key: Hashable) -> tuple[Any, object]:
        steps = self._steps
        if not steps.left:
            raise steps.refuse()
        steps.left -= 1
        message = self._operations[index].message
        try:
            after, outcome = self._model.step(state, message)
        except Refusal as refusal:
            after, outcome = state, refusal
        if key is not state and frozen(state) != key:
            raise ImpureModel(repr(message))
        return after, outcome


def frozen(state: Any) -> Hashable:
    """A value that equals another one exactly if the states do, and that can be hashed.

    Raises:
        TypeError: the state is of a kind that is not known.
    """
    kind: Any = type(state)
    if kind in ATOMS:
        return cast("Hashable", state)
    value: Hashable = state
    try:
        hash(value)
    except TypeError:
        pass
    else:
        if kind.__eq__ is object.__eq__ and not isinstance(state, (NoneType, Enum, type)):
            raise TypeError(_compare(state))  # By its address: two equal states would be two.
        return value
    match state:
        case Mapping():
            return "mapping", frozenset((key, frozen(value)) for key, value in state.items())
        case AbstractSet():
            return "set", frozenset(state)
        case list() | tuple():
            return type(state), tuple(map(frozen, state))
        case bytearray():
            return "bytes", bytes(state)
        case msgspec.Struct():
            return type(state), tuple(frozen(getattr(state, name)) for name in state.__struct_fields__)
        case _ if is_dataclass(state):
            return type(state), tuple(frozen(getattr(state, field.name)) for field in fields(state))
        case _:
            raise TypeError(_compare(state))


def _compare(state: object) -> str:
    return (
        f"a state of the model is a {type(state).__qualname__}, which cannot be compared: use numbers, texts, tuples, "
        "lists, mappings, sets, or dataclasses and structs of these"
    )


def _violation(key: Hashable, search: Search, model: Model[Any], steps: Steps) -> Violation:
    """What is wrong, with as few outcomes as contradict each other."""
    back = search.returns[search.furthest]
    end = search._operations[back.index].end
    before = [index for index, one in enumerate(search._operations) if one.start <= end]
    part = [search._operations[index] for index in before]
    told = Steps(min(steps.taken * EXPLAINING + LEAST, MOST_STEPS), len(part))
    reached = set(search.best)
    stuck = [search._operations[index] for index, _ in back.pending if index not in reached]
    return Violation(
        key,
        tuple(part),
        tuple(part[index] for index in _conflict(part, model, told)),
        tuple(search._operations[index] for index in search.best),
        tuple(stuck),
    )


def _conflict(operations: Sequence[Operation], model: Model[Any], steps: Steps) -> list[int]:
    """Those whose outcomes no order explains, whatever the others have heard: none of them can be left out.

    When the steps are used up, there are some more.
    """
    free: set[int] = set()
    kept = [index for index, one in enumerate(operations) if one.outcome is not UNKNOWN]
    size = len(kept)
    try:
        while size >= 1:
            at = 0
            while at < len(kept):
                tried = free.union(kept[at : at + size])
                if Search(operations, model, steps, tried).succeeds():
                    at += size
                else:
                    free = tried
                    del kept[at : at + size]
            size //= 2
    except TooHard:
        pass  # What is left contradicts itself, and some of it may be in no need of being there.
    return kept
