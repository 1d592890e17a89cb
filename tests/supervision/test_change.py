"""A supervisor that is changed while it works (otp.md 1.10), and supervisors as classes."""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import pytest

import holdfast as hf
from tests.supervision.family import Boom, Family, Life, Plan, kid, refused


class Name(hf.Message[str]): ...


class Named(hf.Actor):
    def __init__(self, name: str) -> None:
        self.name = name

    @hf.on(Name)
    def tell_name(self, message: Name) -> str:
        return self.name

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")


def named(id: str, name: str, **options: Any) -> hf.ChildSpec:
    return hf.child(id, hf.start(Named, name), **options)


async def test_new_flags_hold_at_once() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, *(kid(plan, name) for name in "abc"), intensity=0)
        await family.top.ask(hf.supervision.ChangeSupervisor(hf.supervision.Flags("one_for_all", 5, 10.0)))
        assert await family.after("b", Boom()) == "-b -c -a +a +b +c"


async def test_a_known_child_gets_its_new_spec_and_goes_on() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", children=[named("a", "old")]))
        ref = system.ref("/app/top/a", Named)
        await top.ask(hf.supervision.ChangeSupervisor(children=[named("a", "new", restart="transient", shutdown=1.0)]))
        assert await ref.ask(Name()) == "old", "it was not touched"
        spec = await top.ask(hf.supervision.GetChildSpec("a"))
        assert (spec.restart, spec.shutdown) == ("transient", 1.0)
        ref.tell(Boom())
        assert await ref.ask(Name()) == "new", "its next life is the new one"


async def test_a_new_child_is_added_and_not_started_and_a_missing_one_stays_behind_the_others() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, *(kid(plan, name) for name in "abc"), strategy="rest_for_one")
        await family.top.ask(hf.supervision.ChangeSupervisor(children=[kid(plan, name) for name in "cxa"]))
        assert plan.take() == ""
        assert list((await family.states()).items()) == [
            ("c", "running"),
            ("x", "stopped"),
            ("a", "running"),
            ("b", "running"),
        ]
        assert [await family.ref(name).ask(Life()) for name in "abc"] == [1, 1, 1]
        await family.top.ask(hf.RestartChild("x"))
        plan.take()
        assert await family.after("x", Boom()) == "-x -b -a +x +a +b", "in the new order"
        await system.stop(family.top)
        assert plan.take() == "-b -a -x -c"


INVALID: list[Callable[[Plan], hf.supervision.ChangeSupervisor]] = [
    lambda plan: hf.supervision.ChangeSupervisor("one_for_all"),
    lambda plan: hf.supervision.ChangeSupervisor(hf.supervision.Flags("one_for_all"), "abc"),
    lambda plan: hf.supervision.ChangeSupervisor(hf.supervision.Flags("one_for_all"), [kid(plan, "a"), kid(plan, "a")]),
    lambda plan: hf.supervision.ChangeSupervisor(
        hf.supervision.Flags("one_for_all"), [kid(plan, "a", restart="transient", significant=True)]
    ),
    lambda plan: hf.supervision.ChangeSupervisor(hf.supervision.Flags("one_for_all"), [kid(plan, None)]),
    lambda plan: hf.supervision.ChangeSupervisor(
        hf.supervision.Flags("one_for_all"), [kid(plan, "a", mailbox=hf.bounded(5))]
    ),
    lambda plan: hf.supervision.ChangeSupervisor(
        hf.supervision.Flags("one_for_all"), [kid(plan, "x"), kid(plan, "a", recovery=hf.fresh())]
    ),
]


@pytest.mark.parametrize("change", INVALID)
async def test_if_anything_is_invalid_nothing_changes(
    change: Callable[[Plan], hf.supervision.ChangeSupervisor],
) -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, kid(plan, "a"), kid(plan, "b"))
        assert isinstance(await refused(family.top.ask(change(plan))), hf.SpecError)
        assert await family.states() == {"a": "running", "b": "running"}
        assert await family.after("a", Boom()) == "-a +a", "still one_for_one"


async def test_what_belongs_to_the_address_can_be_changed_when_the_child_is_stopped() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, kid(plan, "a"))
        await family.top.ask(hf.TerminateChild("a"))
        await family.top.ask(hf.supervision.ChangeSupervisor(children=[kid(plan, "a", mailbox=hf.bounded(5))]))
        ref = await family.top.ask(hf.RestartChild("a"))
        assert ref._cell.more.bound is not None


async def test_a_change_lasts_when_the_supervisor_is_restarted() -> None:
    """Also that nothing is left of a child that was only started by request."""
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", children=[named("a", "old"), named("b", "b")]))
        await top.ask(hf.StartChild(named("d", "d")))
        flags = hf.supervision.Flags("one_for_all", intensity=7)
        await top.ask(hf.supervision.ChangeSupervisor(flags, [named("c", "c"), named("a", "new")]))
        await top.ask(hf.supervision.ChangeSupervisor(dataclasses.replace(flags, period=9.0)))
        with system.events() as events:
            top.kill()
            while (await events.until(hf.events.ActorStarted)).address != top.path:
                pass
        states = [(info.id, info.state) for info in await top.ask(hf.WhichChildren())]
        assert states == [("c", "running"), ("a", "running"), ("b", "running")]
        assert await system.ref(f"{top.path}/a", Named).ask(Name()) == "new"
        shown = await system.get_state(top)
        assert (shown["strategy"], shown["intensity"], shown["period"]) == ("one_for_all", 7, 9.0)


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_who_has_ended_and_has_a_spec_yet_is_listed_with_the_reason(isolation: Any) -> None:
    async with hf.ActorSystem(log=False) as system:
        children = [named("a", "a", restart="transient"), named("b", "b")]
        top = await system.start(hf.supervisor("top", children=children, isolation=isolation))
        await top.ask(hf.TerminateChild("a"))
        [ended] = await top.ask(hf.supervision.EndedChildren())
        assert ended == hf.supervision.EndedChild("a", f"{top.path}/a", "shutdown", is_recorded=False)
        await top.ask(hf.RestartChild("a"))
        assert await top.ask(hf.supervision.EndedChildren()) == []


