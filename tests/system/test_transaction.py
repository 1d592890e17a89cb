"""Transactions: each operation is done, undone by whatever fails behind it, and left alone by a dry run (T39)."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf
from tests.system.trees import (
    Add,
    Boom,
    Broken,
    Counter,
    Double,
    Life,
    Slow,
    Stumble,
    Where,
    counter,
    picture,
    ref,
)

# A refused or failed transaction ends with its block, which collects several steps.
# ruff: noqa: PT012

Steps = Callable[[hf.system.Change], object]


def tenfold(state: dict[str, Any]) -> dict[str, Any]:
    return {"count": state["count"] * 10 + 10}


EACH: dict[str, Steps] = {
    "add": lambda change: change.add("/app/left", counter("g")),
    "add to dynamic": lambda change: change.add("/app/pool", hf.start(Counter)),
    "add subtree": lambda change: change.add("/app/left", hf.supervisor("g", children=[counter("h")])),
    "remove": lambda change: change.remove("/app/left/b"),
    "remove stopped": lambda change: change.remove("/app/right/e"),
    "move": lambda change: change.move("/app/left/b", "/app/right"),
    "move stopped": lambda change: change.move("/app/right/e", "/app/left"),
    "move to dynamic": lambda change: change.move("/app/left/a", "/app/pool"),
    "move subtree": lambda change: change.move("/app/left", "/app/right"),
    "reorder": lambda change: change.reorder("/app/left", ["c", "a"]),
    "strategy": lambda change: change.strategy("/app/left", "rest_for_one"),
    "intensity": lambda change: change.intensity("/app/left", 77, 7.0),
    "bind": lambda change: change.bind("/app/right/client", "peer", "/app/left/c"),
    "register": lambda change: change.register("third", "/app/left/c"),
    "unregister": lambda change: change.unregister("first"),
    "suspend": lambda change: change.suspend("/app/left/b"),
    "replace state": lambda change: change.replace_state("/app/left/b", tenfold),
    "replace code": lambda change: change.replace_code("/app/left/b", Double),
}
each = pytest.mark.parametrize("name", EACH)


@each
async def test_a_dry_run_does_nothing_and_tells_what_would_be_done(system: hf.ActorSystem, name: str) -> None:
    before = picture(system)
    async with system.transaction(dry_run=True) as change:
        EACH[name](change)
    assert picture(system) == before
    assert [step.number for step in change.steps] == [1]
    assert change.steps[0].text in change.describe()


@each
async def test_it_is_done(system: hf.ActorSystem, name: str) -> None:
    before = picture(system)
    async with system.transaction() as change:
        EACH[name](change)
    assert picture(system) != before


@each
@pytest.mark.parametrize("position", [0, 1, 2])
async def test_it_is_undone_by_a_failure_behind_it(system: hf.ActorSystem, name: str, position: int) -> None:
    """The operation stands at the first, second and third place; the step that fails is the last one."""
    others: list[Steps] = [EACH["register"], EACH["strategy"]]
    steps = [*others[:position], EACH[name], *others[position:]]
    if name in ("register", "strategy"):
        steps = [EACH[name]]
    before = picture(system)
    transaction = system.transaction()
    change = await transaction.__aenter__()
    for step in steps:
        step(change)
    change.step(Stumble())
    with pytest.raises(hf.TransactionFailed, match="there was a stone") as failed:
        await transaction.__aexit__(None, None, None)
    assert picture(system) == before
    assert failed.value.kept == ()
    assert failed.value.undone == tuple(step.text for step in reversed(change.steps))
    assert not isinstance(failed.value, hf.TransactionRefused)


async def test_all_steps_are_checked_before_anything_is_done(system: hf.ActorSystem) -> None:
    before = picture(system)
    stone = Stumble()
    with pytest.raises(hf.TransactionRefused, match="there is no actor at /app/nowhere"):
        async with system.transaction() as change:
            change.step(stone)
            change.register("third", "/app/left/c")
            change.remove("/app/nowhere")
    assert stone.calls == ["check"]
    assert picture(system) == before


async def test_nothing_is_done_when_the_body_raises(system: hf.ActorSystem) -> None:
    stone = Stumble()
    with pytest.raises(ZeroDivisionError):
        async with system.transaction() as change:
            change.step(stone)
            raise ZeroDivisionError
    assert stone.calls == []


# -- each operation, what is particular to it -------------------------------------------------------------------------


async def test_later_steps_see_what_earlier_ones_add(system: hf.ActorSystem) -> None:
    async with system.transaction() as change:
        g = change.add("/app/left", counter("g", 7))
        change.register("seven", g)
        change.bind("/app/right/client", "peer", g)
        change.add("/app/left", hf.supervisor("more"))
        h = change.add("/app/left/more", counter("h"))
        change.move(g, "/app/left/more")
    assert h in system.tree()
    assert await system.whereis("seven").ask(Add()) == 8
    assert await ref(system, "/app/right/client").ask(Where()) == "/app/left/more/g"


async def test_a_removed_child_has_ended_and_is_forgotten(system: hf.ActorSystem) -> None:
    b = ref(system, "/app/left/b")
    async with system.transaction() as change:
        change.remove(b)
    with pytest.raises(hf.ActorStopped):
        await b.ask(Add())
    with pytest.raises(hf.errors.NoSuchChild):
        await ref(system, "/app/left").ask(hf.supervision.GetChildSpec("b"))


async def test_what_is_removed_cannot_be_used_by_later_steps(system: hf.ActorSystem) -> None:
    for step in (
        lambda change: change.bind("/app/right/client", "peer", "/app/left/b"),
        lambda change: change.move("/app/left/b", "/app/right"),
        lambda change: change.remove("/app/left/b"),
    ):
        with pytest.raises(hf.TransactionRefused, match="removed by this very transaction"):
            async with system.transaction() as change:
                change.remove("/app/left/b")
                step(change)
    assert await ref(system, "/app/left/b").ask(Add()) == 1


async def test_no_binding_is_left_dangling(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.TransactionRefused, match="binding 'peer' would point at /app/left/a, which is removed"):
        async with system.transaction() as change:
            change.remove("/app/left/a")
    async with system.transaction() as change:
        change.remove("/app/left/a")
        change.bind("/app/right/client", "peer", "/app/left/b")
    assert await ref(system, "/app/right/client").ask(Where()) == "/app/left/b"


async def test_a_moved_child_lives_on_and_its_refs_stay_good(system: hf.ActorSystem) -> None:
    a = ref(system, "/app/left/a")
    await a.ask(Add(5))
    await system.suspend(a)
    waiting = a.ask(Add(1))
    async with system.transaction() as change:
        change.move(a, "/app/right")
    assert a.path == "/app/right/a"
    await system.resume(a)
    assert await waiting == 6
    assert await ref(system, "/app/right/client").ask(Where()) == "/app/right/a"
    assert system.whereis("first") == a
    assert await ref(system, "/app/left/a").ask(Life()) == 1  # The address it left leads to it.
    assert "/app/left/a" not in system.tree()


async def test_a_moved_child_is_restarted_by_its_new_supervisor(system: hf.ActorSystem) -> None:
    a, b = ref(system, "/app/left/a"), ref(system, "/app/left/b")
    async with system.transaction() as change:
        change.move(a, "/app/right")
    with system.events() as stream:
        a.tell(Boom())
        assert await a.ask(Life()) == 2
        await system._node.settled()
        restarted = {event.address for event in stream.take() if isinstance(event, hf.events.ChildRestarted)}
    assert restarted == {"/app/right/a"}
    assert await ref(system, "/app/right/d").ask(Life()) == 2  # `right` is one_for_all.
    assert await b.ask(Life()) == 1


async def test_what_is_moved_below_it_comes_along(system: hf.ActorSystem) -> None:
    a = ref(system, "/app/left/a")
    async with system.transaction() as change:
        change.move("/app/left", "/app/right")
    assert a.path == "/app/right/left/a"
    a.tell(Boom())
    assert await a.ask(Life()) == 2
    assert await ref(system, "/app/left/a").ask(Life()) == 2


async def test_an_address_that_was_left_is_free_for_another(system: hf.ActorSystem) -> None:
    a = ref(system, "/app/left/a")
    async with system.transaction() as change:
        change.move(a, "/app/right")
        change.add("/app/left", counter("a", 100))
    assert await ref(system, "/app/left/a").ask(Add()) == 101
    assert await a.ask(Add()) == 1


@pytest.mark.parametrize(
    ("step", "why"),
    [
        (lambda change: change.move("/app/left", "/app/left"), "below itself"),
        (lambda change: change.move("/app/left/a", "/app/right/d"), "no supervisor"),
        (lambda change: change.move("/app", "/app/left"), "no supervisor looks after it"),
        (lambda change: change.add("/app/left", counter("a")), "child 'a' is known already"),
        (lambda change: change.add("/app/left/a", counter("x")), "no supervisor"),
        (lambda change: change.reorder("/app/left", ["x"]), "there is no child 'x'"),
        (lambda change: change.reorder("/app/left", ["a", "a"]), "twice"),
        (lambda change: change.reorder("/app/pool", ["f"]), "no order"),
        (lambda change: change.strategy("/app/left", "one_for_none"), "strategy must be one of"),
        (lambda change: change.strategy("/app/pool", "one_for_all"), "one_for_one"),
        (lambda change: change.intensity("/app/left", -1, 5.0), "intensity must be"),
        (lambda change: change.bind("/app/right/client", "gate", "/app/left/a"), "no binding 'gate'"),
        (lambda change: change.register("first", "/app/left/b"), "first exists already"),
        (lambda change: change.unregister("nobody"), "no actor has the name 'nobody'"),
        (lambda change: change.isolation("/app/left/a", "thread"), "isolation must be one of"),
        (lambda change: change.remove("/app"), "leave the system"),
        (lambda change: change.suspend("/app/right/e"), "/app/right/e: it is stopped: start it first"),
        (lambda change: change.move("/app/right/e", "/app/pool"), "keeps nobody who does not run"),
        (
            lambda change: (
                change.start("/app/right", "e"),
                change.stop("/app/right/e"),
                change.start("/app/right", "e"),
            ),
            "start /app/right/e .*it is stopped by this very transaction",
        ),
    ],
)
async def test_what_cannot_be_is_refused(system: hf.ActorSystem, step: Steps, why: str) -> None:
    before = picture(system)
    with pytest.raises(hf.TransactionRefused, match=why):
        async with system.transaction() as change:
            step(change)
    assert picture(system) == before


BELOW_STOPPED: dict[str, Steps] = {
    "remove": lambda change: change.remove("/app/left/a"),
    "suspend": lambda change: change.suspend("/app/left/a"),
    "move": lambda change: change.move("/app/left/a", "/app/right"),
    "add": lambda change: change.add("/app/left", counter("g")),
    "start": lambda change: change.start("/app/left", "a"),
}


@pytest.mark.parametrize("steps", BELOW_STOPPED.values(), ids=BELOW_STOPPED.keys())
@pytest.mark.parametrize("is_started", [False, True], ids=["stopped before", "started by it"])
async def test_a_supervisor_that_was_stopped_has_nobody_whom_a_step_could_be_about(
    system: hf.ActorSystem, steps: Steps, is_started: bool
) -> None:
    async with system.transaction() as change:
        change.unbind("/app/right/client", "peer")
        change.stop("/app/left")
    with pytest.raises(hf.TransactionRefused, match=r"/app/left is stopped|/app/left: it is stopped"):
        async with system.transaction() as change:
            if is_started:
                change.start("/app", "left")
            steps(change)
    async with system.transaction() as change:  # In one of its own it is started, and then has them.
        change.start("/app", "left")
    assert await ref(system, "/app/left/a").ask(Add()) == 1


async def test_a_child_that_does_not_start_undoes_what_came_before(system: hf.ActorSystem) -> None:
    before = picture(system)
    with pytest.raises(hf.TransactionFailed, match="no such device") as failed:
        async with system.transaction() as change:
            change.move("/app/left/b", "/app/right")
            change.remove("/app/left/c")
            change.add("/app/left", hf.child("broken", hf.start(Broken)))
    assert picture(system) == before
    assert isinstance(failed.value.__cause__, hf.StartFailed)


async def test_an_actor_handles_nothing_between_a_new_state_and_the_end(system: hf.ActorSystem) -> None:
    b = ref(system, "/app/left/b")
    waiting: list[asyncio.Future[int]] = []

    async def ask_and_fail(_: hf.ActorSystem) -> None:
        waiting.append(b.ask(Add()))
        await asyncio.sleep(0)
        await system.get_state(b)
        raise hf.HoldfastError("there was a stone")

    with pytest.raises(hf.TransactionFailed, match="there was a stone"):
        async with system.transaction() as change:
            change.replace_state(b, tenfold)
            change.step(Stumble(ask_and_fail))
    assert await waiting[0] == 1
    async with system.transaction() as change:
        change.replace_state(b, tenfold)
        change.replace_code(b, Double)
    assert await b.ask(Add()) == 22


async def test_the_tree_keeps_its_new_shape_when_a_supervisor_is_restarted(system: hf.ActorSystem) -> None:
    async with system.transaction() as change:
        change.add("/app/left", counter("g", 5))
        change.remove("/app/left/b")
        change.move("/app/left/c", "/app/right")
        change.reorder("/app/left", ["g", "a"])
        change.intensity("/app/left", 33, 3.0)
    left, right = ref(system, "/app/left"), ref(system, "/app/right")
    left.kill()
    right.kill()
    for _ in range(10):
        await system._node.settled()
    assert [info.id for info in await left.ask(hf.WhichChildren())] == ["g", "a"]
    assert [info.id for info in await right.ask(hf.WhichChildren())] == ["d", "e", "client", "c"]
    assert await ref(system, "/app/left/g").ask(Add()) == 6


# -- while others are at work -----------------------------------------------------------------------------------------


async def test_a_child_that_crashes_in_the_middle_is_restarted_by_whoever_has_it(system: hf.ActorSystem) -> None:
    """Its end waits in the old supervisor's queue when it is moved: it is not lost, whichever way it goes."""
    for is_undone in (False, True):
        a = ref(system, "/app/left/a")

        async def crash(_: hf.ActorSystem, a: hf.ActorRef[Any] = a, fails: bool = is_undone) -> None:
            a.tell(Boom())
            assert await a.ask(Life()) > 1
            if fails:
                raise hf.HoldfastError("there was a stone")

        life = await a.ask(Life())
        a.tell(Boom())  # It is handled before the order to the supervisor, its end perhaps not.
        try:
            async with system.transaction() as change:
                change.move(a, "/app/right" if not is_undone else "/app/pool")
                change.step(Stumble(crash))
        except hf.TransactionFailed:
            assert is_undone
        assert await a.ask(Life()) == life + 2


