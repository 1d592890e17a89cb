"""What a registry knows of those who end: holders, holders in other processes, itself (otp.md 1.13, 1.14, W16)."""

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import idle
from tests.supervision.family import Boom, Leave, refused
from tests.supervision.test_registry import Holder, Kept, Listener, Names, Next, Note, by, open_names

# -- ends -----------------------------------------------------------------------------------------------------------


class Witness(hf.Actor):
    """Asks the registry as soon as it hears of an end."""

    def __init__(self, names: Names, *others: hf.ActorRef[Any]) -> None:
        self.names, self.found = names, list[Any]()
        for other in others:
            self.ctx.monitor(other)

    async def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.found.append(await self.names.select(lambda entry: entry.holder == source))

    @hf.on(Kept)
    def kept(self, message: Kept) -> list[Any]:
        return self.found


@pytest.mark.parametrize("how", [hf.NORMAL, hf.Shutdown("x"), "crash", "kill", "terminate"])
async def test_who_hears_of_an_end_finds_nothing_any_more(how: Any) -> None:
    """otp.md 1.13 names, W16. The witness began to watch before the registry did: it hears first."""
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        holder = system.spawn(hf.start(Holder))
        witness = system.spawn(hf.start(Witness, names, holder))
        await by(holder, lambda: names.register("k", 0))
        match how:
            case "crash":
                holder.tell(Boom())
            case "kill":
                holder.kill()
            case "terminate":
                await system.terminate(holder)
                assert await names.whereis("k") is None
            case reason:
                holder.tell(Leave(reason))
        await idle(system)
        assert str(await witness.ask(Kept())) == "[[]]"
        assert await names.count() == 0


async def test_a_dead_holders_key_is_had_before_its_down_has_come() -> None:
    """Elixir: a stale entry is replaced by register and hidden from lookups."""
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        old, new = (system.spawn(hf.start(Holder), name) for name in ("old", "new"))
        await by(old, lambda: names.register("k", 1))
        await system.suspend(names.ref)
        taken = by(new, lambda: names.register("k", 2))
        found = asyncio.ensure_future(names.lookup("k"))
        await idle(system)
        old.kill()
        await idle(system)
        await system.resume(names.ref)  # Its queue: the new one's register, and behind it the old one's DOWN.
        await taken
        assert [entry.holder for entry in await found] == [new]
        assert await names.count() == 1


async def test_an_ask_that_outlives_its_asker_registers_nothing() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system, listeners=["/app/listener"])
        listener = system.spawn(hf.start(Listener), "listener")
        await system.start(hf.supervisor("top", children=[hf.child("h", hf.start(Holder))]))
        holder = system.ref("/app/top/h", Holder)
        await system.suspend(names.ref)
        lost = by(holder, lambda: names.register("k", 1))
        await idle(system)
        holder.kill()
        with pytest.raises(hf.AskFailed):
            await lost
        assert await holder.ask(Kept()) == []  # The next life, which never asked for the key.
        await system.resume(names.ref)
        assert await names.lookup("k") == []
        await by(holder, lambda: names.register("other", 2))
        assert await listener.ask(Next()) == "+other 2 top/h"


async def test_a_restarted_holder_registers_anew() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        await system.start(hf.supervisor("top", children=[hf.child("h", hf.start(Holder, names, "a", "b"))]))
        holder = system.ref("/app/top/h", Holder)
        assert await names.values("a") == [1]
        holder.tell(Boom())
        await holder.ask(Kept())
        assert (await names.values("a"), await names.keys(holder)) == ([2], ["a", "b"])


class Recorded(hf.Actor):
    """Holds a key and has a lock, and is brought back as if nothing had happened."""

    def __init__(self, names_path: str) -> None:
        self.path = names_path
        self.n = 0

    @property
    def _names(self) -> hf.supervision.Registry[str, int]:
        return hf.supervision.Registry(self.ctx.find(self.path, hf.supervision.RegistryActor))

    @hf.on(Note)
    async def note(self, message: Note) -> None:
        if self.n == 0:
            await self._names.register("k", message.n)
        self.n += 1

    @hf.on(Kept)
    async def kept(self, message: Kept) -> list[int]:
        await self._names.register("k", self.n)  # Its own already.
        return [self.n]


