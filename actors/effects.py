"""Effects: what a turn does to the outside world, with a time limit and further attempts."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import random
from collections.abc import Awaitable, Callable
from contextlib import AbstractAsyncContextManager
from contextvars import ContextVar
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import msgspec

from .backoff import Backoff
from .errors import (
    EffectFailed,
    EffectInDoubt,
    HoldfastError,
    SpecError,
    can_be_written,
    error_text,
    shown,
    type_name,
)
from .seconds import check_seconds


@dataclasses.dataclass(frozen=True, slots=True)
class Retry:
    """Say how often an effect is attempted, and how long it waits between two attempts.

    Attempts are not journaled: the next life of the actor, which has no outcome of the effect yet, counts them from 1.

    Attributes:
        attempts: how often at most in one life, >= 1.
        backoff: how long it waits before each further attempt.
        on: classes of errors after which it is attempted again. After any other error it has failed.

    >>> Retry(attempts=5, backoff=Backoff(initial=0.1), on=(ConnectionError,)).attempts
    5
    """

    attempts: int = 3
    backoff: Backoff = dataclasses.field(default_factory=Backoff)
    on: tuple[type[Exception], ...] = (Exception,)

    def __post_init__(self) -> None:
        if not isinstance(self.attempts, int) or isinstance(self.attempts, bool) or self.attempts < 1:
            raise SpecError("Retry", f"attempts must be a whole number >= 1, not {self.attempts!r}")
        if not isinstance(self.backoff, Backoff):
            raise SpecError("Retry", f"backoff must be a Backoff, not {self.backoff!r}")
        if not isinstance(self.on, tuple) or not all(isinstance(k, type) and issubclass(k, Exception) for k in self.on):
            raise SpecError("Retry", f"on must be a tuple of classes of errors, not {self.on!r}")


ONCE = Retry(attempts=1)
"""No further attempt."""

Isolation: TypeAlias = Literal["thread", "process"]
"""Where the plain function of an effect runs."""

LONGEST_LINE: Final = 200
"""Characters of what an attempt has raised."""

_token: ContextVar[int] = ContextVar("fencing_token", default=0)
"""While an effect is performed: the fencing token of the life that performs it."""


class FunctionRaised(Exception):
    """A function in another process has raised something: its type, what it says, and all types that it is of."""

    def __init__(self, kind: str, text: str, kinds: list[str]) -> None:
        super().__init__(kind, text, kinds)
        self.kind, self.text, self.kinds = kind, text, kinds


class FunctionDied(Exception):
    """The process of a function has ended before the function."""


def begin_effect(token: int) -> None:
    """From here on an effect is performed, by the life with this fencing token."""
    _token.set(token)


def fencing_token() -> int:
    """Return the fencing token of the life that makes this effect, for the other side to refuse what comes too late.

    Call it in the function of a `ctx.effect`. A later life of the actor has a larger token, and so has a replica that
    leads after another one; two effects of one life have the same. The other side keeps the largest token that it has
    seen, and refuses what comes with a smaller one: that is from a life which has been replaced and does not know it,
    such as a thread that was left behind.

    It is no part of the turn: a handler that is run again would see another one, and could go another way.

    Raises:
        HoldfastError: no effect is being performed here.

    Source:
        Kleppmann 2016, "How to do distributed locking".
    """
    token = _token.get()
    if not token:
        raise HoldfastError("a fencing token belongs to an effect: read it in the function that ctx.effect calls")
    return token


class FailedAttempt(NamedTuple):
    """An attempt of an effect that has failed, and is followed by another one.

    Attributes:
        number: which attempt it was, from 1.
        most: how many there may be.
        error: what it has raised, in a line.
        seconds: from its end to the next one.
    """

    number: int
    most: int
    error: str
    seconds: float


class EffectCall(msgspec.Struct, frozen=True, eq=False):
    """One effect of a turn: the function, and how it is attempted.

    Attributes:
        function: what is called, with `args`.
        key: what names it where a replay is compared, and in errors and events.
        timeout: seconds that one attempt may take; None: as long as it wants.
        retry: how often it is attempted.
        at_most_once: whether it is in doubt, and is not attempted again, when its process has ended.
        is_async: whether the function is awaited on the event loop.
        isolation: whether any other runs in a thread or in a process of its own.
    """

    function: Callable[..., Any]
    args: tuple[Any, ...]
    key: str
    timeout: float | None
    retry: Retry
    at_most_once: bool
    is_async: bool
    isolation: Isolation

    async def perform(
        self,
        path: str,
        run: Callable[..., Awaitable[Any]],
        seed: int,
        token: int,
        failed: Callable[[FailedAttempt], None],
        around: Callable[[], AbstractAsyncContextManager[None]],
    ) -> object:
        """Attempt it until it succeeds or has failed, and return what it returns. It is awaited in a task of its own.

        Args:
            path: the address of the actor.
            run: runs a function with its arguments in a thread or a process.
            seed: of the jitter of the back-off.
            token: the fencing token of the life that performs it.
            failed: is told of each attempt that is followed by another one.
            around: makes what is entered before each attempt, and is left behind it; its time limit begins inside.

        Raises:
            EffectFailed: the last attempt has raised, or has taken too long, or its process has ended.
            EffectInDoubt: its process has ended, and it is made at most once.
            HoldfastError: the function has raised one itself: that is its answer, and is not attempted again.
        """
        begin_effect(token)
        numbers: random.Random | None = None
        attempt = 0
        while True:
            attempt += 1
            limit = None if self.timeout is None else asyncio.timeout(self.timeout)
            try:
                async with around(), limit or contextlib.nullcontext():
                    return await (self.function(*self.args) if self.is_async else run(self.function, *self.args))
            except HoldfastError:
                raise
            except BaseException as error:  # Whatever a function can raise; it ends neither the program nor its actor.
                if isinstance(error, asyncio.CancelledError) and _is_cancelled():
                    raise
                if isinstance(error, FunctionDied) and self.at_most_once:
                    raise EffectInDoubt(path, self.key) from error
                kind, text = type_name(type(error)), error_text(error)
                if isinstance(error, FunctionRaised):
                    kind, text = error.kind, error.text
                elif limit is not None and limit.expired() and isinstance(error, TimeoutError):
                    text = f"it took longer than {self.timeout:g} s"
                if attempt >= self.retry.attempts or not is_one_of(error, self.retry.on):
                    raise EffectFailed(self.key, attempt, kind, text) from error
            numbers = numbers or random.Random(seed)
            delay = self.retry.backoff.delay(attempt - 1, numbers)
            failed(FailedAttempt(attempt, self.retry.attempts, said_shortly(kind, text), delay))
            await asyncio.sleep(delay)


def said_shortly(kind: str, text: str) -> str:
    """An error in a line.

    >>> said_shortly("OSError", "no route\\nto the card network"), said_shortly("TimeoutError", "")
    ('OSError: no route', 'TimeoutError')
    """
    first = text.split("\n", 1)[0]
    return f"{kind}: {first[:LONGEST_LINE]}" if first else kind


def is_one_of(error: BaseException, kinds: tuple[type[Exception], ...]) -> bool:
    """Whether an error is of one of these classes, be it raised here or in another process.

    >>> raised = FunctionRaised("KeyError", "'a'", ["KeyError", "LookupError"])
    >>> is_one_of(raised, (LookupError,)), is_one_of(KeyError("a"), (OSError,))
    (True, False)
    """
    if isinstance(error, FunctionRaised):
        return any(type_name(kind) in error.kinds for kind in kinds)
    return isinstance(error, kinds)


def _is_cancelled() -> bool:
    """Whether somebody wants this task to end, and it is not the function itself that says so."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0


