"""The checker of linearizability, on histories that are known to be good or bad, and against all orders there are."""

import dataclasses
import itertools
import math
import random
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import holdfast as hf
from holdfast.testing import (
    UNKNOWN,
    ImpureModel,
    Linearization,
    Model,
    NotLinearizable,
    Operation,
    TooHard,
    Violation,
    linearizable,
)
from tests.testing.histories.models import bank, counter, key_value, register

OPEN = math.inf


def op(client: str, start: float, end: float, call: str, *args: Any, to: Any = UNKNOWN, key: Any = None) -> Operation:
    return Operation(client, (call, *args) if key is None else (key, call, *args), start, end, to)


def written(client: str, start: float, end: float, value: Any, key: Any = None) -> Operation:
    return op(client, start, end, "write", value, to=None, key=key)


def read(client: str, start: float, end: float, value: Any, key: Any = None) -> Operation:
    return op(client, start, end, "read", to=value, key=key)


def is_good(operations: Sequence[Operation], model: Model[Any]) -> bool:
    return bool(linearizable(operations, model))


GOOD: dict[str, tuple[Model[Any], list[Operation]]] = {
    "nothing": (register(), []),
    "one after the other": (register(), [written("a", 0, 1, 5), read("b", 2, 3, 5)]),
    "a read beside a write sees the old value": (register(), [written("a", 0, 3, 5), read("b", 1, 2, None)]),
    "a read beside a write sees the new value": (register(), [written("a", 0, 3, 5), read("b", 1, 2, 5)]),
    "two writes beside each other in the other order": (
        register(),
        [written("a", 0, 5, 1), written("b", 1, 4, 2), read("c", 6, 7, 1)],
    ),
    "Herlihy and Wing's H1, as a register": (
        register(0),
        [written("a", 0, 9, 1), read("b", 1, 2, 0), read("c", 3, 4, 1), read("b", 5, 6, 1)],
    ),
    "a write that nobody knows of took effect": (register(), [op("a", 0, OPEN, "write", 5), read("b", 8, 9, 5)]),
    "a write that nobody knows of did not": (register(), [op("a", 0, OPEN, "write", 5), read("b", 8, 9, None)]),
    "a write that nobody knows of took effect late": (
        register(),
        [op("a", 0, OPEN, "write", 5), read("b", 1, 2, None), read("b", 3, 4, 5)],
    ),
    "one of two wins": (
        register(0),
        [op("a", 0, 3, "cas", 0, 1, to=False), op("b", 1, 2, "cas", 0, 2, to=True), read("c", 4, 5, 2)],
    ),
    "counting beside each other": (
        counter(),
        [op("a", 0, 3, "add", 1, to=2), op("b", 1, 2, "add", 1, to=1), op("c", 4, 5, "read", to=2)],
    ),
    "keys have nothing to do with each other": (
        key_value(),
        [written("a", 0, 1, 1, "x"), read("b", 2, 3, None, "y"), read("b", 4, 5, 1, "x")],
    ),
    "a transfer is seen whole": (
        bank(a=10),
        [
            op("c", 0, 9, "transfer", "a", "b", 4, to=True),
            op("d", 1, 2, "total", to=10),
            op("d", 3, 4, "balance", "b", to=4),
        ],
    ),
    "touching times overlap": (register(), [written("a", 0, 1, 5), read("b", 1, 2, None)]),
}

