"""The actor system as a guest in a running asyncio program: life, errors, names, topics, bindings (DESIGN 3)."""

import asyncio
from typing import Any, assert_type

import pytest

import holdfast as hf
from holdfast.supervision.admin import AlreadyStarted

# The failure of a tree comes out of the whole `async with`, so a block cannot be a single statement.
# ruff: noqa: PT012


class Boom(hf.Message): ...


class Life(hf.Message[int]): ...


class Seen(hf.Message[list[int]]): ...


class Scan(hf.Message):
    number: int


class Kid(hf.Actor):
    def __init__(self, log: list[str] | None = None) -> None:
        self.log = log

    def on_stop(self, reason: hf.ExitReason) -> None:
        if self.log is not None:
            self.log.append(self.ctx.path)

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Life)
    def life(self, message: Life) -> int:
        return self.ctx.life


class Listener(hf.Actor):
    def __init__(self) -> None:
        self.seen: list[int] = []

    @hf.subscribe("/scan")
    @hf.on(Scan)
    def scan(self, message: Scan) -> None:
        self.seen.append(message.number)

    @hf.on(Seen)
    def tell(self, message: Seen) -> list[int]:
        return self.seen


# -- life -----------------------------------------------------------------------------------------------------------


async def test_it_lives_in_the_loop_it_is_entered_in_beside_other_tasks() -> None:
    ticks: list[int] = []

    async def host() -> None:
        while True:
            ticks.append(len(ticks))
            await asyncio.sleep(0)

    other = asyncio.ensure_future(host())
    async with hf.ActorSystem("app", log=False) as system:
        ref = system.spawn(hf.start(Kid))
        for _ in range(20):
            await ref.ask(Life())
    assert len(ticks) >= 20
    before = asyncio.all_tasks()
    other.cancel()
    assert before == {other, asyncio.current_task()}  # The system has left nothing of its own.


async def test_leaving_stops_all_actors_newest_first() -> None:
    log: list[str] = []
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("a", hf.start(Kid, log)))
        system.spawn(hf.start(Kid, log), "b")
        await system.start(hf.supervisor("c", children=[hf.child(name, hf.start(Kid, log)) for name in "de"]))
    assert log == ["/app/c/e", "/app/c/d", "/app/b", "/app/a"]


async def test_systems_live_side_by_side_and_do_not_see_each_other() -> None:
    async with hf.ActorSystem("left", log=False) as left, hf.ActorSystem("right", log=False) as right:
        mine = left.spawn(hf.start(Kid), "kid")
        yours = right.spawn(hf.start(Kid), "kid")
        assert (mine.path, yours.path) == ("/left/kid", "/right/kid")
        with pytest.raises(hf.errors.NoSuchActor):
            left.ref("/right/kid", Kid)
        left.register("name", mine)
        right.register("name", yours)
        assert (left.whereis("name"), right.whereis("name")) == (mine, yours)
        await left.stop(mine)
        assert await yours.ask(Life()) == 1


async def test_systems_of_the_same_name_are_told_apart() -> None:
    async with hf.ActorSystem("app", log=False) as one, hf.ActorSystem("app", log=False) as other:
        first, second = one.spawn(hf.start(Kid), "kid"), other.spawn(hf.start(Kid), "kid")
        assert first != second
        await one.stop(first)
        assert await second.ask(Life()) == 1


async def test_a_system_is_entered_once() -> None:
    system = hf.ActorSystem("app", log=False)
    async with system:
        with pytest.raises(hf.HoldfastError, match="system 'app' was entered already; make a new one"):
            await system.__aenter__()
        assert await system.spawn(hf.start(Kid)).ask(Life()) == 1
    with pytest.raises(hf.HoldfastError, match="make a new one"):
        await system.__aenter__()


async def test_a_system_that_was_not_entered_says_so() -> None:
    system = hf.ActorSystem("app", log=False)
    for call in (
        lambda: system.spawn(hf.start(Kid)),
        lambda: system.ref("/app/x", Kid),
        system.events,
        system.connected,
    ):
        with pytest.raises(hf.HoldfastError, match="system 'app' is not running: use it in `async with`"):
            call()
    with pytest.raises(hf.HoldfastError, match="is not running"):
        await system.start(hf.child("x", hf.start(Kid)))
    with pytest.raises(hf.HoldfastError, match="is not running"):
        await system.backup("copy.db")
    assert system.tree() == []
    await system.shutdown()  # Nothing to stop is no error.


