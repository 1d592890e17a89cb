"""What is prepared changes nothing, what is committed is in force at once, and nothing in between is ever seen."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
import signal
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.kernel.cell import DOWN
from holdfast.system.transaction.draft import difference
from tests.launched import kills_itself
from tests.system.trees import Add, Boom, Client, Counter, Double, Life, Stumble, Where, counter, picture, ref

pytestmark = pytest.mark.usefixtures("warm_programs")

# A transaction that fails ends with its block, which collects several steps.
# ruff: noqa: PT012

Meanwhile = Callable[[hf.ActorSystem], Awaitable[None]]
IN_TIME = 20.0


class Slot(Stumble):
    """A step in the middle, which does what a test wants there when all before it is prepared."""

    def __init__(self, do: Meanwhile, *, fails: bool) -> None:
        super().__init__(do)
        self._fails = fails

    async def prepare(self, system: hf.ActorSystem) -> None:
        await super().prepare(system)
        if self._fails:
            raise hf.HoldfastError("there was a stone")


def plus(n: int, state: dict[str, Any]) -> dict[str, Any]:
    return {**state, "count": state["count"] + n}


def hundred(state: dict[str, Any]) -> dict[str, Any]:
    return plus(100, state)


async def crashed(system: hf.ActorSystem, path: str) -> None:
    """An actor is killed, and its next life is up."""
    before = ref(system, path)._cell
    life = before.life
    before.kill()
    async with asyncio.timeout(IN_TIME):
        while True:
            cell = system._node.find(path)
            if cell is not None and (cell is not before or cell.life != life) and cell.host.is_up(cell):
                return
            await asyncio.sleep(0)


@pytest.fixture(params=["plain", "recorded", "in a process", "recorded in a process"])
async def one(system: hf.ActorSystem, request: pytest.FixtureRequest) -> hf.ActorRef[Any]:
    recovery = hf.hybrid(interval=60.0) if "recorded" in request.param else None
    isolation: Any = "process" if "process" in request.param else "task"
    spec = hf.child("one", hf.start(Counter, 5), recovery=recovery, isolation=isolation)
    await system.start(hf.supervisor("top", intensity=99, children=[spec, counter("other")]))
    return ref(system, "/app/top/one")


# -- until the commit nothing has changed -----------------------------------------------------------------------------


async def test_work_that_is_acknowledged_in_the_middle_is_kept(system: hf.ActorSystem, one: hf.ActorRef[Any]) -> None:
    """The life that was held ends; what its next life handles is not overwritten when the transaction is given up."""
    acknowledged: list[int] = []

    async def meanwhile(running: hf.ActorSystem) -> None:
        await crashed(running, one.path)
        acknowledged.extend([await one.ask(Add()) for _ in range(3)])

    with pytest.raises(hf.TransactionFailed, match="there was a stone") as failed:
        async with system.transaction(timeout=IN_TIME) as change:
            change.replace_state(one, hundred)
            change.step(Slot(meanwhile, fails=True))
    assert failed.value.kept == ()
    assert await one.ask(Add(0)) == acknowledged[-1]


async def test_a_life_that_ends_in_the_middle_is_prepared_again(system: hf.ActorSystem, one: hf.ActorRef[Any]) -> None:
    """What its next life has acknowledged before it is held is in the state that is changed."""
    acknowledged: list[int] = []

    async def meanwhile(running: hf.ActorSystem) -> None:
        await crashed(running, one.path)
        acknowledged.append(await one.ask(Add(7)))

    async with system.transaction(timeout=IN_TIME) as change:
        change.replace_state(one, hundred)
        change.step(Slot(meanwhile, fails=False))
    assert await one.ask(Add(0)) == acknowledged[0] + 100


async def test_who_has_a_new_address_since_the_check_is_let_go_of_too(
    system: hf.ActorSystem, one: hf.ActorRef[Any]
) -> None:
    """Its supervisor was restarted before it was held: it is not the same cell any more."""

    async def meanwhile(running: hf.ActorSystem) -> None:
        await crashed(running, "/app/top")

    with pytest.raises(hf.TransactionFailed, match="there was a stone") as failed:
        async with system.transaction(timeout=IN_TIME) as change:
            change.step(Slot(meanwhile, fails=False))
            change.replace_state(one, hundred)
            change.step(Stumble())
    assert failed.value.kept == ()
    assert await ref(system, one.path).ask(Add(), IN_TIME) == 6


@pytest.mark.parametrize("fails", [True, False])
async def test_what_is_held_handles_nothing_before_the_end(
    system: hf.ActorSystem, one: hf.ActorRef[Any], fails: bool
) -> None:
    asked: list[asyncio.Future[int]] = []

    async def meanwhile(running: hf.ActorSystem) -> None:
        asked.append(one.ask(Add(1)))
        await system.resume(one)  # That of a user: the transaction holds it all the same.
        await running.get_status(one)
        assert not asked[0].done()

    try:
        async with system.transaction(timeout=IN_TIME) as change:
            change.replace_state(one, hundred)
            change.resume(one)
            change.step(Slot(meanwhile, fails=fails))
    except hf.TransactionFailed:
        assert fails
    assert await asked[0] == (6 if fails else 106)


async def test_a_user_who_has_suspended_it_is_heard_after_it(system: hf.ActorSystem, one: hf.ActorRef[Any]) -> None:
    """Holding is not suspending: neither ends the other."""
    await system.suspend(one)
    with pytest.raises(hf.TransactionFailed):
        async with system.transaction(timeout=IN_TIME) as change:
            change.replace_state(one, hundred)
            change.step(Stumble())
    assert (await system.get_status(one)).state == "suspended"
    async with system.transaction(timeout=IN_TIME) as change:
        change.replace_state(one, hundred)
    assert (await system.get_status(one)).state == "suspended"
    await system.resume(one)
    assert await one.ask(Add(0)) == 105


async def test_what_it_wants_last_is_what_it_is(system: hf.ActorSystem, one: hf.ActorRef[Any]) -> None:
    async with system.transaction(timeout=IN_TIME) as change:
        change.resume(one)
        change.replace_state(one, hundred)
        change.suspend(one)
    assert (await system.get_status(one)).state == "suspended"
    async with system.transaction(timeout=IN_TIME) as change:
        change.suspend(one)
        change.resume(one)
    assert await one.ask(Add(0)) == 105


async def test_several_changes_of_one_actor_are_one(system: hf.ActorSystem, one: hf.ActorRef[Any]) -> None:
    async with system.transaction(timeout=IN_TIME) as change:
        change.replace_state(one, hundred)
        change.replace_code(one, Double)
        change.replace_state(one, hundred)
    assert await one.ask(Add(1)) == 207
    await crashed(system, one.path)
    assert await one.ask(Add(1)) in (209, 7), "it is of the new class, from what was recorded or from its arguments"


async def test_a_change_that_raises_leaves_it_as_it_was(system: hf.ActorSystem, one: hf.ActorRef[Any]) -> None:
    with pytest.raises(hf.TransactionFailed, match="KeyError"):
        async with system.transaction(timeout=IN_TIME) as change:
            change.replace_state(one, hundred)
            change.replace_state(one, missing)
    assert await one.ask(Add(1)) == 6


def missing(state: dict[str, Any]) -> dict[str, Any]:
    return {"count": state["nothing"]}


# -- what restarts meanwhile ------------------------------------------------------------------------------------------

RESTARTED = ["/app/left", "/app/right"]
SHAPES: dict[str, Callable[[hf.system.Change], object]] = {
    "add": lambda change: change.add("/app/left", counter("g")),
    "add subtree": lambda change: change.add("/app/left", hf.supervisor("g", children=[counter("h")])),
    "remove": lambda change: change.remove("/app/left/b"),
    "stop": lambda change: change.stop("/app/left/b"),
    "start": lambda change: change.start("/app/right", "e"),
    "move": lambda change: change.move("/app/left/b", "/app/right"),
    "move back": lambda change: there_and_back(change),
    "reorder": lambda change: change.reorder("/app/left", ["c", "a"]),
    "strategy": lambda change: change.strategy("/app/left", "rest_for_one"),
    "intensity": lambda change: change.intensity("/app/left", 77, 7.0),
    "move and add": lambda change: move_and_add(change),
    "replace": lambda change: replace(change, "/app/left", "b", "/app/right"),
    "replace stopped": lambda change: replace(change, "/app/right", "e", "/app/left"),
    "move and start": lambda change: move_and_start(change),
    "move and stop": lambda change: move_and_stop(change),
    "swap": lambda change: swap(change),
    "move to what is added": lambda change: move_to_new(change),
}


def move_and_add(change: hf.system.Change) -> None:
    change.move("/app/left/b", "/app/right")
    change.add("/app/right", counter("g"))
    change.reorder("/app/right", ["g", "d"])
    change.move("/app/left/a", "/app/right")


def replace(change: hf.system.Change, above: str, name: str, other: str) -> None:
    change.move(f"{above}/{name}", other)
    change.add(above, counter(name, 100))


def move_and_start(change: hf.system.Change) -> None:
    change.move("/app/right/e", "/app/left")
    change.start("/app/left", "e")


def move_and_stop(change: hf.system.Change) -> None:
    change.move("/app/left/b", "/app/right")
    change.stop("/app/right/b")


def swap(change: hf.system.Change) -> None:
    change.add("/app/right", hf.supervisor("way", children=[counter("b", 100)]))
    change.move("/app/left/b", "/app/right")
    change.move("/app/right/way/b", "/app/left")


def move_to_new(change: hf.system.Change) -> None:
    change.add("/app/right", hf.supervisor("new"))
    change.move("/app/left/b", "/app/right/new")
    change.add("/app/right/new", counter("g"))


def there_and_back(change: hf.system.Change) -> None:
    change.move("/app/left/b", "/app/right")
    change.move("/app/right/b", "/app/left")


shapes = pytest.mark.parametrize("name", SHAPES)
restarted = pytest.mark.parametrize("path", RESTARTED)


def shape(system: hf.ActorSystem) -> dict[str, Any]:
    """What there is: children in order with their states, and flags."""
    found: dict[str, Any] = {}
    for path in RESTARTED:
        actor: Any = ref(system, path)._cell.actor
        found[path] = [actor._flags, [(name, one.state) for name, one in actor._children.items()]]
    return {"tree": sorted(path for path in system.tree() if path.startswith(tuple(RESTARTED))), **found}


async def stopped_for_good(system: hf.ActorSystem) -> None:
    """What the tree has stopped by a message comes back with its supervisor; what a transaction stops does not."""
    async with system.transaction() as change:
        change.start("/app/right", "e")
    async with system.transaction() as change:
        change.stop("/app/right/e")


async def in_force(system: hf.ActorSystem) -> dict[str, Any]:
    """What there is when both supervisors have been restarted: what is in force, and nothing else."""
    for path in RESTARTED:
        await crashed(system, path)
    async with asyncio.timeout(IN_TIME):
        while any(
            one.state not in ("running", "stopped")
            for path in RESTARTED
            for one in getattr(ref(system, path)._cell.actor, "_children", {"": None}).values()
        ):
            await asyncio.sleep(0)
    return shape(system)


@shapes
@restarted
async def test_a_supervisor_that_is_restarted_in_the_middle_has_what_was_in_force(
    system: hf.ActorSystem, name: str, path: str
) -> None:
    await stopped_for_good(system)
    before = shape(system)

    async def meanwhile(running: hf.ActorSystem) -> None:
        await crashed(running, path)

    with pytest.raises(hf.TransactionFailed, match="there was a stone") as failed:
        async with system.transaction(timeout=IN_TIME) as change:
            SHAPES[name](change)
            change.step(Slot(meanwhile, fails=True))
    assert failed.value.kept == ()
    assert shape(system) == before
    assert await in_force(system) == before


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_supervisor_that_is_down_at_the_moment_is_waited_for(system: hf.ActorSystem, isolation: Any) -> None:
    """What is prepared below it has ended with its life, and no next one has begun yet."""
    pause = hf.Backoff(0.3, 0.3, jitter=0.0)
    low = hf.supervisor("low", isolation=isolation, children=[hf.child("b", hf.start(Counter), autostart=False)])
    await system.start(hf.supervisor("top", intensity=99, children=[dataclasses.replace(low, backoff=pause)]))

    async def meanwhile(running: hf.ActorSystem) -> None:
        cell = ref(running, "/app/top/low")._cell
        cell.kill()
        while cell.state is not DOWN:
            await asyncio.sleep(0)

    async with system.transaction(timeout=IN_TIME) as change:
        change.add("/app/top/low", counter("g"))
        if isolation == "task":  # What has not run in another process is not known here.
            change.start("/app/top/low", "b")
        change.step(Slot(meanwhile, fails=False))
    assert await ref(system, "/app/top/low/g").ask(Add()) == 1
    assert isolation == "process" or await ref(system, "/app/top/low/b").ask(Add()) == 1


@shapes
@restarted
async def test_what_is_committed_is_in_force_though_a_supervisor_was_restarted_in_the_middle(
    system: hf.ActorSystem, name: str, path: str
) -> None:
    await stopped_for_good(system)

    async def meanwhile(running: hf.ActorSystem) -> None:
        await crashed(running, path)

    async with system.transaction(timeout=IN_TIME) as change:
        SHAPES[name](change)
        change.step(Slot(meanwhile, fails=False))
    now = shape(system)
    after = await in_force(system)
    assert after == now
    match name:
        case "add" | "add subtree":
            assert "/app/left/g" in after["tree"]
        case "remove" | "stop":
            assert "/app/left/b" not in after["tree"]
        case "start":
            assert "/app/right/e" in after["tree"]
        case "move":
            assert "/app/right/b" in after["tree"]
            assert "/app/left/b" not in after["tree"]
        case "reorder":
            assert [child for child, _ in after["/app/left"][1]] == ["c", "a", "b"]
        case "strategy":
            assert after["/app/left"][0].strategy == "rest_for_one"
        case "intensity":
            assert after["/app/left"][0].intensity == 77
        case "move and add":
            assert [child for child, _ in after["/app/left"][1]] == ["c"]
            assert [child for child, _ in after["/app/right"][1]] == ["g", "d", "e", "client", "b", "a"]
        case "replace" | "swap":
            assert [child for child, _ in after["/app/left"][1]] == ["a", "c", "b"]
            assert await ref(system, "/app/left/b").ask(Add(1)) == 101
            assert await ref(system, "/app/right/b").ask(Add(1)) == 1
        case "replace stopped":
            assert ("e", "stopped") in after["/app/left"][1]
            assert await ref(system, "/app/right/e").ask(Add(1)) == 101
        case "move and start":
            assert ("e", "running") in after["/app/left"][1]
        case "move and stop":
            assert ("b", "stopped") in after["/app/right"][1]
        case "move to what is added":
            tree = [path for path in after["tree"] if path.startswith("/app/right/new")]
            assert tree == ["/app/right/new", "/app/right/new/b", "/app/right/new/g"]
        case _:
            assert "/app/left/b" in after["tree"]


async def test_a_supervisor_starts_the_temporary_children_of_its_plan_again(system: hf.ActorSystem) -> None:
    """As without a transaction; one that is added or moved there is gone with the life of its supervisor."""
    plan = [counter("first", restart="temporary"), counter("second", restart="temporary")]
    top = await system.start(hf.supervisor("top", intensity=9, children=plan))
    async with system.transaction(timeout=IN_TIME) as change:
        change.add(top, counter("third", restart="temporary"))
        change.add(top, counter("fourth"))
        change.move("/app/top/second", "/app/left")
        change.reorder(top, ["fourth"])
    for path in ("/app/top", "/app/left"):
        await crashed(system, path)
    names = [
        [info.id for info in await ref(system, path).ask(hf.WhichChildren())] for path in ("/app/top", "/app/left")
    ]
    assert names == [["fourth", "first"], ["a", "b", "c"]]


async def test_several_steps_about_one_child_are_all_in_force(system: hf.ActorSystem) -> None:
    """No step writes over what another says of the same spec."""
    async with system.transaction(timeout=IN_TIME) as change:
        change.add("/app/left", counter("x"))
        change.isolation("/app/left/x", "process")
        change.replace_code("/app/left/b", Double)
        change.move("/app/left/b", "/app/right")
        change.add("/app/left", hf.supervisor("sub"))
        change.strategy("/app/left/sub", "one_for_all")
        change.add("/app/left/sub", counter("y"))
        change.move("/app/left/sub", "/app/right")
    for path in RESTARTED:
        await crashed(system, path)
    assert system.pid_of(ref(system, "/app/left/x")) != os.getpid()
    assert await ref(system, "/app/right/b").ask(Add(1)) == 2
    assert await ref(system, "/app/right/sub/y").ask(Add(1)) == 1
    flags = ref(system, "/app/right/sub")._cell.actor._flags  # type: ignore[union-attr]
    assert flags.strategy == "one_for_all"


# -- addresses --------------------------------------------------------------------------------------------------------


async def test_the_children_stand_in_the_order_that_the_steps_say(system: hf.ActorSystem) -> None:
    async with system.transaction(dry_run=True) as dry:
        SHAPES["move and add"](dry)
    async with system.transaction(timeout=IN_TIME) as change:
        SHAPES["move and add"](change)
    cell = ref(system, "/app/right")._cell
    assert isinstance(cell.actor, hf.Supervisor)
    assert list(cell.actor._children) == ["g", "d", "e", "client", "b", "a"]
    assert list(cell.children or {}) == ["g", "d", "client", "b", "a"]
    assert dry.difference == change.difference


async def test_who_comes_to_an_address_that_was_left_can_be_bound_at_once(system: hf.ActorSystem) -> None:
    """It has its address, at which messages wait for its start, from the commit on."""
    client, moved = ref(system, "/app/right/client"), ref(system, "/app/left/a")
    async with system.transaction(timeout=IN_TIME) as change:
        change.move(moved, "/app/pool")
        change.add("/app/left", counter("a", 100))
        change.bind(client, "peer", "/app/left/a")
    assert await client.ask(Where()) == "/app/left/a"
    assert await client._cell.extra().bindings["peer"].ref.ask(Add(1)) == 101
    assert await moved.ask(Add(1)) == 1


async def test_who_is_bound_to_one_that_comes_there_is_bound_to_no_other(system: hf.ActorSystem) -> None:
    async with system.transaction(timeout=IN_TIME) as change:
        change.move("/app/left/a", "/app/pool")
        change.add("/app/left", counter("a", 100))
        change.add("/app/left", hf.child("user", hf.start(Client), bindings={"peer": "/app/left/a"}))
    for _ in range(2):
        user = ref(system, "/app/left/user")
        assert await user.ask(Where()) == "/app/left/a"
        assert await user._cell.extra().bindings["peer"].ref.ask(Add(1)) > 100
        await crashed(system, "/app/left")


@pytest.mark.parametrize("what", ["register", "suspend", "replace_state", "move to it"])
async def test_what_needs_it_earlier_is_refused(system: hf.ActorSystem, what: str) -> None:
    with pytest.raises(hf.TransactionRefused, match="when this transaction is in force"):
        async with system.transaction() as change:
            change.move("/app/left/a", "/app/pool")
            change.add("/app/left", hf.supervisor("a") if what == "move to it" else counter("a"))
            match what:
                case "register":
                    change.register("third", "/app/left/a")
                case "suspend":
                    change.suspend("/app/left/a")
                case "replace_state":
                    change.replace_state("/app/left/a", hundred)
                case _:
                    change.move("/app/left/b", "/app/left/a")


async def test_who_was_bound_to_a_life_that_is_over_stays_with_the_actor_and_not_its_address(
    system: hf.ActorSystem,
) -> None:
    client, before = ref(system, "/app/right/client"), ref(system, "/app/left/a")
    await crashed(system, "/app/left")  # The cells below it are other ones now.
    async with system.transaction(timeout=IN_TIME) as change:
        change.move(before, "/app/pool")
        change.add("/app/left", counter("a", 100))
        change.register("third", before)
    assert await client.ask(Where()) == "/app/pool/a"
    assert system._node.names["third"].path == "/app/pool/a"


async def test_an_address_that_somebody_else_has_leads_to_nobody_else_while_that_one_is_restarted(
    system: hf.ActorSystem,
) -> None:
    async with system.transaction(timeout=IN_TIME) as change:
        change.move("/app/left/a", "/app/pool")
    assert await ref(system, "/app/left/a").ask(Add(1)) == 1  # It is found at the address that it had.
    async with system.transaction(timeout=IN_TIME) as change:
        change.add("/app/left", counter("a", 100))
    left = ref(system, "/app/left")._cell
    left.kill()
    seen: set[int | None] = set()
    while (found := system._node.find("/app/left/a")) is None or found.state != "running" or not seen - {None}:
        seen.add(None if found is None else found.parent is not None and id(found.parent))
        await asyncio.sleep(0)
    assert seen <= {None, id(left)}
    assert await ref(system, "/app/left/a").ask(Add(1)) == 101


async def test_a_chain_of_moves_in_one_transaction_renames_nobody_twice(system: hf.ActorSystem) -> None:
    users = [
        hf.child("to_b", hf.start(Client), bindings={"peer": "/app/left/b"}),
        hf.child("to_d", hf.start(Client), bindings={"peer": "/app/right/d"}),
    ]
    await system.start(hf.supervisor("users", children=users))
    async with system.transaction(timeout=IN_TIME) as change:
        change.move("/app/left/b", "/app/pool")
        change.add("/app", hf.supervisor("spare"))
        change.move("/app/right/d", "/app/spare")
        change.move("/app/pool/b", "/app/right")
        change.move("/app/spare/d", "/app/left")
    await crashed(system, "/app/users")
    assert await ref(system, "/app/users/to_b").ask(Where()) == "/app/right/b"
    assert await ref(system, "/app/users/to_d").ask(Where()) == "/app/left/d"


@pytest.mark.parametrize("is_given_up", [False, True])
async def test_a_request_that_waited_in_the_queue_of_a_restarted_supervisor_leaves_nobody_behind(
    system: hf.ActorSystem, is_given_up: bool
) -> None:
    """The supervisor ends between the request and its answer: the newcomer that its next life starts is known."""
    path = "/app/left/g"

    async def restarted(running: hf.ActorSystem) -> None:
        ref(running, "/app/left").kill()  # The request comes before its next life does.

    with pytest.raises(hf.TransactionFailed) if is_given_up else contextlib.nullcontext() as failed:
        async with system.transaction(timeout=IN_TIME) as change:
            change.step(Slot(restarted, fails=False))
            change.add("/app/left", counter("g"))
            if is_given_up:
                change.step(Stumble())
    if is_given_up:
        assert isinstance(failed, pytest.ExceptionInfo)
        assert failed.value.kept == ()
        assert system._node.find(path) is None
        assert [info.id for info in await ref(system, "/app/left").ask(hf.WhichChildren())] == ["a", "b", "c"]
    else:
        assert await ref(system, path).ask(Add(1)) == 1


@pytest.mark.parametrize("what", ["reorder", "move", "add"])
async def test_a_tree_that_could_not_be_started_again_is_refused(system: hf.ActorSystem, what: str) -> None:
    """Its spec would bind somebody to one who is started later: the next restart of their supervisor would fail."""
    users = [counter("first"), hf.child("user", hf.start(Client), bindings={"peer": "/app/top/first"})]
    await system.start(hf.supervisor("top", children=[*users, hf.supervisor("sub", children=[counter("last")])]))
    with pytest.raises(hf.TransactionRefused, match="a restart of a supervisor of both would fail"):
        async with system.transaction() as change:
            match what:
                case "reorder":
                    change.reorder("/app/top", ["user", "first"])
                case "move":
                    change.move("/app/top/first", "/app/top/sub")
                case _:
                    spec = hf.child("more", hf.start(Client), bindings={"peer": "/app/top/sub/last"})
                    change.add("/app/top", spec)
                    change.reorder("/app/top", ["first", "user", "more"])
    async with system.transaction(timeout=IN_TIME) as change:
        change.reorder("/app/top", ["sub", "first", "user"])
    await crashed(system, "/app/top")
    assert await ref(system, "/app/top/user").ask(Where()) == "/app/top/first"


OWN: list[Callable[[hf.system.Change], object]] = [
    lambda change: change.add("/app/recovery", counter("x")),
    lambda change: change.move("/app/left/a", "/app/recovery"),
    lambda change: change.remove("/app/recovery"),
    lambda change: change.replace_code("/app/recovery/controller", Double),
]


@pytest.mark.parametrize("step", OWN)
async def test_what_belongs_to_the_system_itself_is_not_changed(
    system: hf.ActorSystem, step: Callable[[hf.system.Change], object]
) -> None:
    await system.start(counter("recorded", recovery=hf.hybrid(interval=60.0)))
    with pytest.raises(hf.TransactionRefused, match="a part of the system itself"):
        async with system.transaction() as change:
            step(change)


# -- stopping ---------------------------------------------------------------------------------------------------------


class Work(hf.Message[int]): ...


class Worker(hf.Actor):
    """Busy until a test lets it go on."""

    def __init__(self) -> None:
        self.began, self.may_end = asyncio.Event(), asyncio.Event()

    @hf.on(Work)
    async def work(self, message: Work) -> int:
        self.began.set()
        await self.may_end.wait()
        return 1


@pytest.mark.parametrize("is_cancelled", [False, True])
async def test_a_busy_actor_is_stopped_however_long_it_takes(system: hf.ActorSystem, is_cancelled: bool) -> None:
    """There is no time at which it is told as running and stops later."""
    busy = await ref(system, "/app/left").ask(hf.StartChild(hf.child("busy", hf.start(Worker))))
    asked = busy.ask(Work())
    worker: Any = busy._cell.actor
    await worker.began.wait()
    task = asyncio.ensure_future(stopped(system, busy.path))
    if is_cancelled:
        with system.events() as stream:
            async with asyncio.timeout(IN_TIME):
                async for event in stream:
                    if isinstance(event, hf.events.TransactionBegan):
                        break
        task.cancel()
    worker.may_end.set()
    try:
        await task
    except asyncio.CancelledError:
        assert is_cancelled
    assert await asked == 1
    async with system.transaction():  # Behind it.
        pass
    is_there = busy.path in system.tree()
    spec = ref(system, "/app/left")._cell.actor._children["busy"].spec  # type: ignore[union-attr]
    assert is_there == spec.autostart


async def stopped(system: hf.ActorSystem, path: str) -> None:
    async with system.transaction(timeout=0.2) as change:
        change.stop(path)


async def test_who_is_stopped_stays_so_until_it_is_started(system: hf.ActorSystem) -> None:
    async with system.transaction() as change:
        change.stop("/app/left/b")
        change.strategy("/app/left", "one_for_all")
    await crashed(system, "/app/left")
    assert "/app/left/b" not in system.tree()
    a = ref(system, "/app/left/a")
    before = await a.ask(Life())
    a.tell(Boom())
    assert await a.ask(Life()) == before + 1
    assert "/app/left/b" not in system.tree()
    async with system.transaction(dry_run=True) as change:
        change.start("/app/left", "b")
    assert change.difference == (
        "- /app/left/b: Counter, permanent, task, stopped",
        "+ /app/left/b: Counter, permanent, task",
    )
    async with system.transaction() as change:
        b = change.start("/app/left", "b")
        change.register("again", b)
    assert await system.whereis("again").ask(Add(3)) == 3
    await crashed(system, "/app/left")
    assert "/app/left/b" in system.tree()


# -- names and bindings -----------------------------------------------------------------------------------------------


async def test_a_name_that_somebody_else_took_meanwhile_is_left_to_it(system: hf.ActorSystem) -> None:
    a, c = ref(system, "/app/left/a"), ref(system, "/app/left/c")

    async def meanwhile(running: hf.ActorSystem) -> None:
        running.register("till", c)

    with pytest.raises(hf.TransactionFailed, match="till"):
        async with system.transaction(timeout=IN_TIME) as change:
            change.register("till", a)
            change.step(Slot(meanwhile, fails=False))
    assert system.whereis("till") == c


async def test_names_are_in_force_as_the_last_step_says(system: hf.ActorSystem) -> None:
    a, b, d = (ref(system, path) for path in ("/app/left/a", "/app/left/b", "/app/right/d"))
    async with system.transaction(timeout=IN_TIME) as change:  # Two change names, and a third one had one in between.
        change.unregister("first")
        change.register("first", d)
        change.unregister("first")
        change.unregister("second")
        change.register("first", b)
        change.register("second", a)
        change.register("third", d)
        change.unregister("third")
    assert {name: cell.path for name, cell in system._node.names.items()} == {"first": b.path, "second": a.path}
    async with system.transaction(timeout=IN_TIME) as change:
        change.unbind("/app/right/client", "peer")
        change.stop(a)
        change.register("second", d)
    assert {name: cell.path for name, cell in system._node.names.items()} == {"first": b.path, "second": d.path}
    assert [*d._cell.extra().belongings.names] == ["second"]


async def test_a_start_that_waited_in_the_queue_of_a_restarted_supervisor_is_taken_back(
    system: hf.ActorSystem,
) -> None:
    await stopped_for_good(system)
    before = shape(system)

    async def restarted(running: hf.ActorSystem) -> None:
        ref(running, "/app/right").kill()

    with pytest.raises(hf.TransactionFailed, match="there was a stone") as failed:
        async with system.transaction(timeout=IN_TIME) as change:
            change.step(Slot(restarted, fails=False))
            change.start("/app/right", "e")
            change.step(Stumble())
    assert failed.value.kept == ()
    assert shape(system) == before
    async with system.transaction(timeout=IN_TIME) as change:
        change.step(Slot(restarted, fails=False))
        change.start("/app/right", "e")
    assert await ref(system, "/app/right/e").ask(Add(1)) == 1


async def test_who_was_stopped_by_a_message_and_came_back_with_its_supervisor_is_not_stopped_again(
    system: hf.ActorSystem,
) -> None:
    with pytest.raises(hf.TransactionFailed, match="there was a stone") as failed:
        async with system.transaction(timeout=IN_TIME) as change:
            change.start("/app/right", "e")
            change.step(Stumble(lambda running: crashed(running, "/app/right")))
            change.step(Stumble())
    assert failed.value.kept == ()
    assert await ref(system, "/app/right/e").ask(Add(1)) == 1


async def test_a_binding_in_a_process_is_changed_by_the_commit_alone(
    system: hf.ActorSystem, one: hf.ActorRef[Any]
) -> None:
    await system._node.settled()
    before = picture(system)
    with pytest.raises(hf.TransactionFailed):
        async with system.transaction(timeout=IN_TIME) as change:
            change.bind("/app/right/client", "peer", one)
            change.unregister("first")
            change.register("first", one)
            change.step(Stumble())
    assert picture(system) == before


async def test_a_binding_of_a_spec_follows_an_actor_and_not_its_old_address(system: hf.ActorSystem) -> None:
    for name in ("user", "deep"):
        users = [hf.child("client", hf.start(Client), bindings={"peer": "/app/left/a"})]
        above = [hf.supervisor("inner", children=users)] if name == "deep" else users
        await system.start(hf.supervisor(name, children=above))
    async with system.transaction() as change:
        change.move("/app/left", "/app/right")
        change.move("/app/right/left/a", "/app/pool")
    async with system.transaction() as change:
        change.add("/app", hf.supervisor("left", children=[counter("a")]))
        change.add("/app/right/left", counter("a"))
    for path in ("/app/user", "/app/deep", "/app/deep/inner"):
        await crashed(system, path)
    for path in ("/app/user/client", "/app/deep/inner/client"):
        assert await ref(system, path).ask(Where()) == "/app/pool/a"


class Killed(hf.system.Operation):
    """A step at whose commit the process of an actor is killed, which the root hears of later."""

    verb = "kill"

    def __init__(self, pid: int) -> None:
        super().__init__(f"process {pid}")
        self._pid = pid

    async def check(self, system: hf.ActorSystem, draft: Any) -> None: ...

    def commit(self, system: hf.ActorSystem) -> None:
        os.kill(self._pid, signal.SIGKILL)


@pytest.mark.parametrize("place", [0, 1, 2])
async def test_a_process_that_dies_at_the_commit_loses_nothing_of_it(system: hf.ActorSystem, place: int) -> None:
    recovery = hf.hybrid(interval=900.0)
    a = await system.start(hf.child("a", hf.start(Counter, 500), recovery=recovery, isolation="process"))
    b = await system.start(hf.child("b", hf.start(Counter, 500), recovery=recovery))
    with system.events() as stream:
        async with system.transaction(timeout=IN_TIME) as change:
            steps: list[Callable[[], object]] = [
                lambda: change.replace_state(a, taken),
                lambda: change.replace_state(b, hundred),
            ]
            steps.insert(place, lambda: change.step(Killed(system.pid_of(a))))
            for step in steps:
                step()
        assert (await a.ask(Add(0)), await b.ask(Add(0))) == (400, 600)
        (told,) = [event for event in stream.take() if isinstance(event, hf.events.TransactionCommitted)]
    assert told.problems == ()


class Late(hf.system.Operation):
    """A step that is never ready, and says when the time is up."""

    verb = "wait for"

    def __init__(self, target: str) -> None:
        super().__init__(target)
        self.is_up = asyncio.Event()
        self.is_released = False

    async def check(self, system: hf.ActorSystem, draft: Any) -> None: ...

    @property
    def waits_for(self) -> str:
        self.is_up.set()
        return ""

    async def prepare(self, system: hf.ActorSystem) -> None:
        await asyncio.Event().wait()

    async def release(self, system: hf.ActorSystem) -> None:
        self.is_released = True


async def test_who_is_cancelled_while_it_is_asked_what_was_waited_for_leaves_nothing_prepared(
    system: hf.ActorSystem,
) -> None:
    a = await system.start(hf.child("a", hf.start(Counter), recovery=hf.hybrid(), isolation="process"))
    step = Late("/app/a")
    pid = system.pid_of(a)

    async def change() -> None:
        async with system.transaction(timeout=0.1) as change:
            change.step(step)

    changed = asyncio.ensure_future(change())
    await asyncio.wait((changed,), timeout=0.01)
    os.kill(pid, signal.SIGSTOP)  # It does not say what it does.
    try:
        await step.is_up.wait()
        changed.cancel()
        with pytest.raises(asyncio.CancelledError):
            await changed
    finally:
        os.kill(pid, signal.SIGCONT)
    assert step.is_released
    assert await a.ask(Add(1), IN_TIME) == 1


# -- the root ends ----------------------------------------------------------------------------------------------------


class Die(hf.system.Operation):
    """A step at which the program is killed, before the commit or in the middle of it."""

    verb = "die"

    def __init__(self, when: str) -> None:
        super().__init__("now")
        self._when = when

    async def check(self, system: hf.ActorSystem, draft: Any) -> None: ...

    async def prepare(self, system: hf.ActorSystem) -> None:
        self._die("prepare")

    def commit(self, system: hf.ActorSystem) -> None:
        self._die("commit")

    async def finish(self, system: hf.ActorSystem) -> None:
        self._die("finish")

    def _die(self, when: str) -> None:
        if when == self._when:
            os.kill(os.getpid(), signal.SIGKILL)


async def accounts(store: str, when: str, isolation: Any) -> tuple[int, int]:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", durability="os", log=False) as system:
        recovery = hf.hybrid(interval=900.0)
        specs = [hf.child(name, hf.start(Counter), recovery=recovery, isolation=isolation) for name in "ab"]
        a, b = [await system.start(spec) for spec in specs]
        if when:
            for account in (a, b):
                await account.ask(Add(1000))
            async with system.transaction(timeout=IN_TIME) as change:
                if when == "finish":  # Before any process has heard that it is in force.
                    change.step(Die(when))
                change.replace_state(a, taken)
                change.step(Die(when))
                change.replace_state(b, hundred)
        return await a.ask(Add(0)), await b.ask(Add(0))


def taken(state: dict[str, Any]) -> dict[str, Any]:
    return plus(-100, state)


PROGRAM = """
import asyncio, sys
from tests.system.test_transaction_commit import accounts


if __name__ == "__main__":
    asyncio.run(accounts(*sys.argv[1:]))
"""


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("when", ["prepare", "commit", "finish"])
async def test_a_root_that_is_killed_comes_back_with_all_states_or_none(
    tmp_path: Path, when: str, isolation: str
) -> None:
    store, program = str(tmp_path / "store"), tmp_path / "program.py"
    program.write_text(PROGRAM)
    await kills_itself(program, store, when, isolation)
    both = {"prepare": [(1000, 1000)], "commit": [(1000, 1000)], "finish": [(900, 1100)]}
    assert await accounts(store, "", isolation) in both[when]


def test_the_difference_of_large_trees_is_told_and_takes_no_recursion() -> None:
    """Lines that are alike, each changed: what was compared letter by letter failed from some hundreds on."""
    before = [f"/app/near/team/more-{number}: Traveller, permanent, task" for number in range(3000)]
    after = [line.replace("/near/", "/far/") for line in before]
    assert difference(before, after) == [*(f"- {line}" for line in before), *(f"+ {line}" for line in after)]
