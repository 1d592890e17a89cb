"""What was recorded is mapped wherever it is read: outcomes, quarantine, cuts, timers, replicas, older stores."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import msgspec
import pytest

import holdfast as hf
from holdfast.checkpoint import schema
from holdfast.checkpoint.snapshot.snapshot_record import begin_with_older
from holdfast.ftm.mechanisms.lfr import LFR
from tests.upgrades.generations import LONG, Generations, program

PROGRAM = """
import os
import signal


class Add(hf.Message[int]):
    n: int
    why: str


class Die(hf.Message):
    n: int
    why: str


class Wait(hf.Message): ...


class Tick(hf.Message):
    n: int
    why: str


class Other(hf.Actor):
    def __init__(self) -> None:
        self.said: list[Any] = []

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.said = [*self.said, plain(message)]
        return len(self.said)

    @hf.on(Get, readonly=True)
    def get(self, message: Get) -> list[Any]:
        return self.said


class A(Other):
    @hf.on(Wait)
    async def wait(self, message: Wait) -> None:
        came = await self.ctx.wait_for(Tick)
        self.said = [*self.said, plain(came)]
        self.ctx.find("/app/other", Other).tell(Add(n=came.n, why="told"))
        await self.ctx.sleep(3600.0)

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        self.said = [*self.said, plain(message)]

    @hf.on(Die)
    def die(self, message: Die) -> None:
        if message.n:
            os.kill(os.getpid(), signal.SIGKILL)
        self.said = [*self.said, plain(message)]
"""
FIELDS = "    n: int\n    why: str\n"
NEWER = PROGRAM.replace(FIELDS, '    why: str\n    by: str = "nobody"\n    n: int = 0\n')
assert NEWER.count("by: str") == 3


def said(n: int, why: str) -> dict[str, Any]:
    """As the newer program has it."""
    return {"why": why, "by": "nobody", "n": n}


@pytest.fixture
def store(tmp_path: Path) -> Generations:
    return Generations(tmp_path)


async def until(actor: Any, module: Any, count: int) -> list[Any]:
    """What the actor has said, when it is so much."""
    async with asyncio.timeout(LONG):
        while len(found := await actor.ask(module.Get(), timeout=LONG)) < count:
            await asyncio.sleep(0.01)
    return found


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_message_that_a_turn_has_waited_for(store: Generations, isolation: Any) -> None:
    """The turn goes on in the newer program; what it has told to another actor that is recorded is not told again."""
    spec = hf.hybrid(interval=1000.0)
    async with store.run(PROGRAM, isolation=isolation) as (system, actor, old):
        await system.start(hf.child("other", hf.start(old.Other), recovery=spec))
        actor.tell(old.Wait())
        actor.tell(old.Tick(5, "came"))
        async with asyncio.timeout(LONG):
            while not any(k > 1 for _, k in system._homes.at("/app/a").ledger.waits.dues):
                await asyncio.sleep(0.01)
        actor.tell(old.Add(6, "behind"))
        await asyncio.sleep(0.05)
    for _ in range(2):
        async with store.run(NEWER, isolation=isolation) as (system, actor, new):
            await system.start(hf.child("other", hf.start(new.Other), recovery=spec))
            home = system._homes.at("/app/a")
            async with asyncio.timeout(LONG):
                while not home.calls.rests.is_busy:
                    await asyncio.sleep(0.01)
            assert [one.name for one in home.open.values()] == ["upgraded:Wait", "upgraded:Add"]
            assert home.life.diverged is None
            assert store.told(hf.events.RecordsMapped)
            assert len(home.ledger.released) == 3, "it waits again where it waited"


async def test_what_is_told_to_somebody_whose_home_is_not_open(store: Generations) -> None:
    """Its journal has the table of the first program, and what the second one tells is written with another one."""
    spec = hf.hybrid(interval=1000.0)
    says = "        self.said = [*self.said, plain(message)]\n        return"
    tells = """        if message.why == "tell":
            self.ctx.find("/app/other", Other).tell(Add(n=message.n, why="kept"))
