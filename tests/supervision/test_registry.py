"""Registries: keys, values, locks, listeners, metadata (otp.md 1.14 Registry; Elixir's registry_test.exs re-told)."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import idle
from tests.supervision.family import Boom, Leave, refused

virtual = pytest.mark.asyncio(loop_factories=["virtual"])
Names = hf.supervision.Registry[Any, Any]


class Do(hf.Message[Any]):
    """Run a function in the actor's turn."""

    work: Any


class Kept(hf.Message[list[int]]): ...


class Note(hf.Message):
    n: int


class Holder(hf.Actor):
    """Does what it is asked to, as the holder of keys; with keys of its own from its start on."""

    def __init__(self, names: Names | None = None, *keys: Any) -> None:
        self.names, self.own_keys, self.notes = names, keys, list[int]()

    async def on_start(self, restored: bool) -> None:
        for key in self.own_keys:
            assert self.names is not None
            await self.names.register(key, self.ctx.life)

    @hf.on(Do)
    async def do(self, message: Do) -> Any:
        return await message.work()

    @hf.on(Note)
    def note(self, message: Note) -> None:
        self.notes.append(message.n)

    @hf.on(Kept)
    def kept(self, message: Kept) -> list[int]:
        return list(self.notes)

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Leave)
    def leave(self, message: Leave) -> None:
        self.ctx.stop(message.why)


async def open_names(system: hf.ActorSystem, **options: Any) -> Names:
    return hf.supervision.Registry(await system.start(hf.supervision.registry("names", **options)))


def by(holder: hf.ActorRef[Holder], work: Callable[[], Awaitable[Any]]) -> asyncio.Future[Any]:
    return holder.ask(Do(work))


# -- unique ---------------------------------------------------------------------------------------------------------


async def test_unique_keys_have_one_holder_with_a_value() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        one, other = (system.spawn(hf.start(Holder), name) for name in ("one", "other"))
        await by(one, lambda: names.register("hello", {"a": 1}))
        assert await names.lookup("hello") == [hf.supervision.RegistryEntry("hello", one, {"a": 1})]
        assert await names.whereis("hello") == one
        for asker in (one, other):
            assert await refused(by(asker, lambda: names.register("hello", 2))) == hf.errors.AlreadyRegistered(
                "hello", one
            )
        await by(other, lambda: names.register("world", 2))
        assert await by(other, lambda: names.keys()) == ["world"]
        assert (await names.keys(one), await names.keys(other)) == (["hello"], ["world"])
        assert (await names.values("hello"), await names.values("hello", other)) == ([{"a": 1}], [])
        assert (await names.whereis("nobody"), await names.lookup("nobody")) == (None, [])
        assert await names.count() == 2


async def test_only_the_holder_gives_a_key_up_and_twice_is_no_error() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        one, other = (system.spawn(hf.start(Holder), name) for name in ("one", "other"))
        await by(one, lambda: names.register("k", 1))
        assert await by(other, lambda: names.unregister("k")) == 0
        assert await names.whereis("k") == one
        assert await by(one, lambda: names.unregister("k")) == 1
        assert await by(one, lambda: names.unregister("k")) == 0
        await by(other, lambda: names.register("k", 2))
        assert await names.whereis("k") == other


async def test_a_value_is_changed_by_its_holder_only() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        one, other = (system.spawn(hf.start(Holder), name) for name in ("one", "other"))
        await by(one, lambda: names.register("k", 1))
        assert await by(other, lambda: names.update_value("k", lambda value: value + 1)) is None
        assert await by(one, lambda: names.update_value("nobody", lambda value: value + 1)) is None
        assert await by(one, lambda: names.update_value("k", lambda value: value + 1)) == (2, 1)
        assert await names.values("k") == [2]
        assert isinstance(
            await refused(by(one, lambda: names.update_value("k", lambda value: value["x"]))), hf.RemoteCrash
        )


async def test_who_is_no_actor_holds_nothing() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        calls: list[Awaitable[Any]] = [names.register("k", 1), names.unregister("k"), names.keys()]
        calls += [names.update_value("k", lambda value: value), names.unregister_match("k", bool)]
        for call in calls:
            assert isinstance(await refused(call), hf.errors.NotAnActor)
        assert await names.count() == 0


@pytest.mark.parametrize("keys", ["unique", "duplicate"])
async def test_keys_are_told_apart_by_type(keys: str) -> None:
    """Elixir: 1 and 1.0 differ; in Python True too."""
    alike = [1, 1.0, True, "1", b"1", (1,), (1.0,), ((1,),), None, ()]
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system, keys=keys)
        holder = system.spawn(hf.start(Holder))
        for place, key in enumerate(alike):
            await by(holder, lambda key=key, place=place: names.register(key, place))  # type: ignore[misc]
        assert [await names.values(key) for key in alike] == [[place] for place in range(len(alike))]
        found = await names.keys(holder)
        assert [(type(key), key) for key in found] == [(type(key), key) for key in alike]