async def test_a_change_is_forgotten_with_the_process_of_the_supervisor() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", children=[named("a", "old")], isolation="process"))
        await top.ask(hf.supervision.ChangeSupervisor(hf.supervision.Flags(intensity=7), [named("a", "new")]))
        with system.events() as events:
            top.kill()
            while (await events.until(hf.events.ActorStarted)).address != top.path:
                pass
        assert await system.ref(f"{top.path}/a", Named).ask(Name()) == "old"


# -- supervisors as classes -----------------------------------------------------------------------------------------


class Bank(hf.Supervisor):
    """Two branches at first; what `init` returns can be changed from outside, as new code would."""

    answer: ClassVar[Callable[[int], Any] | None] = None
    asked: ClassVar[int] = 0

    def __init__(self, branches: int) -> None:
        self.branches = branches

    def init(self) -> hf.Plan:
        type(self).asked += 1
        if Bank.answer is not None:
            return Bank.answer(self.branches)
        children = [named(f"branch{number}", str(number)) for number in range(self.branches)]
        return hf.Plan(children, strategy="one_for_all", intensity=self.branches)


@pytest.fixture(autouse=True)
def fresh_bank(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Bank, "answer", None)
    monkeypatch.setattr(Bank, "asked", 0)


async def test_init_gives_the_children_and_is_asked_at_each_start() -> None:
    async with hf.ActorSystem(log=False) as system:
        bank = await system.start(hf.child("bank", hf.start(Bank, 2)))
        assert [info.id for info in await bank.ask(hf.WhichChildren())] == ["branch0", "branch1"]
        spec = await system._root_ref().ask(hf.supervision.GetChildSpec("bank"))
        assert (spec.is_supervisor, spec.shutdown) == (True, "infinity")
        bank.kill()
        assert [info.id for info in await bank.ask(hf.WhichChildren())] == ["branch0", "branch1"]
        assert Bank.asked == 2


async def test_a_change_without_anything_asks_init_anew() -> None:
    async with hf.ActorSystem(log=False) as system:
        bank = await system.start(hf.child("bank", hf.start(Bank, 2)))
        Bank.answer = lambda branches: hf.Plan([named("branch1", "new"), named("extra", "x")], strategy="one_for_one")
        await bank.ask(hf.supervision.ChangeSupervisor())
        assert [(info.id, info.state) for info in await bank.ask(hf.WhichChildren())] == [
            ("branch1", "running"),
            ("extra", "stopped"),
            ("branch0", "running"),
        ]


def _ignores(branches: int) -> hf.Plan:
    raise hf.Ignore


def _fails(branches: int) -> hf.Plan:
    raise OSError("no configuration")


@pytest.mark.parametrize(
    ("answer", "error"),
    [(_ignores, None), (_fails, hf.RemoteCrash), (lambda branches: "junk", hf.SpecError)],
    ids=["ignore", "raise", "junk"],
)
async def test_init_that_has_no_answer_changes_nothing(answer: Any, error: type[Exception] | None) -> None:
    """otp.md 1.10: ignore is fine, junk is the caller's error; the supervisor goes on."""
    async with hf.ActorSystem(log=False) as system:
        bank = await system.start(hf.child("bank", hf.start(Bank, 2)))
        Bank.answer = answer
        if error is None:
            await bank.ask(hf.supervision.ChangeSupervisor())
        else:
            assert isinstance(await refused(bank.ask(hf.supervision.ChangeSupervisor())), error)
        assert bank._cell.life == 1
        assert len(await bank.ask(hf.WhichChildren())) == 2


@pytest.mark.parametrize(("answer", "text"), [(_fails, "no configuration"), (lambda branches: 7, "must return a Plan")])
async def test_init_that_has_no_answer_at_a_start_fails_it(answer: Any, text: str) -> None:
    """otp.md 1.1."""
    Bank.answer = answer
    async with hf.ActorSystem(log=False) as system:
        with pytest.raises(hf.StartFailed, match=text):
            await system.start(hf.child("bank", hf.start(Bank, 2)))
        assert system.tree() == ["/app"]


async def test_a_supervisor_in_a_process_can_be_changed_too() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", children=[named("a", "old")], isolation="process"))
        await top.ask(
            hf.supervision.ChangeSupervisor(hf.supervision.Flags(intensity=5), [named("a", "new"), named("b", "b")])
        )
        assert [(info.id, info.state) for info in await top.ask(hf.WhichChildren())] == [
            ("a", "running"),
            ("b", "stopped"),
        ]
        b = await top.ask(hf.RestartChild("b"))
        c = await top.ask(hf.StartChild(named("c", "c")))
        assert (await b.ask(Name()), await c.ask(Name())) == ("b", "c")
        await top.ask(hf.supervision.ChangeSupervisor(children=[named("p", "p", isolation="process")]))
        p = await top.ask(hf.RestartChild("p"))
        assert await p.ask(Name()) == "p"
        assert system.pid_of(p) != system.pid_of(top)
        far = hf.supervisor("far", children=[], isolation="process")
        error = await refused(top.ask(hf.supervision.ChangeSupervisor(children=[far])))
        assert "cannot hold another supervisor" in str(error)
