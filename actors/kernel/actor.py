"""The actor class: state, handlers and hooks, as a user writes them."""

from __future__ import annotations

import functools
import inspect
import typing
from collections.abc import Callable, Coroutine, Iterable
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Protocol, TypeVar, cast, overload

import msgspec

from ..errors import type_name
from ..safe_state import SafeStateChange, watch
from ..seconds import is_seconds
from ..values.path_parts import check_topic
from .bindings import Binding, noting
from .blocking_handlers import in_thread
from .codec import checking
from .envelope import Table
from .message import Message, RuntimeCall, RuntimeOrder

if TYPE_CHECKING:
    from ..exit_reasons import ExitReason
    from .cell import Cell
    from .context import ActorContext
    from .envelope import ReplyHandle
    from .ref import ActorRef

R = TypeVar("R")
S = TypeVar("S")
M = TypeVar("M", bound=Message[Any])
F = TypeVar("F", bound=Callable[..., Any])


class _On(Protocol[R]):
    """What `@on(M)` accepts: a method that takes the message and gives its reply, now, later, or by a handle."""

    @overload
    def __call__(
        self, handler: Callable[[S, M], Coroutine[Any, Any, R | ReplyHandle[R]]]
    ) -> Callable[[S, M], Coroutine[Any, Any, R | ReplyHandle[R]]]: ...
    @overload
    def __call__(self, handler: Callable[[S, M], R | ReplyHandle[R]]) -> Callable[[S, M], R | ReplyHandle[R]]: ...


class Handles(typing.NamedTuple):
    """What `@on` notes on a method."""

    kind: type[Message[Any]]
    readonly: bool
    to_thread: bool
    supersedes: str | bool | Callable[[Any], Any] | None = None


def on(
    kind: type[Message[R]],
    *,
    readonly: bool = False,
    to_thread: bool = False,
    supersedes: str | Literal[True] | Callable[[Any], Any] | None = None,
) -> _On[R]:
    """Make a method the handler of one message type (and of types derived from it that have none of their own).

    Args:
        kind: the message class; the method's return type must be the reply it declares.
        readonly: the handler changes no state, so a replay may leave it out, and asks are answered while another turn
            rests (`ctx.sleep`, `ctx.wait_for`), or has an effect out (`ctx.effect`).
        to_thread: the handler, a plain `def`, blocks: it is run in a worker thread. The actor handles nothing else
            meanwhile. In it, `self.ctx` and refs' `tell` work, and what has to be awaited does not.
        supersedes: the handler overwrites all that it wrote for an earlier message with the same key, and reads
            nothing: the latest wins. A replay may leave the earlier ones out. The key is the field of this name, what
            a function makes of the message, or (True) the same for all messages of this type.
    """
    if not (isinstance(kind, type) and issubclass(kind, Message)):
        raise TypeError(f"@on takes a Message class, not {kind!r}")
    if isinstance(supersedes, str):
        if supersedes not in kind.__struct_fields__:
            raise TypeError(f"@on({kind.__name__}, supersedes={supersedes!r}): {kind.__name__} has no such field")
    elif supersedes is not None and supersedes is not True and not callable(supersedes):
        raise TypeError(f"@on({kind.__name__}): supersedes is a field, a function or True, not {supersedes!r}")
    if readonly and supersedes is not None:
        raise TypeError(f"@on({kind.__name__}): a readonly handler writes nothing, so it supersedes nothing")

    def mark(handler: Any) -> Any:
        handler.__handles__ = (*handled_by(handler), Handles(kind, readonly, to_thread, supersedes))
        return handler

    return cast("_On[R]", mark)


def subscribe(topic: str) -> Callable[[F], F]:
    """Subscribe the actor to a topic from its start; goes above `@on` on a handler of that topic's messages."""
    check_topic("subscribe", topic)

    def mark(handler: F) -> F:
        cast("Any", handler).__topics__ = (*_topics_of(handler), topic)
        return handler

    return mark


def handled_by(handler: object) -> tuple[Handles, ...]:
    """What `@on` has noted on a method; nothing on anything else."""
    return getattr(handler, "__handles__", ())


def _topics_of(handler: object) -> tuple[str, ...]:
    """What `@subscribe` has noted on a method; nothing on anything else."""
    return getattr(handler, "__topics__", ())