def effect_of(
    function: Callable[..., Any],
    args: tuple[Any, ...],
    key: str,
    timeout: float | None,
    retry: Retry | None,
    *,
    at_most_once: bool,
    is_async: bool,
    isolation: Isolation,
) -> EffectCall:
    """The effect that a handler wants.

    Raises:
        SpecError: it is no function, or a setting is wrong.
    """
    if not callable(function):
        raise SpecError("effect", f"takes a function and its arguments, not {function!r}")
    if timeout is not None:
        timeout = check_seconds("effect", "timeout", timeout)
    if retry is not None and not isinstance(retry, Retry):
        raise SpecError("effect", f"retry must be a Retry, or None, not {retry!r}")
    if at_most_once and retry is not None and retry.attempts > 1:
        raise SpecError("effect", "what is performed at most once is not attempted again: leave `retry` out")
    if not isinstance(key, str) or not can_be_written(key):
        raise SpecError("effect", f"key must be text that can be written, not {shown(key)}")
    if isolation not in ("thread", "process"):
        raise SpecError("effect", f"isolation must be 'thread' or 'process', not {isolation!r}")
    if isolation == "process" and is_async:
        raise SpecError("effect", "an async function runs on the event loop: isolation='process' is for a plain def")
    name = key or name_of(function)
    return EffectCall(function, args, name, timeout, retry or ONCE, at_most_once, is_async, isolation)


def name_of(function: Callable[..., Any]) -> str:
    """What a function is called where nobody has named its effect.

    >>> name_of(functools.partial(max, 1))
    'max'
    """
    while isinstance(function, functools.partial):
        function = function.func
    try:
        return function.__qualname__
    except AttributeError:  # It is an object that can be called.
        return type(function).__qualname__
