"""Futures and tasks that tell who looks at them and who ends them: that is how tasks and turns wait for each other."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from contextvars import Context, copy_context
from typing import Any, ClassVar, Protocol, TypeVar

from ..numbered import NumberedFuture, NumberedTask

T = TypeVar("T")


class AccessListener(Protocol):
    """Hears what each step reads and changes, by tokens of what that is."""

    def read(self, token: Hashable) -> None:
        """Something was looked at in the present step."""
        ...

    def write(self, token: Hashable) -> None:
        """Note that the present step has changed something."""
        ...


class Telling:
    """What a future and a task have in common: each look at one is told, and each end that comes from outside."""

    __slots__ = ()

    kind: ClassVar[str]
    listener: AccessListener
    number: int

    @property
    def token(self) -> Hashable:
        return self.kind, self.number

    def cancel(self, msg: Any = None) -> Any:
        self.listener.write(self.token)
        return self._real.cancel(msg)

    def done(self) -> Any:
        self.listener.read(self.token)
        return self._real.done()

    def cancelled(self) -> Any:
        self.listener.read(self.token)
        return self._real.cancelled()

    def result(self) -> Any:
        self.listener.read(self.token)
        return self._real.result()

    def exception(self) -> Any:
        self.listener.read(self.token)
        return self._real.exception()

    def add_done_callback(self, fn: Callable[[Any], object], /, *, context: Context | None = None) -> None:
        self.listener.read(self.token)
        self._real.add_done_callback(fn, context=copy_context() if context is None else context)

    def __await__(self) -> Any:
        self.listener.read(self.token)
        return self._real.__await__()

    @property
    def _real(self) -> Any:
        return super()


class TellingFuture(Telling, NumberedFuture[T]):
    """A future of a run whose steps have footprints."""

    __slots__ = ("listener",)

    kind = "future"

    def set_result(self, result: T) -> None:
        self.listener.write(self.token)
        super().set_result(result)

    def set_exception(self, exception: type | BaseException) -> None:
        self.listener.write(self.token)
        super().set_exception(exception)


class TellingTask(Telling, NumberedTask[T]):
    """A task of such a run."""

    __slots__ = ("listener",)

    kind = "task"

    def __init__(self, listener: AccessListener, number: int, *args: Any, **options: Any) -> None:
        self.listener = listener
        super().__init__(number, *args, **options)
