"""Programs that want more of a system than they may: they are slowed or refused, and nobody else is."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import msgspec
import pytest

import holdfast as hf
from holdfast.actors.errors import ConnectionFull
from holdfast.actors.process.wire import frames
from holdfast.checkpoint.home import ask_recovery
from holdfast.cluster.lines import calls, far_line, inflow, lines
from holdfast.cluster.lines.far_line import AGAIN, NEW, FarLine
from holdfast.cluster.lines.line import NOBODY, Boot, LineBatch
from holdfast.events import ConnectionLimited, DeadLetter, KeptForSystem
from tests.cluster.reach import Account, Add, Large, News, Pay, Reach, Total, Wait, run, shop_of

FEW = hf.system.ConnectionLimits(messages=100, asks=20, subscriptions=3, ties=3, kept=10)


class Slow(hf.Actor):
    """Takes a second of virtual time for each message, and may ask back first."""

    def __init__(self, seen: list[int]) -> None:
        self.seen = seen

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        await asyncio.sleep(1.0)
        self.seen.append(message.amount)
        return message.amount


class AskBack(hf.Message[None]):
    whom: hf.ActorRef[Account]


class Back(hf.Actor):
    """Asks whom each message names, an actor of the other system, and is busy meanwhile."""

    def __init__(self) -> None:
        self.answers = 0

    @hf.on(AskBack)
    async def ask_back(self, message: AskBack) -> None:
        await message.whom.ask(Add(1), timeout=5.0)
        self.answers += 1

    @hf.on(Total)
    def total(self, message: Total) -> int:
        return self.answers


def line_of(system: hf.ActorSystem, bank: hf.system.SystemConnection) -> FarLine:
    found = system.lines.at(bank._call.far._owner.name)  # type: ignore[union-attr]
    assert found is not None
    return found


def test_who_tells_too_much_is_slowed_and_nobody_else_is() -> None:
    async def work(reach: Reach) -> None:
        seen: list[int] = []
        async with reach.bank(limits=FEW) as system, hf.connect("bank") as greedy, hf.connect("bank") as other:
            await system.start(hf.child("slow", hf.start(Slow, seen)))
            for number in range(300):
                greedy.ref("/bank/slow", Slow).tell(Add(number))
            for _ in range(100):
                assert await other.ref("/bank/plain", Account).ask(Add(1)) > 0
                assert system.ref("/bank/slow")._cell.host.load(system.ref("/bank/slow")._cell) <= FEW.messages + 1
            far = line_of(system, greedy)
            assert far.inflow.held
            held, waits = len(far.inflow.held), greedy._call.far.line._unnumbered  # type: ignore[union-attr]
            for number in range(1000):  # Now it has heard that it is to hold back.
                greedy.ref("/bank/slow", Slow).tell(Add(300 + number))
            await asyncio.sleep(10.0)
            assert len(waits) >= 1000
            assert len(far.inflow.held) <= held
            await asyncio.sleep(1400.0)
        assert seen == [*range(1300)]

    run(work)


def test_answers_go_past_messages_that_wait() -> None:
    """Each message makes its receiver ask back: if the answers waited behind the messages, none would come in time."""

    async def work(reach: Reach) -> None:
        async with (
            reach.bank(limits=FEW) as system,
            hf.ActorSystem("shop", log=False) as shop,
            hf.connect("bank", within=shop) as bank,
        ):
            await system.start(hf.child("back", hf.start(Back)))
            account = await shop.start(hf.child("account", hf.start(Account)))
            back = bank.ref("/bank/back", Back)
            for _ in range(1000):
                back.tell(AskBack(account))
            assert await back.ask(Total(), timeout=600.0) == 1000

    run(work)


@pytest.mark.parametrize("who", ["plain", "kept"])
def test_asks_over_the_limit_are_refused_at_once_and_may_come_later(who: str) -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank(limits=FEW) as system, hf.connect("bank") as bank, hf.connect("bank") as other:
            events = system.events()
            account = bank.ref(f"/bank/{who}", Account)
            first = [asyncio.ensure_future(account.ask(Wait(1.0), timeout=600.0)) for _ in range(FEW.asks)]
            await asyncio.sleep(0.1)
            for _ in range(3):
                with pytest.raises(ConnectionFull, match="20 of its asks have no outcome yet"):
                    await account.ask(Wait(1.0))
            assert await other.ref("/bank/plain", Account).ask(Total(), timeout=600.0) == 0
            await asyncio.gather(*first)
            assert await account.ask(Total(), timeout=600.0) == 0
            limited = await events.until(ConnectionLimited, timeout=1.0)
            assert limited.what == "asks"

    run(work)


def test_asks_that_have_run_out_do_not_count() -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank(limits=FEW), hf.connect("bank") as bank:
            account = bank.ref("/bank/plain", Account)
            for _ in range(5):
                asks = [account.ask(Wait(1000.0), timeout=1.0) for _ in range(FEW.asks)]
                for done in await asyncio.gather(*asks, return_exceptions=True):
                    assert isinstance(done, hf.AskTimeout), done
                await asyncio.sleep(0.1)

    run(work)


class Listener(hf.Actor):
    """Watches as often as it is told to, and tells of each DOWN."""

    def __init__(self, whom: hf.ActorRef[Account], heard: list[str]) -> None:
        self._whom, self._heard = whom, heard

    @hf.on(Add)
    def watch(self, message: Add) -> int:
        for _ in range(message.amount):
            self.ctx.monitor(self._whom)
        return message.amount

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self._heard.append(str(reason))


def test_who_subscribes_and_watches_too_much_is_refused_and_told_so() -> None:
    async def work(reach: Reach) -> None:
        heard: list[str] = []
        async with (
            reach.bank(limits=FEW) as system,
            hf.ActorSystem("shop", log=False) as shop,
            hf.connect("bank", within=shop) as bank,
        ):
            events = shop.events()
            account = bank.ref("/bank/plain", Account)
            listener = await shop.start(hf.child("listener", hf.start(Listener, account, heard)))
            for number in range(100):
                bank.subscribe(f"/topic{number}", listener)
                bank.subscribe(f"/topic{number}", listener)  # Twice is once.
            await listener.ask(Add(100))
            assert await account.ask(Total()) == 0  # What was sent before it has arrived.
            assert system._node.topics.names() == ["/topic0", "/topic1", "/topic2"]
            assert (await events.until(ConnectionLimited, timeout=1.0)).what == "subscriptions"
            assert (await events.until(ConnectionLimited, timeout=1.0)).what == "ties"
            await asyncio.sleep(0.1)
            assert len(heard) == 97
            assert "bank" in heard[0]
            for number in range(100):
                bank.unsubscribe(f"/topic{number}", listener)
            bank.subscribe("/later", listener)
            assert await account.ask(Total()) == 0
            assert system._node.topics.names() == ["/later"]

    run(work)


class Hostile:
    """A program that speaks the language of lines, and keeps to nothing."""

    def __init__(self, reach: Reach, name: str, token: str = "ff") -> None:
        self._transport = reach.post.transport()
        self.name, self.boot, self.bank = name, Boot(5, token), NOBODY
        self.sent = 0
        self.line = self.to_line = 0
        self.heard: list[LineBatch] = []

    def begin_anew(self) -> None:
        self.bank, self.sent, self.line, self.to_line = NOBODY, 0, self.line + 1, 0

    async def greet(self) -> None:
        await self._transport.hear(self._transport.own_place(), self._hear)
        self._send(())
        await asyncio.sleep(0.1)

    async def beat(self, *, takes: bool) -> None:
        while True:
            self._send((), 1000 if takes else 0)
            await asyncio.sleep(1.0)

    def _hear(self, data: bytes, back: str) -> None:
        batch = msgspec.msgpack.decode(data, type=LineBatch)
        if self.bank == NOBODY:
            self.bank, self.to_line = batch.boot, batch.line
        if batch.items:
            self.heard.append(batch)

    def send(self, *made: frames.Frame) -> None:
        self._send(tuple(NEW + msgspec.msgpack.encode(one) for one in made))
        self.sent += len(made)

    def _send(self, items: tuple[bytes, ...], got: int = 0) -> None:
        batch = LineBatch(self.name, self.boot, self.bank, got, self.sent + 1, items, "", self.line, self.to_line)
        self._transport.post("inbox of bank", msgspec.msgpack.encode(batch), self._transport.own_place())


def body_of(message: hf.Message[Any]) -> msgspec.Raw:
    return msgspec.Raw(msgspec.msgpack.encode(message))


def name_of(kind: type[hf.Message[Any]]) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def ask_of(number: int, message: hf.Message[Any], to: str = "/bank/plain", kind: int = 0) -> frames.Ask:
    return frames.Ask(
        number, to, f"{type(message).__module__}:{type(message).__qualname__}", body_of(message), 60.0, kind
    )


def test_who_does_not_hold_back_loses_its_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(far_line, "MOST_HELD", 1 << 20)

    async def work(reach: Reach) -> None:
        async with reach.bank(limits=FEW) as system, hf.connect("bank") as other:
            events = system.events()
            await system.start(hf.child("slow", hf.start(Slow, [])))
            evil = Hostile(reach, "evil")
            await evil.greet()
            far = system.lines.at("evil")
            assert far is not None
            name = name_of(Add)
            for _ in range(100):
                evil.send(*(frames.Tell("/bank/slow", name, body_of(Add(1))) for _ in range(500)))
                assert far.inflow.held_bytes <= 2 << 20
                await asyncio.sleep(0.01)
                assert await other.ref("/bank/plain", Account).ask(Total()) == 0
            limited = await events.until(ConnectionLimited, timeout=1.0)
            assert (limited.address, limited.what) == ("/evil", "line")
            assert system.lines.at("evil") is not far

    run(work)


def test_who_never_takes_its_outcomes_gets_no_more_and_then_loses_its_line() -> None:
    async def work(reach: Reach) -> None:
        few = hf.system.ConnectionLimits(asks=1000, message_bytes=1 << 20)
        async with reach.bank(limits=few) as system, hf.connect("bank") as other:
            evil = Hostile(reach, "evil")
            await evil.greet()
            far = system.lines.at("evil")
            assert far is not None
            assert far.line is not None
            for number in range(200):
                evil.send(ask_of(number, Large(b"x" * 50_000)))
                await asyncio.sleep(0.05)
                assert await other.ref("/bank/plain", Account).ask(Total()) == 0
                assert far.line.waiting_bytes < 2 << 20
            assert far.line.waiting_bytes > 1 << 20

    run(work)


def test_who_takes_nothing_of_what_it_is_told_loses_its_line() -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank() as system:
            evil = Hostile(reach, "evil")
            await evil.greet()
            far = system.lines.at("evil")
            assert far is not None
            beats = asyncio.ensure_future(evil.beat(takes=False))
            for _ in range(20):
                far.stand_in("/evil/ear").ref.tell(News("x" * (1 << 20)))
            await asyncio.sleep(5.0)
            assert not far.is_closed
            await asyncio.sleep(10.0)
            assert far.is_closed
            beats.cancel()

    run(work)


@pytest.mark.parametrize("is_there", [True, False])
def test_who_cannot_be_reached_is_not_blamed_for_what_it_does_not_take(is_there: bool) -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank() as system:
            evil = Hostile(reach, "evil")
            await evil.greet()
            evil.send(frames.Command("/evil/ear", "subscribe", {"topic": "/news"}))
            await asyncio.sleep(0.1)
            beats = asyncio.ensure_future(evil.beat(takes=True)) if is_there else None
            events = system.events()
            async with asyncio.timeout(60.0):
                await system.publish("/news", News("x"))
            assert any(isinstance(event, ConnectionLimited) for event in events.take()) is is_there
            assert system.lines.at("evil") is None
            if beats is not None:
                beats.cancel()

    run(work)


@pytest.mark.parametrize("takes", [False, True], ids=["takes nothing", "accepts nothing"])
def test_who_takes_nothing_of_what_is_published_holds_nobody_up_for_long(takes: bool) -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank() as system, hf.connect("bank") as other:
            evil = Hostile(reach, "evil")
            await evil.greet()
            evil.send(frames.Command("/evil/ear", "subscribe", {"topic": "/news"}))
            await asyncio.sleep(0.1)
            assert system._node.topics.names() == ["/news"]
            beats = asyncio.ensure_future(evil.beat(takes=takes))  # It is there.
            async with asyncio.timeout(60.0):
                for _ in range(30):
                    await system.publish("/news", News("x" * (1 << 20)))
            beats.cancel()
            assert await other.ref("/bank/plain", Account).ask(Total()) == 0
            assert system.lines.at("evil") is None
            assert system._node.topics.names() == []

    run(work)


def test_whoever_only_greets_keeps_nobody_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calls, "MOST_CALLERS", 10)

    async def work(reach: Reach) -> None:
        async with reach.bank() as system, hf.connect("bank") as first:
            for number in range(100):
                await Hostile(reach, f"client~{number:x}", f"{number:x}").greet()
            async with hf.connect("bank") as second:
                assert await second.ref("/bank/plain", Account).ask(Add(1)) == 1
            assert await first.ref("/bank/plain", Account).ask(Total()) == 1
            assert len(system.lines._lines) <= 10

    run(work)


def test_names_of_systems_are_not_taken_note_of_for_ever(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(calls, "MOST_SYSTEMS", 3)

    async def work(reach: Reach) -> None:
        async with reach.bank(tmp_path / "bank.db") as system, hf.connect("bank") as client:
            for number in range(10):
                await Hostile(reach, f"evil{number}").greet()
            assert [one.system for one in system.connected() if one.system.startswith("evil")] == [
                "evil0",
                "evil1",
                "evil2",
            ]
            with pytest.raises(hf.Unreachable):
                async with hf.ActorSystem("shop", log=False) as shop, hf.connect("bank", within=shop, timeout=2.0):
                    pass
            await asyncio.sleep(lines.FORGET_SECONDS + 2.0)
            await system.drop_kept("evil1")
            async with hf.ActorSystem("shop", log=False) as shop, hf.connect("bank", within=shop) as bank:
                assert await bank.ref("/bank/plain", Account).ask(Add(1)) == 1
            assert await client.ref("/bank/plain", Account).ask(Total()) == 1
            with pytest.raises(hf.SpecError, match="no system of that name was ever connected"):
                await system.drop_kept("nobody")

    run(work)


def test_what_is_kept_for_a_system_that_stays_away_is_bounded_and_can_be_dropped(tmp_path: Path) -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank_stack(tmp_path / "bank.db") as bank:
            async with shop_of(tmp_path / "shop.db", limits=FEW) as clerk:
                shop: Any = clerk._cell.node
                letters, kept = shop.events.listen(), shop.events.listen()
                bank.transport.is_cut = True
                for _ in range(25):
                    await clerk.ask(Pay(1, "tell"))
                assert [(await kept.until(KeptForSystem)).is_full for _ in range(2)] == [False, True]
                letter = await letters.until(DeadLetter)
                assert "10 messages" in letter.why
                assert shop.numbers.dead_letters == 15
            # The next run of the program has it still, and the operator drops it.
            async with hf.ActorSystem("shop", store=f"sqlite:{tmp_path / 'shop.db'}", log=False) as again:
                assert [(one.system, one.is_connected, one.kept) for one in again.connected()] == [("bank", False, 10)]
                assert await again.drop_kept("bank") == 10
                assert again.connected() == []
                assert again.dead_letters == 10
            await asyncio.sleep(10.0)  # Nothing of the first run is on its way any more.
            bank.transport.is_cut = False
            async with shop_of(tmp_path / "shop.db", limits=FEW) as clerk:
                await clerk.ask(Pay(1, "tell"))
                await asyncio.sleep(1.0)
                assert await bank.total() == 1

    run(work)


@pytest.mark.parametrize("name", ["messages", "asks", "kept_bytes"])
def test_limits_are_whole_numbers_from_1_on(name: str) -> None:
    for wrong in (0, -1, 1.5, True, "many"):
        with pytest.raises(hf.SpecError, match=f"{name} must be a whole number from 1 on"):
            hf.system.ConnectionLimits(**{name: wrong})  # type: ignore[arg-type]
    with pytest.raises(hf.SpecError, match="connection_limits must be a ConnectionLimits"):
        hf.ActorSystem("app", connection_limits=10)  # type: ignore[arg-type]


def test_one_program_is_taken_from_for_so_long_at_a_time() -> None:
    """A batch of very many items does not hold up the loop: others have their turn in between."""

    async def work(reach: Reach) -> None:
        async with reach.bank() as system, hf.connect("bank") as bank:
            account = bank.ref("/bank/plain", Account)
            assert await account.ask(Total()) == 0
            far = line_of(system, bank)
            rounds: list[int] = []
            take, loop, count = far._take_now, asyncio.get_running_loop(), 0

            def counted(data: bytes) -> None:
                nonlocal count
                if count == 0:
                    loop.call_soon(end_round)
                count += 1
                take(data)

            def end_round() -> None:
                nonlocal count
                rounds.append(count)
                count = 0

            far._take_now = counted  # type: ignore[method-assign]
            for _ in range(2000):
                account.tell(Add(1))
            assert await account.ask(Total()) == 2000
            assert max(rounds) <= 2 * inflow.SLICE  # The next round may begin just before the count.
            assert sum(rounds) >= 2000

    run(work)


def test_outcomes_are_not_kept_for_ever_for_programs_that_never_take_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """They open a connection, ask a recorded actor, and are gone. Nothing is done twice for those that come back."""
    monkeypatch.setattr(ask_recovery, "MOST_GONE", 5)

    async def work(reach: Reach) -> None:
        async with reach.bank_stack(tmp_path / "bank.db") as bank:
            evil = [Hostile(reach, f"client~{number:x}", f"a{number:x}") for number in range(20)]
            for one in evil:
                await one.greet()
                one.send(ask_of(1, Add(1), "/bank/kept"))
                await asyncio.sleep(0.1)
            await asyncio.sleep(lines.FORGET_SECONDS + 5.0)
            assert await bank.total() == 20
            for _ in range(2):
                far = bank.system._homes.far
                assert sum(len(mail.answers) for mail in far._mail.values()) == 5
                assert len(far._forgotten) == 15
                await bank.again()
            again = msgspec.msgpack.encode(ask_of(1, Add(1), "/bank/kept"))
            for one in (evil[0], evil[-1]):
                one.begin_anew()
                await one.greet()
                one._send((AGAIN + again,))
                await asyncio.sleep(1.0)
            first, last = (msgspec.msgpack.decode(one.heard[-1].items[-1][1:]) for one in (evil[0], evil[-1]))
            assert (first[0], first[3].rpartition(".")[2]) == (4, "ConnectionLost")
            assert last == [3, 1, 20]
            assert await bank.total() == 20

    run(work)
