"""Plain Python objects as actors: their methods are called by messages, their callbacks are fed from topics.

The object's code does not change, and knows nothing of actors; its attributes are the state that is recovered.
"""

from __future__ import annotations

import functools
import inspect
import random
import sys
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, cast

import msgspec

from .actors.errors import HoldfastError, type_name
from .actors.kernel.actor import Actor, on, subscribe
from .actors.kernel.message import Message
from .actors.kernel.ref import ActorRef
from .actors.seconds import check_seconds

__all__ = ["Bus", "Calls", "Wrapped", "calls", "wrap"]

Parameter = inspect.Parameter


class Calls:
    """One message class for each public method of a class, as attributes: `calls(Robot).move(1.0)`; made by `calls`."""

    def __init__(self, kind: type, messages: dict[str, type[Message[Any]]]) -> None:
        self._kind = kind
        self.messages = types.MappingProxyType(messages)

    def __getattr__(self, name: str) -> Callable[..., Message[Any]]:
        try:
            return self.messages[name]
        except KeyError:
            raise AttributeError(f"{type_name(self._kind)} has no public method {name!r}") from None

    def __repr__(self) -> str:
        return f"<calls of {type_name(self._kind)}: {', '.join(self.messages)}>"


@functools.cache
def calls(kind: type) -> Calls:
    """Message classes for the public methods of a class, typed by their signatures; the same ones each time.

    Raises:
        TypeError: a method takes `*args` or `**kwargs`, which no message can have as fields; wrap it with `methods=`.

    >>> class Robot:
    ...     def move(self, by: float, times: int = 1) -> float: ...
    >>> calls(Robot).move(2.0)
    move(by=2.0, times=1)
    """
    return Calls(kind, {name: _call(kind, name, method) for name, method in _public(kind)})


def _public(kind: type) -> Iterable[tuple[str, Any]]:
    for name, found in inspect.getmembers_static(kind):
        if not name.startswith("_") and inspect.isfunction(found):
            yield name, found


def _call(kind: type, name: str, method: Any) -> type[Message[Any]]:
    """The message class for one method."""
    hints = typing.get_type_hints(method)
    fields: dict[str, Any] = {"__module__": kind.__module__, "__qualname__": f"{kind.__qualname__}.{name}"}
    declared = fields["__annotations__"] = dict[str, Any]()
    for parameter in list(inspect.signature(method).parameters.values())[1:]:
        if parameter.kind in (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD):
            raise TypeError(f"{type_name(kind)}.{name} takes {parameter}: no message has such fields; use methods=")
        declared[parameter.name] = hints.get(parameter.name, Any)
        if parameter.default is not Parameter.empty:
            fields[parameter.name] = msgspec.field(default_factory=_always(parameter.default))
    message: Any = Message
    reply = message[hints.get("return", Any)]
    try:
        made = types.new_class(name, (reply,), {"frozen": True}, lambda namespace: namespace.update(fields))
    except TypeError as error:
        raise TypeError(f"{type_name(kind)}.{name} cannot be called by a message: {error}; use methods=") from error
    return cast("type[Message[Any]]", made)


def _always(value: Any) -> Callable[[], Any]:
    return lambda: value


class BusTick(Message):
    """A timer of a wrapped program is due."""

    number: int