async def test_what_is_no_key_is_refused_by_name() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        for key in ([1], {"a": 1}, object(), ("a", [1]), 1 << 70, "half \ud800"):
            error = await refused(names.lookup(key))
            assert isinstance(error, hf.SpecError)
            assert "key" in str(error)


# -- duplicate ------------------------------------------------------------------------------------------------------


async def test_duplicate_keys_have_many_entries_also_of_one_holder() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system, keys="duplicate")
        one, other = (system.spawn(hf.start(Holder), name) for name in ("one", "other"))
        for holder, value in ((one, 1), (one, 2), (other, 3), (one, 2)):
            await by(holder, lambda value=value: names.register("k", value))  # type: ignore[misc]
        await by(other, lambda: names.register("l", 4))
        assert await names.values("k") == [1, 2, 3, 2]
        assert await names.values("k", one) == [1, 2, 2]
        assert await names.keys(one) == ["k", "k", "k"]
        assert await names.count() == 5
        assert await names.count_match("k", lambda value: value > 1) == 3
        assert [entry.value for entry in await names.match("k", lambda value: value == 2)] == [2, 2]
        assert [entry.holder for entry in await names.select(lambda entry: entry.value > 2)] == [other, other]
        assert await by(one, lambda: names.unregister_match("k", lambda value: value == 2)) == 2
        assert await by(other, lambda: names.unregister_match("k", lambda value: value == 1)) == 0
        assert await names.values("k") == [1, 3]
        assert await by(one, lambda: names.unregister("k")) == 1
        assert await names.values("k") == [3]
        assert isinstance(
            await refused(by(other, lambda: names.update_value("k", lambda value: 9))), hf.errors.NotUnique
        )


async def test_dispatch_tells_every_holder_once_per_entry() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system, keys="duplicate")
        one, other = (system.spawn(hf.start(Holder), name) for name in ("one", "other"))
        for holder in (one, other, one):
            await by(holder, lambda: names.register("k", 0))
        assert await names.dispatch("k", Note(7)) == 3
        assert (await one.ask(Kept()), await other.ask(Kept())) == ([7, 7], [7])
        assert await names.dispatch("nobody", Note(8)) == 0
        assert await by(one, lambda: names.dispatch("k", Note(9))) == 3
        assert await other.ask(Kept()) == [7, 9]


async def test_dispatch_calls_a_function_with_the_entries_in_the_caller() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        holder = system.spawn(hf.start(Holder))
        await by(holder, lambda: names.register("k", 5))
        seen: list[Any] = []

        async def later(entries: list[hf.supervision.RegistryEntry[Any, Any]]) -> None:
            seen.extend(entries)

        assert await names.dispatch("k", later) == 1
        assert await names.dispatch("nobody", later) == 0
        assert seen == [hf.supervision.RegistryEntry("k", holder, 5)]
        with pytest.raises(ZeroDivisionError):
            await names.dispatch("k", lambda entries: 1 // 0)  # type: ignore[arg-type, return-value]
        assert await names.count() == 1


async def test_a_holder_without_room_keeps_a_message_from_nobody_else() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system, keys="duplicate")
        full = system.spawn(hf.start(Holder), "full", mailbox=hf.bounded(1, overflow="reject"))
        free = system.spawn(hf.start(Holder), "free")
        for holder in (full, free):
            await by(holder, lambda: names.register("k", 0))
        await system.suspend(full)
        full.tell(Note(1))
        assert await names.dispatch("k", Note(2)) == 2
        assert (system.dead_letters, await free.ask(Kept())) == (1, [2])


# -- locks ----------------------------------------------------------------------------------------------------------


async def test_a_lock_is_had_by_one_at_a_time_in_order_of_asking() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        inside: list[int] = []

        async def work(n: int) -> None:
            async with names.lock("k"):
                inside.append(n)
                await idle(system)
                assert inside[-1] == n
                inside.append(n)

        await asyncio.gather(*(work(n) for n in range(5)))
        assert inside == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
        async with names.lock("k"), names.lock("other"):  # Another key is another lock.
            pass


async def test_a_lock_is_free_again_after_an_exception() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        with pytest.raises(ZeroDivisionError):
            async with names.lock("k"):
                raise ZeroDivisionError
        async with names.lock("k", timeout=1.0):
            pass


@pytest.mark.parametrize("how", ["kill", "crash"])
async def test_a_lock_is_free_again_when_its_holder_has_ended(how: str) -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        holder = system.spawn(hf.start(Holder))
        has_it, go_on = asyncio.Event(), asyncio.Event()

        async def hold() -> None:
            async with names.lock("k"):
                has_it.set()
                await go_on.wait()
                raise ValueError("boom")

        held = by(holder, hold)
        await has_it.wait()
        waiting = asyncio.ensure_future(names.lock("k").__aenter__())
        await idle(system)
        assert not waiting.done()
        if how == "kill":
            holder.kill()
        else:
            go_on.set()
        await waiting
        assert isinstance(await refused(held), hf.AskFailed if how == "kill" else hf.RemoteCrash)