class Actor:
    """Base of all actors: one message at a time, state in attributes.

    `ctx` is there before `__init__` runs. Construct in `__init__`, act in `on_start`: an actor that is restored runs
    `__init__` again.

    A class may define these plain methods in pairs, and the base has none of them:

    - `get_state(self) -> state` and `set_state(self, state)`: what a snapshot saves, instead of attributes.
    - `get_delta(self) -> delta` and `apply_delta(self, delta)`: what has changed since `get_delta` was called last, and
      that change made to an actor with the state before it. Mechanisms use them, recovery does not. Each delta is
      applied once, in order, or its state is replaced by a whole one; then the runtime calls `get_delta` and drops
      what it returns, so that the next one counts from there.
    - `migrate(cls, state, old)`, a class method: the state of an older version of the class, or of another class, as
      this one has it.
    """

    ctx: ActorContext

    deterministic: ClassVar[bool] = True
    """False refuses recovery methods that replay messages."""
    state_access: ClassVar[bool] = True
    """False refuses mechanisms that save and restore the state."""
    key_variables: ClassVar[tuple[str, ...] | None] = None
    """What a snapshot saves; None saves every instance attribute without a leading underscore."""
    schema_version: ClassVar[int] = 1
    """Raise it when the saved state changes its shape."""
    turn_timeout: ClassVar[float | None] = None
    """Seconds that a turn may take, with all that it waits for; then the actor crashes by `TurnTimeout`.

    None: as many as it wants. Of an actor with recovery no time counts while its turn rests (`ctx.sleep`,
    `ctx.wait_for`). A turn that blocks its process ends by `Limits(hung_after=...)`; starts and ends have limits of
    their own (`start_timeout`, `shutdown`). Behind a mechanism it is the usual `Detection(watch_turns=...)`.
    """

    _keeps_promises: ClassVar[bool] = False
    """Whether its reply handles belong to the address: the next life answers, or whatever `node.kept` has of it."""
    _table: ClassVar[Table] = Table()
    _declared: ClassVar[dict[type, Handles]] = {}
    _topics: ClassVar[tuple[str, ...]] = ()
    _bindings: ClassVar[frozenset[str]] = frozenset()
    _supervises: ClassVar[bool] = False
    """Whether it starts children of its own by a spec, and restarts them."""
    _is_dynamic: ClassVar[bool] = False
    """Whether those children stop at the same time."""
    _with_successor: ClassVar[Literal["moved", "anew", "awaited"]] = "moved"
    """What becomes of it when another one takes its supervisor's place: it is moved there, or another one takes its own
    place, too, or its end is waited for."""
    _is_asked_again: ClassVar[bool] = False
    """Whether it answers for the runtime: what a recorded turn asks of it, and is not handled, is its next life's."""
    _is_part: ClassVar[bool] = False
    """Whether it is a part of the runtime: from another process only who was granted its address speaks to it."""

    @classmethod
    def _may_order(cls, start: Start[Any], path: str) -> tuple[str, ...]:
        """Addresses to which who begins so at `path` may give orders from its process, besides what it starts."""
        return ()

    @classmethod
    def _speaks_for(cls, path: str) -> tuple[str, ...]:
        """Addresses besides its own of which an actor that lives at `path` may tell events from its process."""
        return ()

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if inspect.iscoroutinefunction(cls.__init__):
            raise TypeError(f"{type_name(cls)}.__init__ cannot be async: what has to be awaited goes into on_start")
        table, declared, topics = Table(), dict[type, Handles](), list[str]()
        members, marked = dict[str, Any](), dict[str, tuple[Handles, ...]]()
        heard = dict[str, tuple[str, ...]]()  # the topics of a handler, or of the one in whose place it stands
        for one in reversed(cls.__mro__):
            members.update(vars(one))
            marked.update((name, marks) for name, value in vars(one).items() if (marks := handled_by(value)))
            told = ((name, _topics_of(value), value is None) for name, value in vars(one).items())
            heard.update((name, topics) for name, topics, is_taken_away in told if topics or is_taken_away)
        for name in sorted(members):
            handler = members[name]
            marks, subscribed = handled_by(handler), _topics_of(handler)
            if not marks and name in marked and members[name] is not None:
                lost = " and ".join(f"@on({handles.kind.__name__})" for handles in marked[name])
                raise TypeError(
                    f"{type_name(cls)}.{name} stands in the place of a handler and is none: write {lost} above it, "
                    f"too, or `{name} = None` if nothing is to handle that"
                )
            for handles in marks:
                if not any(vars(one).get(name) is handler for one in cls.__mro__[1:] if issubclass(one, Actor)):
                    _check(cls, name, handler, handles.kind)  # Else it was when the base was made; this is slow.
                if handles.kind in table:
                    raise TypeError(f"{type_name(cls)} has two handlers for {type_name(handles.kind)}: see {name}")
                turn = in_thread(handler) if handles.to_thread else handler
                turn = noting(turn) if issubclass(handles.kind, RuntimeOrder) else turn
                table[handles.kind] = checking(turn) if issubclass(handles.kind, RuntimeCall) else turn
                declared[handles.kind] = handles
            if marks and not subscribed and heard.get(name):
                lost = " and ".join(f'@subscribe("{topic}")' for topic in heard[name])
                raise TypeError(
                    f"{type_name(cls)}.{name} stands in the place of a handler that subscribes, and does not: write "
                    f"{lost} above it, too, or, if it is not to, give it another name and write `{name} = None`"
                )
            if subscribed and not marks:
                raise TypeError(f"{type_name(cls)}.{name} has @subscribe without @on: nothing would ever reach it")
            topics.extend(subscribed)
        _check_state(cls)
        _check_turn_timeout(cls)
        cls._table, cls._declared, cls._topics = table, declared, tuple(topics)
        cls._bindings = cls._bindings | _declared_bindings(cls)

    def on_start(self, restored: bool) -> Any:
        """Called first at each life, `restored` says whether state came back; may be async. Turn 0."""

    def on_stop(self, reason: ExitReason) -> Any:
        """Called last, at every end in good order and after a crash; may be async.

        Not called when the life is killed, when its start failed, or when an EXIT ends it that it does not trap. If it
        returns an exit reason (a clean one, a `Crash`, or the one that it was given), that becomes the life's own; if
        it raises, so does the crash, unless there was one.
        """

    def on_exit(self, source: ActorRef[Any], reason: ExitReason) -> Any:
        """Hear that a linked actor has ended, if this one traps exits (`ctx.trap_exits`)."""

    def on_down(self, source: ActorRef[Any], reason: ExitReason, recovering: bool) -> Any:
        """Hear that a monitored life, or a watched address, has ended."""

    def on_undelivered(self, message: Message[Any]) -> Any:
        """Take a queued message that will not be handled, because the actor stops; without this it is a dead letter."""

    def on_safe_state(self, entered: bool) -> Any:
        """Hear that an actor whose recovery method names this one begins to be recovered (True), or is back (False).

        May be async. Of several recoveries at a time it hears once: of the first beginning, and of the last end.
        """

    @on(SafeStateChange)
    def _on_safe_state(self, message: SafeStateChange) -> Any:
        """An ordinary message, in its place, and journaled if we are recorded."""
        watch(self.ctx._cell, message)
        return self.on_safe_state(message.entered)

    def on_recovered(self) -> Any:
        """State and messages are back; called before new messages are let in."""

    def _state_root(self) -> Any:
        """Whose attributes the key variables are."""
        return self

    def _overview(self) -> dict[str, Any]:
        """What control shows beside the attributes, and nobody can replace."""
        return {}

    def _outside(self) -> Iterable[Coroutine[Any, Any, Any]]:
        """What it does outside its turns, and waits."""
        return ()

    def _is_starting(self) -> bool:
        """Whether the start goes on though `on_start` has returned; the end of it is `lives.came_up`."""
        return False

    def _child_lost(self, cell: Cell) -> None:
        """A child that lives on in another process has another supervisor from now on."""

    def _told_account(self) -> Any:
        """What it leaves to another one that takes its place, as plain data."""
        return ()

    def _wind_down(self, attempt: int) -> None:
        """Another one is to take its place, as soon as nothing is in the way of that; 0: it is not to be any more."""

    def _why_occupied(self) -> str:
        """Why nobody can take its place at this instant; "" if somebody can."""
        return ""

    async def _stop_children(self) -> None:
        """The life ends: its children go first, newest first."""
        for child in reversed(list((self.ctx._cell.children or {}).values())):
            await child.node.stop_child(child)