async def test_shutdown_may_be_called_early_and_again() -> None:
    log: list[str] = []
    async with hf.ActorSystem("app", log=False) as system:
        ref = system.spawn(hf.start(Kid, log), "kid")
        await asyncio.gather(system.shutdown(), system.shutdown())
        await system.shutdown()
        assert log == ["/app/kid"]
        with pytest.raises(hf.ActorStopped):
            await ref.ask(Life())


async def test_an_exception_in_the_body_stops_everything_and_goes_on() -> None:
    log: list[str] = []
    with pytest.raises(ZeroDivisionError):
        async with hf.ActorSystem("app", log=False) as system:
            await system.start(hf.child("kid", hf.start(Kid, log)))
            _ = 1 / 0
    assert log == ["/app/kid"]


async def test_cancelling_the_body_stops_everything() -> None:
    log: list[str] = []
    up = asyncio.Event()

    async def program() -> None:
        async with hf.ActorSystem("app", log=False) as system:
            await system.start(hf.child("kid", hf.start(Kid, log)))
            up.set()
            await asyncio.Event().wait()

    task = asyncio.ensure_future(program())
    await up.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert log == ["/app/kid"]


# -- the tree fails -------------------------------------------------------------------------------------------------


async def test_when_the_root_gives_up_the_body_is_cancelled_and_hears_why() -> None:
    log: list[str] = []
    ends: list[str] = []
    why = r"the tree of app gave up: restart intensity reached; the last to end was /app/kid: .*boom"
    with pytest.raises(hf.TreeFailed, match=why):
        async with hf.ActorSystem("app", intensity=1, log=False) as system:
            await system.start(hf.child("sibling", hf.start(Kid, log)))
            ref = await system.start(hf.child("kid", hf.start(Kid)))
            try:
                for life in (1, 2):
                    assert await ref.ask(Life()) == life
                    ref.tell(Boom())
                await asyncio.Event().wait()
            except asyncio.CancelledError:
                ends.append("cancelled")
                raise
    assert ends == ["cancelled"]
    assert log == ["/app/sibling"]


async def test_who_catches_the_failure_of_a_tree_is_not_cancelled() -> None:
    """Else the next `asyncio.timeout()` or task group around it would take the cancel for its own."""
    task = asyncio.current_task()
    assert task is not None
    with pytest.raises(hf.TreeFailed):
        async with asyncio.timeout(60), hf.ActorSystem("app", intensity=0, log=False) as system:
            (await system.start(hf.child("kid", hf.start(Kid)))).tell(Boom())
            await asyncio.Event().wait()
    assert task.cancelling() == 0
    async with asyncio.TaskGroup() as group:
        group.create_task(asyncio.sleep(0))


async def test_a_body_that_fails_while_the_tree_does_keeps_its_exception_as_the_cause() -> None:
    with pytest.raises(hf.TreeFailed) as caught:
        async with hf.ActorSystem("app", intensity=0, log=False) as system:
            (await system.start(hf.child("kid", hf.start(Kid)))).tell(Boom())
            try:
                await asyncio.Event().wait()
            finally:
                raise OSError("the body's own")
    assert isinstance(caught.value.__cause__, OSError)
    task = asyncio.current_task()
    assert task is not None
    assert task.cancelling() == 0


async def test_a_spawned_actor_may_crash_without_harm_to_the_tree() -> None:
    async with hf.ActorSystem("app", intensity=0, log=False) as system:
        ref = system.spawn(hf.start(Kid), "kid")
        with pytest.raises(hf.RemoteCrash):
            await ref.ask(Boom())
        with pytest.raises(hf.ActorStopped):
            await ref.ask(Life())
        assert system.tree() == ["/app"]


# -- starting, stopping, finding ------------------------------------------------------------------------------------


async def test_start_takes_specs_only() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        with pytest.raises(hf.SpecError, match="start: takes child"):
            await system.start(hf.start(Kid))  # type: ignore[arg-type]


async def test_an_id_in_use_is_refused() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("kid", hf.start(Kid)))
        with pytest.raises(AlreadyStarted):
            await system.start(hf.child("kid", hf.start(Kid)))
        with pytest.raises(hf.errors.NameTaken, match="/app/kid exists already"):
            system.spawn(hf.start(Kid), "kid")