async def test_transactions_come_one_after_another(system: hf.ActorSystem) -> None:
    log: list[str] = []
    first_is_in = asyncio.Event()
    go_on = asyncio.Event()

    async def one(name: str, do: Callable[[hf.ActorSystem], Any]) -> None:
        async with system.transaction() as change:
            change.step(Stumble(do))
        log.append(f"{name} is over")

    async def wait(_: hf.ActorSystem) -> None:
        first_is_in.set()
        await go_on.wait()
        log.append("first")

    async def tell(_: hf.ActorSystem) -> None:
        log.append("second")

    tasks = [asyncio.create_task(one("first", wait))]
    await first_is_in.wait()
    tasks.append(asyncio.create_task(one("second", tell)))
    await asyncio.sleep(0)
    go_on.set()
    await asyncio.gather(*tasks)
    assert log.index("first") < log.index("second")


async def test_one_inside_another_is_refused(system: hf.ActorSystem) -> None:
    async with system.transaction() as change:
        with pytest.raises(hf.TransactionRefused, match="this task is in a transaction already"):
            async with system.transaction():
                pass
        change.unregister("first")
    assert "first" not in system._node.names
    async with system.transaction(dry_run=True):  # The refused one has left nothing behind.
        pass


async def test_a_cancelled_one_is_rolled_back(system: hf.ActorSystem) -> None:
    before = picture(system)
    started = asyncio.Event()

    async def wait(_: hf.ActorSystem) -> None:
        started.set()
        await asyncio.get_running_loop().create_future()

    async def change_it() -> None:
        async with system.transaction() as change:
            change.move("/app/left/b", "/app/right")
            change.add("/app/left", counter("g"))
            change.step(Stumble(wait))

    task = asyncio.create_task(change_it())
    await started.wait()
    assert "/app/right/b" not in system.tree()  # What is there already is as it was until all of it is in force.
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert picture(system) == before


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_one_that_takes_too_long_is_rolled_back(system: hf.ActorSystem) -> None:
    before = picture(system)
    with pytest.raises(hf.TransactionFailed, match="not within 3 s"):
        async with system.transaction(timeout=3.0) as change:
            change.strategy("/app/left", "one_for_all")
            change.add("/app/left", hf.child("slow", hf.start(Slow)))
    assert picture(system) == before
    assert await ref(system, "/app/left").ask(hf.supervision.CountChildren()) == hf.supervision.ChildCounts(3, 3, 0, 3)


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_one_that_waits_too_long_for_another_is_refused(system: hf.ActorSystem) -> None:
    started = asyncio.Event()

    async def wait(_: hf.ActorSystem) -> None:
        started.set()
        await asyncio.get_running_loop().create_future()

    async def hold() -> None:
        async with system.transaction(timeout=60.0) as change:
            change.step(Stumble(wait))

    task = asyncio.create_task(hold())
    await started.wait()
    with pytest.raises(hf.TransactionRefused, match="another transaction is not over"):
        async with system.transaction(timeout=1.0) as change:
            change.unregister("first")
    with pytest.raises(hf.TransactionFailed, match="not within 60 s"):
        await task


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_child_that_waits_for_its_restart_is_moved_when_it_is_up(system: hf.ActorSystem) -> None:
    top = ref(system, "/app/left")
    g = await top.ask(hf.StartChild(counter("g", backoff=hf.Backoff(initial=2.0, jitter=0.0))))
    g.tell(Boom())
    await system._node.settled()
    async with system.transaction() as change:
        change.move(g, "/app/right")
    assert (g.path, await g.ask(Life())) == ("/app/right/g", 2)