"""
    third = PROGRAM.replace(FIELDS, "    n: float = 0.5\n    why: str = ''\n    more: int = 1\n")
    async with store.run(PROGRAM) as (system, actor, old):
        other = await system.start(hf.child("other", hf.start(old.Other), recovery=spec))
        await other.ask(old.Add(1, "first"), timeout=LONG)
    async with store.run(NEWER.replace(says, tells + says)) as (_, actor, new):
        await actor.ask(new.Add(n=2, why="tell"), timeout=LONG)
        await actor.ask(new.Get(), timeout=LONG)
    async with store.run(third.replace(says, tells + says)) as (system, _, last):
        other = await system.start(hf.child("other", hf.start(last.Other), recovery=spec))
        assert await until(other, last, 2) == [
            {"n": 1.0, "why": "first", "more": 1},
            {"n": 2.0, "why": "kept", "more": 1},
        ]


async def test_messages_in_quarantine(store: Generations) -> None:
    async with store.run(PROGRAM, isolation="process", max_deliveries=1) as (system, actor, old):
        await actor.ask(old.Add(1, "before"), timeout=LONG)
        actor.tell(old.Die(7, "kills"))
        await until(actor, old, 1)
        assert [one.message for one in system.quarantined()] == [old.Die(7, "kills")]
    gentle = NEWER.replace("if message.n:", "if message.n < 0:")
    stubborn = PROGRAM.replace(FIELDS, "    n: str\n    why: str\n", 2)
    async with store.run(stubborn, isolation="task") as (system, actor, other):
        (one,) = system.quarantined()
        assert not isinstance(one.message, other.Die)
        with pytest.raises(hf.HoldfastError, match=r"now they are \(n: str, why: str\)"):
            system.retry(one)
    async with store.run(gentle, isolation="task") as (system, actor, new):
        (one,) = system.quarantined()
        assert one.message == new.Die(n=7, why="kills", by="nobody")
        system.retry(one)
        assert await until(actor, new, 2) == [{"n": 1, "why": "before"}, said(7, "kills")]


async def test_the_cut_of_a_group(store: Generations) -> None:
    """It is made in the newer program, of records of the older one, and brought back in one that is newer again."""
    async with store.run(PROGRAM, method=hf.replay_only) as (_, actor, old):
        await actor.ask(old.Add(1, "old"), timeout=LONG)
    last = NEWER.replace('    by: str = "nobody"\n', "")
    async with store.run(NEWER) as (system, actor, new):
        await actor.ask(new.Add(n=2, why="new"), timeout=LONG)
        await system.suspend(actor)
        actor.tell(new.Add(n=3, why="waits"))
        await system.checkpoint_group([actor], name="cut")
        await system.resume(actor)
        await actor.ask(new.Add(n=4, why="gone"), timeout=LONG)
    async with store.run(last) as (system, actor, newest):
        await system.restore_group("cut")
        found = await until(actor, newest, 3)
        assert [(one["n"], one["why"]) for one in found] == [(1, "old"), (2, "new"), (3, "waits")]


async def test_replicas_get_what_was_mapped(tmp_path: Path, store: Generations) -> None:
    async with store.run(PROGRAM, method=hf.replay_only) as (system, actor, old):
        await actor.ask(old.Add(1, "handled"), timeout=LONG)
        await system.suspend(actor)
        actor.tell(old.Add(2, "waits"))
        await asyncio.sleep(0)
    async with store.run(NEWER, mechanism=LFR()) as (_, actor, new):
        assert await until(actor, new, 2) == [said(1, "handled"), said(2, "waits")]


async def test_a_store_of_before_with_names_only(store: Generations, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has no types, no defaults and no tags; and nothing of what turns have sent."""

    def as_before(name: str, shape: schema.Shape) -> Any:
        return "shape", name, tuple(tuple(row[:3]) for row in shape if row.place != "=")

    with monkeypatch.context() as patch:
        patch.setattr(schema, "shape_entry", as_before)
        async with store.run(PROGRAM, method=hf.replay_only) as (system, actor, old):
            await actor.ask(old.Add(1, "handled"), timeout=LONG)
            await system.suspend(actor)
            actor.tell(old.Add(2, "waits"))
            await asyncio.sleep(0)
    for _ in range(2):
        async with store.run(NEWER, method=hf.replay_only) as (system, actor, new):
            entries = system._homes.journal.load("/app/a").entries
            assert ("shape", "upgraded:Add", (("", True, ("n", "why")),)) in [entry for _, entry in entries]
            assert await until(actor, new, 2) == [said(1, "handled"), said(2, "waits")]


