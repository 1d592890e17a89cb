"""The hooks by which a user's class may say itself what its state is; without them its attributes are saved."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class GivesState(Protocol):
    """An actor that makes its state itself."""

    def get_state(self) -> Any: ...


@runtime_checkable
class TakesState(Protocol):
    """An actor that is given such a state back."""

    def set_state(self, state: Any) -> Any: ...


@runtime_checkable
class MigratesState(Protocol):
    """A class that makes its state of one that an older version of it, or another class, has had."""

    def migrate(self, state: Any, before: Any) -> Any: ...


@runtime_checkable
class GivesDeltas(Protocol):
    """A class whose actors say what has changed in their state, and take that in."""

    def get_delta(self) -> Any: ...

    def apply_delta(self, delta: Any) -> Any: ...