async def test_an_actor_may_remove_itself_and_change_its_supervisor(system: hf.ActorSystem) -> None:
    class Leave(hf.Message[str]): ...

    class Leaver(hf.Actor):
        @hf.on(Leave)
        async def leave(self, message: Leave) -> str:
            async with system.transaction() as change:
                change.remove(self.ctx.ref)
                change.strategy("/app/left", "one_for_all")
            return change.describe()

    leaver = await ref(system, "/app/left").ask(hf.StartChild(hf.child("leaver", hf.start(Leaver))))
    assert "remove /app/left/leaver" in await leaver.ask(Leave())
    async with system.transaction():  # The next one waits until it is gone.
        pass
    assert "/app/left/leaver" not in system.tree()


async def test_an_actor_cannot_change_itself_in_its_own_turn(system: hf.ActorSystem) -> None:
    class Sleep(hf.Message): ...

    class Sleeper(hf.Actor):
        @hf.on(Sleep)
        async def sleep(self, message: Sleep) -> None:
            async with system.transaction() as change:
                change.suspend(self.ctx.ref)

    sleeper = await system.start(hf.child("sleeper", hf.start(Sleeper)))
    with pytest.raises(hf.RemoteCrash, match="within its own turn"):
        await sleeper.ask(Sleep())


