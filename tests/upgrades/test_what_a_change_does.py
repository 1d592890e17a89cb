"""The table of docs/recovery/upgrades.md: what a change of the program does to what is recorded, row by row."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any, NamedTuple

import pytest

import holdfast as hf
from holdfast.checkpoint.store_tools import export_store
from tests.upgrades.generations import LONG, Generations

PROGRAM = """
class Place(msgspec.Struct, array_like=True):
    x: int
    y: int = 0


class Add(hf.Message[int]):
    n: int
    why: str
    where: Place


class Later(hf.Message): ...


class Keep(hf.Message): ...


class A(hf.Actor):
    def __init__(self) -> None:
        self.said: list[Any] = []
        self.total = 0
        self.keeps = False

    @hf.on(Add)
    def add(self, message: Add) -> int:
        if self.keeps:
            self.ctx.stash()
            return 0
        self.said = [*self.said, plain(message)]
        self.total += 1
        return self.total

    @hf.on(Later)
    def later(self, message: Later) -> None:
        self.ctx.tell_after(1.0, Add(n=3, why="timer", where=Place(3)))

    @hf.on(Keep)
    def keep(self, message: Keep) -> None:
        self.keeps = not self.keeps
        if not self.keeps:
            self.ctx.unstash()

    @hf.on(Get, readonly=True)
    def get(self, message: Get) -> list[Any]:
        return self.said
