"""Refs to actors of other systems, over a simulated post on the virtual clock; systems end, and begin anew."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

import holdfast as hf
from holdfast.actors.errors import AskDeadlock, BadMessage, BadReply, ConnectionLost, NotGranted
from holdfast.actors.process.wire import frames
from holdfast.cluster.lines.far_line import NEW
from holdfast.cluster.lines.line import NOBODY, Boot, LineBatch, Note
from holdfast.cluster.lines.lines import FORGET_SECONDS, SILENT_SECONDS, LineTaken
from holdfast.testing.fleet.post import NO_POST_FAULTS, PostFaults
from tests.cluster.reach import (
    Account,
    Add,
    Clerk,
    Crash,
    Large,
    News,
    No,
    Pay,
    Reach,
    Refuse,
    Total,
    Wait,
    run,
    shop_of,
)


@pytest.mark.parametrize("who", ["plain", "kept"])
def test_whoever_is_connected_tells_sends_and_asks(who: str) -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank(), hf.connect("bank") as bank:
            account = bank.ref(f"/bank/{who}", Account)
            assert await account.ask(Add(5)) == 5
            account.tell(Add(1))
            await account.send(Add(1))
            assert await account.ask(Total()) == 7
            with pytest.raises(No) as refused:
                await account.ask(Refuse())
            assert refused.value.why == "not today"
            with pytest.raises(hf.RemoteCrash, match="ValueError: broken"):
                await account.ask(Crash())
            with pytest.raises(hf.AskTimeout):
                await account.ask(Wait(10.0), timeout=1.0)
            with pytest.raises(hf.SpecError, match="no address of 'bank'"):
                bank.ref("/shop/clerk")

    run(work)


async def sums_up(reach: Reach) -> None:
    async with reach.bank() as system, hf.connect("bank", timeout=60.0) as bank:
        for who in ("plain", "kept"):
            account = bank.ref(f"/bank/{who}", Account)
            answers = await asyncio.gather(*(account.ask(Add(1), timeout=600.0) for _ in range(100)))
            assert answers == [*range(1, 101)]
            for _ in range(50):
                account.tell(Add(1))
            await account.send(Add(1))
            assert await account.ask(Total(), timeout=600.0) == 151
        assert not system._homes.far._open
        await asyncio.sleep(600.0)
        assert not any(mail.answers for mail in system._homes.far._mail.values())  # All are known to have arrived.


@pytest.mark.parametrize("seed", range(6))
def test_each_ask_has_one_outcome_in_order_whatever_the_post_does(seed: int) -> None:
    run(sums_up, seed, PostFaults(lost=0.1, doubled=0.1, late=0.1))


def test_nobody_answers_and_that_is_said_in_time() -> None:
    async def work(reach: Reach) -> None:
        with pytest.raises(hf.Unreachable, match="/bank cannot be reached: no program that leads it has answered"):
            async with hf.connect("bank", timeout=2.0):
                pass

    run(work)


def test_a_system_of_another_name_is_told_of_at_once() -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank():
            with pytest.raises(hf.SpecError, match="called 'bank', not 'blank': say system='bank'"):
                async with hf.connect("bank", system="blank"):
                    pass

    run(work)


def test_another_program_leads_and_only_what_is_kept_goes_on(tmp_path: Path) -> None:
    """What was asked of a plain actor ends, for nobody knows whether it was done; a recorded one is asked again."""

    async def work(reach: Reach) -> None:
        async with hf.ActorSystem("shop", log=False) as shop:
            async with reach.bank(tmp_path / "bank.db"):
                connected = hf.connect("bank", within=shop)
                bank = await connected.__aenter__()
                plain, kept = bank.ref("/bank/plain", Account), bank.ref("/bank/kept", Account)
                assert await kept.ask(Add(5)) == 5
                reach.transports[0].is_mute = True  # The bank does what it is asked, nobody hears of it, and it ends.
                lost = plain.ask(Add(1), timeout=600.0)
                again = kept.ask(Add(1), timeout=600.0)
                await asyncio.sleep(1.0)
            async with reach.bank(tmp_path / "bank.db"):
                with pytest.raises(ConnectionLost, match="nobody knows whether /bank/plain has handled the message"):
                    await lost
                assert await again == 6
                assert await kept.ask(Total()) == 6
                await bank.close()

    run(work)


def test_tells_to_a_system_that_is_away_are_refused_and_asks_wait(tmp_path: Path) -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank(), hf.connect("bank") as bank:
            account = bank.ref("/bank/plain", Account)
            reach.transports[0].is_cut = True
            await asyncio.sleep(SILENT_SECONDS + 3.0)
            assert not bank.is_reachable
            with pytest.raises(hf.Unreachable, match="/bank cannot be reached: it does not answer; nothing was sent"):
                account.tell(Add(1))
            asked = account.ask(Add(2), timeout=600.0)
            reach.transports[0].is_cut = False
            assert await asked == 2
            assert bank.is_reachable

    run(work)


def test_whoever_has_called_and_is_silent_is_forgotten_and_may_come_back() -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank() as system, hf.connect("bank") as bank:
            account = bank.ref("/bank/kept", Account)
            assert await account.ask(Add(1)) == 1
            reach.transports[1].is_cut = True
            await asyncio.sleep(FORGET_SECONDS + 5.0)
            assert system.lines.at(bank._call.far._owner.name) is None  # type: ignore[union-attr]
            reach.transports[1].is_cut = False
            assert await account.ask(Add(1), timeout=60.0) == 2

    run(work)


class Watcher(hf.Actor):
    """Watches an actor of another system, subscribes, and asks it."""

    def __init__(self, heard: list[str], whom: hf.ActorRef[Account]) -> None:
        self.heard, self.whom = heard, whom

    def on_start(self, restored: bool) -> None:
        self.ctx.monitor(self.whom)

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.heard.append(f"{source.path}: {reason}")

    @hf.on(News)
    def news(self, message: News) -> None:
        self.heard.append(message.text)

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        return await self.whom.ask(message)


def test_actors_watch_each_other_over_systems() -> None:
    async def work(reach: Reach) -> None:
        heard: list[str] = []
        async with hf.ActorSystem("shop", log=False) as shop:
            async with reach.bank() as system:
                bank = await hf.connect("bank", within=shop).__aenter__()
                plain = bank.ref("/bank/plain", Account)
                watcher = await shop.start(hf.child("watcher", hf.start(Watcher, heard, plain)))
                assert await watcher.ask(Add(3)) == 3
                system.ref("/bank/plain").kill()
                while not heard:
                    await asyncio.sleep(0.1)
                assert heard == ["/bank/plain: killed"]
                watcher.kill()
                assert await watcher.ask(Add(3)) == 3  # Its next life watches again; the account's was new.
                bank.subscribe("/news", watcher)
                await asyncio.sleep(1.0)
                await system.publish("/news", News("from the bank"))
                await bank.publish("/news", News("from outside"))
                while len(heard) < 3:
                    await asyncio.sleep(0.1)
                assert heard[1:] == ["from the bank", "from outside"]
                reach.transports[0].is_cut = True
            await asyncio.sleep(SILENT_SECONDS + 3.0)
            assert heard[3:] == ["/bank/plain: no connection to bank"]
            await bank.close()

    run(work)


class Looped(hf.Actor):
    def __init__(self, whom: hf.ActorRef[Any]) -> None:
        self.whom = whom

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        return await self.whom.ask(message, timeout=60.0)


def test_two_systems_that_reach_each_other_see_a_deadlock_at_once() -> None:
    async def work(reach: Reach) -> None:
        async with (
            reach.bank() as system,
            hf.ActorSystem("shop", log=False) as shop,
            hf.connect("bank", within=shop) as bank,
        ):
            here = await shop.start(hf.child("loop", hf.start(Looped, bank.ref("/bank/loop"))))
            back = system.lines.find("/shop/loop")
            assert back is not None
            await system.start(hf.child("loop", hf.start(Looped, back.ref)))
            began = asyncio.get_running_loop().time()
            with pytest.raises((AskDeadlock, hf.RemoteCrash), match=r"AskDeadlock|waits"):
                await here.ask(Add(1), timeout=60.0)
            assert asyncio.get_running_loop().time() - began < 5.0

    run(work)


def test_one_system_may_not_order_another_about() -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank(), hf.connect("bank") as bank:
            account = bank.ref("/bank/plain", Account)
            for order in (account.stop, account.kill):
                with pytest.raises(NotGranted, match="only messages go over a connection") as refused:
                    order()
                assert "bindings" not in str(refused.value)  # A client has no spec to give them in.
            with pytest.raises(hf.UnknownMessage):
                bank.ref("/bank").ask(hf.TerminateChild("plain"))
            far = bank._call.far  # type: ignore[union-attr]
            name, body = "holdfast.supervision.admin:TerminateChild", hf.TerminateChild("plain")
            key, answer = far.acceptance()
            far.connection.send(frames.Offer(key, "/bank", name, body))  # type: ignore[arg-type]
            with pytest.raises(hf.UnknownMessage):
                await answer
            assert await account.ask(Add(1)) == 1
            far.command("/bank/plain", "kill", {})
            assert await account.ask(Add(1)) == 2

    run(work)


def test_two_systems_of_one_name_are_not_reached_at_once() -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank(), hf.ActorSystem("shop", log=False) as shop, hf.connect("bank", within=shop):
            with pytest.raises(LineTaken):
                async with hf.connect("bank", within=shop):
                    pass

    run(work)


def test_what_an_earlier_run_has_sent_is_refused_however_late() -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank() as system:
            late = frames.Tell("/bank/plain", f"{Add.__module__}:Add", Add(7))  # type: ignore[arg-type]
            items = (NEW + msgspec.msgpack.encode(late),)
            for to in (NOBODY, Boot(system.lines.boot.era, "abcd"), Boot(1, "00")):
                batch = LineBatch("client", Boot(5, "ff"), to, 0, 1, items)
                reach.post.transport().post("inbox of bank", msgspec.msgpack.encode(batch), "client")
            reach.post.transport().post("inbox of bank", b"garbage", "client")
            await asyncio.sleep(5.0)
            assert await system.ref("/bank/plain", Account).ask(Total()) == 0

    run(work)


@pytest.mark.parametrize("how", ["tell", "send", "ask"])
@pytest.mark.parametrize("faults", [NO_POST_FAULTS, PostFaults(lost=0.1, doubled=0.1, late=0.1)], ids=["", "lossy"])
def test_recorded_actors_of_two_systems_reach_each_other_once(tmp_path: Path, how: str, faults: PostFaults) -> None:
    """The receiver's system ends and begins anew while messages are on their way; none is lost or comes twice."""

    async def work(reach: Reach) -> None:
        paid = 0
        async with AsyncExitStack() as stack:
            bank = await stack.enter_async_context(reach.bank_stack(tmp_path / "bank.db"))
            clerk = await stack.enter_async_context(shop_of(tmp_path / "shop.db"))
            for round_ in range(4):
                answers = [clerk.ask(Pay(1, how), timeout=3000.0) for _ in range(20)]
                paid += 20
                if round_ % 2:
                    bank.transport.is_cut = True
                    await asyncio.sleep(1.0)
                    await bank.again()
                await asyncio.gather(*answers)
            assert await clerk.ask(Pay(0, "ask"), timeout=3000.0) == paid
            assert await bank.total() == paid

    run(work, faults=faults)