async def test_a_name_taken_by_a_spawned_actor_is_no_crash_of_the_root() -> None:
    async with hf.ActorSystem("app", intensity=0, log=False) as system:
        ref = system.spawn(hf.start(Kid), "kid")
        with pytest.raises(hf.errors.NameTaken, match="/app/kid exists already"):
            await system.start(hf.child("kid", hf.start(Kid)))
        assert await ref.ask(Life()) == 1
        await system.stop(ref)
        await system.start(hf.child("kid", hf.start(Kid)))


async def test_a_stopped_actor_is_gone_and_its_id_is_free() -> None:
    log: list[str] = []
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("kid", hf.start(Kid, log)))
        await system.stop(ref)
        assert log == ["/app/kid"]
        with pytest.raises(hf.ActorStopped):
            await ref.ask(Life())
        await system.start(hf.child("kid", hf.start(Kid)))
        assert await ref.ask(Life()) == 1  # A ref is a handle on an address.


@pytest.mark.parametrize("restart", ["permanent", "transient", "temporary"])
async def test_stopping_what_has_stopped_is_no_error(restart: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("kid", hf.start(Kid), restart=restart)  # type: ignore[arg-type]
        supervised, spawned = await system.start(spec), system.spawn(hf.start(Kid))
        for ref in (supervised, spawned, supervised, spawned):
            await system.stop(ref)
        assert system.tree() == ["/app"]


async def test_a_ref_says_who_lives_there_or_that_nobody_does() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.supervisor("top", children=[hf.child("kid", hf.start(Kid))]))
        assert system.ref("/app/top/kid", Kid) == system.ref("/app/top/kid", hf.Actor)
        for path in ("/app/top/nobody", "/app/nobody/kid", "/other/top/kid", "/appendix", "kid", ""):
            with pytest.raises(hf.errors.NoSuchActor) as nobody:
                system.ref(path, Kid)
            assert nobody.value.actor == path
        assert system.ref("/app/top/kid") == system.ref("/app/top/kid", hf.Actor)
        with pytest.raises(hf.errors.WrongActor, match=r"/app/top/kid is a .*Kid, not a .*Listener"):
            system.ref("/app/top/kid", Listener)


async def test_the_tree_lists_parents_before_children_in_start_order() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.supervisor("z", children=[hf.child(name, hf.start(Kid)) for name in "ba"]))
        await system.start(hf.child("y", hf.start(Kid)))
        assert system.tree() == ["/app", "/app/z", "/app/z/b", "/app/z/a", "/app/y"]
        await system.stop(system.ref("/app/z", hf.Supervisor))
        assert system.tree() == ["/app", "/app/y"]


async def test_names_find_actors_and_are_free_when_those_have_stopped() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        one, other = system.spawn(hf.start(Kid)), system.spawn(hf.start(Kid))
        system.register("boss", one)
        system.register("boss", one)
        assert system.whereis("boss") == one
        with pytest.raises(hf.errors.NameTaken):
            system.register("boss", other)
        await system.stop(one)
        with pytest.raises(hf.errors.NoSuchActor):
            system.whereis("boss")
        system.register("boss", other)
        system.unregister("boss")
        system.unregister("boss")
        with pytest.raises(hf.errors.NoSuchActor):
            system.whereis("boss")
        with pytest.raises(hf.ActorStopped):
            system.register("ghost", one)


# -- topics and bindings --------------------------------------------------------------------------------------------


async def test_what_is_published_comes_to_every_subscriber_in_order() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        listeners = [system.spawn(hf.start(Listener)) for _ in range(3)]
        for number in range(10):
            await system.publish("/scan", Scan(number))
        await system.publish("/nobody listens", Scan(99))
        assert [await listener.ask(Seen()) for listener in listeners] == [list(range(10))] * 3


async def test_a_subscription_ends_with_the_actor_and_begins_anew_with_its_next_life() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        gone = system.spawn(hf.start(Listener))
        kept = await system.start(hf.child("listener", hf.start(Listener)))
        await system.stop(gone)
        await system.publish("/scan", Scan(1))
        assert await kept.ask(Seen()) == [1]
        kept.kill()
        await system._node.settled()
        await system.publish("/scan", Scan(2))
        assert await kept.ask(Seen()) == [2]
        assert system.dead_letters == 0


async def test_publishing_waits_for_room_at_a_bounded_subscriber() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        listener = system.spawn(hf.start(Listener), mailbox=hf.bounded(1))
        for number in range(5):
            await system.publish("/scan", Scan(number))
        await system._node.settled()
        reply = listener.ask(Seen())
        assert await reply == [0, 1, 2, 3, 4]


