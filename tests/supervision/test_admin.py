"""Admin calls: messages to a supervisor's ref, with typed refusals (otp.md 1.9)."""

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.supervision.admin import (
    AlreadyPresent,
    AlreadyStarted,
    ChildBusy,
    ChildInfo,
    DeleteChild,
    NoSuchChild,
    RestartChild,
    StartChild,
    TerminateChild,
    WhichChildren,
)

virtual = pytest.mark.asyncio(loop_factories=["virtual"])


class Boom(hf.Message): ...


class Life(hf.Message[int]): ...


class Switch:
    """Whether starts succeed."""

    def __init__(self) -> None:
        self.is_broken = False


class Kid(hf.Actor):
    partner: hf.Binding[hf.Actor]

    def __init__(self, switch: Switch | None = None, *, late: bool = False) -> None:
        self.switch, self.late = switch, late
        self._check(not late)

    async def on_start(self, restored: bool) -> None:
        await asyncio.sleep(0)
        self._check(self.late)

    def _check(self, here: bool) -> None:
        if here and self.switch is not None and self.switch.is_broken:
            raise OSError("broken")

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Life)
    def life(self, message: Life) -> int:
        return self.ctx.life


def kid(id: str, *args: Any, **options: Any) -> hf.ChildSpec:
    return hf.child(id, hf.start(Kid, *args), **options)


async def begin(system: hf.ActorSystem, *children: hf.ChildSpec, **options: Any) -> hf.ActorRef[hf.Supervisor]:
    return await system.start(hf.supervisor("top", children=children, **options))


async def states(top: hf.ActorRef[hf.Supervisor]) -> dict[str, str]:
    return {info.id: info.state for info in await top.ask(WhichChildren())}


async def test_which_children_tells_all_in_start_order() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, kid("b"), hf.supervisor("a"), kid("c", restart="transient"))
        await top.ask(TerminateChild("c"))
        assert await top.ask(WhichChildren()) == [
            ChildInfo("b", "running", "/app/top/b", False),
            ChildInfo("a", "running", "/app/top/a", True),
            ChildInfo("c", "stopped", "/app/top/c", False),
        ]


async def test_a_child_can_be_started_stopped_started_again_stopped_and_forgotten() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        ref = await top.ask(StartChild(kid("x")))
        assert ref == system.ref("/app/top/x", Kid)
        assert await ref.ask(Life()) == 1
        await top.ask(TerminateChild("x"))
        assert await states(top) == {"x": "stopped"}
        with pytest.raises(hf.errors.NoSuchActor):
            system.ref("/app/top/x", Kid)
        again = await top.ask(RestartChild("x"))
        assert await again.ask(Life()) == 1
        assert await ref.ask(Life()) == 1  # The ref from before is good again.
        await top.ask(TerminateChild("x"))
        await top.ask(DeleteChild("x"))
        assert await states(top) == {}
        await top.ask(StartChild(kid("x")))
        assert await states(top) == {"x": "running"}


async def test_a_child_that_was_stopped_and_started_by_hand_is_still_supervised() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, kid("x"), intensity=9)
        for _ in range(3):
            await top.ask(TerminateChild("x"))
            ref = await top.ask(RestartChild("x"))
            for life in (2, 3):
                ref.tell(Boom())
                assert await ref.ask(Life()) == life


async def test_what_does_not_fit_is_refused_by_type_and_changes_nothing() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, kid("up"), kid("down"))
        await top.ask(TerminateChild("down"))
        up = AlreadyStarted("up", system.ref("/app/top/up", Kid))
        refusals: list[tuple[hf.Message[Any], hf.Refusal, str]] = [
            (StartChild(kid("up")), up, "child 'up' runs already, at /app/top/up: use that one"),
            (StartChild(kid("down")), AlreadyPresent("down"), "child 'down' is known already: start it"),
            (RestartChild("up"), ChildBusy("up", "running"), "child 'up' is running: stop it first"),
            (DeleteChild("up"), ChildBusy("up", "running"), "child 'up' is running: stop it first"),
            (TerminateChild("nobody"), NoSuchChild("nobody"), "there is no child 'nobody': WhichChildren"),
            (RestartChild("nobody"), NoSuchChild("nobody"), "there is no child 'nobody'"),
            (DeleteChild("nobody"), NoSuchChild("nobody"), "there is no child 'nobody'"),
        ]
        for message, refusal, text in refusals:
            with pytest.raises(type(refusal), match=text) as caught:
                await top.ask(message)
            assert caught.value == refusal
        assert await states(top) == {"up": "running", "down": "stopped"}