class One(msgspec.Struct, array_like=True, tag="one"):
    x: int


class Two(msgspec.Struct, array_like=True, tag="two"):
    x: int | None = None


class Both(hf.Message):
    which: list[One | Two]


def test_a_table_is_read_as_it_was_written() -> None:
    table = schema.shape_of(Both)
    assert schema.as_shape(msgspec.msgpack.decode(msgspec.msgpack.encode(table))) == table
    assert [row.place for row in table] == ["", "which[]|One", "which[]|Two"]


PARTS = """
from typing import NamedTuple


@dataclasses.dataclass
class Part:
    n: int


class Pair(NamedTuple):
    x: int


class Kept(msgspec.Struct):
    x: int


class Set(hf.Message): ...


class A(hf.Actor):
    def __init__(self) -> None:
        self.parts: list[Any] = []

    @hf.on(Set)
    def set(self, message: Set) -> None:
        self.parts = [Part(1), Pair(2), Kept(3)]

    @hf.on(Get, readonly=True)
    def get(self, message: Get) -> list[Any]:
        return [repr(part) for part in self.parts]
"""


MADE = """
class Kept(msgspec.Struct):
    x: int
    y: int = 0


class Wait(hf.Message): ...


class Tick(hf.Message): ...


async def make() -> Kept:
    return Kept(1)


class A(hf.Actor):
    def __init__(self) -> None:
        self.parts: list[Any] = []

    @hf.on(Wait)
    async def wait(self, message: Wait) -> None:
        made = await self.ctx.effect(make)
        await self.ctx.wait_for(Tick)
        self.parts = [made]

    @hf.on(Tick)
    def tick(self, message: Tick) -> None: ...

    @hf.on(Get)
    def get(self, message: Get) -> list[Any]:
        return [repr(part) for part in self.parts]
"""


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_what_an_effect_has_returned_and_cannot_be_read_waits_for_the_older_program(
    store: Generations, isolation: Any
) -> None:
    """A turn in hand would be over, had its handler got an error in the place of what was returned."""
    async with store.run(MADE, isolation=isolation) as (system, actor, old):
        actor.tell(old.Wait())
        async with asyncio.timeout(LONG):
            while not any(k > 1 for _, k in system._homes.at("/app/a").ledger.waits.dues):
                await asyncio.sleep(0.01)
    with pytest.raises(hf.StartFailed, match=r"what make has ended with: .*:Kept has no y"):
        async with store.run(MADE.replace("    y: int = 0\n", ""), isolation=isolation):
            pass
    async with store.run(MADE, isolation=isolation) as (_, actor, old):
        actor.tell(old.Tick())
        assert await actor.ask(old.Get(), timeout=LONG) == ["Kept(x=1, y=0)"]


