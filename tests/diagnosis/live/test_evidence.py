"""Healthy is a claim that needs evidence: of what nobody sees, or nobody has seen to have gone, nothing is said."""

from collections.abc import AsyncIterator

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.console.diagnosed import diagnosed
from holdfast.console.operate.diagnosing import diagnosis_lines
from holdfast.diagnosis import Watch
from holdfast.diagnosis.engine import State
from holdfast.diagnosis.literals import ok
from holdfast.diagnosis.model import Expectation
from holdfast.diagnosis.observers import Manner, Observer
from holdfast.testing import advance

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

DISK = Expectation("ok(disk)", ("ledger",))
QUICK = Manner(every=0.1, time_to_live=1.0)


class Ask(hf.Message): ...


class Ledger(hf.Actor):
    def on_start(self, restored: bool) -> None:
        self.ctx.every(0.5, Ask())

    @hf.on(Ask)
    def _ask(self, message: Ask) -> None: ...


class Disk(Observer):
    """Says, by a word of its user's, that the disk is well, but in the looks in which it crashes."""

    looks = 0

    def __init__(self, crashes: range, word: object = "ok(disk)", *, holds: bool = True) -> None:
        super().__init__(manner=QUICK)
        self.crashes, self.word, self.holds = crashes, word, holds

    def look(self) -> None:
        Disk.looks += 1
        if Disk.looks in self.crashes:
            raise OSError("no such device")
        self.verdict(self.word, self.holds)  # type: ignore[arg-type]


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    Disk.looks = 0
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("ledger", hf.start(Ledger)))
        yield system


async def watched(system: hf.ActorSystem, *observers: hf.ChildSpec) -> Watch:
    return await diagnosis.watch(system, observers=observers, expect=[DISK], seconds=0.5, repair="off")


def disk(*arguments: object, **options: bool) -> hf.ChildSpec:
    return diagnosis.observer("disk", hf.start(Disk, *arguments, **options))  # type: ignore[arg-type]


@pytest.mark.parametrize("word", ["ok(disk)", ok("disk")], ids=["text", "atom"])
async def test_an_observer_says_its_words_as_text_or_as_atoms(system: hf.ActorSystem, word: object) -> None:
    found = await watched(system, disk(range(0), word, holds=False))
    await advance(1.0)
    said = await found.diagnosis()
    assert (said.state, said.suspects) == (State.FAULTY, ("ledger",))


@pytest.mark.parametrize(("word", "why"), [("disk", "BadLiteral"), ("not ok(disk)", "BadLiteral"), (5, "TypeError")])
async def test_a_word_that_is_none_is_refused_and_told(system: hf.ActorSystem, word: object, why: str) -> None:
    found = await watched(system, disk(range(0), word))
    await advance(1.0)
    said = await found.diagnosis()
    assert list(said.crashed_observers) == ["/app/diagnosis/observers/disk"]
    assert why in said.crashed_observers["/app/diagnosis/observers/disk"]
    assert said.unknown == ("ledger",)


async def test_what_nobody_observes_is_unknown(system: hf.ActorSystem) -> None:
    found = await watched(system)
    await advance(1.0)
    said = await found.diagnosis()
    assert (said.state, said.unknown) == (State.HEALTHY, ("ledger",))
    assert "nobody says whether ok(disk) holds" in (await found.why()).text


@pytest.mark.parametrize(
    ("crashes", "knows"),
    [(range(1, 10**6), False), (range(1, 4), True), (range(1, 10**6, 9), True)],
    ids=["always", "at first", "now and then"],
)
async def test_an_observer_that_crashes_is_named(system: hf.ActorSystem, crashes: range, knows: bool) -> None:
    found = await watched(system, disk(crashes))
    await advance(9.0)
    said = await found.diagnosis()
    crashed = "observer /app/diagnosis/observers/disk has crashed: OSError: no such device"
    assert crashed in str(said)
    assert crashed in (await found.why()).text
    (shown,) = await diagnosed(system, None, 1.0)
    assert any(crashed in line for line in diagnosis_lines(shown))
    if not knows:
        assert said.unknown == ("ledger",)
    elif len(crashes) < 4:
        assert said.unknown == ()
        await advance(60.0)
        assert str(await found.diagnosis()) == "healthy"


async def test_who_was_suspected_is_unknown_until_the_symptom_is_seen_to_have_gone(system: hf.ActorSystem) -> None:
    found = await watched(system, disk(range(0), holds=False))
    await advance(1.0)
    assert (await found.diagnosis()).suspects == ("ledger",)
    await system.publish(diagnosis.TOUCHED, diagnosis.Touched(("ledger",), "restart", 0.0, grace=2.0))
    await advance(0.5)
    said = await found.diagnosis()
    assert (said.state, said.unknown, said.uncleared) == (State.HEALTHY, ("ledger",), ("ledger",))
    await advance(2.5)
    assert (await found.diagnosis()).suspects == ("ledger",)
