"""Nothing is lost when a supervisor or a program stops in good order: who is told something may have ended before.

A supervisor stops its children one after another. What a recorded actor says meanwhile to one that has been stopped
already waits at that one's home for its next life, and leaves once.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
from collections import Counter
from collections.abc import AsyncGenerator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.between_player import TOPIC, Account, Book, Listener, Pay, Speaker
from tests.checkpoint.players import Do, Doer, Note, Seen, until
from tests.checkpoint.strikes import home, let_through

IN_TIME = 15.0
VERBS = ("tell", "flush", "send", "ask", "publish", "forward")
SEED = int(os.environ.get("HOLDFAST_SEED", "20261128"))
ENDS = int(os.environ.get("HOLDFAST_BETWEEN", "12"))
"""How often the accounts are ended in good order."""


def team(isolation: str = "task", *, a: dict[str, Any] | None = None, b: dict[str, Any] | None = None) -> hf.ChildSpec:
    """The one that speaks (a) is started first, so it is stopped last."""
    place = "process" if isolation == "process" else "task"
    own: dict[str, Any] = {"recovery": hf.hybrid(interval=3600.0), "isolation": place}
    first: dict[str, Any] = {"shutdown": 20.0, **own, **(a or {})}
    second: dict[str, Any] = {**own, **(b or {})}
    return hf.supervisor(
        "team",
        children=[
            hf.child("fragile", hf.start(Doer), rules=[hf.rule(OSError, "escalate")]),
            hf.child("a", hf.start(Speaker), **first),
            hf.child("b", hf.start(Listener), **second),
        ],
        isolation="process" if isolation == "subtree" else "task",
    )


@contextlib.asynccontextmanager
async def running(spec: hf.ChildSpec | None = None, store: str | None = None) -> AsyncGenerator[hf.ActorSystem]:
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        await system.start(team() if spec is None else spec)
        yield system


def root(system: hf.ActorSystem) -> hf.ActorRef[hf.Supervisor]:
    return system.ref("/app", hf.Supervisor)


def at(system: hf.ActorSystem, name: str) -> hf.ActorRef[Doer]:
    return system.ref(f"/app/team/{name}", Doer)


async def restarted(system: hf.ActorSystem) -> None:
    await root(system).ask(hf.RestartChild("team", running=True), timeout=IN_TIME)


async def terminated(system: hf.ActorSystem) -> None:
    await system.terminate(system.ref("/app/team", hf.Supervisor))


async def ordered(system: hf.ActorSystem) -> None:
    await root(system).ask(hf.TerminateChild("team"), timeout=IN_TIME)
    await root(system).ask(hf.RestartChild("team"), timeout=IN_TIME)


async def escalated(system: hf.ActorSystem) -> None:
    at(system, "fragile").tell(Do(["fail"]))


HOWS: dict[str, Callable[[hf.ActorSystem], Awaitable[None]]] = {
    "restart": restarted,
    "terminate": terminated,
    "stop and start": ordered,
    "escalation": escalated,
}


async def seen(system: hf.ActorSystem, name: str) -> list[str]:
    """What an actor has done, as soon as it is there again."""
    async with asyncio.timeout(IN_TIME):
        while True:
            try:
                return await at(system, name).ask(Seen(), timeout=IN_TIME)
            except (hf.ActorStopped, hf.errors.NoSuchActor):
                await asyncio.sleep(0.002)


async def has_seen(system: hf.ActorSystem, name: str, what: str) -> list[str]:
    async with asyncio.timeout(IN_TIME):
        while what not in (found := await seen(system, name)):
            await asyncio.sleep(0.002)
    return found


async def speaks(system: hf.ActorSystem, gate: Path, *steps: str) -> Callable[[], bool]:
    """Have the one speak when it is let through; what is returned says whether the other one has been stopped."""
    await at(system, "a").send(Do([f"gate {gate}", "add begun", *steps], peer=at(system, "b")))
    await until(gate.exists)
    switch = home(at(system, "b"))
    return lambda: switch.life.port is None and switch.intake.between is not None


async def told_to_stop(ref: hf.ActorRef[Any], isolation: str = "task") -> None:
    """Wait until the actor is to end behind its turn in hand; that is not seen of one in a process, and not needed."""
    if isolation == "task":
        await until(lambda: bool(ref._cell.extra().urgent), IN_TIME)


def steps_of(verb: str) -> list[str]:
    return ["tell hello", "flush"] if verb == "flush" else [f"{verb} hello"]


async def judge(system: hf.ActorSystem, verb: str) -> None:
    """What was said has come once, and the one that has said it has gone on."""
    what = "begun" if verb == "forward" else "hello"
    assert (await has_seen(system, "b", what)).count(what) == 1
    said = ["begun", "hello:1"] if verb == "ask" else ["begun"]
    assert await has_seen(system, "a", said[-1]) == said


TABLE = [
    *(("task", how, verb) for how in HOWS for verb in VERBS),
    *((place, "restart", verb) for place in ("process", "subtree") for verb in ("tell", "ask")),
]


@pytest.mark.parametrize(("isolation", "how", "verb"), TABLE)
async def test_what_is_said_to_who_was_stopped_before_comes_once(
    isolation: str, how: str, verb: str, tmp_path: Path
) -> None:
    gate = tmp_path / "gate"
    async with running(team(isolation)) as system:
        has_ended = await speaks(system, gate, *steps_of(verb))
        with system.events() as stream:
            ending = asyncio.ensure_future(HOWS[how](system))
            await until(has_ended, IN_TIME)
            let_through(gate)
            await ending
            await judge(system, verb)
            assert not [one for one in stream.take() if isinstance(one, hf.events.DeadLetter)]


PROGRAMS = [("task", verb) for verb in VERBS] + [("process", "ask"), ("subtree", "ask"), ("subtree", "tell")]


@pytest.mark.parametrize(("isolation", "verb"), PROGRAMS)
async def test_it_comes_in_the_next_program_if_this_one_ends(isolation: str, verb: str, tmp_path: Path) -> None:
    store, gate = f"sqlite:{tmp_path / 'app.db'}", tmp_path / "gate"
    async with contextlib.AsyncExitStack() as program:
        system = await program.enter_async_context(running(team(isolation), store))
        has_ended = await speaks(system, gate, *steps_of(verb))
        ending = asyncio.ensure_future(program.aclose())
        await until(has_ended, IN_TIME)
        let_through(gate)
        await ending
    async with running(team(isolation), store) as system:
        await judge(system, verb)


async def test_without_a_store_it_is_a_dead_letter_when_the_program_ends(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    async with contextlib.AsyncExitStack() as program:
        system = await program.enter_async_context(running())
        await at(system, "a").send(Do([f"gate {gate}", "tell hello"], peer=at(system, "b")))
        await until(gate.exists)
        switch = home(at(system, "b"))
        stream = system.events()
        ending = asyncio.ensure_future(program.aclose())
        await until(lambda: switch.cell.state == "gone", IN_TIME)
        let_through(gate)
        await ending
        letters = [one for one in stream.take() if isinstance(one, hf.events.DeadLetter)]
        assert [one.address for one in letters] == ["/app/team/b"]


async def test_without_a_store_what_waits_is_a_dead_letter_when_the_program_ends() -> None:
    async with contextlib.AsyncExitStack() as program:
        system = await program.enter_async_context(running())
        ref, stream = at(system, "b"), system.events()
        await root(system).ask(hf.TerminateChild("team"), timeout=IN_TIME)
        ref.tell(Note("too late"))
        await program.aclose()
        assert [one.address for one in stream.take() if isinstance(one, hf.events.DeadLetter)] == [ref.path]


async def test_what_an_outsider_says_meanwhile(tmp_path: Path) -> None:
    """Tells and sends wait for the next life; an ask fails at once, for it can be asked again."""
    gate = tmp_path / "gate"
    async with running() as system:
        relay = await system.start(hf.child("relay", hf.start(Speaker), recovery=hf.hybrid()))
        has_ended = await speaks(system, gate)
        ref = at(system, "b")
        ending = asyncio.ensure_future(restarted(system))
        await until(has_ended, IN_TIME)
        ref.tell(Note("told"))
        await ref.send(Note("sent"))
        await system.publish(TOPIC, Note("published"))
        with pytest.raises(hf.ActorStopped, match="may start it again"):
            await ref.ask(Note("asked"))
        await relay.ask(Do(["tell relayed"], peer=ref))
        asked = asyncio.ensure_future(relay.ask(Do(["ask relayed too"], peer=ref), timeout=IN_TIME))
        let_through(gate)
        await ending
        await asked
        assert await seen(system, "b") == ["told", "sent", "published", "relayed", "relayed too"]


async def test_a_mailbox_that_is_full_stays_full_between_two_lives(tmp_path: Path) -> None:
    """A recorded turn has its ask let in when there is room; nobody from outside waits for that."""
    gate = tmp_path / "gate"
    async with running(team(b={"mailbox": hf.bounded(1)})) as system:
        has_ended = await speaks(system, gate, "ask hello", "send again")
        ref = at(system, "b")
        ending = asyncio.ensure_future(restarted(system))
        await until(has_ended, IN_TIME)
        ref.tell(Note("told"))
        with pytest.raises(hf.MailboxFull):
            ref.tell(Note("too many"))
        with pytest.raises(hf.ActorStopped, match="may start it again"):
            await ref.send(Note("too many"))
        let_through(gate)
        await ending
        assert await has_seen(system, "b", "again") == ["told", "hello", "again"]
        assert await seen(system, "a") == ["begun", "hello:2"]


@pytest.mark.parametrize("how", ["it", "its supervisor", "removed"])
async def test_who_is_told_something_after_a_stop_by_order(how: str, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    async with running() as system:
        has_ended = await speaks(system, gate, "tell hello")
        ref = at(system, "b")
        stop: Awaitable[Any]
        if how == "it":
            let_through(gate)
            await has_seen(system, "b", "hello")
            stop = system.ref("/app/team", hf.Supervisor).ask(hf.TerminateChild("b"), timeout=IN_TIME)
        elif how == "removed":
            stop = system.stop(system.ref("/app/team", hf.Supervisor))
        else:
            stop = root(system).ask(hf.TerminateChild("team"), timeout=IN_TIME)
        ending = asyncio.ensure_future(stop)
        if how != "it":
            await until(has_ended, IN_TIME)
            ref.tell(Note("while it ends"))
            let_through(gate)
        await ending
        with system.events() as stream:
            ref.tell(Note("later"))
            letters = [one.address for one in stream.take() if isinstance(one, hf.events.DeadLetter)]
        assert letters == ([] if how == "its supervisor" else [ref.path])
        if how == "it":
            await system.ref("/app/team", hf.Supervisor).ask(hf.RestartChild("b"), timeout=IN_TIME)
        elif how == "removed":
            await system.start(team())
        else:
            await root(system).ask(hf.RestartChild("team"), timeout=IN_TIME)
        later = ["later"] if how == "its supervisor" else []
        assert await seen(system, "b") == [
            "hello" if how == "it" else "while it ends",
            *(["hello"] * (how != "it")),
            *later,
        ]


@pytest.mark.parametrize("isolation", ["task", "process", "subtree"])
@pytest.mark.parametrize("when", ["asks then", "has asked", "is busy as well"])
async def test_who_waits_for_it_does_not_hold_up_the_stop(isolation: str, when: str, tmp_path: Path) -> None:
    """The stop has a long time limit, and the ask a longer one: the turn is left, and the next life has the answer."""
    gate, other = tmp_path / "gate", tmp_path / "other"
    async with running(team(isolation, a={"shutdown": 2 * IN_TIME})) as system:
        ref, said = at(system, "b"), "hello" if when == "asks then" else str(other)
        switch = home(ref)
        if when == "asks then":
            await speaks(system, gate, "wait hello")
        else:
            ref.tell(Do([f"gate {gate}"]))
            await until(gate.exists)
            await at(system, "a").send(Do(["add begun", f"{'both' if 'busy' in when else 'wait'} {other}"], peer=ref))
            await until(lambda: any(source.ask is not None for source in switch.open.values()), IN_TIME)
        ending = asyncio.ensure_future(restarted(system))
        if when != "asks then":
            await told_to_stop(ref, isolation)
            let_through(gate)
        if when != "has asked":  # Else nothing keeps them from living again at once.
            await until(lambda: switch.life.port is None and switch.intake.between is not None, IN_TIME)
            let_through(gate if when == "asks then" else other)
        await asyncio.wait_for(ending, IN_TIME)
        assert await has_seen(system, "a", f"{said}:1") == ["begun", f"{said}:1"]
        assert await seen(system, "b") == [said]


async def test_an_ask_that_waits_for_room_waits_on(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    async with running(team(b={"mailbox": hf.bounded(1)})) as system:
        ref = at(system, "b")
        ref.tell(Do([f"gate {gate}"]))
        await until(gate.exists)
        ref.tell(Note("queued"))
        outside = ref.ask(Note("outside"), timeout=IN_TIME)  # Has the place that is free when the turn in hand ends.
        await at(system, "a").send(Do(["add begun", "ask hello"], peer=ref))
        switch = home(ref)
        await until(lambda: len(switch.intake.bound.waiting) > 1, IN_TIME)
        ending = asyncio.ensure_future(restarted(system))
        await told_to_stop(ref)
        let_through(gate)
        await ending
        with pytest.raises(hf.ActorStopped):
            await outside
        assert await has_seen(system, "a", "hello:2") == ["begun", "hello:2"]


async def test_an_effect_that_is_out_is_waited_for(tmp_path: Path) -> None:
    """It is made once, though the turn is left behind it."""
    gate, other = tmp_path / "gate", tmp_path / "other"
    async with running() as system:
        ref = at(system, "b")
        ref.tell(Do([f"gate {gate}"]))
        await until(gate.exists)
        await at(system, "a").send(Do(["add begun", f"both {other}"], peer=ref))
        await until(other.exists)
        switch = home(ref)
        with system.events() as stream:
            ending = asyncio.ensure_future(restarted(system))
            await told_to_stop(ref)
            let_through(gate)
            await until(lambda: switch.intake.between is not None, IN_TIME)
            for _ in range(20):
                await asyncio.sleep(0.002)
            let_through(other)
            await ending
            await has_seen(system, "a", f"{other}:1")
            assert not [one for one in stream.take() if isinstance(one, hf.events.EffectRepeated)]


async def test_a_reply_that_was_promised_to_a_recorded_turn_is_given_by_the_next_life(tmp_path: Path) -> None:
    async with running() as system:
        ref = at(system, "b")
        await at(system, "a").send(Do(["add begun", "promise"], peer=ref))
        switch = home(ref)
        await until(lambda: bool(switch.calls.later), IN_TIME)
        await restarted(system)
        await ref.ask(Do(["reply kept"]), timeout=IN_TIME)
        assert await has_seen(system, "a", "promised:kept") == ["begun", "promised:kept"]


MECHANISMS: dict[str, dict[str, Any]] = {
    "pbr": {"mechanism": hf.ftm.PBR()},
    "lfr": {"mechanism": hf.ftm.LFR()},
    "tmr": {"mechanism": hf.ftm.TMR()},
    "tr": {"mechanism": hf.ftm.TR()},
}


@pytest.mark.parametrize("name", MECHANISMS)
@pytest.mark.parametrize("verb", ["tell", "ask"])
async def test_behind_a_mechanism_it_waits_as_well(verb: str, name: str, tmp_path: Path) -> None:
    gate, mechanism = tmp_path / "gate", MECHANISMS[name]
    async with running(team(a={**mechanism, "shutdown": 60.0}, b=mechanism)) as system:
        has_ended = await speaks(system, gate, *steps_of(verb))
        ending = asyncio.ensure_future(restarted(system))
        await until(has_ended, IN_TIME)
        let_through(gate)
        await ending
        await judge(system, verb)


# -- accounts ---------------------------------------------------------------------------------------------------------

NAMES = ("alice", "bob", "carol", "dave")


def bank(draw: random.Random) -> hf.ChildSpec:
    strategy: Any = draw.choice(["one_for_one", "one_for_all", "rest_for_one"])
    accounts = [hf.child(name, hf.start(Account), recovery=hf.hybrid(interval=0.05)) for name in NAMES]
    fragile = hf.child("fragile", hf.start(Doer), rules=[hf.rule(OSError, "escalate")])
    return hf.supervisor("team", strategy=strategy, intensity=1000, children=[fragile, *accounts])


async def order(system: hf.ActorSystem, draw: random.Random, first: int, last: int, accepted: list[int]) -> None:
    """Order payments for as long as there is somebody to pay; who is not there, or full, is asked later."""
    for number in range(first, last):
        payer, payee = draw.sample(NAMES, 2)
        is_free = NAMES.index(payer) < NAMES.index(payee)  # Two that ask each other would wait for each other.
        how = draw.choice(["tell", "send", "ask", "first"] if is_free else ["tell", "send"])
        with contextlib.suppress(hf.ActorStopped, hf.errors.NoSuchActor):
            ref = system.ref(f"/app/team/{payer}", Account)
            await ref.send(Pay(number, f"/app/team/{payee}", how))
            accepted.append(number)
        if draw.random() < 0.3:
            await asyncio.sleep(0.001 * draw.random())


@pytest.mark.parametrize("part", range(3))
async def test_no_coin_is_lost_or_made_by_ends_in_good_order(part: int, tmp_path: Path) -> None:
    draw, store = random.Random(SEED + part), f"sqlite:{tmp_path / 'app.db'}"
    print(f"HOLDFAST_SEED={SEED}, part {part}")
    accepted, number, ends = list[int](), 0, 0
    while ends < ENDS:
        async with running(bank(draw), store) as system:
            for _ in range(draw.randint(1, 4)):
                ordering = asyncio.ensure_future(order(system, draw, number, number + 40, accepted))
                number += 40
                await asyncio.sleep(0.004 * draw.random())
                with contextlib.suppress(hf.errors.NoSuchActor, hf.ActorStopped, hf.errors.ChildBusy):
                    await HOWS[draw.choice(list(HOWS))](system)
                ends += 1
                await ordering
    async with running(bank(draw), store) as system:
        async with asyncio.timeout(IN_TIME):
            while True:
                books = [await system.ref(f"/app/team/{one}", Account).ask(Book(), timeout=IN_TIME) for one in NAMES]
                paid = Counter(n for book in books for n in book[0])
                got = Counter(n for book in books for n in book[1])
                if set(accepted) <= paid.keys() and paid.keys() <= got.keys():
                    break
                await asyncio.sleep(0.02)
    assert paid == got == Counter(accepted)
    assert sum(coins for *_, coins in books) == 100 * len(NAMES)