class Grab(hf.Message):
    path: str


class Locker(hf.Actor):
    """Takes a lock and dies with it, in a process of its own."""

    @hf.on(Grab)
    async def grab(self, message: Grab) -> None:
        names = hf.supervision.Registry[str, int](self.ctx.find(message.path, hf.supervision.RegistryActor))
        async with names.lock("k"):
            await names.register("locked", 1)
            await asyncio.get_running_loop().create_future()


async def test_a_lock_is_free_again_when_its_holders_process_is_killed() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system, listeners=["/app/listener"])
        listener = system.spawn(hf.start(Listener), "listener")
        locker = await system.start(hf.child("p", hf.start(Locker), isolation="process", restart="temporary"))
        locker.tell(Grab(names.ref.path))
        assert await listener.ask(Next()) == "+locked 1 p"
        locker.kill()
        async with names.lock("k"):
            assert await names.count() == 0


@virtual
async def test_who_waits_too_long_for_a_lock_neither_has_it_nor_keeps_it_from_others() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        async with names.lock("k"):
            with pytest.raises(hf.AskTimeout):
                async with names.lock("k", timeout=2.0):
                    raise AssertionError
            cancelled = asyncio.ensure_future(names.lock("k", timeout=60.0).__aenter__())
            patient = asyncio.ensure_future(names.lock("k", timeout=60.0).__aenter__())
            await idle(system)
            cancelled.cancel()
        await patient
        assert asyncio.get_running_loop().time() == 2.0


# -- listeners and metadata -----------------------------------------------------------------------------------------


class Next(hf.Message[str]): ...


class Listener(hf.Actor):
    def __init__(self) -> None:
        self.heard: asyncio.Queue[str] = asyncio.Queue()

    @hf.on(hf.supervision.KeyRegistered)
    def registered(self, message: hf.supervision.KeyRegistered) -> None:
        self.heard.put_nowait(f"+{message.key} {message.value} {message.holder.path[5:]}")

    @hf.on(hf.supervision.KeyFreed)
    def freed(self, message: hf.supervision.KeyFreed) -> None:
        self.heard.put_nowait(f"-{message.key} {message.holder.path[5:]}{' ended' if message.ended else ''}")

    @hf.on(Next)
    def next(self, message: Next) -> hf.ReplyHandle[str]:
        handle = self.ctx.reply_handle()
        self.ctx.create_task(self._reply(handle))
        return handle

    async def _reply(self, handle: hf.ReplyHandle[str]) -> None:
        handle.reply(await self.heard.get())


async def test_listeners_hear_of_every_key_by_name_or_address() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system, listeners=["audit", "/app/second", "nobody", "/app/deaf"])
        listeners = [system.spawn(hf.start(Listener), name) for name in ("first", "second")]
        system.register("audit", listeners[0])
        deaf = system.spawn(hf.start(Holder), "deaf")
        one, other = (system.spawn(hf.start(Holder), name) for name in ("one", "other"))
        await by(one, lambda: names.register("k", 1))
        await by(one, lambda: names.update_value("k", lambda value: 2))
        await by(one, lambda: names.unregister("k"))
        await by(one, lambda: names.unregister("k"))
        await by(other, lambda: names.register(("l", 1), 3))
        assert isinstance(await refused(by(one, lambda: names.register(("l", 1), 4))), hf.errors.AlreadyRegistered)
        other.kill()
        for listener in listeners:
            heard = [await listener.ask(Next()) for _ in range(4)]
            assert heard == ["+k 1 one", "-k one", "+('l', 1) 3 other", "-('l', 1) other ended"]
        assert await deaf.ask(Kept()) == []


async def test_metadata_belongs_to_the_registry() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system, meta={"a": 1, "none": None})
        assert [await names.meta(name) for name in ("a", "none", "b")] == [1, None, None]
        assert (await names.meta("none", 7), await names.meta("b", 7)) == (None, 7)
        await names.put_meta("b", [2])
        await names.put_meta("a", "x")
        assert [await names.meta(name) for name in ("a", "b")] == ["x", [2]]
        await names.delete_meta("a")
        await names.delete_meta("a")
        assert await names.meta("a") is None
        assert await names.count() == 0


# -- specs ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "problem"),
    [({"keys": "many"}, "keys must be one of unique, duplicate"), ({"listeners": "audit"}, "listeners must be a list")],
)
def test_a_wrong_option_is_named(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(hf.SpecError, match=f"registry 'names': {problem}"):
        hf.supervision.registry("names", **options)


async def test_who_asks_a_registry_that_is_gone_hears_so() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        await system.stop(names.ref)
        for call in (names.lookup("k"), names.count(), names.meta("a"), names.lock("k").__aenter__()):
            assert isinstance(await refused(call), hf.ActorStopped)
        with pytest.raises(hf.errors.NoSuchActor):
            system.ref("/app/names", hf.supervision.RegistryActor)
