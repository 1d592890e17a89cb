"""Effects: what a turn does to the outside world, with a time limit and further attempts."""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import random
from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from typing import Any

from .backoff import Backoff
from .errors import EffectFailed, HoldfastError, SpecError, error_text, type_name
from .seconds import check_seconds


@dataclasses.dataclass(frozen=True, slots=True)
class Retry:
    """Say how often an effect is attempted, and how long it waits between two attempts.

    Attributes:
        attempts: how often at most, >= 1.
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

_token: ContextVar[int] = ContextVar("fencing_token", default=0)
"""While an effect is performed: the fencing token of the life that performs it."""


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


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class EffectCall:
    """One effect of a turn: the function, and how it is attempted.

    Attributes:
        function: what is called, with `args`.
        key: what names it where a replay is compared, and in errors and events.
        timeout: seconds that one attempt may take; None: as long as it wants.
        retry: how often it is attempted.
        is_async: whether the function is awaited on the event loop; any other runs in a thread.
    """

    function: Callable[..., Any]
    args: tuple[Any, ...]
    key: str
    timeout: float | None
    retry: Retry
    is_async: bool

    async def perform(self, in_thread: Callable[..., Awaitable[Any]], seed: int, token: int) -> object:
        """Attempt it until it succeeds or has failed, and return what it returns. It is awaited in a task of its own.

        Args:
            in_thread: runs a function with its arguments in a thread.
            seed: of the jitter of the back-off.
            token: the fencing token of the life that performs it.

        Raises:
            EffectFailed: the last attempt has raised, or has taken too long.
            HoldfastError: the function has raised one itself: that is its answer, and is not attempted again.
        """
        _token.set(token)
        numbers: random.Random | None = None
        attempt = 0
        while True:
            attempt += 1
            limit = asyncio.timeout(self.timeout)
            try:
                work = self.function(*self.args) if self.is_async else in_thread(self.function, *self.args)
                if self.timeout is None:
                    return await work
                async with limit:
                    return await work
            except HoldfastError:
                raise
            except BaseException as error:  # Whatever a function can raise; it ends neither the program nor its actor.
                if isinstance(error, asyncio.CancelledError) and _is_cancelled():
                    raise
                text = error_text(error)
                if self.timeout is not None and limit.expired() and isinstance(error, TimeoutError):
                    text = f"it took longer than {self.timeout:g} s"
                if attempt >= self.retry.attempts or not isinstance(error, self.retry.on):
                    raise EffectFailed(self.key, attempt, type_name(type(error)), text) from error
            numbers = numbers or random.Random(seed)
            await asyncio.sleep(self.retry.backoff.delay(attempt - 1, numbers))


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
) -> EffectCall:
    """The effect that a handler wants.

    Raises:
        SpecError: it is no function, or a setting is wrong.
    """
    if not callable(function):
        raise SpecError("effect", f"takes a function and its arguments, not {function!r}")
    if timeout is not None:
        check_seconds("effect", "timeout", timeout)
    if retry is not None and not isinstance(retry, Retry):
        raise SpecError("effect", f"retry must be a Retry, or None, not {retry!r}")
    if at_most_once and retry is not None and retry.attempts > 1:
        raise SpecError("effect", "what is performed at most once is not attempted again: leave `retry` out")
    if not isinstance(key, str):
        raise SpecError("effect", f"key must be a str, not {key!r}")
    return EffectCall(function, args, key or name_of(function), timeout, retry or ONCE, is_async)


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