BAD: dict[str, tuple[Model[Any], list[Operation]]] = {
    "a lost write": (register(), [written("a", 0, 1, 5), read("b", 2, 3, None)]),
    "a value from nowhere": (register(), [written("a", 0, 1, 5), read("b", 2, 3, 6)]),
    "new, then old": (
        register(0),
        [written("a", 0, 9, 1), read("b", 1, 2, 1), read("c", 3, 4, 0)],
    ),
    "a stale read after a failover": (
        register(),
        [written("a", 0, 1, 1), written("a", 2, 3, 2), read("b", 4, 5, 1)],
    ),
    "split brain: two readers see two orders": (
        register(),
        [
            written("a", 0, 1, 1),
            written("b", 0, 1, 2),
            read("c", 2, 3, 1),
            read("d", 2, 3, 2),
            read("c", 4, 5, 1),
        ],
    ),
    "both of two win": (
        register(0),
        [op("a", 0, 3, "cas", 0, 1, to=True), op("b", 1, 2, "cas", 0, 2, to=True)],
    ),
    "counted twice": (counter(), [op("a", 0, 1, "add", 1, to=1), op("b", 2, 3, "add", 1, to=3)]),
    "not counted": (counter(), [op("a", 0, 1, "add", 1, to=1), op("b", 2, 3, "add", 1, to=1)]),
    "a bump that was executed twice": (
        counter(),
        [op("a", 0, 1, "bump", 1, to=None), op("b", 2, 3, "read", to=2)],
    ),
    "an unknown one took effect twice": (
        counter(),
        [op("a", 0, OPEN, "add", 1), op("b", 1, 2, "read", to=2)],
    ),
    "an unknown one took effect before it was invoked": (
        register(),
        [read("b", 0, 1, 5), op("a", 2, OPEN, "write", 5)],
    ),
    "an unknown one took effect and was undone": (
        register(),
        [op("a", 0, OPEN, "write", 5), read("b", 1, 2, 5), read("b", 3, 4, None)],
    ),
    "one of the keys is wrong": (
        key_value(),
        [written("a", 0, 1, 1, "x"), written("a", 0, 1, 1, "y"), read("b", 2, 3, None, "y"), read("b", 4, 5, 1, "x")],
    ),
    "half of a transfer is seen": (
        bank(a=10),
        [
            op("c", 0, 9, "transfer", "a", "b", 4, to=True),
            op("d", 1, 2, "balance", "b", to=4),
            op("d", 3, 4, "balance", "a", to=10),
        ],
    ),
    "more was given than there was": (
        bank(a=10),
        [op("c", 0, 9, "transfer", "a", "b", 7, to=True), op("d", 0, 9, "transfer", "a", "c", 7, to=True)],
    ),
}  # fmt: skip


class Anything:
    """Equals every outcome."""

    def __eq__(self, other: object) -> bool:
        return True

    __hash__ = None  # type: ignore[assignment]


def unsaid(operations: Sequence[Operation], kept: Sequence[Operation]) -> list[Operation]:
    """As if all but those that are kept had heard whatever would do."""
    return [
        one if one in kept or one.outcome is UNKNOWN else dataclasses.replace(one, outcome=Anything())
        for one in operations
    ]


@pytest.mark.parametrize("name", GOOD)
def test_this_history_is_good(name: str) -> None:
    model, operations = GOOD[name]
    found = linearizable(operations, model)
    assert isinstance(found, Linearization), str(found)
    found.verify()
    done = [operation for operation in operations if operation.outcome is not UNKNOWN]
    assert all(operation in found.order for operation in done)


@pytest.mark.parametrize("name", BAD)
def test_this_history_is_bad(name: str) -> None:
    model, operations = BAD[name]
    found = linearizable(operations, model)
    assert isinstance(found, Violation)
    assert found.stuck
    assert set(found.conflict) <= set(found.operations)
    assert not linearizable(unsaid(found.operations, found.conflict), model)
    for one in found.conflict:
        assert linearizable(unsaid(found.operations, [other for other in found.conflict if other is not one]), model)
    with pytest.raises(NotLinearizable, match="no order gives the outcomes marked with"):
        found.verify()


@pytest.mark.parametrize("name", [*GOOD, *BAD])
def test_the_order_in_which_it_was_written_down_does_not_matter(name: str) -> None:
    model, operations = {**GOOD, **BAD}[name]
    for seed in range(5):
        shuffled = random.Random(seed).sample(operations, len(operations))
        assert is_good(shuffled, model) == (name in GOOD)


