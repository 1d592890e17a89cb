"""Who is stopped and started again, and in which order (otp.md 1.2 to 1.4).

The log tells starts as `+a` and stops in good order as `-a`; a kill leaves no trace.
"""

from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import ChildRestarted, SupervisorGaveUp
from holdfast.supervision.admin import RestartChild, TerminateChild, WhichChildren
from holdfast.supervision.spec import Restart, Strategy


class Boom(hf.Message): ...


class Leave(hf.Message):
    reason: hf.ExitReason = hf.NORMAL


class Life(hf.Message[int]): ...


class Kid(hf.Actor):
    def __init__(self, log: list[str]) -> None:
        self.name = self.ctx.path.rpartition("/")[2]
        self.log = log
        log.append(f"+{self.name}")

    def on_stop(self, reason: hf.ExitReason) -> None:
        self.log.append(f"-{self.name}")

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Leave)
    def leave(self, message: Leave) -> None:
        self.ctx.stop(message.reason)

    @hf.on(Life)
    def life(self, message: Life) -> int:
        return self.ctx.life


class Family:
    """Four children, a to d, under one supervisor."""

    def __init__(self, system: hf.ActorSystem, log: list[str]) -> None:
        self.system, self.log = system, log
        self.top = system.ref("/app/top", hf.Supervisor)

    @classmethod
    async def start(
        cls, system: hf.ActorSystem, strategy: Strategy, intensity: int = 9, **restart: Restart
    ) -> "Family":
        log: list[str] = []
        children = [hf.child(name, hf.start(Kid, log), restart=restart.get(name, "permanent")) for name in "abcd"]
        await system.start(hf.supervisor("top", strategy=strategy, intensity=intensity, children=children))
        assert log == ["+a", "+b", "+c", "+d"]
        return cls(system, log)

    def ref(self, name: str) -> hf.ActorRef[Kid]:
        return self.system.ref(f"/app/top/{name}", Kid)

    async def after(self, name: str, message: hf.Message[Any]) -> str:
        """What was started and stopped because of a message to one child."""
        self.log.clear()
        self.ref(name).tell(message)
        await self.system._node.settled()
        return " ".join(self.log)

    async def after_kill(self, *names: str) -> str:
        """What was started and stopped because these were killed at once."""
        self.log.clear()
        for name in names:
            self.ref(name).kill()
        await self.system._node.settled()
        return " ".join(self.log)

    async def states(self) -> dict[str, str]:
        return {info.id: info.state for info in await self.top.ask(WhichChildren())}

    async def lives(self) -> list[int]:
        return [await self.ref(name).ask(Life()) for name in "abcd"]


@pytest.mark.parametrize(
    ("strategy", "failed", "expected", "lives"),
    [
        ("one_for_one", "b", "-b +b", [1, 2, 1, 1]),
        ("one_for_all", "b", "-b -d -c -a +a +b +c +d", [2, 2, 2, 2]),
        ("one_for_all", "a", "-a -d -c -b +a +b +c +d", [2, 2, 2, 2]),
        ("rest_for_one", "b", "-b -d -c +b +c +d", [1, 2, 2, 2]),
        ("rest_for_one", "d", "-d +d", [1, 1, 1, 2]),
    ],
)
async def test_a_crash_restarts_those_the_strategy_names(
    strategy: Strategy, failed: str, expected: str, lives: list[int]
) -> None:
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, strategy)
        assert await family.after(failed, Boom()) == expected
        assert await family.lives() == lives


async def test_children_are_stopped_in_reverse_when_all_is_over() -> None:
    async with hf.ActorSystem(log=False) as system:
        log = (await Family.start(system, "one_for_one")).log
    assert log == ["+a", "+b", "+c", "+d", "-d", "-c", "-b", "-a"]


@pytest.mark.parametrize(
    ("restart", "message", "expected", "state"),
    [
        ("permanent", Leave(), "-b +b", "running"),
        ("permanent", Leave(hf.SHUTDOWN), "-b +b", "running"),
        ("permanent", Boom(), "-b +b", "running"),
        ("transient", Leave(), "-b", "stopped"),
        ("transient", Leave(hf.Shutdown("done")), "-b", "stopped"),
        ("transient", Leave(hf.KILLED), "-b +b", "running"),
        ("transient", Boom(), "-b +b", "running"),
        ("temporary", Leave(), "-b", None),
        ("temporary", Boom(), "-b", None),
    ],
)
async def test_the_restart_type_decides_by_the_reason(
    restart: Restart, message: hf.Message[Any], expected: str, state: str | None
) -> None:
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, "one_for_one", b=restart)
        assert await family.after("b", message) == expected
        assert (await family.states()).get("b") == state