@pytest.mark.parametrize("how", ["tell", "send"])
def test_what_a_recorded_actor_tells_another_system_outlives_its_own_program(tmp_path: Path, how: str) -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank(tmp_path / "bank.db") as system:
            account = system.ref("/bank/kept", Account)
            async with shop_of(tmp_path / "shop.db") as clerk:
                assert await clerk.ask(Pay(1, how)) == 1
                await asyncio.sleep(1.0)
                reach.transports[1].is_cut = True
                assert await clerk.ask(Pay(2, how)) == 3
            assert await account.ask(Total()) == 1
            async with shop_of(tmp_path / "shop.db") as clerk:
                await asyncio.sleep(5.0)
                assert await account.ask(Total()) == 3
                assert await clerk.ask(Pay(4, how)) == 7
                await asyncio.sleep(5.0)
                assert await account.ask(Total()) == 7

    run(work)


@pytest.mark.parametrize("how", ["tell", "send", "ask"])
def test_whoever_is_removed_and_started_anew_says_other_things_than_before(tmp_path: Path, how: str) -> None:
    """The new actor counts its turns from the beginning: what both say in their first turns are two things."""

    async def work(reach: Reach) -> None:
        async with (
            reach.bank(tmp_path / "bank.db") as system,
            hf.ActorSystem("shop", store=f"sqlite:{tmp_path / 'shop.db'}", log=False) as shop,
            hf.connect("bank", within=shop, timeout=600.0) as bank,
        ):
            account = bank.ref("/bank/kept", Account)
            spec = hf.child("clerk", hf.start(Clerk, account), recovery=hf.hybrid())
            reach.transports[-1].is_cut = True
            for amount in (1, 2):
                clerk = await shop.start(spec, fresh=True)
                await clerk.send(Pay(amount, how))
                await asyncio.sleep(1.0)
                if amount == 1:
                    await shop.stop(clerk)
            reach.transports[-1].is_cut = False
            await asyncio.sleep(60.0)
            assert await clerk.ask(Pay(0, "tell")) == 2
            found = await system.ref("/bank/kept", Account).ask(Total())
            assert found == 3 or (how == "ask" and found == 2), "of who is removed an ask may be lost"

    run(work)