async def test_an_actor_with_recovery_holds_its_keys_over_a_crash() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        spec = hf.child("r", hf.start(Recorded, names.ref.path), recovery=hf.hybrid(interval=60.0), isolation="process")
        recorded = await system.start(spec)
        await recorded.send(Note(5))
        await recorded.send(Note(6))
        assert await recorded.ask(Kept()) == [2]
        recorded.kill()
        assert await names.whereis("k") == recorded
        assert await recorded.ask(Kept()) == [2]
        assert (await names.values("k"), recorded._cell.life) == ([2], 2)
        await system.stop(recorded)
        assert await names.whereis("k") is None


# -- the registry itself is restarted -------------------------------------------------------------------------------


async def test_a_restarted_registry_has_lost_nothing_but_the_dead() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system, meta={"since": 1}, listeners=["/app/listener"])
        listener = system.spawn(hf.start(Listener), "listener")
        await system.start(hf.supervisor("top", children=[hf.child("again", hf.start(Holder))]))
        again = system.ref("/app/top/again", Holder)
        living, dying = (system.spawn(hf.start(Holder), name) for name in ("living", "dying"))
        for holder in (living, dying, again):
            await by(holder, lambda holder=holder: names.register(holder.path, 1))  # type: ignore[misc]
        await names.put_meta("since", 2)
        names.ref.kill()
        dying.kill()
        again.kill()  # Restarted, but it is another life that never registered.
        assert [entry.holder for entry in await names.select(lambda entry: True)] == [living]
        assert (await names.meta("since"), names.ref._cell.life) == (2, 2)
        assert await refused(by(living, lambda: names.register(living.path))) == hf.errors.AlreadyRegistered(
            living.path, living
        )
        heard = [await listener.ask(Next()) for _ in range(5)]
        assert [text.partition(" ")[0] for text in heard] == [
            *("+/app/living", "+/app/dying", "+/app/top/again", "-/app/dying", "-/app/top/again")
        ]
        living.kill()
        assert await listener.ask(Next()) == "-/app/living living ended", "the new life watches them too"


async def test_locks_outlive_a_restart_of_the_registry() -> None:
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        order: list[str] = []

        async def work(name: str) -> None:
            async with names.lock("k"):
                order.append(f"+{name}")
                await go_on[name].wait()
                order.append(f"-{name}")

        go_on = {name: asyncio.Event() for name in "ab"}
        async with asyncio.TaskGroup() as group:
            for name in "ab":
                group.create_task(work(name))
                await idle(system)
            names.ref.kill()
            go_on["b"].set()
            await idle(system)
            go_on["a"].set()
        assert order == ["+a", "-a", "+b", "-b"]


async def test_a_registry_that_is_given_up_is_empty_when_it_comes_again() -> None:
    """In a rest_for_one supervisor its holders come after it, and register again."""
    async with hf.ActorSystem(log=False) as system:
        spec = hf.supervisor(
            "top",
            strategy="rest_for_one",
            children=[hf.supervision.registry("names"), hf.child("h", hf.start(Finder, "/app/top/names"))],
        )
        await system.start(spec)
        names = hf.supervision.Registry[str, int](system.ref("/app/top/names", hf.supervision.RegistryActor))
        stranger = system.spawn(hf.start(Holder))
        await by(stranger, lambda: names.register("stranger", 1))
        top = system.ref("/app/top", hf.Supervisor)
        top.kill()
        await idle(system)
        holder = system.ref("/app/top/h", Finder)
        assert await holder.ask(Kept()) == []
        again = hf.supervision.Registry[str, int](system.ref("/app/top/names", hf.supervision.RegistryActor))
        assert [(entry.key, entry.holder) for entry in await again.select(lambda entry: True)] == [("finder", holder)]
        again.ref.kill()
        await idle(system)
        assert (await again.values("finder"), holder._cell.life) == ([2], 2)


