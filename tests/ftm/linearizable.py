"""Whether a history of concurrent operations could have happened one after the other: a checker of linearizability.

A history is a list of operations with the times at which each was invoked and came back. It is linearizable if there is
an order of them that a sequential model allows, in which no operation stands before one that came back before it was
invoked. An operation whose outcome nobody knows (its client crashed, or waited too long) may have taken effect at any
time after it was invoked, or never.

Source: Wing and Gong 1993; the memo of configurations is Lowe's (2017); by key: Herlihy and Wing's locality.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

UNKNOWN: Final = object()
"""The result of an operation that has not come back."""
Step = Callable[[Any, str, tuple[Any, ...]], tuple[Any, Any]]
"""(state, name, arguments) -> (state after it, result). States can be hashed."""


@dataclass(frozen=True)
class Model:
    """A sequential object: its first state, and what an operation does to it. `by_key`: one such object per key."""

    initial: Hashable
    step: Step
    by_key: bool = False


@dataclass(frozen=True)
class Operation:
    """One operation of one client. Times are any numbers in the order of what happened; `end` is inf if it is open."""

    client: str
    name: str
    args: tuple[Any, ...]
    start: float
    end: float = math.inf
    result: Any = UNKNOWN
    key: Hashable = None

    def __str__(self) -> str:
        outcome = "?" if self.result is UNKNOWN else repr(self.result)
        where = "" if self.key is None else f"{self.key}."
        args = ", ".join(map(repr, self.args))
        return f"[{self.start:g}, {self.end:g}] {self.client}: {where}{self.name}({args}) -> {outcome}"


@dataclass
class History:
    """What clients do, written down while they do it: `begin`, then `end`; or neither `end` nor `forget`: unknown."""

    operations: list[Operation] = field(default_factory=list)
    _clock: itertools.count[int] = field(default_factory=itertools.count)

    def begin(self, client: str, name: str, *args: Any, key: Hashable = None) -> int:
        """An operation is invoked; the number is for `end`."""
        self.operations.append(Operation(client, name, args, next(self._clock), key=key))
        return len(self.operations) - 1

    def end(self, number: int, result: Any) -> None:
        """It came back."""
        self.operations[number] = replace(self.operations[number], end=next(self._clock), result=result)

    def forget(self, number: int) -> None:
        """It is known that it had no effect: it was refused, or never handled."""
        self.operations[number] = replace(self.operations[number], name="")

    def known(self) -> list[Operation]:
        """All but those that are known to have had no effect."""
        return [operation for operation in self.operations if operation.name]


@dataclass(frozen=True)
class Linearizable:
    """It could have happened in this order (of one key after the other)."""

    order: tuple[Operation, ...]


@dataclass(frozen=True)
class Violation:
    """It could not. `reached` is as far as an order can be had, then none of `stuck` can be next."""

    key: Hashable
    reached: tuple[Operation, ...]
    stuck: tuple[Operation, ...]

    def __str__(self) -> str:
        where = "" if self.key is None else f" of {self.key!r}"
        return "\n".join(
            [
                f"the history{where} is not linearizable. At best:",
                *(f"  {operation}" for operation in self.reached),
                "and then none of these can be next:",
                *(f"  {operation}" for operation in self.stuck),
            ]
        )


class TooHard(Exception):
    """The search took more steps than it may: nobody knows."""


def check(
    history: History | Iterable[Operation], model: Model, *, most_steps: int = 2_000_000
) -> Linearizable | Violation:
    """Whether the history is linearizable.

    Raises:
        TooHard: it took too long to find out. ValueError: an operation comes back before it is invoked.
    """
    operations = history.known() if isinstance(history, History) else list(history)
    for operation in operations:
        if not operation.start < operation.end:
            raise ValueError(f"it ends before it begins: {operation}")
        if (operation.result is UNKNOWN) != math.isinf(operation.end):
            raise ValueError(f"it has either a result and an end, or neither: {operation}")
    order: list[Operation] = []
    for key, part in _parts(operations, model):
        found = _search(part, model, key, most_steps)
        if isinstance(found, Violation):
            return found
        order.extend(found)
    return Linearizable(tuple(order))


def _parts(operations: list[Operation], model: Model) -> list[tuple[Hashable, list[Operation]]]:
    if not model.by_key:
        return [(None, operations)]
    parts = defaultdict[Hashable, list[Operation]](list)
    for operation in operations:
        parts[operation.key].append(operation)
    return list(parts.items())


class _Entry:
    """An invocation (`back` is its return, if it has one) or a return, in a list in the order of time."""

    __slots__ = ("back", "before", "index", "is_call", "next")

    def __init__(self, index: int, *, is_call: bool) -> None:
        self.index, self.is_call = index, is_call
        self.before: _Entry | None = None
        self.next: _Entry | None = None
        self.back: _Entry | None = None

    def take(self) -> None:
        """Out of the list, with its return."""
        for entry in (self, self.back):
            if entry is not None:
                assert entry.before is not None
                entry.before.next = entry.next
                if entry.next is not None:
                    entry.next.before = entry.before

    def put_back(self) -> None:
        """To where it was."""
        for entry in (self.back, self):
            if entry is not None:
                assert entry.before is not None
                entry.before.next = entry
                if entry.next is not None:
                    entry.next.before = entry


def _entries(operations: Sequence[Operation]) -> _Entry:
    """The head of the list."""
    timed: list[tuple[float, int, _Entry]] = []
    for index, operation in enumerate(operations):
        call = _Entry(index, is_call=True)
        # At the same time: what comes back does so after what is invoked, so that they overlap.
        timed.append((operation.start, 0, call))
        if not math.isinf(operation.end):
            call.back = _Entry(index, is_call=False)
            timed.append((operation.end, 1, call.back))
    head = last = _Entry(-1, is_call=False)
    for _, _, entry in sorted(timed, key=lambda one: one[:2]):
        last.next, entry.before = entry, last
        last = entry
    return head


def _search(
    operations: Sequence[Operation], model: Model, key: Hashable, most_steps: int
) -> list[Operation] | Violation:
    head = _entries(operations)
    left = sum(not math.isinf(operation.end) for operation in operations)  # that must find their place
    state, placed = model.initial, 0
    taken: list[tuple[_Entry, Any]] = []
    seen: set[tuple[int, Hashable]] = set()
    deepest: tuple[list[int], list[int]] = ([], [])
    entry = head.next
    for _ in range(most_steps):
        if not left:
            return [operations[one.index] for one, _ in taken]
        if entry is not None and entry.is_call:
            operation = operations[entry.index]
            after, result = model.step(state, operation.name, operation.args)
            config = (placed | 1 << entry.index, after)
            if (operation.result is UNKNOWN or operation.result == result) and config not in seen:
                seen.add(config)
                taken.append((entry, state))
                state, placed = after, config[0]
                left -= entry.back is not None
                entry.take()
                entry = head.next
            else:
                entry = entry.next
            continue
        # A return of what has no place yet: nothing behind it can come first.
        if len(taken) >= len(deepest[0]):
            deepest = ([one.index for one, _ in taken], _waiting(head))
        if not taken:
            reached, stuck = deepest
            return Violation(key, tuple(operations[at] for at in reached), tuple(operations[at] for at in stuck))
        undone, state = taken.pop()
        placed &= ~(1 << undone.index)
        left += undone.back is not None
        undone.put_back()
        entry = undone.next
    raise TooHard(f"{len(operations)} operations took more than {most_steps} steps")


def _waiting(head: _Entry) -> list[int]:
    """Those that could be next: invoked before the first return."""
    waiting: list[int] = []
    entry = head.next
    while entry is not None and entry.is_call:
        waiting.append(entry.index)
        entry = entry.next
    return waiting


# -- models ----------------------------------------------------------------------------------------------------------


def _register(state: Any, name: str, args: tuple[Any, ...]) -> tuple[Any, Any]:
    match name, args:
        case "read", ():
            return state, state
        case "write", (value,):
            return value, None
        case "cas", (old, new):
            return (new, True) if state == old else (state, False)
        case "delete", ():
            return None, state is not None
        case _:
            raise ValueError(f"a register has no {name}{args}")


def _counter(state: Any, name: str, args: tuple[Any, ...]) -> tuple[Any, Any]:
    match name, args:
        case "read", ():
            return state, state
        case "add", (amount,):
            return state + amount, state + amount
        case "bump", (amount,):  # says nothing of the value
            return state + amount, None
        case _:
            raise ValueError(f"a counter has no {name}{args}")


def _bank(state: Any, name: str, args: tuple[Any, ...]) -> tuple[Any, Any]:
    balances = dict(state)
    match name, args:
        case "balance", (account,):
            return state, balances.get(account, 0)
        case "total", ():
            return state, sum(balances.values())
        case "transfer", (giver, taker, amount):
            if balances.get(giver, 0) < amount:
                return state, False
            balances[giver] -= amount
            balances[taker] = balances.get(taker, 0) + amount
            return tuple(sorted(balances.items())), True
        case _:
            raise ValueError(f"a bank has no {name}{args}")


def register(initial: Hashable = None) -> Model:
    """read() -> value, write(value) -> None, cas(old, new) -> bool."""
    return Model(initial, _register)


def key_value() -> Model:
    """A register for each key, None at first; delete() -> bool, too."""
    return Model(None, _register, by_key=True)


def counter(initial: int = 0) -> Model:
    """read() -> value, add(n) -> the value after it, bump(n) -> None."""
    return Model(initial, _counter)


def bank(**balances: int) -> Model:
    """balance(account), total(), transfer(giver, taker, amount) -> bool: False if there is not enough."""
    return Model(tuple(sorted(balances.items())), _bank)