def test_a_violation_shows_the_shortest_beginning_and_what_contradicts_itself_in_it() -> None:
    lost = [written("a", 0, 1, 5, "x"), read("b", 2, 3, None, "x"), read("b", 6, 7, 5, "x"), read("b", 4, 5, 9, "y")]
    found = linearizable(lost, key_value())
    assert isinstance(found, Violation)
    assert found.key == "x"
    assert [one.message[1] for one in found.operations] == ["write", "read"]
    assert (found.reached, found.stuck, found.conflict) == ((lost[0],), (lost[1],), (lost[1],))
    assert str(found).splitlines()[1:3] == [
        "  1 0.000 a []    ('x', 'write', 5) -> None",
        "* - 0.000 b   []  ('x', 'read') -> None",
    ]


# -- against all orders ---------------------------------------------------------------------------------------------


def is_good_by_trying_all(operations: Sequence[Operation], model: Model[Any]) -> bool:
    """What the definition says, without any cleverness."""
    done = [one for one in operations if one.outcome is not UNKNOWN]
    unknown = [one for one in operations if one.outcome is UNKNOWN]
    for count in range(len(unknown) + 1):
        for some in itertools.combinations(unknown, count):
            for order in itertools.permutations([*done, *some]):
                if _respects_time(order) and _is_allowed(order, model):
                    return True
    return False


def _respects_time(order: Sequence[Operation]) -> bool:
    return not any(later.end < earlier.start for earlier, later in itertools.combinations(order, 2))


def _is_allowed(order: Sequence[Operation], model: Model[Any]) -> bool:
    state = model.initial
    for one in order:
        state, result = model.step(state, one.message)
        if one.outcome is not UNKNOWN and one.outcome != result:
            return False
    return True


calls = st.sampled_from(
    [(("read",), 0), (("read",), 1), (("read",), 2), (("write", 1), None), (("write", 2), None),
     (("cas", 0, 1), True), (("cas", 1, 2), False), (("cas", 1, 2), True)]
)  # fmt: skip


@st.composite
def histories(draw: st.DrawFn) -> list[Operation]:
    made: list[Operation] = []
    for index in range(draw(st.integers(1, 6))):
        message, outcome = draw(calls)
        start = draw(st.integers(0, 8))
        if draw(st.integers(0, 5)) == 0:
            made.append(Operation(f"{index}", message, start))
        else:
            made.append(Operation(f"{index}", message, start, start + draw(st.integers(1, 6)), outcome))
    return made


@settings(max_examples=400)
@given(histories())
def test_it_says_what_trying_all_orders_says(operations: list[Operation]) -> None:
    assert is_good(operations, register(0)) == is_good_by_trying_all(operations, register(0))


# -- larger ones ----------------------------------------------------------------------------------------------------


def executed(model: Model[Any], seed: int, count: int, clients: int) -> list[Operation]:
    """A history that happened: each takes effect somewhere between its invocation and its return."""
    chance, state, clock, made = random.Random(seed), model.initial, 0.0, list[Operation]()
    free = [0.0] * clients
    for _ in range(count):
        client = chance.randrange(clients)
        clock += chance.random()
        start = max(free[client], clock - chance.random() * 3)
        clock = max(clock, start + 0.001)
        message = chance.choice([("read",), ("write", chance.randrange(5)), ("cas", chance.randrange(5), 1)])
        state, outcome = model.step(state, message)
        end = clock + 0.001 + chance.random() * 3
        free[client] = end + 0.001
        if chance.random() < 0.02:
            made.append(Operation(f"{client}", message, start))
            free[client] = math.inf if clients > 90 else end + 0.001
        else:
            made.append(Operation(f"{client}", message, start, end, outcome))
        clock = max(clock, start)
    return made