class Finder(Holder):
    """Finds the registry by its address."""

    def __init__(self, path: str, key: str = "finder") -> None:
        super().__init__(hf.supervision.Registry(self.ctx.find(path, hf.supervision.RegistryActor)), key)


# -- processes ------------------------------------------------------------------------------------------------------


class Act(hf.Message[str]):
    path: str
    what: str


class Far(hf.Actor):
    """Uses a registry from a process of its own."""

    @hf.on(Act)
    async def act(self, message: Act) -> str:
        names = hf.supervision.Registry[Any, Any](self.ctx.find(message.path, hf.supervision.RegistryActor))
        key = ("far", self.ctx.path)
        match message.what:
            case "register":
                await names.register(key, {"n": [1]})
            case "update":
                return repr(await names.update_value(key, lambda value: {"n": [*value["n"], 2]}))
            case "look":
                return repr([(entry.key, entry.holder.path, entry.value) for entry in await names.lookup(key)])
            case "taken":
                try:
                    await names.register("near", 1)
                except hf.errors.AlreadyRegistered as no:
                    return f"{no.key} is {no.holder.path}"
            case _:
                return repr((await names.keys(), await names.select(lambda entry: entry.key == "near")))
        return ""

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")


@pytest.mark.parametrize("where", ["process", "subtree"])
async def test_actors_in_other_processes_hold_keys_like_any_other(where: str) -> None:
    child = hf.child("far", hf.start(Far), isolation="process" if where == "process" else "task")
    async with hf.ActorSystem(log=False) as system:
        names = await open_names(system)
        near = system.spawn(hf.start(Holder), "near")
        await by(near, lambda: names.register("near", 0))
        isolation: Any = "process" if where == "subtree" else "task"
        await system.start(hf.supervisor("top", children=[child], isolation=isolation, intensity=9))
        far = system.ref("/app/top/far", Far)
        watch = system.spawn(hf.start(Witness, names, far))

        async def act(what: str) -> str:
            return await far.ask(Act(names.ref.path, what))

        await act("register")
        key = ("far", "/app/top/far")
        assert await names.lookup(key) == [hf.supervision.RegistryEntry(key, far, {"n": [1]})]
        assert await act("update") == "({'n': [1, 2]}, {'n': [1]})"
        assert await act("look") == f"[({key}, '/app/top/far', {{'n': [1, 2]}})]"
        assert await act("taken") == "near is /app/near"
        assert (await act("rest")).startswith(f"([{key}], [RegistryEntry(key='near', holder=<ActorRef /app/near>")
        far.tell(Boom())
        assert await act("look") == "[]"
        await act("register")
        far.kill()
        while len(await watch.ask(Kept())) < 1:
            await idle(system)
        assert await act("look") == "[]"
        assert await names.keys(near) == ["near"]


async def test_a_registry_inside_a_process_serves_those_outside() -> None:
    async with hf.ActorSystem(log=False) as system:
        children = [hf.supervision.registry("names"), hf.child("in", hf.start(Far))]
        await system.start(hf.supervisor("top", children=children, isolation="process"))
        names = hf.supervision.Registry[Any, Any](system.ref("/app/top/names", hf.supervision.RegistryActor))
        inner, outer = system.ref("/app/top/in", Far), system.spawn(hf.start(Holder), "outer")
        await inner.ask(Act(names.ref.path, "register"))
        await by(outer, lambda: names.register("o", 1))
        assert [await names.whereis(key) for key in (("far", inner.path), "o")] == [inner, outer]
        outer.kill()
        while await names.count() > 1:
            await idle(system)
        assert await names.keys(inner) == [("far", inner.path)]
