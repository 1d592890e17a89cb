"""`Ignore`: an actor that does not want to be started (otp.md 1.1, 1.2, 1.4, 1.9, 1.14)."""

import pytest

import holdfast as hf
from holdfast.supervision.spec import Isolation, Restart
from tests.supervision.family import Boom, Family, Kid, Plan, kid

LATE = pytest.mark.parametrize("late", [False, True], ids=["__init__", "on_start"])


@LATE
@pytest.mark.parametrize(("restart", "known"), [("permanent", True), ("transient", True), ("temporary", False)])
async def test_at_the_first_start_the_spec_is_kept_unless_it_is_temporary(
    restart: Restart, known: bool, late: bool
) -> None:
    plan = Plan()
    plan.todo["b"] = ["ignore"]
    async with hf.ActorSystem(log=False) as system:
        with system.events() as events:
            children = [kid(plan, "a"), kid(plan, "b", late=late, restart=restart), kid(plan, "c")]
            top = await system.start(hf.supervisor("top", children=children))
            told = events.take()
        family = Family(system, plan)
        assert plan.log[:3] == ["+a", "?b", "+c"]
        assert (await family.states()).get("b") == ("stopped" if known else None)
        counts = await top.ask(hf.supervision.CountChildren())
        assert (counts.specs, counts.active, counts.workers) == (3 if known else 2, 2, 3 if known else 2)
        assert "/app/top/b" not in system.tree()
        assert not [event for event in told if isinstance(event, (hf.events.ActorCrashed, hf.events.ChildStartFailed))]


@LATE
async def test_start_child_answers_none(late: bool) -> None:
    plan = Plan()
    plan.todo["b"] = ["ignore", "ignore"]
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan)
        assert await family.top.ask(hf.StartChild(kid(plan, "b", late=late))) is None
        assert await family.states() == {"b": "stopped"}
        assert await family.top.ask(hf.RestartChild("b")) is None
        assert await family.states() == {"b": "stopped"}
        assert await family.top.ask(hf.RestartChild("b")) == family.ref("b")
        plan.todo["c"] = ["ignore"]
        assert await family.top.ask(hf.StartChild(kid(plan, "c", late=late, restart="temporary"))) is None
        assert await family.states() == {"b": "running"}


@LATE
async def test_a_restart_that_ignores_leaves_the_spec_without_a_life(late: bool) -> None:
    """otp.md 1.4: the supervisor lives, and it is no failed attempt."""
    plan = Plan()
    plan.todo["a"] = [0.0, "ignore"]
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, kid(plan, "a", late=late), kid(plan, "b"), intensity=1)
        gone = family.ref("a")
        await family.after("a", Boom())
        assert await family.states() == {"a": "stopped", "b": "running"}
        with pytest.raises(hf.ActorStopped):
            await gone.ask(Boom())


@LATE
async def test_in_a_group_the_others_are_started_all_the_same(late: bool) -> None:
    plan = Plan()
    plan.todo["b"] = [0.0, "ignore"]
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(
            system, plan, *(kid(plan, name, late=late) for name in "abc"), strategy="one_for_all"
        )
        await family.after("c", Boom())
        assert await family.states() == {"a": "running", "b": "stopped", "c": "running"}


@LATE
async def test_a_dynamic_child_that_ignores_is_never_kept(late: bool) -> None:
    plan = Plan()
    plan.todo["a"] = ["ignore", 0.0, "ignore"]
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.dynamic("top"))
        family = Family(system, plan)
        assert await top.ask(hf.StartChild(kid(plan, "a", late=late))) is None
        assert await family.states() == {}
        assert await top.ask(hf.StartChild(kid(plan, "a", late=late))) == family.ref("a")
        await family.after("a", Boom())  # The restart ignores.
        assert await family.states() == {}
        assert system.tree() == ["/app", "/app/top"]


class Lazy(hf.Supervisor):
    """A supervisor that finds that it has nothing to do."""

    def init(self) -> hf.Plan:
        raise hf.Ignore


async def test_a_supervisor_whose_init_ignores_is_not_started() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, hf.child("lazy", hf.start(Lazy)), kid(plan, "b"))
        assert await family.states() == {"lazy": "stopped", "b": "running"}


