"""Registries: actors found by key, with a value each. Elixir's Registry.

`registry(...)` is the child spec, `Registry(ref)` the handle with which the registry is used, from outside and from
actors, in any process. A key is held by an actor, and freed by the runtime when that actor's life ends: whoever has
heard of the end (by DOWN, EXIT, a restart) does not find it any more.
"""

from __future__ import annotations

import uuid
from collections.abc import Awaitable, Callable, Iterable, Mapping
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Generic, cast, get_args, overload

import msgspec
from typing_extensions import TypeVar

from ...actors.errors import ActorStopped, SendError, SpecError, type_name
from ...actors.kernel.actor import Start
from ...actors.kernel.message import Message, Refusal
from ...actors.kernel.ref import DEFAULT_TIMEOUT, ActorRef, cell_of, current
from ..spec import ChildSpec, Restart, Shutdown
from .registrar import (
    Count,
    DeleteMeta,
    DropEntries,
    Find,
    GetMeta,
    Keys,
    KeyTaken,
    Lock,
    NotAnActor,
    PutMeta,
    Register,
    RegistryActor,
    RegistryRow,
    ReplaceValue,
    Unlock,
    key_of,
)

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

K = TypeVar("K", default=Any)
V = TypeVar("V", default=Any)
D = TypeVar("D")
T = TypeVar("T")


class AlreadyRegistered(Refusal, text="key {key!r} is held by {holder.path}: take another one, or wait for its end"):
    """A living actor holds this key: `holder` is it, perhaps the asker itself."""

    key: Any
    holder: ActorRef[Any]


class RegistryEntry(msgspec.Struct, Generic[K, V], frozen=True):
    """One key, its holder and the value that goes with it."""

    key: K
    holder: ActorRef[Any]
    value: V


def registry(
    name: str,
    *,
    keys: Keys = "unique",
    listeners: Iterable[str] = (),
    meta: Mapping[str, Any] | None = None,
    restart: Restart = "permanent",
    shutdown: Shutdown = 5.0,
) -> ChildSpec:
    """Describe a registry, as a child spec. Use it through `Registry(ref)`.

    Args:
        name: the last part of its address.
        keys: "unique": one holder per key; "duplicate": any number of entries, also several of one holder that has no
            recovery.
        listeners: addresses ("/app/audit") or registered names ("audit") of actors that get `KeyRegistered` and
            `KeyFreed`; who is not there at the time misses them.
        meta: values that belong to the registry itself, to begin with.
        restart, shutdown: as any child's.

    A restart of the registry loses nothing: its entries belong to its address. They are lost when the address is
    given up, say because its supervisor is restarted; put it first in a "rest_for_one" supervisor, then its holders
    are restarted after it, and register again. What actors with recovery hold is kept with what is recorded of them.

    Raises:
        SpecError: naming the option and what it may be.
    """
    where = f"registry {name!r}"
    if keys not in get_args(Keys):
        raise SpecError(where, f"keys must be one of {', '.join(get_args(Keys))}, not {keys!r}")
    told = () if isinstance(listeners, str) else tuple(listeners)
    if isinstance(listeners, str) or not all(isinstance(one, str) and one for one in told):
        raise SpecError(where, f"listeners must be a list of names or addresses, not {listeners!r}")
    return ChildSpec(name, Start(RegistryActor, (keys, told, dict(meta or {}))), restart, shutdown)