RAISED = """
from typing import Any

import holdfast as hf
import msgspec


class Kept(msgspec.Struct):
    x: int
    y: int = 0


async def make() -> Kept:
    return Kept(1)


class Get(hf.Message[list[Any]]): ...


class Wait(hf.Message): ...


class Tick(hf.Message): ...


class NoSeat(hf.errors.Refusal, text="no seat in row {row}"):
    row: int


class Closed(hf.HoldfastError, text="{what} is closed"):
    what: str


async def seat() -> None:
    raise NoSeat(3)


async def shop() -> None:
    raise Closed("the shop")


class A(hf.Actor):
    def __init__(self) -> None:
        self.parts: list[str] = []

    @hf.on(Wait)
    async def wait(self, message: Wait) -> None:
        said = []
        for one in (seat, shop):
            try:
                await self.ctx.effect(one)
            except hf.HoldfastError as error:
                said.append(repr(error))
        said.append(repr(await self.ctx.effect(make)))
        await self.ctx.wait_for(Tick)
        self.parts = said

    @hf.on(Tick)
    def tick(self, message: Tick) -> None: ...

    @hf.on(Get)
    def get(self, message: Get) -> list[Any]:
        return list(self.parts)
"""


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("NoSeat", "NoPlace"), r"seat has ended with: .*:NoSeat is not loaded"),
        (("    y: int = 0\n", ""), r"make has ended with: .*:Kept has no y"),
        (("row", "place"), r"the refusal upgraded:NoSeat is in its journal: .*place is new"),
        (("Closed", "Shut"), r"shop has ended with: .*\.Closed is not loaded"),
    ],
    ids=["refusal gone", "field of a value", "field of a refusal", "error gone"],
)
async def test_what_effects_have_ended_with_and_cannot_be_read_waits_for_the_older_program(
    store: Generations, change: tuple[str, str], said: str
) -> None:
    """In a process, where no class of the older program is loaded."""
    isolation = "process"
    async with store.run(RAISED, isolation=isolation) as (system, actor, old):
        actor.tell(old.Wait())
        async with asyncio.timeout(LONG):
            while not any(k == 4 for _, k in system._homes.at("/app/a").ledger.waits.dues):
                await asyncio.sleep(0.01)
    with pytest.raises(hf.StartFailed, match=said):
        async with store.run(RAISED.replace(*change), isolation=isolation):
            pass
    async with store.run(RAISED, isolation=isolation) as (_, actor, old):
        actor.tell(old.Tick())
        assert await actor.ask(old.Get(), timeout=LONG) == ["NoSeat(3)", "Closed('the shop')", "Kept(x=1, y=0)"]


async def test_classes_inside_of_a_state(store: Generations) -> None:
    """Fields with defaults are added, and fields are renamed."""
    newer = (
        PARTS.replace("@dataclasses.dataclass\n", '@hf.renamed(count="n")\n@dataclasses.dataclass\n')
        .replace(
            "    n: int\n",
            "    tags: list[str] = dataclasses.field(default_factory=list, kw_only=True)\n    count: int\n",
        )
        .replace("class Pair(NamedTuple):\n    x: int\n", "class Pair(NamedTuple):\n    x: int\n    y: int = 5\n")
        .replace(
            "class Kept(msgspec.Struct):\n    x: int\n", "class Kept(msgspec.Struct):\n    x: int\n    y: int = 6\n"
        )
    )
    async with store.run(PARTS) as (system, actor, old):
        actor.tell(old.Set())
        assert await actor.ask(old.Get(), timeout=LONG) == ["Part(n=1)", "Pair(x=2)", "Kept(x=3)"]
        await system.checkpoint(actor, timeout=LONG)
    async with store.run(newer) as (_, actor, new):
        found = await actor.ask(new.Get(), timeout=LONG)
        assert found == ["Part(tags=[], count=1)", "Pair(x=2, y=5)", "Kept(x=3, y=6)"]


ASIDE = """
class Add(hf.Message):
    n: int
    why: str


class Keep(hf.Message): ...


class A(hf.Actor):
    key_variables = ("said",)
    keeps = True

    def __init__(self) -> None:
        self.said: list[Any] = []

    @hf.on(Add)
    def add(self, message: Add) -> None:
        if self.keeps:
            self.ctx.stash()
        else:
            self.said = [*self.said, plain(message)]

    @hf.on(Keep)
    def keep(self, message: Keep) -> None:
        self.ctx.unstash()

    @hf.on(Get, readonly=True)
    def get(self, message: Get) -> list[Any]:
        return self.said
"""