@pytest.mark.parametrize("strategy", ["one_for_all", "rest_for_one"])
async def test_a_child_that_needs_no_restart_leaves_its_siblings_alone(strategy: Strategy) -> None:
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, strategy, a="temporary", b="transient")
        assert await family.after("a", Boom()) == "-a"
        assert await family.after("b", Leave()) == "-b"
        assert await family.states() == {"b": "stopped", "c": "running", "d": "running"}


@pytest.mark.parametrize("strategy", ["one_for_one", "one_for_all", "rest_for_one"])
async def test_a_clean_end_of_a_permanent_child_counts_as_a_restart(strategy: Strategy) -> None:
    """otp.md 1.3: intensity 0 and a permanent child that exits normally: the supervisor gives up."""
    async with hf.ActorSystem(log=False) as system:
        with system.events() as events:
            family = await Family.start(system, strategy, intensity=0)
            await family.after("c", Leave())
            assert [event.child for event in events.take() if isinstance(event, SupervisorGaveUp)] == ["c"]


@pytest.mark.parametrize("strategy", ["one_for_all", "rest_for_one"])
async def test_a_temporary_sibling_stopped_with_the_group_vanishes(strategy: Strategy) -> None:
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, strategy, c="temporary")
        gone = family.ref("c")
        assert await family.after("a", Boom()) == "-a -d -c -b +a +b +d"
        assert await family.states() == dict.fromkeys("abd", "running")
        with pytest.raises(hf.ActorStopped):
            await gone.ask(Life())


async def test_one_for_all_starts_siblings_that_were_stopped_by_hand() -> None:
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, "one_for_all")
        await family.top.ask(TerminateChild("a"))
        await family.top.ask(TerminateChild("d"))
        assert await family.after("b", Boom()) == "-b -c +a +b +c +d"
        assert await family.states() == dict.fromkeys("abcd", "running")


async def test_rest_for_one_starts_only_later_siblings_that_were_stopped_by_hand() -> None:
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, "rest_for_one")
        await family.top.ask(TerminateChild("a"))
        await family.top.ask(TerminateChild("d"))
        assert await family.after("b", Boom()) == "-b -c +b +c +d"
        assert (await family.states())["a"] == "stopped"


async def test_one_for_all_starts_a_transient_that_had_finished() -> None:
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, "one_for_all", d="transient")
        assert await family.after("d", Leave()) == "-d"
        assert await family.after("a", Boom()) == "-a -c -b +a +b +c +d"


async def test_one_for_one_leaves_siblings_that_were_stopped_by_hand() -> None:
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, "one_for_one")
        await family.top.ask(TerminateChild("a"))
        assert await family.after("b", Boom()) == "-b +b"
        assert (await family.states())["a"] == "stopped"


@pytest.mark.parametrize(("strategy", "starts"), [("one_for_all", "+a +b +c +d"), ("rest_for_one", "-d +b +c +d")])
async def test_siblings_that_die_together_are_one_restart(strategy: Strategy, starts: str) -> None:
    """As in OTP, where the EXITs of children that are being stopped anyway are flushed."""
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, strategy, intensity=1)
        names = "abcd" if strategy == "one_for_all" else "bc"
        with system.events() as events:
            assert await family.after_kill(*names) == starts
            restarted = [event for event in events.take() if isinstance(event, ChildRestarted)]
        assert len(restarted) == 1
        assert await family.after_kill() == ""


async def test_in_one_for_one_each_death_counts() -> None:
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, "one_for_one", intensity=2)
        with system.events() as events:
            assert await family.after_kill("a", "b") == "+a +b"
            assert not [event for event in events.take() if isinstance(event, SupervisorGaveUp)]
            await family.after_kill("c")
            assert [event.child for event in events.take() if isinstance(event, SupervisorGaveUp)] == ["c"]


async def test_a_child_stopped_by_hand_and_started_again_keeps_its_place_in_the_order() -> None:
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, "rest_for_one")
        await family.top.ask(TerminateChild("b"))
        await family.top.ask(RestartChild("b"))
        assert await family.after("b", Boom()) == "-b -d -c +b +c +d"
