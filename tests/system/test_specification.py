"""What transactions have made of the tree is there when the root is started again, whole or not at all."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import signal
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tr import TR
from holdfast.system.specification import SpecificationNotKept, SpecificationSuperseded
from tests.launched import kills_itself
from tests.system.test_transaction_commit import Die, plus
from tests.system.trees import Add, Client, Counter, Double, Stumble, Where, counter, ref

pytestmark = pytest.mark.usefixtures("warm_programs")

IN_TIME = 20.0
RECORDED = hf.hybrid(interval=900.0)


def left(**options: Any) -> hf.ChildSpec:
    children = [counter("a"), counter("b"), counter("c"), counter("r", recovery=RECORDED)]
    return hf.supervisor("left", intensity=9, children=children, **options)


def right() -> hf.ChildSpec:
    client = hf.child("client", hf.start(Client), bindings={"peer": "/app/left/a"})
    return hf.supervisor("right", children=[counter("d"), client, counter("s", 500, recovery=RECORDED)])


class Odd(Counter):
    def __init__(self, odd: Any) -> None:
        super().__init__()


@asynccontextmanager
async def program(store: Path, *, fresh: bool = False, first: Any = None) -> AsyncGenerator[hf.ActorSystem]:
    """The program whose root ends and is started again."""
    async with hf.ActorSystem("app", store=f"sqlite:{store}", durability="os", log=False) as system:
        await system.start(first or left(), fresh=fresh)
        await system.start(right(), fresh=fresh)
        yield system


def shape(system: hf.ActorSystem) -> dict[str, Any]:
    """The specification, as it is lived."""
    found: dict[str, Any] = {}
    root = system._node.root
    assert root is not None
    waiting = [root]
    while waiting:
        cell = waiting.pop(0)
        actor: Any = cell.actor
        if isinstance(actor, hf.Supervisor):
            children = [(name, one.state, one.spec.start.kind) for name, one in actor._children.items()]
            below = [name for name in cell.children or () if name != "recovery"]  # It comes with the first home.
            found[cell.path] = (actor._flags, children, below)
            waiting += (cell.children or {}).values()
        else:
            bindings = {} if cell.more is None else {port: to.path for port, to in cell.more.bindings.items()}
            found[cell.path] = (type(actor), type(cell.host.place), bindings)
    return found


def much(change: hf.system.Change) -> None:
    change.add("/app/left", hf.supervisor("sub", children=[counter("x")]))
    change.move("/app/left/a", "/app/left/sub")
    change.move("/app/left/b", "/app/right")
    change.remove("/app/left/c")
    change.add("/app/left", hf.child("user", hf.start(Client), bindings={"peer": "/app/left/sub/x"}))
    change.reorder("/app/right", ["b", "s"])
    change.strategy("/app/right", "rest_for_one")
    change.intensity("/app/left", 77, 7.0)
    change.replace_code("/app/right/s", Double)
    change.replace_state("/app/right/s", lambda state: plus(1000, state))
    change.stop("/app/right/d")
    change.add("/app", hf.supervisor("top", children=[counter("y", recovery=RECORDED)]))
    change.reorder("/app", ["top", "right"])
    change.intensity("/app", 88, 8.0)


def move(change: hf.system.Change) -> None:
    change.move("/app/left/a", "/app/right")
    change.reorder("/app/right", ["a"])  # It has to be there before the client that is bound to it.


CHANGES: dict[str, Callable[[hf.system.Change], object]] = {
    "add": lambda change: change.add("/app/left", counter("x")),
    "remove": lambda change: change.remove("/app/left/b"),
    "move": lambda change: move(change),
    "reorder": lambda change: change.reorder("/app/left", ["c", "r"]),
    "flags": lambda change: change.intensity("/app/left", 77, 7.0),
    "stop": lambda change: change.stop("/app/left/b"),
    "code": lambda change: change.replace_code("/app/left/r", Double),
    "process": lambda change: change.isolation("/app/left/r", "process"),
    "at the top": lambda change: change.add("/app", counter("x")),
    "bind": lambda change: change.bind("/app/right/client", "peer", "/app/right/d"),
    "bind to a later one": lambda change: change.bind("/app/right/client", "peer", "/app/right/s"),
    "unbind": lambda change: change.unbind("/app/right/client", "peer"),
    "flags of the root": lambda change: change.intensity("/app", 77, 7.0),
    "strategy of the root": lambda change: change.strategy("/app", "rest_for_one"),
    "order at the top": lambda change: change.reorder("/app", ["right", "left"]),
    "to the top": lambda change: change.move("/app/left/a", "/app"),
    "from the top": lambda change: change.move("/app/right", "/app/left"),
    "much": much,
}


@pytest.mark.parametrize("name", CHANGES)
async def test_the_next_root_has_what_is_in_force(tmp_path: Path, name: str) -> None:
    async with program(tmp_path / "store") as system:
        async with system.transaction(timeout=IN_TIME) as change:
            CHANGES[name](change)
        now = shape(system)
    for _ in range(2):
        async with program(tmp_path / "store") as system:
            assert shape(system) == now
    async with program(tmp_path / "other") as system:
        assert shape(system) != now


@pytest.mark.parametrize("is_kept", [False, True])
async def test_a_program_that_starts_children_without_end_does_not_grow(tmp_path: Path, is_kept: bool) -> None:
    store: dict[str, Any] = {"store": f"sqlite:{tmp_path}/app.db"} if is_kept else {}
    async with hf.ActorSystem("app", log=False, **store) as system:
        kept = await system.start(counter("kept"))
        async with system.transaction() as change:
            change.respecify(kept, shutdown=7.0)
        for number in range(500):
            await system.terminate(await system.start(counter(f"c{number}", restart="temporary")))
        known = system._specifications
        assert len(known._declared) <= 250
        assert len(known._seen) <= 250
        assert ("/app/kept" in known._declared) == is_kept
    if is_kept:
        async with hf.ActorSystem("app", log=False, **store) as system:
            await system.start(counter("kept"))
            assert system._specifications._there()["/app/kept"].shutdown == 7.0


async def test_a_transaction_on_top_of_another_one_is_kept_too(tmp_path: Path) -> None:
    async with program(tmp_path / "store") as system:
        before = shape(system)
        async with system.transaction(timeout=IN_TIME) as change:
            much(change)
    async with program(tmp_path / "store") as system:
        assert await ref(system, "/app/right/s").ask(Add(1)) == 1502
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove("/app/top")
            change.move("/app/left/sub/a", "/app")
        now = shape(system)
    async with program(tmp_path / "store") as system:
        assert shape(system) == now
        assert await ref(system, "/app/right/client").ask(Where()) == "/app/a"
    async with program(tmp_path / "store", fresh=True) as system:
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove("/app/a")
            change.intensity("/app", 3, 5.0)  # No child that begins afresh takes back what the root was given.
            change.reorder("/app", ["left", "right"])
        assert shape(system) == before
    async with program(tmp_path / "store") as system:
        assert shape(system) == before


async def test_what_was_stopped_stays_stopped_wherever_it_is(tmp_path: Path) -> None:
    """A child of the root too, of the program or of a transaction; started again it has its state."""
    paths = ["/app/top", "/app/added", "/app/left/b"]

    @asynccontextmanager
    async def begun() -> AsyncGenerator[tuple[hf.ActorSystem, hf.ActorRef[Any]]]:
        async with program(tmp_path / "store") as system:
            yield system, await system.start(counter("top", recovery=RECORDED))

    def states(system: hf.ActorSystem) -> list[str]:
        children: dict[str, str] = {}
        for path, one in shape(system).items():
            if isinstance(one[1], list):
                children |= {f"{path}/{name}": state for name, state, _ in one[1]}
        return [children[path] for path in paths]

    async with begun() as (system, top):
        assert await top.ask(Add(5)) == 5
        async with system.transaction(timeout=IN_TIME) as change:
            change.add("/app", counter("added", recovery=RECORDED))
        async with system.transaction(timeout=IN_TIME) as change:
            for path in paths:
                change.stop(path)
        assert states(system) == ["stopped"] * 3
    for _ in range(2):
        async with begun() as (system, top):
            assert states(system) == ["stopped"] * 3
            with pytest.raises(hf.ActorStopped):
                await top.ask(Add(1))
    async with begun() as (system, top):
        async with system.transaction(timeout=IN_TIME) as change:
            change.start("/app", "top")
            change.start("/app", "added")
            change.start("/app/left", "b")
        assert states(system) == ["running"] * 3
        assert await top.ask(Add(1)) == 6
    async with begun() as (system, top):
        assert states(system) == ["running"] * 3
        assert await top.ask(Add(1)) == 7


async def test_what_is_taken_back_leaves_no_trace(tmp_path: Path) -> None:
    async with program(tmp_path / "store") as system:
        before = shape(system)
        async with system.transaction(timeout=IN_TIME) as change:
            change.add("/app/left", counter("x"))
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove("/app/left/x")
        with pytest.raises(hf.TransactionFailed):  # noqa: PT012
            async with system.transaction(timeout=IN_TIME) as change:
                much(change)
                change.step(Stumble())
        assert system._specifications._kept == {}
    async with program(tmp_path / "store") as system:
        assert shape(system) == before


async def test_a_program_that_says_something_else_is_newer(tmp_path: Path) -> None:
    async with program(tmp_path / "store") as system, system.transaction(timeout=IN_TIME) as change:
        change.add("/app/left", counter("x"))
        change.strategy("/app/right", "one_for_all")
        change.add("/app", counter("top"))
    async with hf.ActorSystem("app", store=f"sqlite:{tmp_path / 'store'}", log=False) as system:
        with system.events() as stream:
            await system.start(left(strategy="rest_for_one"))
            assert [event.address for event in stream.take() if isinstance(event, SpecificationSuperseded)] == [
                "/app/left"
            ]
            await system.start(right())
            top = await system.start(counter("top", 100))  # It was there already, as the transaction said.
            assert await top.ask(Add(1)) == 101
        assert system._node.find("/app/left/x") is None
        actor: Any = ref(system, "/app/right")._cell.actor
        assert actor._flags.strategy == "one_for_all"
    async with program(tmp_path / "store", first=left(strategy="rest_for_one")) as system:
        assert system._node.find("/app/left/x") is None


@pytest.mark.parametrize("is_recorded", [False, True])
async def test_who_was_moved_away_from_the_root_lives_where_it_was_moved(tmp_path: Path, is_recorded: bool) -> None:
    """What the program starts as before is that one, with its state, also when it was moved on, and back again."""
    recovery = RECORDED if is_recorded else None
    spec, store = counter("one", recovery=recovery), tmp_path / "store"
    sub = hf.supervisor("sub")
    count = 0

    @asynccontextmanager
    async def begun(where: str, first: Any = spec) -> AsyncGenerator[hf.ActorSystem]:
        nonlocal count
        async with program(store) as system:
            await system.start(sub)
            one = await system.start(first)
            assert one.path == where
            count = count + 1 if is_recorded else 1
            assert await one.ask(Add(1)) == count
            assert await ref(system, where).ask(Add(0)) == count
            there = system._node.find("/app/one")  # It leads to where a recorded actor has gone.
            assert there is None or there.path == where
            yield system

    async with begun("/app/one") as system, system.transaction(timeout=IN_TIME) as change:
        change.move("/app/one", "/app/sub")
    async with begun("/app/sub/one") as system, system.transaction(timeout=IN_TIME) as change:
        change.move("/app/sub", "/app/right")
    async with begun("/app/right/sub/one") as system:
        async with system.transaction(timeout=IN_TIME) as change:
            change.move("/app/right/sub/one", "/app/left")
        async with system.transaction(timeout=IN_TIME) as change:
            change.move("/app/left/one", "/app")
        assert "/app/one" not in system._specifications._kept
        async with system.transaction(timeout=IN_TIME) as change:
            change.move("/app/one", "/app/left")
            change.move("/app/right/sub", "/app")
    async with begun("/app/left/one"):
        pass
    if is_recorded:
        return
    async with begun("/app/one", first=counter("one", recovery=recovery, shutdown=3.0)) as system:  # It is newer.
        assert system._node.find("/app/left/one") is not None


@pytest.mark.parametrize("below", ["process", "journaled", "dynamic", "unstorable"])
async def test_who_was_moved_to_where_the_next_root_starts_nobody_is_where_the_program_says(
    tmp_path: Path, below: str
) -> None:
    odd: Any = lambda: 5  # noqa: E731
    spec = {
        "process": hf.supervisor("to", isolation="process"),
        "journaled": hf.dynamic("to", journal=True),
        "dynamic": hf.dynamic("to"),
        "unstorable": hf.supervisor("to", children=[hf.child("y", hf.start(Odd, odd))]),
    }[below]
    one = counter("one", recovery=RECORDED)
    comes_back = below in ("process", "journaled")
    async with program(tmp_path / "store") as system:
        await system.start(spec)
        await (await system.start(one)).ask(Add(2))
        with system.events() as stream:
            async with system.transaction(timeout=IN_TIME) as change:
                change.move("/app/one", "/app/to")
            told = {event.address for event in stream.take() if isinstance(event, SpecificationNotKept)}
        assert ("/app/one" in told) is not comes_back
    async with program(tmp_path / "store") as system:
        await system.start(spec)
        found = await system.start(one)
        assert found.path == ("/app/to/one" if comes_back else "/app/one")
        assert await found.ask(Add(1), IN_TIME) == (3 if comes_back else 1)


async def test_who_was_removed_by_a_transaction_stays_so_until_somebody_says_otherwise(tmp_path: Path) -> None:
    store, one = tmp_path / "store", counter("one", recovery=RECORDED)
    async with program(store) as system:
        await (await system.start(one)).ask(Add(3))
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove("/app/one")
    async with program(store) as system:
        gone = await system.start(one)
        with pytest.raises(hf.ActorStopped):
            await gone.ask(Add(1))
        async with system.transaction(timeout=IN_TIME) as change:  # It is nothing to this one.
            change.intensity("/app/left", 77, 7.0)
    async with program(store) as system:
        gone = await system.start(one)
        with pytest.raises(hf.ActorStopped):
            await gone.ask(Add(1))
        assert await (await system.start(one)).ask(Add(1)) == 4  # In one life of the root the program is at its word.
    async with program(store) as system:
        assert await (await system.start(one)).ask(Add(1)) == 5


@pytest.mark.parametrize("is_first", [False, True])
async def test_who_was_moved_below_what_the_program_has_changed_is_where_the_program_says(
    tmp_path: Path, is_first: bool
) -> None:
    store, one = tmp_path / "store", counter("one")
    async with program(store) as system:
        await system.start(one)
        async with system.transaction(timeout=IN_TIME) as change:
            change.move("/app/one", "/app/left")
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        with system.events() as stream:
            if is_first:
                assert (await system.start(one)).path == "/app/left/one"
            await system.start(left(strategy="rest_for_one"))
            if not is_first:
                assert (await system.start(one)).path == "/app/one"
            superseded = [event.address for event in stream.take() if isinstance(event, SpecificationSuperseded)]
        assert sorted(superseded) == ["/app/left", "/app/one"]
        assert await ref(system, "/app/one").ask(Add(1)) == 1
        assert system._node.find("/app/left/one") is None
    async with program(store, first=left(strategy="rest_for_one")) as system:
        assert (await system.start(one)).path == "/app/one"


@pytest.mark.parametrize("what", ["move", "add", "rise"])
async def test_a_tree_that_the_next_root_could_not_start_is_refused(tmp_path: Path, what: str) -> None:
    """`left` is started first: nobody in it may be bound by its spec to somebody in `right`, or above that."""
    async with program(tmp_path / "store") as system:
        before = shape(system)
        with pytest.raises(hf.TransactionRefused, match="the next root would start it before"):  # noqa: PT012
            async with system.transaction(timeout=IN_TIME) as change:
                user = hf.child("user", hf.start(Client), bindings={"peer": "/app/right/d"})
                match what:
                    case "move":
                        change.move("/app/left/a", "/app/right")
                        change.reorder("/app/right", ["a"])
                        change.move("/app/right/client", "/app/left")
                    case "add":
                        change.add("/app/left", user)
                    case _:
                        change.add("/app", user)  # It waits for `right` ...
                        other = hf.child("other", hf.start(Client), bindings={"peer": "/app/user"})
                        change.add("/app/left", other)  # ... and `left` would wait for it.
        assert shape(system) == before
        async with system.transaction(timeout=IN_TIME) as change:
            change.add("/app/right", hf.child("late", hf.start(Client), bindings={"peer": "/app/left/b"}))
            change.add("/app", hf.child("one", hf.start(Client), bindings={"peer": "/app/right/d"}))
            change.add("/app", hf.child("two", hf.start(Client), bindings={"peer": "/app/one"}))
        now = shape(system)
    async with program(tmp_path / "store") as system:
        assert shape(system) == now


async def test_a_class_that_is_gone_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with program(tmp_path / "store") as system, system.transaction(timeout=IN_TIME) as change:
        change.add("/app", counter("top"))
        change.add("/app/left", hf.child("x", hf.start(Client)))
    monkeypatch.delattr("tests.system.trees.Client")
    told = r"cannot be had any more: .*Client.* nothing is lost; .* all recorded states stay"
    with pytest.raises(hf.SpecError, match=told):
        async with program(tmp_path / "store"):
            pass
    monkeypatch.undo()
    monkeypatch.delattr("tests.system.trees.Counter")
    async with hf.ActorSystem("app", store=f"sqlite:{tmp_path / 'store'}", log=False) as system:
        assert system._node.find("/app/top") is None
    monkeypatch.undo()
    async with program(tmp_path / "store") as system:
        assert await ref(system, "/app/top").ask(Add(1)) == 1
        assert system._node.find("/app/left/x") is not None


async def test_a_start_that_fails_forgets_nothing(tmp_path: Path) -> None:
    async with program(tmp_path / "store") as system, system.transaction(timeout=IN_TIME) as change:
        change.add("/app/right", counter("x"))
    async with hf.ActorSystem("app", store=f"sqlite:{tmp_path / 'store'}", log=False) as system:
        with pytest.raises(hf.StartFailed, match="/app/left/a"):
            await system.start(right())  # Its client is bound to somebody who is not there yet.
        await system.start(left())
        await system.start(right())
        assert await ref(system, "/app/right/x").ask(Add(1)) == 1


async def test_in_one_life_of_the_root_the_program_is_taken_at_its_word(tmp_path: Path) -> None:
    async with program(tmp_path / "store") as system:
        async with system.transaction(timeout=IN_TIME) as change:
            change.add("/app/left", counter("x"))
        await system.stop(ref(system, "/app/left"))
        await system.start(left())
        assert system._node.find("/app/left/x") is None


async def test_what_cannot_be_stored_is_told_and_the_next_root_begins_as_the_program_says(tmp_path: Path) -> None:
    async with program(tmp_path / "store") as system:
        async with system.transaction(timeout=IN_TIME) as change:
            change.add("/app/left", counter("x"))
        with system.events() as stream:
            async with system.transaction(timeout=IN_TIME) as change:
                odd: Any = lambda: 5  # noqa: E731
                change.add("/app/left", hf.child("y", hf.start(Counter, odd)))
            (told,) = [event for event in stream.take() if isinstance(event, SpecificationNotKept)]
        assert told.address == "/app/left"
        assert told.why == (
            "child 'y'.fields['start'].args[0]: a value of type function cannot be stored; "
            "give the actor what it is made from"
        )
    async with program(tmp_path / "store") as system:
        assert system._node.find("/app/left/x") is None
        assert system._node.find("/app/left/y") is None


async def test_who_is_bound_to_the_program_comes_back_behind_it(tmp_path: Path) -> None:
    user = hf.child("user", hf.start(Client), bindings={"peer": "/app/right/d"})
    async with program(tmp_path / "store") as system, system.transaction(timeout=IN_TIME) as change:
        change.add("/app", user)
    async with program(tmp_path / "store") as system:
        assert await ref(system, "/app/user").ask(Where()) == "/app/right/d"


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_mechanisms_and_specifications_are_kept_side_by_side(tmp_path: Path) -> None:
    async with program(tmp_path / "store") as system:
        async with system.transaction(timeout=60) as change:
            change.protect("/app/left/r", PBR())
            change.add("/app/left", counter("x", recovery=RECORDED, mechanism=TR()))
        async with system.transaction(timeout=60) as change:
            change.reorder("/app/left", ["x", "r"])
            change.protect("/app/left/x", None)
        for event in await change.settled():
            assert event.is_kept
        assert await ref(system, "/app/left/r").ask(Add(5)) == 5
        notes = system._mechanism_notes.declared()
        assert notes["/app/left/r"] is None
    for _ in range(2):
        async with program(tmp_path / "store") as system:
            specs = {one.spec.id: one.spec for one in ref(system, "/app/left")._cell.actor._children.values()}  # type: ignore[union-attr]
            assert list(specs) == ["x", "r", "a", "b", "c"]
            assert specs["x"].mechanism is None
            assert await ref(system, "/app/left/r").ask(Add(0)) == 5


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_what_cannot_be_noted_stops_neither_the_transaction_nor_the_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with program(tmp_path / "store") as system:
        with monkeypatch.context() as broken, system.events() as events:

            def fail() -> Any:
                raise hf.errors.MechanismRefused("/app/left/r", "there is none of that name")

            broken.setattr(system._mechanism_notes, "declared", fail)
            async with system.transaction(timeout=IN_TIME) as change:
                change.remove("/app/left/c")
                change.replace_state("/app/left/r", taken)
            (event,) = (one for one in events.take() if isinstance(one, hf.events.TransactionCommitted))
        assert len(event.problems) == 1
        assert "there is none of that name" in event.problems[0]
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove("/app/left/b")
        assert await ref(system, "/app/left/r").ask(Add(1)) == -99
    async with program(tmp_path / "store") as system:
        assert sorted(ref(system, "/app/left")._cell.children or {}) == ["a", "r"]
        assert await ref(system, "/app/left/r").ask(Add(0)) == -99


# -- the root is killed -----------------------------------------------------------------------------------------------


async def killed(store: str, when: str) -> None:
    """The root is killed by a step in the middle of a transaction."""
    async with program(Path(store)) as system:
        await ref(system, "/app/right/s").ask(Add(100))
        async with system.transaction(timeout=IN_TIME) as change:
            if when == "finish":
                change.step(Die(when))
            change.replace_state("/app/left/r", taken)
            change.replace_state("/app/right/s", given)
            change.replace_code("/app/right/s", Double)
            change.step(Die(when))
            move(change)
            change.add("/app/left", counter("x"))
            change.remove("/app/left/b")


def taken(state: dict[str, Any]) -> dict[str, Any]:
    return plus(-100, state)


def given(state: dict[str, Any]) -> dict[str, Any]:
    return plus(100, state)


PROGRAM = """
import asyncio, sys
from tests.system.test_specification import killed, on_trial