def test_what_a_recorded_actor_asks_another_system_waits_for_the_next_connection(tmp_path: Path) -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank(tmp_path / "bank.db") as system, hf.ActorSystem("shop", log=False) as shop:
            connected = await hf.connect("bank", within=shop).__aenter__()
            account = connected.ref("/bank/kept", Account)
            clerk = await shop.start(hf.child("clerk", hf.start(Clerk, account), recovery=hf.hybrid()))
            assert await clerk.ask(Pay(1, "ask")) == 1
            reach.transports[0].is_cut = True
            paid = clerk.ask(Pay(2, "ask"), timeout=600.0)
            await asyncio.sleep(1.0)
            await connected.close()
            reach.transports[0].is_cut = False
            await asyncio.sleep(1.0)
            assert not paid.done()
            async with hf.connect("bank", within=shop):
                assert await paid == 3
                assert await system.ref("/bank/kept", Account).ask(Total()) == 3

    run(work)


class Slow(hf.Actor):
    """Recorded: its first turn ends when it is let go."""

    go: asyncio.Event

    def __init__(self) -> None:
        self.total = 0

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        await self.go.wait()
        self.total += message.amount
        return self.total


def test_what_was_asked_and_waits_at_the_end_of_a_program_is_answered_by_the_next(tmp_path: Path) -> None:
    """One ask is in hand when the system is stopped, others wait behind it: the next program does them all, once."""

    async def work(reach: Reach) -> None:
        @asynccontextmanager
        async def bank() -> AsyncGenerator[hf.ActorSystem]:
            async with hf.ActorSystem("bank", store=f"sqlite:{tmp_path}/b.db", reachable="bank", log=False) as system:
                await system.start(hf.child("slow", hf.start(Slow), recovery=hf.hybrid(), shutdown=1.0))
                yield system

        Slow.go = asyncio.Event()
        async with AsyncExitStack() as stack:
            async with bank():
                connected = await stack.enter_async_context(hf.connect("bank"))
                slow = connected.ref("/bank/slow", Slow)
                asked = [slow.ask(Add(1), timeout=600.0) for _ in range(5)]
                await asyncio.sleep(1.0)
            Slow.go.set()
            async with bank():
                assert await asyncio.gather(*asked) == [1, 2, 3, 4, 5]

    run(work)