class Registry(Generic[K, V]):
    """A handle on a registry: `names = Registry[str, int](ref)`, with the types of its keys and values.

    A key is None, a bool, int, float, str, bytes, or a tuple of these; 1, 1.0 and True are three keys. A value that
    crosses a process border is coded as in a message. Functions are called in the caller, never in the registry.

    Every call is an ask, and may fail as one: ActorStopped if there is no registry, AskTimeout after `timeout` seconds.
    """

    __slots__ = ("ref", "timeout")

    def __init__(self, ref: ActorRef[RegistryActor], timeout: float = DEFAULT_TIMEOUT) -> None:
        cell_of("Registry", ref)
        self.ref, self.timeout = ref, timeout

    def __repr__(self) -> str:
        return f"<Registry {self.ref.path}>"

    # -- one's own entries: to be called by the actor that holds them ------------------------------------------------

    @overload
    async def register(self: Registry[K, None], key: K) -> None: ...
    @overload
    async def register(self, key: K, value: V) -> None: ...
    async def register(self, key: K, value: Any = None) -> None:
        """Hold a key from now on.

        An actor with recovery holds it in all its lives, until it gives it up. It has one entry for a key: to say its
        own again changes the value.

        Raises:
            AlreadyRegistered: with unique keys, by another living actor, or by this one if it has no recovery.
            NotAnActor: it was not called by an actor.
        """
        packed = pack_key(key)
        try:
            await self._ask(Register(packed, value, _life()))
        except KeyTaken as taken:
            raise AlreadyRegistered(key, taken.holder) from None

    async def unregister(self, key: K) -> int:
        """Give up all one's entries for a key; returns how many there were. Others' stay as they are."""
        return await self._ask(DropEntries(pack_key(key)))

    async def unregister_match(self, key: K, test: Callable[[V], bool]) -> int:
        """Give up those of one's entries for a key whose value passes the test; returns how many."""
        packed = pack_key(key)
        rows = await self._ask(Find(packed, _own_ref()))
        numbers = [row.number for row in rows if test(row.value)]
        return await self._ask(DropEntries(packed, numbers)) if numbers else 0

    async def update_value(self, key: K, change: Callable[[V], V]) -> tuple[V, V] | None:
        """Put `change(value)` in the place of the value of one's unique key.

        Returns:
            The new and the old value; None if this actor does not hold the key.

        Raises:
            NotUnique: the registry has duplicate keys.
        """
        packed = pack_key(key)
        rows = await self._ask(Find(packed, _own_ref()))
        if not rows:
            return None
        old: V = rows[0].value
        new = change(old)
        return (new, old) if await self._ask(ReplaceValue(packed, rows[0].number, new)) else None

    # -- anybody's entries ------------------------------------------------------------------------------------------

    async def lookup(self, key: K) -> list[RegistryEntry[K, V]]:
        """Return the entries for a key, oldest first."""
        return self._entries(await self._ask(Find(pack_key(key))))

    async def whereis(self, key: K) -> ActorRef[Any] | None:
        """Return the first holder of a key; None if nobody holds it."""
        rows = await self._ask(Find(pack_key(key)))
        return rows[0].holder if rows else None

    async def keys(self, holder: ActorRef[Any] | None = None) -> list[K]:
        """List the keys of one holder, else of the calling actor; a key with several entries comes as often."""
        return [key_of(row.key) for row in await self._ask(Find(None, holder or _own_ref()))]

    async def values(self, key: K, holder: ActorRef[Any] | None = None) -> list[V]:
        """Return the values of a key, those of one holder if it is given."""
        return [row.value for row in await self._ask(Find(pack_key(key), holder))]

    async def match(self, key: K, test: Callable[[V], bool]) -> list[RegistryEntry[K, V]]:
        """Return the entries for a key whose value passes the test."""
        return [entry for entry in await self.lookup(key) if test(entry.value)]

    async def select(self, test: Callable[[RegistryEntry[K, V]], bool]) -> list[RegistryEntry[K, V]]:
        """Return all entries that pass the test."""
        return [entry for entry in self._entries(await self._ask(Find())) if test(entry)]

    async def count(self) -> int:
        """Count the entries that there are."""
        return await self._ask(Count())

    async def count_match(self, key: K, test: Callable[[V], bool]) -> int:
        """Count the entries for a key that pass the test."""
        return len(await self.match(key, test))

    async def dispatch(
        self, key: K, to: Message[Any] | Callable[[list[RegistryEntry[K, V]]], Awaitable[None] | None]
    ) -> int:
        """Tell a message to all holders of a key, or call a function with their entries, unless there are none.

        A holder that cannot take the message keeps it from nobody else: that one is a dead letter.

        Returns:
            How many entries there were.
        """
        entries = await self.lookup(key)
        if isinstance(to, Message):
            for entry in entries:
                try:
                    entry.holder.tell(to)
                except SendError as error:
                    cell = entry.holder._cell
                    cell.node.not_taken(cell, to, error)
        elif entries and (done := to(entries)) is not None:
            await done
        return len(entries)

    # -- locks ------------------------------------------------------------------------------------------------------

    @asynccontextmanager
    async def lock(self, key: K, timeout: float | None = None) -> AsyncGenerator[None, None]:
        """`async with names.lock(key):` one at a time, in the order in which they asked; not re-entrant.

        A lock is independent of whether anybody holds the key. It is given back at the end of the block, or by the
        runtime when the actor's life ends.

        Raises:
            AskTimeout: it was not to be had within `timeout` seconds (the handle's if left out).
        """
        packed = pack_key(key)
        ctx = current.get(None)
        ticket = (uuid.uuid4() if ctx is None else ctx.uuid()).hex
        try:
            await self.ref.ask(Lock(packed, ticket, _life()), self.timeout if timeout is None else timeout)
            yield
        finally:
            try:
                self.ref.tell(Unlock(packed, ticket))  # Also if it was not granted, or was and we did not wait for it.
                if ctx is not None:
                    await ctx.flush()  # A recorded turn that crashes takes back what has not left.
            except ActorStopped:  # This life is over, and its locks with it.
                pass

    # -- metadata ---------------------------------------------------------------------------------------------------

    async def put_meta(self, name: str, value: Any) -> None:
        """Keep a value that belongs to the registry itself."""
        await self._ask(PutMeta(name, value))

    @overload
    async def meta(self, name: str) -> Any: ...
    @overload
    async def meta(self, name: str, default: D) -> Any | D: ...
    async def meta(self, name: str, default: object = None) -> Any:
        """Such a value; `default` if there is none of that name."""
        found = await self._ask(GetMeta(name))
        return found[0] if found else default

    async def delete_meta(self, name: str) -> None:
        """Forget a value that belongs to the registry as a whole."""
        await self._ask(DeleteMeta(name))

    async def _ask(self, message: Message[T]) -> T:
        return await self.ref.ask(message, self.timeout)

    def _entries(self, rows: list[RegistryRow]) -> list[RegistryEntry[K, V]]:
        return [RegistryEntry(cast("K", key_of(row.key)), row.holder, cast("V", row.value)) for row in rows]


def pack_key(key: object) -> bytes:
    """A key as bytes, different for different keys.

    Raises:
        SpecError: it is of a type that is no key.

    >>> pack_key(1) == pack_key(1.0), key_of(pack_key(("a", (1, None))))
    (False, ('a', (1, None)))
    """
    _check_key(key)
    try:
        return msgspec.msgpack.encode(key)
    except (OverflowError, UnicodeError, msgspec.MsgspecError) as error:
        raise SpecError("registry", f"{key!r} is no key: {error}") from error


def _check_key(key: object) -> None:
    if type(key) is tuple:
        for part in cast("tuple[object, ...]", key):
            _check_key(part)
    elif key is not None and type(key) not in (bool, int, float, str, bytes):
        raise SpecError(
            "registry",
            f"a key is None, a bool, int, float, str, bytes or a tuple of these, not {key!r} ({type_name(type(key))})",
        )


def _life() -> int:
    """The calling actor's life, that of a recorded one not told: its replay has to send the same."""
    ctx = current.get(None)
    return ctx.life if ctx is not None and ctx._may_fail_fast else 0


def _own_ref() -> ActorRef[Any]:
    ctx = current.get(None)
    if ctx is None:
        raise NotAnActor
    return ctx.ref
