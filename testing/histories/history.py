"""A history: what clients have asked of actors, when, and what they heard."""

from __future__ import annotations

import asyncio
import enum
import itertools
import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Any, Final, Generic, TypeVar

from ...actors.errors import AskTimeout, HoldfastError, SendError
from ...actors.kernel.message import Message, Refusal
from ...actors.kernel.ref import DEFAULT_TIMEOUT, ActorRef

R = TypeVar("R")
S = TypeVar("S")


class Unknown(enum.Enum):
    """The type of UNKNOWN."""

    UNKNOWN = "?"

    def __repr__(self) -> str:
        return "?"


UNKNOWN: Final = Unknown.UNKNOWN
"""The outcome of an operation of which nobody knows whether it took effect."""


@dataclass(frozen=True)
class Operation:
    """One operation of one client.

    Attributes:
        client: who asked.
        message: what was asked: a message, or whatever the model understands.
        start: when it was invoked: any number, in the order of what happened.
        end: when its outcome was there, by the same numbers; inf: it never was.
        outcome: the reply, or the Refusal that was raised; UNKNOWN: it may take effect at any time, or never.
        to: the address of the actor that was asked, if there is one.
        at: when it was invoked, in seconds on the clock of the loop; for charts alone.
    """

    client: str
    message: Any
    start: float
    end: float = math.inf
    outcome: object = UNKNOWN
    to: str = ""
    at: float = 0.0

    def __str__(self) -> str:
        return f"{self.client}: {self.told()}"

    def told(self) -> str:
        """Say in words what was asked of whom, and what came back."""
        return f"{f'{self.to} ' if self.to else ''}{self.message!r} -> {self.outcome!r}"


def same_outcome(heard: object, expected: object) -> bool:
    """Say whether two outcomes are one: equal replies, or errors of one class with equal arguments."""
    if isinstance(expected, BaseException):
        return type(heard) is type(expected) and heard.args == expected.args
    return bool(heard == expected)


@dataclass(frozen=True)
class Model(Generic[S]):
    """A sequential specification: what an actor would do if it were asked one thing after the other.

    Attributes:
        initial: the state at the beginning.
        step: (state, message) -> (state after it, reply). It must be pure: the state it gets stays as it is. A Refusal
            that it raises is the outcome, and the state stays.
        key: the part of the system that an operation is about. Operations of different keys have nothing to do with
            each other and are judged one key after the other, each from `initial`; that is much quicker.
        same: whether the outcome that was heard is the one that `step` gave.
    """

    initial: S
    step: Callable[[S, Any], tuple[S, object]]
    key: Callable[[Operation], Hashable] | None = None
    same: Callable[[object, object], bool] = same_outcome


class History:
    """A record of what clients do, written down while they do it.

    `ask` and `tell` do both. For what is no ask of an actor there are `begin`, and then `end` or `forget`; an operation
    that neither follows is one of which nobody knows whether it took effect.

    Attributes:
        operations: all of them, in the order in which they were invoked, without those that surely had no effect.
    """

    def __init__(self) -> None:
        self._all: dict[int, Operation] = {}
        self._numbers = itertools.count()
        self._clock = itertools.count()

    @property
    def operations(self) -> list[Operation]:
        """Return all operations, in the order in which they were invoked, without those that surely had no effect."""
        return list(self._all.values())

    def begin(self, client: str, message: object, *, to: str = "", at: float = 0.0) -> int:
        """Note that an operation is invoked. Returns its number, for `end` and `forget`."""
        number = next(self._numbers)
        self._all[number] = Operation(client, message, next(self._clock), to=to, at=at)
        return number

    def end(self, number: int, outcome: object) -> None:
        """Note the outcome of an operation: the reply, or a Refusal."""
        self._all[number] = replace(self._all[number], end=next(self._clock), outcome=outcome)

    def forget(self, number: int) -> None:
        """Take an operation out that surely had no effect: it was refused, or never handled."""
        del self._all[number]

    def ask(
        self, ref: ActorRef[Any], message: Message[R], timeout: float = DEFAULT_TIMEOUT, *, client: str | None = None
    ) -> asyncio.Future[R]:
        """Ask as `ref.ask` does, and write it down: for tests and programs, not for the turns of actors.

        A reply and a Refusal are outcomes. After an error that says that the message was surely not handled (SendError,
        AskTimeout with `handled=False`) the operation is forgotten. After any other (a time-out, a crash, a lost
        connection) and after a wait that was cancelled before there was a reply it is unknown.

        Args:
            ref, message, timeout: of `ref.ask`.
            client: who asks; by default the name of the task that does.
        """
        number = self._begin(ref, message, client)
        try:
            asked = ref.ask(message, timeout)
        except BaseException:
            self.forget(number)  # Refused at the call.
            raise
        told: asyncio.Future[R] = asked.get_loop().create_future()

        def note(asked: asyncio.Future[R]) -> None:
            # Written down before whoever waits goes on: what that one does next comes after this.
            if asked.cancelled():
                told.cancel()
                return
            error = asked.exception()
            if error is None:
                self.end(number, asked.result())
            elif isinstance(error, Refusal):
                self.end(number, error)
            elif isinstance(error, SendError) or (isinstance(error, AskTimeout) and error.handled is False):
                self.forget(number)
            if told.done():
                return
            if error is None:
                told.set_result(asked.result())
            else:
                told.set_exception(error)

        def give_up(told: asyncio.Future[R]) -> None:
            if told.cancelled():
                asked.cancel()

        asked.add_done_callback(note)
        told.add_done_callback(give_up)
        return told

    def tell(self, ref: ActorRef[Any], message: Message[Any], *, client: str | None = None) -> None:
        """Tell as `ref.tell` does, and write it down: it takes effect some time, or never."""
        number = self._begin(ref, message, client)
        try:
            ref.tell(message)
        except HoldfastError:
            self.forget(number)
            raise

    def _begin(self, ref: ActorRef[Any], message: object, client: str | None) -> int:
        loop = ref._cell.node.loop
        return self.begin(client or _task_name(), message, to=ref.path, at=loop.time())

    def __str__(self) -> str:
        return "\n".join(map(str, self.operations))


def _task_name() -> str:
    try:
        task = asyncio.current_task()
    except RuntimeError:  # No loop runs.
        task = None
    return "client" if task is None else task.get_name()
