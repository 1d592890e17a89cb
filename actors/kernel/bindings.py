"""Bindings: named ports of an actor that the runtime can point elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast, overload

from ..errors import HoldfastError

if TYPE_CHECKING:
    from .actor import Actor
    from .ref import ActorRef

A_co = TypeVar("A_co", bound="Actor", covariant=True)


class Unbound(HoldfastError, text="{actor}.{port} is not bound; bind it in the child spec or with system.bind()"):
    """A binding was used before anything was bound to it."""

    actor: str
    port: str


class Binding(Generic[A_co]):
    """A port declared in the class body (`teller: Binding[Account]`); reading it gives the bound `ActorRef`.

    It is re-pointed between turns of its owner, so one turn sees one target.
    """

    __slots__ = ("_name",)

    def __init__(self) -> None:
        self._name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, actor: None, owner: type) -> Binding[A_co]: ...
    @overload
    def __get__(self, actor: Actor, owner: type) -> ActorRef[A_co]: ...
    def __get__(self, actor: Actor | None, owner: type) -> Binding[A_co] | ActorRef[A_co]:
        if actor is None:
            return self
        bound = actor.ctx.bound(self._name)
        if bound is None:
            raise Unbound(actor.ctx.path, self._name)
        return cast("ActorRef[A_co]", bound)

    def __set__(self, actor: Any, target: Any) -> None:
        raise AttributeError(f"binding {self._name!r} is set by the runtime: use system.bind()")