"""
FIELDS = "    n: int\n    why: str\n    where: Place\n"
PLACE = "    x: int\n    y: int = 0\n"
MADE = 'Add(n=3, why="timer", where=Place(3))'


class Row(NamedTuple):
    """A change (texts that take the place of others), and what becomes of a message, or why it is refused."""

    change: dict[str, str]
    becomes: Any = None
    refused: str = ""


ROWS = {
    "a field added in front, with a default": Row(
        {FIELDS: "    tags: list[str] = []\n" + FIELDS, "Add(hf.Message[int])": "Add(hf.Message[int], kw_only=True)"},
        lambda n, why: {"tags": [], "n": n, "why": why, "where": at(n)},
    ),
    "a field added behind, with a default": Row(
        {FIELDS: FIELDS + "    by: str | None = None\n"},
        lambda n, why: {"n": n, "why": why, "where": at(n), "by": None},
    ),
    "a field removed": Row(
        {FIELDS: "    n: int\n    where: Place\n", 'why="timer", ': ""}, lambda n, why: {"n": n, "where": at(n)}
    ),
    "fields in another order": Row(
        {FIELDS: "    where: Place\n    why: str\n    n: int\n"}, lambda n, why: {"where": at(n), "why": why, "n": n}
    ),
    "int becomes float": Row(
        {"    n: int\n": "    n: float\n"}, lambda n, why: {"n": float(n), "why": why, "where": at(n)}
    ),
    "str becomes str or None": Row(
        {"    why: str\n": "    why: str | None\n"}, lambda n, why: {"n": n, "why": why, "where": at(n)}
    ),
    "a field renamed, and said": Row(
        {"class Add(": '@hf.renamed(count="n")\nclass Add(', "    n: int\n": "    count: int\n", "n=3": "count=3"},
        lambda n, why: {"count": n, "why": why, "where": at(n)},
    ),
    "a class renamed, and said": Row(
        {"Add": "Put", "class Put(": '@hf.renamed("Add")\nclass Put('},
        lambda n, why: {"n": n, "why": why, "where": at(n)},
    ),
    "a field renamed in a class inside": Row(
        {PLACE: "    y: int = 0\n    east: int = 0\n", "class Place(": '@hf.renamed(east="x")\nclass Place('},
        lambda n, why: {"n": n, "why": why, "where": {"y": 0, "east": n}},
    ),
    "a class inside coded by names": Row(
        {", array_like=True": "", PLACE: "    y: int = 0\n    x: int = 0\n", "Place(3)": "Place(x=3)"},
        lambda n, why: {"n": n, "why": why, "where": {"y": 0, "x": n}},
    ),
    "a field added without a default": Row(
        {FIELDS: "    by: str\n" + FIELDS, "n=3": "by='', n=3"}, refused="by is new and has no default"
    ),
    "a field renamed, and not said": Row(
        {"    n: int\n": "    count: int\n", "n=3": "count=3"}, refused="count is new and has no default"
    ),
    "a type that does not decode": Row(
        {"    n: int\n": "    n: str\n", "n=3": "n='3'"},
        refused="were (n: int, why: str, where: Place), now they are (n: str, ",
    ),
    "a type inside that does not decode": Row(
        {"    x: int\n": "    x: str\n", "Place(3)": "Place('3')"}, refused="where: its fields were (x: int, "
    ),
}


def at(n: int) -> dict[str, int]:
    return {"x": n, "y": 0}


def changed(text: str, change: dict[str, str]) -> str:
    for old, new in change.items():
        assert old in text, old
        text = text.replace(old, new)
    return text


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("row", ROWS)
@pytest.mark.some(14)
async def test_messages(tmp_path: Path, row: str, isolation: Any) -> None:
    """One was handled, one was put aside, one waits, and one comes by a timer: all of them alike."""
    store, case = Generations(tmp_path), ROWS[row]
    async with store.run(PROGRAM) as (system, actor, old):
        await actor.ask(old.Add(1, "handled", old.Place(1)), timeout=LONG)
        actor.tell(old.Keep())
        actor.tell(old.Add(2, "stashed", old.Place(2)))
        actor.tell(old.Later())
        await actor.ask(old.Get(), timeout=LONG)
        await system.suspend(actor)
        actor.tell(old.Keep())
        actor.tell(old.Add(4, "waiting", old.Place(4)))
        await asyncio.sleep(0)
    if case.refused:
        before = recorded(store.store)
        with pytest.raises(hf.StartFailed) as refused:
            async with store.run(changed(PROGRAM, case.change), isolation=isolation):
                pass
        assert "does not fit the code" in str(refused.value)
        assert case.refused in str(refused.value)
        assert recorded(store.store) == before
        case = Row({}, lambda n, why: {"n": n, "why": why, "where": at(n)})  # The old program goes on.
    told = {1: "handled", 2: "stashed", 4: "waiting", 3: "timer"}
    async with store.run(changed(PROGRAM, case.change), isolation=isolation) as (system, actor, new):
        async with asyncio.timeout(LONG):
            while len(said := await actor.ask(new.Get(), timeout=LONG)) < 4:
                await asyncio.sleep(0.01)
        assert said == [case.becomes(n, why) for n, why in told.items()]
        mapped = store.told(hf.events.RecordsMapped)
        assert bool(mapped) == bool(case.change)
    async with store.run(changed(PROGRAM, case.change), isolation=isolation) as (system, actor, new):
        assert await actor.ask(new.Get(), timeout=LONG) == said


STATE = """
class Set(hf.Message):
    items: list[int]


class Fail(hf.Message[None]): ...


class More(hf.Message[None]): ...


class A(hf.Actor):
    def __init__(self) -> None:
        self.items: list[int] = []
        self.size = 0

    @hf.on(Set)
    def set(self, message: Set) -> None:
        self.items, self.size = message.items, len(message.items)

    @hf.on(Fail)
    def fail(self, message: Fail) -> None:
        for name in set(vars(self)) - {"ctx"}:
            setattr(self, name, 7)
        raise ValueError("it goes back to where it was")

    @hf.on(More)
    def more(self, message: More) -> None:
        [goods] = [value for value in vars(self).values() if isinstance(value, list)]
        goods.append(3)

    @hf.on(Get, readonly=True)
    def get(self, message: Get) -> list[Any]:
        return [{name: value for name, value in vars(self).items() if name != "ctx"}]
