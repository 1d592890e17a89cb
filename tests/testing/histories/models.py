"""Sequential objects whose operations are tuples: ("write", 5), or with a key in front ("x", "write", 5)."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

from holdfast.testing import Model, Operation


def register_step(state: Any, message: tuple[Any, ...]) -> tuple[Any, Any]:
    """read -> value, write(value) -> None, cas(old, new) -> bool."""
    match message:
        case ("read",):
            return state, state
        case ("write", value):
            return value, None
        case ("cas", old, new):
            return (new, True) if state == old else (state, False)
        case _:
            raise ValueError(f"a register has no {message}")


def counter_step(state: int, message: tuple[Any, ...]) -> tuple[int, Any]:
    """read -> value, add(n) -> the value after it, bump(n) -> None."""
    match message:
        case ("read",):
            return state, state
        case ("add", amount):
            return state + amount, state + amount
        case ("bump", amount):
            return state + amount, None
        case _:
            raise ValueError(f"a counter has no {message}")


def bank_step(state: dict[str, int], message: tuple[Any, ...]) -> tuple[dict[str, int], Any]:
    """balance(account), total, transfer(giver, taker, amount) -> bool: False if there is not enough."""
    match message:
        case ("balance", account):
            return state, state.get(account, 0)
        case ("total",):
            return state, sum(state.values())
        case ("transfer", giver, taker, amount):
            if state.get(giver, 0) < amount:
                return state, False
            moved = {**state, giver: state[giver] - amount}
            return {**moved, taker: moved.get(taker, 0) + amount}, True
        case _:
            raise ValueError(f"a bank has no {message}")


def _key(operation: Operation) -> Hashable:
    key: Hashable = operation.message[0]
    return key


def _keyed_step(state: Any, message: tuple[Any, ...]) -> tuple[Any, Any]:
    return register_step(state, message[1:])


def register(initial: Any = None) -> Model[Any]:
    return Model(initial, register_step)


def key_value() -> Model[Any]:
    """A register for each key, None at first. Operations are (key, "write", value)."""
    return Model(None, _keyed_step, key=_key)


def counter(initial: int = 0) -> Model[int]:
    return Model(initial, counter_step)


def bank(**balances: int) -> Model[dict[str, int]]:
    return Model(balances, bank_step)