@pytest.mark.parametrize("seed", range(10))
def test_what_happened_is_good_and_a_stale_read_in_it_is_found(seed: int) -> None:
    operations = executed(register(0), seed, 400, 6)
    assert is_good(operations, register(0))
    chance = random.Random(seed)
    at = chance.choice(
        [at for at, one in enumerate(operations) if one.message == ("read",) and one.outcome is not UNKNOWN]
    )
    wrong = Operation("x", ("read",), operations[at].start, operations[at].end, "never written")
    assert not is_good([*operations[:at], wrong, *operations[at + 1 :]], register(0))


def test_ten_thousand_requests_on_many_keys_are_checked() -> None:
    operations = [
        Operation(one.client, (key, *one.message), one.start, one.end, one.outcome)
        for key in range(50)
        for one in executed(register(), key, 200, 5)
    ]
    assert len(operations) == 10_000
    assert is_good(operations, key_value())


def test_a_search_that_takes_too_long_says_so() -> None:
    beside = [op(f"{n}", 0, 1, "bump", 2**n, to=None) for n in range(20)]
    with pytest.raises(TooHard, match="21 operations took more than 1000 steps"):
        linearizable([*beside, op("r", 2, 3, "read", to=-1)], counter(), most_steps=1000)


# -- models ---------------------------------------------------------------------------------------------------------


def test_a_model_that_changes_its_state_in_place_is_found_out() -> None:
    def step(state: list[int], message: tuple[Any, ...]) -> tuple[list[int], None]:
        state.append(message[1])
        return state, None

    with pytest.raises(ImpureModel, match="return a new one"):
        linearizable([written("a", 0, 1, 5)], Model([], step))


def test_a_state_that_cannot_be_compared_is_refused() -> None:
    class State:
        pass

    with pytest.raises(TypeError, match="State, which cannot be compared"):
        linearizable([written("a", 0, 1, 5)], Model(State(), lambda state, message: (state, None)))


class Full(hf.Refusal):
    most: int


@dataclasses.dataclass
class Stack:
    """A state that cannot be hashed, of all kinds of values that cannot."""

    items: list[int]
    seen: set[int]
    last: dict[str, bytearray]


def push(state: Stack, message: tuple[str, int]) -> tuple[Stack, int]:
    if len(state.items) == 2:
        raise Full(2)
    name, number = message
    after = Stack([*state.items, number], {*state.seen, number}, {**state.last, name: bytearray([number])})
    return after, len(after.items)


def test_a_refusal_of_the_model_is_an_outcome_and_its_state_need_not_be_hashable() -> None:
    model = Model(Stack([], set(), {}), push)
    beside = [op("a", 0, 9, "push", 1, to=2), op("b", 0, 9, "push", 2, to=1), op("c", 3, 9, "push", 3, to=Full(2))]
    assert is_good(beside, model)
    assert not is_good([*beside[:2], dataclasses.replace(beside[2], outcome=Full(3))], model)
    assert not is_good([*beside[:2], dataclasses.replace(beside[2], outcome=3)], model)


def test_what_is_no_history_is_refused() -> None:
    with pytest.raises(ValueError, match="ends before it begins"):
        linearizable([read("a", 2, 1, None)], register())
    with pytest.raises(ValueError, match="either an outcome and an end"):
        linearizable([op("a", 0, 1, "read")], register())
    for model in (register(), counter(), bank()):
        with pytest.raises(ValueError, match="has no "):
            linearizable([op("a", 0, 1, "fly", to=None)], model)


def test_a_chart_shows_the_last_of_many_and_all_that_contradict_each_other() -> None:
    many = [written("a", 2 * n, 2 * n + 1, n) for n in range(100)]
    found = linearizable([*many, read("b", 200, 201, 7), op("c", 150, OPEN, "write", 3)], register())
    assert isinstance(found, Violation)
    text = str(found).splitlines()
    assert text[1] == "  ... 78 of 102 are not shown"
    assert [line.startswith("*") for line in text[2:-1]].count(True) == len(found.conflict)
    assert len(text) == 1 + 1 + 24 + 1