N_WHY = "    n: int\n    why: str\n"
LIVE = ("keeps = True", "keeps = False")


async def test_what_is_put_aside_over_snapshots_of_several_programs(store: Generations) -> None:
    """Each snapshot says with which table the first of what is left was written."""
    second = ASIDE.replace(N_WHY, "    why: str\n    n: int\n")
    third = ASIDE.replace(N_WHY, "    n: float\n    why: str\n").replace(*LIVE)
    async with store.run(ASIDE.replace(*LIVE)) as (system, actor, old):
        actor.tell(old.Add(0, "contained"))
        await actor.ask(old.Get(), timeout=LONG)
        await system.checkpoint(actor, timeout=LONG)  # Only this has the table from here on.
    async with store.run(ASIDE) as (system, actor, old):
        actor.tell(old.Add(1, "first"))
        await actor.ask(old.Get(), timeout=LONG)
        await system.checkpoint(actor, timeout=LONG)
    for number in (2, 3):
        async with store.run(second) as (system, actor, new):
            actor.tell(new.Add(n=number, why="later"))
            await actor.ask(new.Get(), timeout=LONG)
            await system.checkpoint(actor, timeout=LONG)
            assert len(system._homes.at("/app/a").shapes.fields["upgraded:Add"]) == 2
    async with store.run(third) as (system, actor, new):
        actor.tell(new.Keep())
        found = [(one["n"], one["why"]) for one in await until(actor, new, 4)]
        assert found == [(0, "contained"), (1, "first"), (2, "later"), (3, "later")]
        await system.checkpoint(actor, timeout=LONG)
        assert len(system._homes.at("/app/a").shapes.fields["upgraded:Add"]) == 1, "nothing is left of the older ones"
        await actor.ask(new.Get(), timeout=LONG)
        await system.checkpoint(actor, timeout=LONG)
        assert not [entry for _, entry in system._homes.journal.load("/app/a").entries if "upgraded:Add" in entry]


async def test_the_timers_of_a_snapshot_are_written_anew_by_each_program(store: Generations) -> None:
    """A snapshot of the second program has them as that one has coded them, whatever its journal begins with."""
    timed = ASIDE.replace("self.ctx.unstash()", 'self.ctx.every(3600.0, Add(n=9, why="timer"))')
    second = timed.replace(N_WHY, "    why: str\n    n: int\n")
    third = timed.replace(N_WHY, "    n: float\n    why: str\n")
    async with store.run(timed) as (system, actor, old):
        actor.tell(old.Keep())
        actor.tell(old.Add(1, "aside"))
        await actor.ask(old.Get(), timeout=LONG)
        await system.checkpoint(actor, timeout=LONG)
    for text in (second, third, third):
        async with store.run(text) as (system, actor, new):
            ((name, body, *_),) = system._homes.at("/app/a").timers.saved().values()
            assert name == "upgraded:Add"
            assert system._node.codec.decode(new.Add, body) == new.Add(n=9, why="timer")
            actor.tell(new.Add(n=2, why="aside"))
            await actor.ask(new.Get(), timeout=LONG)
            await system.checkpoint(actor, timeout=LONG)