def _check_turn_timeout(cls: type[Actor]) -> None:
    seconds = cls.turn_timeout
    if seconds is not None and not is_seconds(seconds):
        raise TypeError(f"{type_name(cls)}.turn_timeout must be seconds > 0 or None, not {seconds!r}")
    if seconds is not None and cls._supervises:
        raise TypeError(f"{type_name(cls)}.turn_timeout: a supervisor has none, for it waits for nobody in its turns")


def _check(cls: type, name: str, handler: Any, kind: type) -> None:
    """Refuse a handler whose message annotation contradicts `@on`, when the class is made."""
    if any(handles.to_thread for handles in handler.__handles__) and inspect.iscoroutinefunction(handler):
        raise TypeError(f"{type_name(cls)}.{name} is `async def`: to_thread is for handlers that block")
    parameters = list(inspect.signature(handler).parameters.values())
    if len(parameters) != 2:
        raise TypeError(f"{type_name(cls)}.{name} must take self and the message, nothing else")
    try:
        declared = typing.get_type_hints(handler).get(parameters[1].name)
    except NameError:  # A name that is only imported for checking, or defined further down.
        return
    if isinstance(declared, type) and declared is not Any and not issubclass(kind, declared):
        raise TypeError(f"{type_name(cls)}.{name} is @on({kind.__name__}) but takes a {declared.__name__}")