async def test_terminating_twice_is_no_error() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, kid("x"))
        await top.ask(TerminateChild("x"))
        await top.ask(TerminateChild("x"))
        assert await states(top) == {"x": "stopped"}


async def test_a_temporary_child_is_forgotten_when_it_is_stopped() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, kid("x", restart="temporary"))
        await top.ask(TerminateChild("x"))
        assert await states(top) == {}
        with pytest.raises(NoSuchChild):
            await top.ask(RestartChild("x"))


async def test_something_that_is_no_spec_is_refused_and_the_supervisor_lives() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, kid("x"))
        with pytest.raises(hf.SpecError, match="StartChild: takes child"):
            await top.ask(StartChild("x"))
        assert await system.ref("/app/top/x", Kid).ask(Life()) == 1


@pytest.mark.parametrize("late", [False, True], ids=["__init__", "on_start"])
async def test_a_start_that_fails_leaves_nothing_behind(late: bool) -> None:
    """otp.md 1.9: the spec is discarded, the address is free."""
    switch = Switch()
    switch.is_broken = True
    broken = hf.child("x", hf.start(Kid, switch, late=late))
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, intensity=0)
        with pytest.raises(hf.StartFailed, match="/app/top/x could not be started: OSError: broken"):
            await top.ask(StartChild(broken))
        assert await states(top) == {}
        assert system.tree() == ["/app", "/app/top"]
        switch.is_broken = False
        assert await (await top.ask(StartChild(broken))).ask(Life()) == 1


@pytest.mark.parametrize("late", [False, True], ids=["__init__", "on_start"])
async def test_a_restart_by_hand_that_fails_keeps_the_spec_and_frees_the_address(late: bool) -> None:
    switch = Switch()
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, hf.child("x", hf.start(Kid, switch, late=late)), intensity=0)
        await top.ask(TerminateChild("x"))
        switch.is_broken = True
        with pytest.raises(hf.StartFailed, match="OSError: broken"):
            await top.ask(RestartChild("x"))
        assert await states(top) == {"x": "stopped"}
        assert system.tree() == ["/app", "/app/top"]
        await top.ask(DeleteChild("x"))
        switch.is_broken = False
        ref = await top.ask(StartChild(kid("x")))
        assert await ref.ask(Life()) == 1


async def test_a_start_with_a_binding_to_nobody_fails_and_leaves_nothing_behind() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        bound = kid("x", bindings={"partner": "/app/top/partner"})
        with pytest.raises(hf.StartFailed, match="binding 'partner': there is no actor at /app/top/partner"):
            await top.ask(StartChild(bound))
        assert system.tree() == ["/app", "/app/top"]
        await top.ask(StartChild(kid("partner")))
        await top.ask(StartChild(bound))
        assert await states(top) == {"partner": "running", "x": "running"}


@virtual
async def test_deleting_a_child_that_its_group_left_stopped_frees_its_address() -> None:
    """After a failed attempt of one_for_all the later children are stopped, with their queues, until the retry."""
    switch = Switch()
    slow = hf.Backoff(initial=60.0, maximum=60.0, jitter=0.0)
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, kid("a"), kid("b", switch, backoff=slow), kid("c"), strategy="one_for_all")
        ref = system.ref("/app/top/c", Kid)
        switch.is_broken = True
        system.ref("/app/top/a", Kid).tell(Boom())
        await system._node.settled()
        assert await states(top) == {"a": "running", "b": "restarting", "c": "stopped"}
        waiting = ref.ask(Life())
        await top.ask(DeleteChild("c"))
        with pytest.raises(hf.ActorStopped):
            await waiting
        assert await (await top.ask(StartChild(kid("c")))).ask(Life()) == 1


async def test_admin_calls_do_not_count_as_restarts() -> None:
    """otp.md 1.6."""
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, kid("x"), intensity=0)
        for _ in range(10):
            await top.ask(TerminateChild("x"))
            await top.ask(RestartChild("x"))
        assert await states(top) == {"x": "running"}