class Bus:
    """The connection of a wrapped program: it registers its callbacks there, and publishes through it."""

    def __init__(self, actor: Wrapped) -> None:
        self._actor = actor
        self._is_open = True
        self.callbacks: dict[str, list[Callable[[Any], Any]]] = {}
        self.timers: list[tuple[float, Callable[[], Any]]] = []
        self.sent: list[tuple[str | ActorRef[Any], Message[Any]]] = []

    def subscribe(self, topic: str, callback: Callable[[Any], Any]) -> None:
        """Have `callback` called with each message of a topic; only while the program is made.

        Raises:
            HoldfastError: later, or a topic that `callbacks=` of `wrap` does not name.
        """
        self._registering()
        if topic not in self._actor._kinds:
            raise HoldfastError(f"{self._actor.ctx.path}: callbacks= of wrap does not say what comes on {topic!r}")
        self.callbacks.setdefault(topic, []).append(callback)

    def every(self, seconds: float, callback: Callable[[], Any]) -> None:
        """Have `callback` called every so many seconds; only while the program is made."""
        self._registering()
        self.timers.append((check_seconds(self._actor.ctx.path, "seconds", seconds), callback))

    def publish(self, topic: str, message: Message[Any]) -> None:
        """Send to all subscribers of a topic, when the callback has returned."""
        self._sending()
        self.sent.append((topic, message))

    def tell(self, to: ActorRef[Any], message: Message[Any]) -> None:
        """Send to an actor, when the callback has returned."""
        self._sending()
        self.sent.append((to, message))

    def now(self) -> float:
        """Return the Unix time in seconds, the same again under replay."""
        return self._actor.ctx.now()

    @property
    def random(self) -> random.Random:
        """A random generator that gives the same again under replay."""
        return self._actor.ctx.random

    def closed(self) -> None:
        """Take no more subscriptions and the like, because the program has been made."""
        self._is_open = False

    def _registering(self) -> None:
        if not self._is_open:  # A later life would not know of it.
            raise HoldfastError(
                f"{self._actor.ctx.path}: callbacks are registered while the program is made, not later"
            )

    def _sending(self) -> None:
        if self._is_open:  # It is made again for each life.
            raise HoldfastError(f"{self._actor.ctx.path}: a program sends from its callbacks, not while it is made")


class Wrapped(Actor):
    """An actor around a plain object, `program`; classes of this kind are made by `wrap`."""

    _factory: ClassVar[Any]
    _has_bus: ClassVar[bool] = False
    _kinds: ClassVar[Mapping[str, type[Message[Any]]]] = {}

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        make = type(self)._factory
        self._bus = Bus(self)
        self.program: Any = make(self._bus, *args, **kwargs) if self._has_bus else make(*args, **kwargs)
        self._bus.closed()

    def _state_root(self) -> Any:
        return self.program

    def on_start(self, restored: bool) -> None:
        if not restored:  # Those of a recorded actor outlive its lives.
            for number, (seconds, _) in enumerate(self._bus.timers):
                self.ctx.every(seconds, BusTick(number))

    async def _called(self, callbacks: Iterable[Callable[..., Any]], *args: Any) -> Any:
        """Call them in turn, then let out what they have sent; returns what the last one returned."""
        bus = self._bus
        bus.sent.clear()  # Of a callback that raised.
        result = None
        for callback in callbacks:
            result = callback(*args)
            if inspect.isawaitable(result):
                result = await result
        for to, message in bus.sent:
            if isinstance(to, str):
                await self.ctx.publish(to, message)
            else:
                to.tell(message)
        bus.sent.clear()
        return result