def _check_state(cls: type[Actor]) -> None:
    """Refuse what cannot say which variables are saved, when the class is made."""
    names = cast("Any", cls.key_variables)
    if names is not None and (isinstance(names, str) or not all(isinstance(name, str) for name in names)):
        raise TypeError(f"{type_name(cls)}.key_variables must be names, such as ('goal', 'pose.x'), not {names!r}")
    if not isinstance(cls.schema_version, int) or isinstance(cls.schema_version, bool):
        raise TypeError(f"{type_name(cls)}.schema_version must be a whole number, not {cls.schema_version!r}")


def _declared_bindings(cls: type) -> frozenset[str]:
    """Make `name: Binding[X]` in the class body a port; returns the names."""
    names: set[str] = set()
    for name, declared in vars(cls).get("__annotations__", {}).items():
        text = declared if isinstance(declared, str) else getattr(declared, "__qualname__", "")
        origin = typing.get_origin(declared) or declared
        if origin is Binding or text.split("[")[0].rpartition(".")[2] == "Binding":
            port: Binding[Any] = Binding()
            port.__set_name__(cls, name)
            setattr(cls, name, port)
            names.add(name)
    return frozenset(names)


class Start(msgspec.Struct, Generic[S], frozen=True, repr_omit_defaults=True):
    """A recipe for a new actor: class and arguments, never a live object. Made by `start`."""

    kind: type[S]
    args: tuple[Any, ...] = ()
    kwargs: dict[str, Any] = {}
    begins_with: tuple[Any, ...] | None = None
    """Flags and children of a supervisor that takes the place of another one, instead of what its class says."""

    def check(self, *, is_partial: bool = False) -> None:
        """Raise TypeError if the arguments do not fit the class; if `is_partial`, more of them come later."""
        signature = signature_of(self.kind)
        (signature.bind_partial if is_partial else signature.bind)(*self.args, **self.kwargs)


signature_of: Callable[[type], inspect.Signature] = functools.cache(inspect.signature)
"""What a class takes. Found out once: that takes longer than all else that a spec is checked for."""


P = typing.ParamSpec("P")
A = TypeVar("A", bound=Actor)


def start(kind: Callable[P, A], *args: P.args, **kwargs: P.kwargs) -> Start[A]:
    """Make a recipe for an actor: `start(Account, 100)`. Typed like the class's `__init__`; nothing runs yet.

    Raises:
        TypeError: `kind` is no Actor class. (Arguments are checked where a child spec is made of it.)
    """
    if not (isinstance(kind, type) and issubclass(kind, Actor)):
        raise TypeError(f"start takes an Actor class, not {kind!r}")
    return Start(cast("type[A]", kind), args, kwargs)