"""
INIT = "        self.items: list[int] = []\n        self.size = 0\n"
SIZE = "        self.items, self.size = message.items, len(message.items)\n"
MIGRATED = """@hf.renamed(goods="size")
class A(hf.Actor):
    schema_version = 2

    @classmethod
    def migrate(cls, state, from_version):
        return {"goods": state["items"], "size": from_version}
"""
STATES = {
    "a variable added": Row({INIT: INIT + "        self.price = 9\n"}, {"items": [1, 2], "size": 2, "price": 9}),
    "a variable removed": Row(
        {
            INIT: "        self.items: list[int] = []\n",
            "self.items, self.size = message.items, len(message.items)": "self.items = message.items",
        },
        {"items": [1, 2]},
    ),
    "a variable renamed, and said": Row(
        {"class A(": '@hf.renamed(goods="items")\nclass A(', "self.items": "self.goods"}, {"goods": [1, 2], "size": 2}
    ),
    "the class renamed, and said": Row(
        {"class A(": '@hf.renamed("A")\nclass B(', "class Set": "A = None\n\n\nclass Set"}, {"items": [1, 2], "size": 2}
    ),
    "migrate wins": Row({"class A(hf.Actor):\n": MIGRATED, "self.items": "self.goods"}, {"goods": [1, 2], "size": 1}),
    "a variable renamed, and not said": Row({"self.items": "self.goods"}, refused="say @hf.renamed(goods='items')"),
    "another version without migrate": Row(
        {"class A(hf.Actor):\n": "class A(hf.Actor):\n    schema_version = 2\n"}, refused="has no classmethod migrate"
    ),
    "another class": Row(
        {"class A(": "class B(", "class Set": "A = None\n\n\nclass Set"}, refused="it was recorded by upgraded:A"
    ),
}


WAYS: dict[str, dict[str, Any]] = {
    "task": {},
    "process": {"isolation": "process"},
    "masked": {"mechanism": hf.ftm.TR()},
    "replicated": {"mechanism": hf.ftm.PBR()},
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("row", STATES)
async def test_states(tmp_path: Path, row: str, way: str) -> None:
    store, case, options = Generations(tmp_path), STATES[row], WAYS[way]
    async with store.run(STATE, mechanism=options.get("mechanism")) as (system, actor, old):
        actor.tell(old.Set([1, 2]))
        await actor.ask(old.Get(), timeout=LONG)
        await system.checkpoint(actor, timeout=LONG)
        await actor.ask(old.More(), timeout=LONG)  # It is handled again, on the state as it is now.
    text = changed(STATE, case.change)
    if "A = None" in text:
        text = text.replace("A = None\n", "") + "\n\nA = B\n"
    if case.refused:
        before = recorded(store.store)
        with pytest.raises(hf.StartFailed) as refused:
            async with store.run(text, **options):
                pass
        assert "does not fit the code" in str(refused.value)
        assert case.refused in str(refused.value)
        assert recorded(store.store) == before
        text, case = STATE, Row({}, {"items": [1, 2], "size": 2})
    async with store.run(text, **options) as (_, actor, new):
        grown = {name: [*value, 3] if isinstance(value, list) else value for name, value in case.becomes.items()}
        assert await actor.ask(new.Get(), timeout=LONG) == [grown]
        with pytest.raises(hf.errors.RemoteCrash):
            await actor.ask(new.Fail(), timeout=LONG)
        assert await actor.ask(new.Get(), timeout=LONG) == [grown]
        told = {event.changes for event in store.told(hf.events.RecordsMapped)}  # at each start
        assert told == (
            {"upgraded.A has no size any more: what was saved of it is dropped"} if "removed" in row else set()
        )


def recorded(store: Path) -> list[Any]:
    """All that a closed store has of actors."""
    return [record for record in export_store(store) if record["record"] not in ("store", "note")]