async def test_events_tell_of_it(system: hf.ActorSystem) -> None:
    with system.events() as stream:
        async with system.transaction() as change:
            change.unregister("first")
        with pytest.raises(hf.TransactionFailed):
            async with system.transaction() as change:
                change.unregister("second")
                change.step(Stumble())
        kinds = (hf.events.TransactionBegan, hf.events.TransactionCommitted, hf.events.TransactionRolledBack)
        told = [event for event in stream.take() if isinstance(event, kinds)]
    began, committed, began_again, back = told
    assert isinstance(began, hf.events.TransactionBegan)
    assert isinstance(committed, hf.events.TransactionCommitted)
    assert isinstance(began_again, hf.events.TransactionBegan)
    assert isinstance(back, hf.events.TransactionRolledBack)
    assert (began.steps, committed.problems) == (("unregister first",), ())
    assert (back.step, back.reason) == ("stumble over a stone", "there was a stone")
    assert back.steps == ("unregister second", "stumble over a stone")


async def test_what_cannot_be_undone_is_told(system: hf.ActorSystem) -> None:
    class Stuck(Stumble):
        async def release(self, system: hf.ActorSystem) -> None:
            raise hf.HoldfastError("it is stuck")

    async def nothing(_: hf.ActorSystem) -> None: ...

    with pytest.raises(hf.TransactionFailed, match="NOT undone: stumble over a stone: it is stuck") as failed:
        async with system.transaction() as change:
            change.unregister("first")
            change.step(Stuck(nothing))
            change.step(Stumble())
    assert failed.value.undone == ("stumble over a stone", "unregister first")
    assert "first" in system._node.names


async def test_a_child_is_restarted_by_other_options_from_now_on(system: hf.ActorSystem) -> None:
    one = ref(system, "/app/left/a")
    async with system.transaction() as change:
        change.respecify(one, restart="transient")
    assert change.describe().startswith("1. set restart='transient' of /app/left/a\n- /app/left/a: Counter, permanent")
    await system.terminate(one)
    assert "/app/left/a" not in system.tree()


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"mailbox": hf.bounded(3)}, "mailbox of a child that runs cannot be another"),
        ({"restart": "often"}, "restart must be one of permanent, transient, temporary, not 'often'"),
        ({"restart": "transient", "significant": True}, "significant, but auto_shutdown is 'never'"),
    ],
)
async def test_options_that_a_child_cannot_have_are_refused(
    system: hf.ActorSystem, options: dict[str, Any], problem: str
) -> None:
    before = picture(system)
    with pytest.raises(hf.TransactionRefused, match=problem):
        async with system.transaction() as change:
            change.respecify("/app/left/a", **options)
    assert picture(system) == before
