"""Probes: what they receive, in order; what they answer; and what they say when something else came (otp.md W14)."""

import asyncio

import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, Probe, Unexpected, probe


class Ping(hf.Message[str]):
    n: int = 0


class Pong(hf.Message):
    n: int = 0


class Forward(hf.Message[str]):
    """Ask the probe, and answer what it says."""

    to: hf.ActorRef


class Busy(hf.Refusal):
    for_seconds: float


class Player(hf.Actor):
    @hf.on(Pong)
    def pong(self, message: Pong) -> None:
        if self.ctx.sender is not None:
            self.ctx.sender.tell(Pong(message.n + 1))

    @hf.on(Ping)
    def ping(self, message: Ping) -> str:
        raise ValueError("boom")

    @hf.on(Forward)
    async def forward(self, message: Forward) -> str:
        return await message.to.ask(Ping(7))


async def test_messages_are_expected_in_the_order_in_which_they_came(probe: Probe) -> None:
    for n in range(3):
        probe.ref.tell(Pong(n))
    assert await probe.expect(Pong) == Pong(0)
    assert await probe.expect(Pong(1)) == Pong(1)
    assert probe.waiting == () or probe.waiting == (Pong(2),)
    await probe.expect(Pong(2))
    await probe.expect_no_message()


async def test_what_else_came_is_listed(probe: Probe) -> None:
    probe.ref.tell(Pong(1))
    asked = probe.ref.ask(Ping(2))
    await probe.expect(Pong)
    with pytest.raises(Unexpected) as failure:
        await probe.expect(Pong(3))
    assert str(failure.value).splitlines() == [
        f"{probe.path} expected Pong(n=3), got Ping(n=2) (asked)",
        "received so far:",
        "  1. Pong(n=1) (told)",
        "  2. Ping(n=2) (asked)",
    ]
    asked.cancel()


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_nothing_comes_in_time(probe: Probe) -> None:
    with pytest.raises(Unexpected, match=r"expected .*Pong, got nothing in 3600 s\nit has received nothing"):
        await probe.expect(Pong, timeout=3600.0)
    assert asyncio.get_running_loop().time() == 3600.0


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_no_message_within_a_time_or_until_idle(probe: Probe) -> None:
    loop = asyncio.get_running_loop()
    loop.call_later(10.0, probe.ref.tell, Pong())
    await probe.expect_no_message()
    await probe.expect_no_message(within=9.0)
    with pytest.raises(Unexpected, match=r"expected no message, got Pong\(n=0\)"):
        await probe.expect_no_message(within=2.0)
    assert loop.time() == 10.0


async def test_no_message_waits_for_what_is_on_its_way(actor_system: GuardedSystem, probe: Probe) -> None:
    player = actor_system.spawn(hf.start(Player))
    probe.tell(player, Pong(1))
    with pytest.raises(Unexpected, match=r"expected no message, got Pong\(n=2\) \(told by /app/"):
        await probe.expect_no_message()


async def test_fishing_drops_what_comes_before(probe: Probe) -> None:
    for n in range(5):
        probe.ref.tell(Pong(n))
    assert await probe.fish(lambda message: message.n == 3) == Pong(3)
    assert await probe.fish(Pong) == Pong(4)
    with pytest.raises(Unexpected, match=r"got nothing in 0.01 s\nreceived so far:\n  1. Pong"):
        await probe.fish(Ping, timeout=0.01)


async def test_a_probe_sends_as_itself(actor_system: GuardedSystem, probe: Probe) -> None:
    player = actor_system.spawn(hf.start(Player), "player")
    probe.tell(player, Pong(1))
    await probe.expect(Pong(2))
    assert probe.sender == player


async def test_a_probe_answers_and_refuses(actor_system: GuardedSystem, probe: Probe) -> None:
    player = actor_system.spawn(hf.start(Player))
    answer = player.ask(Forward(probe.ref))
    await probe.expect(Ping(7))
    assert not answer.done()
    probe.reply("hello")
    assert await answer == "hello"

    answer = player.ask(Forward(probe.ref))
    await probe.expect(Ping)
    probe.refuse(Busy(2.0))
    with pytest.raises(Busy):
        await answer


async def test_only_an_ask_can_be_answered(probe: Probe) -> None:
    with pytest.raises(hf.HoldfastError, match="no message was expected yet"):
        probe.reply(1)
    probe.ref.tell(Pong())
    await probe.expect(Pong)
    with pytest.raises(hf.HoldfastError, match=r"Pong\(n=0\) \(told\) is no ask"):
        probe.reply(1)


async def test_a_probe_hears_of_the_end_of_a_life(actor_system: GuardedSystem, probe: Probe) -> None:
    actor_system.expect_crashes(1)
    player = await actor_system.start(hf.child("player", hf.start(Player), restart="transient"))
    probe.monitor(player)
    probe.watch(player)
    probe.link(player)
    player.tell(Ping())
    await probe.expect_exit(player, hf.Crash)
    down = await probe.expect_down(player, hf.Crash)
    assert not down.recovering
    await actor_system.stop(player)
    assert (await probe.expect_down(player, hf.SHUTDOWN)).reason.is_clean


async def test_another_end_than_the_expected_one_is_told(actor_system: GuardedSystem, probe: Probe) -> None:
    player = actor_system.spawn(hf.start(Player), "player")
    probe.watch(player)
    player.kill()
    with pytest.raises(Unexpected, match=r"expected DOWN of /app/player for Crash, got DOWN of /app/player: killed"):
        await probe.expect_down(player, hf.Crash)


async def test_a_probe_subscribes_to_a_topic(actor_system: GuardedSystem, probe: Probe) -> None:
    probe.subscribe("/news")
    await actor_system.publish("/news", Pong(5))
    await probe.expect(Pong(5))
    await probe.stop()
    await actor_system.publish("/news", Pong(6))  # No dead letter: it is no subscriber any more.


async def test_several_probes_have_names_of_their_own(actor_system: GuardedSystem) -> None:
    one, other = probe(actor_system, "one"), probe(actor_system, "other")
    one.tell(other.ref, Pong())
    await other.expect(Pong)
    assert (one.path, other.sender) == ("/app/one", one.ref)