async def test_children_added_by_hand_are_restarted_but_do_not_outlive_their_supervisor() -> None:
    """otp.md 1.2: dynamic children behave as static ones, and are lost when the supervisor itself is restarted."""
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, kid("static"), intensity=1)
        ref = await top.ask(StartChild(kid("dynamic")))
        ref.tell(Boom())
        assert await ref.ask(Life()) == 2
        ref.tell(Boom())  # One more than the intensity: the supervisor gives up, and the root starts it again.
        while (known := await children_of(system)) != {"static": "running"}:
            assert known in (
                {},
                {"static": "starting"},
                {"static": "running", "dynamic": "running"},
                {"static": "running", "dynamic": "stopped"},
            )
        with pytest.raises(hf.ActorStopped):
            await ref.ask(Life())


async def children_of(system: hf.ActorSystem) -> dict[str, str]:
    """What the supervisor tells; nothing while it is down."""
    await asyncio.sleep(0)
    try:
        return await states(system.ref("/app/top", hf.Supervisor))
    except hf.ActorStopped:
        return {}


@virtual
async def test_the_supervisor_answers_while_children_back_off() -> None:
    slow = hf.Backoff(initial=60.0, maximum=60.0, jitter=0.0)
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, kid("x", backoff=slow), kid("y", backoff=slow), intensity=9)
        for name in "xy":
            system.ref(f"/app/top/{name}", Kid).tell(Boom())
        await system._node.settled()
        assert await states(top) == {"x": "restarting", "y": "restarting"}
        with pytest.raises(AlreadyPresent):
            await top.ask(StartChild(kid("x")))
        with pytest.raises(ChildBusy):
            await top.ask(RestartChild("x"))
        with pytest.raises(ChildBusy):
            await top.ask(DeleteChild("x"))
        await top.ask(StartChild(kid("z")))
        await top.ask(TerminateChild("y"))
        assert asyncio.get_running_loop().time() == 0.0
        assert await states(top) == {"x": "restarting", "y": "stopped", "z": "running"}
        await asyncio.sleep(100.0)
        assert await states(top) == {"x": "running", "y": "stopped", "z": "running"}


async def test_counts_are_of_specs_and_of_who_runs() -> None:
    """otp.md 1.9: supervisors and workers count whether they run or not."""
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, kid("a"), kid("b"), hf.supervisor("c"), hf.dynamic("d"))
        assert await top.ask(hf.supervision.CountChildren()) == hf.supervision.ChildCounts(
            specs=4, active=4, supervisors=2, workers=2
        )
        for name in "bc":
            await top.ask(TerminateChild(name))
        assert await top.ask(hf.supervision.CountChildren()) == hf.supervision.ChildCounts(
            specs=4, active=2, supervisors=2, workers=2
        )


async def test_a_spec_comes_back_with_its_defaults() -> None:
    async with hf.ActorSystem(log=False) as system:
        spec = kid("a", restart="transient")
        top = await begin(system, spec)
        told = await top.ask(hf.supervision.GetChildSpec("a"))
        assert told == spec
        assert (told.restart, told.shutdown, told.is_supervisor) == ("transient", 5.0, False)
        with pytest.raises(NoSuchChild):
            await top.ask(hf.supervision.GetChildSpec("b"))


async def test_a_name_taken_by_somebody_else_is_told_as_it_is() -> None:
    """otp.md 1.9: a clash outside the supervisor's own list is passed through."""
    async with hf.ActorSystem(log=False) as system:
        system.spawn(hf.start(Kid), "x")
        with pytest.raises(hf.errors.NameTaken, match="/app/x"):
            await system.start(kid("x"))
        assert [info.id for info in await system._root_ref().ask(WhichChildren())] == []


async def test_calls_to_a_supervisor_that_is_not_there_say_so() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        await system.stop(top)
        for call in (WhichChildren(), StartChild(kid("x")), TerminateChild("x")):
            with pytest.raises(hf.ActorStopped):
                await top.ask(call)


@pytest.mark.parametrize(
    ("order", "text"),
    [
        (TerminateChild("p"), "TerminateChild(id='p')"),
        (RestartChild("p", running=True), "RestartChild(id='p', running=True)"),
        (StartChild(args=(1,), id="p"), "StartChild(args=(1,), id='p')"),
        (DeleteChild("p", erase=False), "DeleteChild(id='p', erase=False)"),
    ],
)
def test_the_text_of_an_order_has_what_was_given(order: hf.Message[Any], text: str) -> None:
    assert repr(order) == text


def test_the_text_of_a_spec_has_what_a_user_can_say() -> None:
    text = repr(hf.child("kid", hf.start(Kid)))
    assert "start=Start(kind=<class 'tests.supervision.test_admin.Kid'>)" in text
    assert not [name for name in ("begins_with", "comes_back", "made_up", "late", "unless") if f"{name}=" in text]