if __name__ == "__main__":
    asyncio.run({"killed": killed, "on_trial": on_trial}[sys.argv[1]](*sys.argv[2:]))
"""


async def on_trial(store: str) -> None:
    """The root is killed before it is known whether a mechanism stays."""
    async with program(Path(store)) as system:
        async with system.transaction(timeout=60) as change:
            change.protect("/app/left/r", PBR())
            change.add("/app/left", counter("x"))
        os.kill(os.getpid(), signal.SIGKILL)


async def until_killed(tmp_path: Path, *arguments: str) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    await kills_itself(tmp_path / "program.py", *arguments)


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_a_mechanism_that_was_on_trial_is_not_there_and_all_else_is(tmp_path: Path) -> None:
    await until_killed(tmp_path, "on_trial", str(tmp_path / "store"))
    async with program(tmp_path / "store") as system:
        left: Any = ref(system, "/app/left")._cell.actor
        assert list(left._children) == ["a", "b", "c", "r", "x"]
        assert left._children["r"].spec.mechanism is None


@pytest.mark.parametrize("when", ["prepare", "commit", "finish"])
async def test_a_root_that_is_killed_comes_back_as_the_old_specification_or_the_new_one(
    tmp_path: Path, when: str
) -> None:
    await until_killed(tmp_path, "killed", str(tmp_path / "store"), when)
    async with program(tmp_path / "store") as system:
        children = [
            [info.id for info in await ref(system, at).ask(hf.WhichChildren())] for at in ("/app/left", "/app/right")
        ]
        amounts = await ref(system, "/app/left/r").ask(Add(0)), await ref(system, "/app/right/s").ask(Add(0))
        kind = type(ref(system, "/app/right/s")._cell.actor)
    if when == "finish":
        assert children == [["c", "r", "x"], ["a", "d", "client", "s"]]
        assert amounts == (-100, 700)
        assert kind is Double
    else:
        assert children == [["a", "b", "c", "r"], ["d", "client", "s"]]
        assert amounts == (0, 600)
        assert kind is Counter


# -- bindings ---------------------------------------------------------------------------------------------------------

BOUND: dict[str, dict[str, Any]] = {
    "task": {},
    "process": {"isolation": "process"},
    "recorded": {"recovery": RECORDED},
    "protected": {"mechanism": PBR()},
}


def above(path: str, **options: Any) -> hf.ChildSpec:
    """A supervisor that has a client, bound to a counter outside, and one that comes behind it."""
    client = hf.child("client", hf.start(Client), bindings={"peer": path}, **options)
    return hf.supervisor("above", intensity=9, children=[counter("first"), client, counter("last", 300)])


async def restarted(system: hf.ActorSystem, path: str, below: str) -> hf.ActorRef[Client]:
    """The supervisor at an address has been restarted: one of those below it in its next life."""
    before = system._node.find(below)
    system.ref(path, hf.Actor).kill()
    async with asyncio.timeout(IN_TIME):
        while (cell := system._node.find(below)) in (None, before) or cell.state != "running":
            await asyncio.sleep(0.002)
    return hf.ActorRef(cell)


@pytest.mark.parametrize("to", ["/app/other", "/app/above/first", "/app/above/last"])
@pytest.mark.parametrize("kind", list(BOUND))
async def test_a_binding_that_a_transaction_has_made_outlives_the_supervisor(kind: str, to: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=9) as system:
        for name in ("one", "other"):
            await system.start(counter(name, 500))
        await system.start(above("/app/one", **BOUND[kind]))
        async with system.transaction(timeout=IN_TIME) as change:
            change.bind("/app/above/client", "peer", to)
        await restarted(system, "/app/above", "/app/above/client")
        client = await restarted(system, "/app/above", "/app/above/client")
        assert await client.ask(Where(), IN_TIME) == to
        async with asyncio.timeout(IN_TIME):
            while (cell := system._node.find(to)) is None or cell.state != "running":
                await asyncio.sleep(0.002)
        bound = client._cell.extra().bindings["peer"].ref
        assert isinstance(await bound.ask(Add(1), IN_TIME), int)
        await bound.send(Add(1))


async def test_a_binding_that_a_transaction_has_made_outlives_the_process_of_the_supervisor() -> None:
    async with hf.ActorSystem("app", log=False, intensity=9) as system:
        for name in ("one", "other"):
            await system.start(counter(name, 500))
        await system.start(dataclasses.replace(above("/app/one"), isolation="process"))
        for to in ("/app/other", "/app/above/last"):
            async with system.transaction(timeout=IN_TIME) as change:
                change.bind("/app/above/client", "peer", to)
            client = await restarted(system, "/app/above", "/app/above/client")
            assert await client.ask(Where(), IN_TIME) == to


async def test_a_binding_outside_of_a_transaction_lasts_for_the_life_of_the_supervisor() -> None:
    async with hf.ActorSystem("app", log=False, intensity=9) as system:
        one, other = [await system.start(counter(name, 500)) for name in ("one", "other")]
        await system.start(above("/app/one"))
        client = system.ref("/app/above/client", Client)
        system.bind(client, "peer", other)
        client.kill()
        assert await client.ask(Where(), IN_TIME) == "/app/other"
        client = await restarted(system, "/app/above", "/app/above/client")
        assert await client.ask(Where(), IN_TIME) == one.path


async def test_what_a_transaction_has_unbound_stays_so_and_can_be_bound_again() -> None:
    async with hf.ActorSystem("app", log=False, intensity=9) as system:
        await system.start(counter("one", 500))
        await system.start(above("/app/one"))
        async with system.transaction(timeout=IN_TIME) as change:
            change.unbind("/app/above/client", "peer")
        client = await restarted(system, "/app/above", "/app/above/client")
        with pytest.raises(hf.RemoteCrash, match="is not bound"):
            await client.ask(Where(), IN_TIME)
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove("/app/one")  # Nobody is bound to it any more, and no restart would be.
            change.bind("/app/above/client", "peer", "/app/above/first")
        client = await restarted(system, "/app/above", "/app/above/client")
        assert await client.ask(Where(), IN_TIME) == "/app/above/first"


async def test_a_binding_of_a_transaction_that_gives_up_is_in_no_spec() -> None:
    async with hf.ActorSystem("app", log=False, intensity=9) as system:
        for name in ("one", "other"):
            await system.start(counter(name, 500))
        await system.start(above("/app/one"))

        async def given_up() -> None:
            async with system.transaction(timeout=IN_TIME) as change:
                change.bind("/app/above/client", "peer", "/app/other")
                change.step(Stumble())

        with pytest.raises(hf.TransactionFailed):
            await given_up()
        client = await restarted(system, "/app/above", "/app/above/client")
        assert await client.ask(Where(), IN_TIME) == "/app/one"


async def test_a_binding_that_a_transaction_has_made_follows_who_is_moved() -> None:
    async with hf.ActorSystem("app", log=False, intensity=9) as system:
        await system.start(counter("one", 500))
        await system.start(above("/app/one"))
        await system.start(hf.supervisor("there", children=[counter("other", 500)]))
        async with system.transaction(timeout=IN_TIME) as change:
            change.bind("/app/above/client", "peer", "/app/there/other")
        async with system.transaction(timeout=IN_TIME) as change:
            change.move("/app/there/other", "/app")
        client = await restarted(system, "/app/above", "/app/above/client")
        assert await client.ask(Where(), IN_TIME) == "/app/other"


async def test_two_that_transactions_have_bound_to_each_other_come_back() -> None:
    """Neither of them is waited for."""
    async with hf.ActorSystem("app", log=False, intensity=2, period=60.0) as system:
        for name in ("here", "there"):
            await system.start(hf.supervisor(name, children=[hf.child("client", hf.start(Client))]))
        here, there = "/app/here/client", "/app/there/client"
        async with system.transaction(timeout=IN_TIME) as change:
            change.bind(here, "peer", there)
            change.bind(there, "peer", here)
        before = [system._node.find(path) for path in (here, there)]
        for path in ("/app/here", "/app/there"):
            system.ref(path, hf.Actor).kill()
        async with asyncio.timeout(IN_TIME):
            while any((cell := system._node.find(path)) in (None, *before) for path in (here, there)):
                await asyncio.sleep(0.002)
        assert cell is not None
        for path, to in ((here, there), (there, here)):
            assert await system.ref(path, Client).ask(Where(), IN_TIME) == to


async def test_what_is_bound_to_a_later_one_hinders_no_transaction(tmp_path: Path) -> None:
    """Neither the next ones, whose trees are looked at anew, nor the start of the next root."""
    store = f"sqlite:{tmp_path / 'store'}"
    async with hf.ActorSystem("app", store=store, durability="os", log=False) as system:
        async with system.transaction(timeout=IN_TIME) as change:
            change.add("/app", hf.supervisor("above", children=[hf.child("client", hf.start(Client)), counter("last")]))
            change.add("/app", counter("other"))
        async with system.transaction(timeout=IN_TIME) as change:
            change.bind("/app/above/client", "peer", "/app/above/last")
        for first in ("last", "client"):
            async with system.transaction(timeout=IN_TIME) as change:
                change.reorder("/app/above", [first])
        async with system.transaction(timeout=IN_TIME) as change:
            change.bind("/app/above/client", "peer", "/app/other")
        async with system.transaction(timeout=IN_TIME) as change:
            change.add("/app", hf.child("client", hf.start(Client)))
        async with system.transaction(timeout=IN_TIME) as change:
            change.bind("/app/client", "peer", "/app/above/last")
            change.bind("/app/above/client", "peer", "/app/client")
    async with hf.ActorSystem("app", store=store, durability="os", log=False) as system:
        assert await system.ref("/app/client", Client).ask(Where(), IN_TIME) == "/app/above/last"
        assert await system.ref("/app/above/client", Client).ask(Where(), IN_TIME) == "/app/client"


# -- the root itself --------------------------------------------------------------------------------------------------


async def test_the_program_has_the_last_word_on_the_flags_of_the_root(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'store'}"

    async def begun(changed: bool = False, **flags: Any) -> tuple[int, list[str], list[str]]:
        async with hf.ActorSystem("app", store=store, durability="os", log=False, **flags) as system:
            with system.events() as stream:
                for name in ("a", "b", "c"):
                    await system.start(counter(name))
                superseded = [one.address for one in stream.take() if isinstance(one, SpecificationSuperseded)]
            if changed:
                async with system.transaction(timeout=IN_TIME) as change:
                    change.intensity("/app", 77, 7.0)
                    change.reorder("/app", ["c", "a"])
            root: Any = system._node.root
            names = [name for name in root.actor._children if name in "abc"]
            return root.actor._flags.intensity, names, superseded

    assert await begun(changed=True) == (77, ["c", "a", "b"], [])
    assert await begun() == (77, ["c", "a", "b"], [])
    # What it says now is newer; it says nothing of the order.
    assert (await begun(intensity=5))[:2] == (5, ["c", "a", "b"])
    assert (await begun())[:2] == (3, ["c", "a", "b"])


async def test_the_order_of_the_root_is_that_of_the_last_transaction_without_those_that_are_gone(
    tmp_path: Path,
) -> None:
    def order(system: hf.ActorSystem) -> list[str]:
        root: Any = system._node.root
        listed = [name for name in root.actor._children if name not in ("left", "right")]
        assert [name for name in root.children if name in listed] == listed
        return listed

    async with program(tmp_path / "store") as system:
        async with system.transaction(timeout=IN_TIME) as change:
            for name in ("x", "y", "z"):
                change.add("/app", counter(name))
            change.reorder("/app", ["z", "y", "x", "right", "left"])
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove("/app/y")
        assert order(system) == ["z", "x"]
    async with program(tmp_path / "store") as system:
        root: Any = system._node.root
        assert list(root.actor._children)[-4:] == ["z", "x", "right", "left"]
        assert order(system) == ["z", "x"]