@pytest.mark.parametrize("who", ["plain", "kept"])
def test_what_is_too_large_is_refused_and_the_line_goes_on(who: str) -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank(), hf.connect("bank") as bank:
            account = bank.ref(f"/bank/{who}", Account)
            with pytest.raises(BadMessage, match=r"the limit between systems"):
                account.ask(Large(bytes(8 * 1024 * 1024)))
            with pytest.raises(BadReply, match=r"the limit between systems|send it in parts"):
                await account.ask(Large(bytes(3 * 1024 * 1024)))
            assert await account.ask(Add(1)) == 1

    run(work)


NAME = f"{Add.__module__}:Add"
HOSTILE = {
    "a tell in the name of an actor here": lambda: frames.Tell("/bank/plain", NAME, Add(7), 0, "/bank/kept"),  # type: ignore[arg-type]
    "a tell in the name of a third system": lambda: frames.Tell("/bank/plain", NAME, Add(7), 0, "/shop/clerk"),  # type: ignore[arg-type]
    "a tell through this system": lambda: frames.Tell("/shop/clerk", NAME, Add(7)),  # type: ignore[arg-type]
    "the end of an actor here": lambda: frames.Command("/bank/plain", "exit", {"source": "/bank/kept", "reason": {}}),
    "a link without an end": lambda: frames.Command("/bank/plain", "link", {}),
    "a word about another's ask": lambda: frames.Command("/shop/clerk", "settled", {"number": 1}),
    "an ask without an end": lambda: frames.Ask(1, "/bank/plain", NAME, Add(7), float("nan")),  # type: ignore[arg-type]
}
"""What a program may not say, though it is let in."""