SENDS = """
class Note(hf.Message):
    n: int
    why: str = "none"
    more: int = 0


class Add(hf.Message[float]):
    n: int


class Sink(hf.Actor):
    @hf.on(Note)
    def note(self, message: Note) -> None: ...


OTHERS = {"sink": Sink}


class A(hf.Actor):
    def __init__(self) -> None:
        self.total = 0

    @hf.on(Add)
    async def add(self, message: Add) -> float:
        self.total += message.n
        self.ctx.find("/app/sink", Sink).tell(Note(n=message.n))
        return self.total

    @hf.on(Get, readonly=True)
    def get(self, message: Get) -> list[Any]:
        return [self.total]
"""
SENT = {
    "in another order": ({'    n: int\n    why: str = "none"\n': '    why: str = "none"\n    n: int = 0\n'}, ""),
    "renamed": (
        {
            "class Note": '@hf.renamed("Note", count="n")\nclass Told',
            "Note": "Told",
            "    n: int\n    why": "    count: int\n    why",
            "(n=message": "(count=message",
        },
        "",
    ),
    "a field gone, which cannot be compared": ({"    more: int = 0\n": "", "n=message.n)": "n=message.n + 1)"}, ""),
    "another type, which cannot be compared": ({"    n: int\n    why": "    n: float\n    why"}, ""),
    "what is added up is a float": (
        {"Add(hf.Message[float]):\n    n: int\n": "Add(hf.Message[float]):\n    n: float\n"},
        "",
    ),
    "another value": ({"n=message.n)": "n=message.n + 1)"}, "output 1 .tell of upgraded:Note"),
    "another value in another order": (
        {
            '    n: int\n    why: str = "none"\n': '    why: str = "none"\n    n: int = 0\n',
            "n=message.n)": "n=message.n + 1)",
        },
        "output 1 .tell of upgraded:Note",
    ),
    "another reply": (
        {"return self.total\n": "return self.total + 0.5\n"},
        "the reply to upgraded:Add is not what it was",
    ),
}


@pytest.mark.parametrize("change", SENT)
async def test_what_turns_have_sent_is_compared_with_the_table_that_it_had(store: Generations, change: str) -> None:
    async with store.run(SENDS, method=hf.replay_only) as (_, actor, old):
        for number in (1, 2):
            await actor.ask(old.Add(number), timeout=LONG)
    text, (changes, diverges) = SENDS, SENT[change]
    for one, other in changes.items():
        assert one in text
        text = text.replace(one, other)
    text = text.replace('@hf.renamed("Told"', '@hf.renamed("Note"')
    if diverges:
        with pytest.raises(hf.StartFailed, match=diverges):
            async with store.run(text, method=hf.replay_only):
                pass
        return
    for _ in range(2):
        async with store.run(text, method=hf.replay_only) as (_, actor, new):
            assert await actor.ask(new.Get(), timeout=LONG) == [3]
            await actor.ask(new.Add(0), timeout=LONG)


async def test_code_that_is_loaded_once_more_has_its_own_table(store: Generations, tmp_path: Path) -> None:
    """A snapshot is taken when it comes in; what follows is written by other classes of the same names."""
    newer = ASIDE.replace(N_WHY, "    why: str\n    n: int\n").replace(*LIVE)
    async with store.run(ASIDE.replace(*LIVE)) as (system, actor, old):
        await actor.ask(old.Get(), timeout=LONG)
        actor.tell(old.Add(1, "old"))
        await actor.ask(old.Get(), timeout=LONG)
        await system.suspend(actor)
        with program(newer, tmp_path / "again") as new:
            await system.replace_code(actor, new.A)
            await system.resume(actor)
            actor.tell(new.Add("new", 2))
            await actor.ask(new.Get(), timeout=LONG)
    async with store.run(newer) as (_, actor, new):
        assert await actor.ask(new.Get(), timeout=LONG) == [{"n": 1, "why": "old"}, {"why": "new", "n": 2}]


async def test_what_is_read_once_more_for_an_older_snapshot_is_mapped_too(tmp_path: Path) -> None:
    """The newest snapshot is damaged in the middle of a run: what follows the one before it was recorded long ago."""
    generations = Generations(tmp_path)
    async with generations.run(PROGRAM, method=hf.replay_only) as (_, actor, old):
        for n in range(3):
            await actor.ask(old.Add(n=n, why="old"), LONG)
    async with generations.run(NEWER, method=hf.replay_only) as (system, actor, new):
        await actor.ask(new.Add(n=3, why="new"), LONG)
        home = system._homes.at("/app/a")
        assert home is not None
        actor.kill()
        begin_with_older(home)
        expected = [*(said(n, "old") for n in range(3)), said(3, "new")]
        assert await actor.ask(new.Get(), LONG) == expected