def wrap(
    factory: Callable[..., Any],
    name: str | None = None,
    *,
    methods: Mapping[type[Message[Any]], str] | None = None,
    callbacks: Mapping[str, type[Message[Any]] | tuple[type[Message[Any]], str]] | None = None,
    key_variables: Iterable[str] | None = None,
    deterministic: bool = True,
) -> type[Wrapped]:
    """Make an actor class around a plain Python class or program, whose code does not change.

    To live in a process of its own it must be found by name, as a namedtuple must: assign it to that name in the
    module (`RobotActor = wrap(Robot, "RobotActor")`).

    Args:
        factory: makes the object, from the arguments of `start`: a class or a function, importable for a process.
        name: of the actor class; left out, that of the factory with "Actor" behind it.
        methods: what calls which method: a message's fields are its arguments, or the message as a whole is the only
            one. Left out (and without `callbacks`): `calls(factory)`, a message for each public method.
        callbacks: what comes on which topic. `{"/scan": (Scan, "on_scan")}` calls that method; `{"/scan": Scan}` is
            for a program that registers callbacks by itself: the factory gets a `Bus` as its first argument, and the
            callbacks that it subscribes to that topic are called. Each message type belongs to one topic.
        key_variables: dotted paths from the object down, such as "robot.pose.x"; left out, all attributes without a
            leading underscore.
        deterministic: whether the same messages lead to the same state; False refuses methods that replay.

    Raises:
        TypeError: a method is not there, or does not take what the message has; key_variables are no names.

    >>> class Counter:
    ...     def __init__(self) -> None:
    ...         self.count = 0
    ...     def add(self, n: int) -> int:
    ...         self.count += n
    ...         return self.count
    >>> wrap(Counter).__name__
    'CounterActor'
    """
    if methods is None and callbacks is None:
        if not isinstance(factory, type):
            raise TypeError(f"wrap needs methods= or callbacks= for {factory!r}, which is no class")
        methods = {kind: method for method, kind in calls(factory).messages.items()}
    if isinstance(key_variables, str):
        raise TypeError(f"wrap: key_variables must be names, such as ('goal', 'robot.pose.x'), not {key_variables!r}")
    name = name or f"{getattr(factory, '__name__', 'program')}Actor"
    namespace: dict[str, Any] = {
        "__module__": sys._getframe(1).f_globals.get("__name__", __name__),
        "__doc__": f"A {getattr(factory, '__name__', 'program')}, called by messages.",
        "_factory": staticmethod(factory),
        "deterministic": deterministic,
        "key_variables": None if key_variables is None else tuple(key_variables),
    }
    has_bus = any(not isinstance(fed, tuple) for fed in (callbacks or {}).values())
    namespace["_has_bus"] = has_bus
    for number, (kind, method) in enumerate((methods or {}).items()):
        caller = _caller(factory, kind, method)
        namespace[f"_call_{number}"] = on(kind)(_sending(caller) if has_bus else caller)
    kinds: dict[str, type[Message[Any]]] = {}
    for number, (topic, fed) in enumerate((callbacks or {}).items()):
        if isinstance(fed, tuple):
            kind, caller = fed[0], _caller(factory, *fed, is_callback=True)
            handler = _sending(caller) if has_bus else caller
        else:
            kind, handler = fed, _fed(topic)
        kinds[topic] = kind
        namespace[f"_feed_{number}"] = subscribe(topic)(on(kind)(handler))
    namespace["_kinds"] = kinds
    if has_bus:
        namespace["_tick"] = on(BusTick)(_ticking())
    made = types.new_class(name, (Wrapped,), {}, lambda body: body.update(namespace))
    made.__qualname__ = name
    return cast("type[Wrapped]", made)


def _caller(factory: Any, kind: type[Message[Any]], method: str, *, is_callback: bool = False) -> Any:
    """A handler that calls a method with a message's fields, or with the message."""
    fields = kind.__struct_fields__
    found = inspect.getattr_static(factory, method, None) if isinstance(factory, type) else None
    if isinstance(factory, type) and not callable(found):
        raise TypeError(f"{type_name(factory)} has no method {method!r}")
    is_whole = is_callback
    if found is not None and not is_callback:
        parameters = list(inspect.signature(found).parameters.values())[1:]
        problem = _misfit(parameters, kind)
        is_whole = bool(problem) and len(parameters) == 1
        if problem and not is_whole:
            raise TypeError(f"{type_name(factory)}.{method} cannot be called with {type_name(kind)}: {problem}")
        fields = tuple(one.name for one in parameters if one.kind is not Parameter.KEYWORD_ONLY)
    first = () if is_whole else fields
    rest = () if is_whole else tuple(name for name in kind.__struct_fields__ if name not in fields)

    def call(self: Wrapped, message: Any) -> Any:
        bound = getattr(self.program, method)
        if is_whole:
            return bound(message)
        return bound(*(getattr(message, name) for name in first), **{name: getattr(message, name) for name in rest})

    return call


def _misfit(parameters: list[Parameter], kind: type[Message[Any]]) -> str:
    """Why a message's fields are no arguments for these parameters; "" if they are."""
    names = {one.name for one in parameters if one.kind not in (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)}
    missing = sorted(set(names) - set(kind.__struct_fields__))
    unknown = sorted(set(kind.__struct_fields__) - set(names))
    if missing:
        return f"it has no field {missing[0]!r}"
    return f"there is no parameter {unknown[0]!r}" if unknown else ""


def _sending(caller: Callable[[Wrapped, Any], Any]) -> Any:
    """A handler that lets out what the method it calls has sent."""

    def call(self: Wrapped, message: Any) -> Any:
        return self._called([functools.partial(caller, self)], message)

    return call


def _fed(topic: str) -> Any:
    """A handler that calls what the program has subscribed to a topic."""

    def feed(self: Wrapped, message: Any) -> Any:
        return self._called(self._bus.callbacks.get(topic, ()), message)

    return feed


def _ticking() -> Any:
    """A handler that calls what the program wants called now and then."""

    def tick(self: Wrapped, message: BusTick) -> Any:
        return self._called([self._bus.timers[message.number][1]])

    return tick