@pytest.mark.parametrize("what", HOSTILE)
def test_a_program_speaks_for_its_own_actors_and_to_actors_of_the_system(what: str) -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank() as system, hf.connect("bank") as bank:
            letters: list[str] = []
            system._node.events.add_sink(lambda event: letters.append(str(event)))
            account = bank.ref("/bank/plain", Account)
            assert await account.ask(Add(1)) == 1
            line = bank._call.far.line  # type: ignore[union-attr]
            assert line is not None
            line.put(NEW + msgspec.msgpack.encode(HOSTILE[what]()))
            assert await account.ask(Add(1)) == 2  # The line goes on, and the account has not changed.
            assert any("not understood" in one for one in letters), letters

    run(work)


@pytest.mark.parametrize("name", ["", "a/b", "bank", "x\0y", "n" * 300])
def test_a_program_with_a_name_that_is_none_is_not_answered(name: str) -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank() as system:
            batch = LineBatch(name, Boot(5, "ff"), NOBODY, 0, 1, ())
            reach.post.transport().post("inbox of bank", msgspec.msgpack.encode(batch), "client")
            batch = LineBatch("good", Boot(5, "no number"), NOBODY, 0, 1, ())
            reach.post.transport().post("inbox of bank", msgspec.msgpack.encode(batch), "client")
            await asyncio.sleep(1.0)
            assert not system.lines._lines

    run(work)


@asynccontextmanager
async def two_systems() -> AsyncGenerator[tuple[hf.ActorSystem, hf.ActorSystem]]:
    """Two systems that can be reached, each with an account."""
    async with (
        hf.ActorSystem("alpha", reachable="alpha", log=False) as alpha,
        hf.ActorSystem("beta", reachable="beta", log=False) as beta,
    ):
        for system in (alpha, beta):
            await system.start(hf.child("plain", hf.start(Account)))
        yield alpha, beta