class Name(hf.Message[str]): ...


class Teller(hf.Actor):
    def __init__(self, name: str) -> None:
        self.name = name

    @hf.on(Name)
    def tell(self, message: Name) -> str:
        return self.name


class Both(hf.Message[tuple[str, str]]):
    """The reply is what the binding gave before and after the gate was passed, within one turn."""


class Clerk(hf.Actor):
    teller: hf.Binding[Teller]

    def __init__(self, entered: asyncio.Event, gate: asyncio.Event) -> None:
        self.entered, self.gate = entered, gate

    @hf.on(Name)
    async def name(self, message: Name) -> str:
        return await self.teller.ask(Name())

    @hf.on(Both)
    async def both(self, message: Both) -> tuple[str, str]:
        before = await self.teller.ask(Name())
        self.entered.set()
        await self.gate.wait()
        return before, await self.teller.ask(Name())


async def test_a_binding_can_be_pointed_elsewhere_while_the_actor_lives() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        one, other = (system.spawn(hf.start(Teller, name)) for name in ("one", "other"))
        clerk = system.spawn(hf.start(Clerk, asyncio.Event(), asyncio.Event()))
        with pytest.raises(hf.RemoteCrash, match="teller is not bound"):
            await clerk.ask(Name())
        clerk = system.spawn(hf.start(Clerk, asyncio.Event(), asyncio.Event()))
        system.bind(clerk, "teller", one)
        assert await clerk.ask(Name()) == "one"
        system.bind(clerk, "teller", other)
        assert await clerk.ask(Name()) == "other"
        with pytest.raises(hf.SpecError, match=r"Clerk has no binding 'boss' \(it has: teller\)"):
            system.bind(clerk, "boss", one)


async def test_a_binding_outlives_a_restart_of_its_owner() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("teller", hf.start(Teller, "one")))
        spec = hf.child("clerk", hf.start(Clerk, asyncio.Event(), asyncio.Event()), bindings={"teller": "/app/teller"})
        clerk = await system.start(spec)
        assert await clerk.ask(Name()) == "one"
        clerk.kill()
        assert await clerk.ask(Name()) == "one"


async def test_one_turn_sees_one_target() -> None:
    """DESIGN 3: a bind takes effect between turns of the owner."""
    entered, gate = asyncio.Event(), asyncio.Event()
    async with hf.ActorSystem("app", log=False) as system:
        one, other = (system.spawn(hf.start(Teller, name)) for name in ("one", "other"))
        clerk = system.spawn(hf.start(Clerk, entered, gate))
        system.bind(clerk, "teller", one)
        both = clerk.ask(Both())
        await entered.wait()
        system.bind(clerk, "teller", system.spawn(hf.start(Teller, "soon forgotten")))
        system.bind(clerk, "teller", other)
        gate.set()
        assert await both == ("one", "one")
        assert await clerk.ask(Name()) == "other"


class Slow(hf.Actor):
    """Says good-bye only when it is let."""

    def __init__(self, let: asyncio.Event, said: list[str]) -> None:
        self.let, self.said = let, said

    async def on_stop(self, reason: hf.ExitReason) -> None:
        await self.let.wait()
        self.said.append(str(reason))


async def test_a_cancel_while_the_system_stops_waits_for_the_end() -> None:
    let, said = asyncio.Event(), list[str]()
    inside = asyncio.Event()

    async def program() -> None:
        async with hf.ActorSystem("t", log=False) as system:
            system.spawn(hf.start(Slow, let, said))
            inside.set()
            await asyncio.get_running_loop().create_future()

    task = asyncio.get_running_loop().create_task(program())
    await inside.wait()
    for _ in range(3):  # SIGTERM again and again
        task.cancel()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
    assert not task.done()
    let.set()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert said == ["shutdown"]


async def test_a_ref_is_typed_by_what_was_started(system: hf.ActorSystem) -> None:
    """The type checkers look at this one."""
    spec = assert_type(hf.child("typed", hf.start(Typed)), hf.ChildSpec[Typed])
    assert_type(await system.start(spec), hf.ActorRef[Typed])
    tree = hf.supervisor("tree", children=[spec])
    assert_type(await system.start(tree), hf.ActorRef[Any])


class Typed(hf.Actor): ...