async def test_a_start_by_the_system_answers_none_and_a_spawn_says_so() -> None:
    plan = Plan()
    plan.todo["a"] = ["ignore", "ignore"]
    async with hf.ActorSystem(log=False) as system:
        assert await system.start(kid(plan, "a", restart="temporary")) is None
        with pytest.raises(hf.errors.StartIgnored, match="/app/a does not want to be started: not needed here"):
            system.spawn(hf.start(Kid, plan), "a")
        assert system.tree() == ["/app"]


async def test_raised_in_a_handler_it_is_a_crash_like_any_other() -> None:
    class Asks(hf.Message): ...

    class Confused(hf.Actor):
        @hf.on(Asks)
        def asks(self, message: Asks) -> None:
            raise hf.Ignore

    async with hf.ActorSystem(log=False) as system:
        ref = await system.start(hf.child("confused", hf.start(Confused)))
        with pytest.raises(hf.RemoteCrash, match="Ignore"):
            await ref.ask(Asks())


class Picky(hf.Actor):
    """Lives in another process, and does not want to."""

    def __init__(self, where: str) -> None:
        self.where = where
        if where == "__init__":
            raise hf.Ignore("no device")

    def on_start(self, restored: bool) -> None:
        if self.where == "on_start":
            raise hf.Ignore("no device")


@pytest.mark.parametrize("where", ["__init__", "on_start"])
async def test_it_works_alike_in_a_process_of_its_own(where: str) -> None:
    async with hf.ActorSystem(log=False) as system:
        with system.events() as events:
            picky = hf.child("picky", hf.start(Picky, where), isolation="process")
            top = await system.start(hf.supervisor("top", children=[picky]))
            assert [(info.id, info.state) for info in await top.ask(hf.WhichChildren())] == [("picky", "stopped")]
            assert await top.ask(hf.RestartChild("picky")) is None
            told = events.take()
        assert not [event for event in told if isinstance(event, (hf.events.ActorCrashed, hf.events.ChildStartFailed))]
        assert system._workers.processes() == {}


@pytest.mark.parametrize("where", ["__init__", "on_start"])
async def test_it_works_alike_in_a_subtree_in_a_process(where: str) -> None:
    async with hf.ActorSystem(log=False) as system:
        children = [hf.child("picky", hf.start(Picky, where)), hf.child("good", hf.start(Picky, ""))]
        top = await system.start(hf.supervisor("top", children=children, isolation="process"))
        infos = await top.ask(hf.WhichChildren())
        assert [(info.id, info.state) for info in infos] == [("picky", "stopped"), ("good", "running")]
        lazy = hf.child("lazy", hf.start(Lazy), isolation="process", restart="temporary")
        assert await system.start(lazy) is None


class Refuses(hf.Actor):
    def __init__(self, where: str, error: str) -> None:
        self.where, self.error = where, error
        self.at("__init__")

    def on_start(self, restored: bool) -> None:
        self.at("on_start")

    def at(self, where: str) -> None:
        if where == self.where:
            raise hf.Ignore("no device") if self.error == "ignore" else ValueError("no device")


@pytest.mark.parametrize("error", ["ignore", "raise"])
@pytest.mark.parametrize("where", ["__init__", "on_start"])
@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("above", ["task", "process"])
async def test_a_first_start_that_is_refused_is_no_recovery_that_has_failed(
    above: Isolation, isolation: Isolation, where: str, error: str
) -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.dynamic("top", isolation=above))
        spec = hf.child("x", hf.start(Refuses, where, error), isolation=isolation, recovery=hf.hybrid())
        with system.events() as events:
            if error == "ignore":
                assert await top.ask(hf.StartChild(spec)) is None
            else:
                with pytest.raises(hf.StartFailed, match="ValueError: no device"):
                    await top.ask(hf.StartChild(spec))
            await system._node.settled()
            told = events.take()
        assert not [event for event in told if isinstance(event, hf.events.RecoveryFailed)]
        failed = [event for event in told if isinstance(event, hf.events.ChildStartFailed)]
        assert len(failed) == (error == "raise")