@pytest.mark.parametrize("faults", [NO_POST_FAULTS, PostFaults(lost=0.2, doubled=0.2, late=0.2)], ids=["", "lossy"])
@pytest.mark.parametrize("seed", range(5))
def test_two_systems_may_open_a_connection_to_each_other_at_the_same_time(faults: PostFaults, seed: int) -> None:
    """Both use one line; whoever closes its connection first leaves the other one's."""

    async def work(reach: Reach) -> None:
        async with two_systems() as (alpha, beta):
            there, back = hf.connect("beta", within=alpha, timeout=60.0), hf.connect("alpha", within=beta, timeout=60.0)
            await asyncio.gather(there.__aenter__(), back.__aenter__())
            ours, theirs = there.ref("/beta/plain", Account), back.ref("/alpha/plain", Account)
            for number in range(1, 21):
                asked = [ref.ask(Add(1), timeout=600.0) for ref in (ours, theirs)]
                assert await asyncio.gather(*asked) == [number, number]
            assert (len(alpha.lines._lines), len(beta.lines._lines)) == (1, 1)
            for closed, still in ((there, theirs), (back, ours)):
                await closed.close()
                await asyncio.sleep(10.0)
                if closed is there:
                    assert await still.ask(Add(1), timeout=600.0) == 21
                    assert back.is_reachable
                    async with hf.connect("beta", within=alpha, timeout=60.0) as again:
                        assert await again.ref("/beta/plain", Account).ask(Total(), timeout=600.0) == 20
                        assert await still.ask(Add(1), timeout=600.0) == 22
            await asyncio.sleep(40.0)
            assert (len(alpha.lines._lines), len(beta.lines._lines)) == (0, 0)

    run(work, seed, faults)


@pytest.mark.parametrize("first", ["there", "back"])
def test_whichever_system_connects_first_the_other_one_may_too(first: str) -> None:
    async def work(reach: Reach) -> None:
        async with two_systems() as (alpha, beta):
            calls = {"there": ("beta", alpha), "back": ("alpha", beta)}
            names = [first, *(name for name in calls if name != first)]
            one, two = (hf.connect(calls[name][0], within=calls[name][1]) for name in names)
            async with one:
                refs = {one: one.ref(f"/{one.system}/plain", Account)}
                assert await refs[one].ask(Add(1)) == 1
                async with two:
                    refs[two] = two.ref(f"/{two.system}/plain", Account)
                    assert [await refs[one].ask(Add(1)), await refs[two].ask(Add(1))] == [2, 1]
                await asyncio.sleep(10.0)
                assert await refs[one].ask(Add(1)) == 3

    run(work)


def test_nobody_takes_over_a_connection_by_a_greeting() -> None:
    """Whoever greets a system under the name of one that it calls is not taken for that, whatever era it claims."""

    async def work(reach: Reach) -> None:
        async with two_systems() as (alpha, _), hf.connect("beta", within=alpha) as there:
            account = there.ref("/beta/plain", Account)
            assert await account.ask(Add(1)) == 1
            evil = reach.post.transport()
            heard: list[LineBatch] = []
            await evil.hear(
                evil.own_place(), lambda data, back: heard.append(msgspec.msgpack.decode(data, type=LineBatch))
            )
            for to in (NOBODY, alpha.lines.boot):
                notes: tuple[Note, ...] = ("", "bye")
                for note in notes:
                    batch = LineBatch("beta", Boot(1 << 60, "ff"), to, 0, 1, (NEW + b"x",), note)
                    evil.post("inbox of alpha", msgspec.msgpack.encode(batch), evil.own_place())
            await asyncio.sleep(5.0)
            assert await account.ask(Add(1)) == 2
            assert {one.note for one in heard} == {""}
            assert not any(one.items for one in heard)

    run(work)


def test_a_connection_that_is_closed_unheard_begins_anew() -> None:
    """What says that it is closed gets lost; the next one, of the same run, is not taken for it."""

    async def work(reach: Reach) -> None:
        async with reach.bank(), hf.ActorSystem("shop", log=False) as shop:
            for number in range(1, 10):
                async with hf.connect("bank", within=shop) as bank:
                    account = bank.ref("/bank/plain", Account)
                    account.tell(Add(1))
                    assert await account.ask(Total()) == number
                    reach.transports[-1].is_cut = True

    run(work)
