"""Futures and tasks that tell who looks at them and who ends them: that is how tasks and turns wait for each other."""

from __future__ import annotations

from collections.abc import Callable, Generator, Hashable
from contextvars import Context, copy_context
from typing import Any, Protocol, TypeVar

from ..numbered import NumberedFuture, NumberedTask

T = TypeVar("T")


class Listener(Protocol):
    """Hears of them."""

    def read(self, token: Hashable) -> None:
        """Something was looked at in the present step."""
        ...

    def write(self, token: Hashable) -> None:
        """Something was changed."""
        ...


class TellingFuture(NumberedFuture[T]):
    """A future of a run whose steps have footprints."""

    __slots__ = ("listener",)

    listener: Listener

    @property
    def token(self) -> Hashable:
        return ("future", self.number)

    def set_result(self, result: T) -> None:
        self.listener.write(self.token)
        super().set_result(result)

    def set_exception(self, exception: type | BaseException) -> None:
        self.listener.write(self.token)
        super().set_exception(exception)

    def cancel(self, msg: Any = None) -> bool:
        self.listener.write(self.token)
        return super().cancel(msg)

    def done(self) -> bool:
        self.listener.read(self.token)
        return super().done()

    def cancelled(self) -> bool:
        self.listener.read(self.token)
        return super().cancelled()

    def result(self) -> T:
        self.listener.read(self.token)
        return super().result()

    def exception(self) -> BaseException | None:
        self.listener.read(self.token)
        return super().exception()

    def add_done_callback(self, fn: Callable[[Any], object], /, *, context: Context | None = None) -> None:
        self.listener.read(self.token)
        super().add_done_callback(fn, context=copy_context() if context is None else context)

    def __await__(self) -> Generator[Any, None, T]:
        self.listener.read(self.token)
        return super().__await__()

    __iter__ = __await__


class TellingTask(NumberedTask[T]):
    """A task of such a run."""

    __slots__ = ("listener",)

    def __init__(self, listener: Listener, number: int, *args: Any, **options: Any) -> None:
        self.listener = listener
        super().__init__(number, *args, **options)

    @property
    def token(self) -> Hashable:
        return ("task", self.number)

    def cancel(self, msg: Any = None) -> bool:
        self.listener.write(self.token)
        return super().cancel(msg)

    def done(self) -> bool:
        self.listener.read(self.token)
        return super().done()

    def cancelled(self) -> bool:
        self.listener.read(self.token)
        return super().cancelled()

    def result(self) -> T:
        self.listener.read(self.token)
        return super().result()

    def exception(self) -> BaseException | None:
        self.listener.read(self.token)
        return super().exception()

    def add_done_callback(self, fn: Callable[[Any], object], /, *, context: Context | None = None) -> None:
        self.listener.read(self.token)
        super().add_done_callback(fn, context=copy_context() if context is None else context)

    def __await__(self) -> Generator[Any, None, T]:
        self.listener.read(self.token)
        return super().__await__()
