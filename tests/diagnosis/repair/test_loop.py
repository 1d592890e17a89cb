"""What keeps repair from doing harm: budgets, waits, modes, people, other diagnoses, and who is left alone."""

import asyncio
import sys
from collections.abc import AsyncIterator
from typing import Any

import pytest

import holdfast as hf
from holdfast.diagnosis.literals import ok, on
from holdfast.diagnosis.messages import MODEL, OBSERVATIONS, ModelChanged
from holdfast.diagnosis.observations import Observation
from holdfast.diagnosis.planning import find_plan
from holdfast.diagnosis.repair import (
    DONE,
    FAILED,
    LOST,
    SKIPPED,
    UNVERIFIED,
    ActionBegan,
    ActionEnded,
    AdviceScored,
    ApprovalWanted,
    Approve,
    BadStance,
    Deny,
    GaveUp,
    GetRepairStatus,
    Held,
    NobodyWaits,
    Planned,
    Policy,
    RepairAction,
    RepairBegan,
    Repaired,
    Repairer,
    RepairGaveUp,
    Repertoire,
    RetryRepair,
    SetMode,
    SetStance,
    Undone,
    action,
)
from holdfast.supervision.arbiter import Hand, arbiter_of
from tests.diagnosis.repair.simulated import OBSERVERS, Scene, World, now, scene, watcher

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

QUICK: dict[str, Any] = {"verify": 6.0, "settle": 1.0, "cool_down": 0.5}


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("t", log=False, seed=1) as running:
        yield running


def stopped(*names: str):
    def change(world: World) -> None:
        world.running -= {*names}

    return change


def off(*names: str, dead: bool = False):
    def change(world: World) -> None:
        for name in names:
            world.switch(name, False)
        if dead:
            world.dead |= {*names}

    return change


def outcomes(here: Scene) -> list[tuple[str, str]]:
    return [(str(one.step), one.outcome) for one in here.all(ActionEnded)]


# -- giving up ------------------------------------------------------------------------------------------------------


async def test_a_dead_device_is_given_up_within_the_budget_and_said_aloud(system: hf.ActorSystem) -> None:
    # T62, T66
    here = await scene(system, Policy(attempts=2, **QUICK))
    with system.events() as events:
        await here.change(off("hu", dead=True))
        over = await here.hear(GaveUp)
        await here.rest()
        aloud = [one for one in events.take() if isinstance(one, RepairGaveUp)]
    assert outcomes(here) == [("power_up(hu)", UNVERIFIED)] * 2
    assert over.components == ("hu",)
    assert "nothing is left to try" in over.why
    assert "was not observed within 3 s" in over.why
    assert [one.components for one in aloud] == [("hu",)]
    assert (await here.repairer.ask(GetRepairStatus())).given_up == ("hu",)


async def test_what_was_given_up_does_not_hinder_the_repair_of_others(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(attempts=2, **QUICK))
    await here.change(off("hu", dead=True))
    await here.hear(GaveUp)
    await here.change(stopped("jtn"))
    await here.hear(Repaired)
    await here.rest()
    assert here.done() == ["power_up(hu)", "power_up(hu)", "start_node(jtn)"]
    assert len(here.all(GaveUp)) == 1


async def test_one_dead_device_does_not_keep_the_others_down(system: hf.ActorSystem) -> None:
    # T66: everything that does not need it is up after the first plan already.
    def all_off(world: World) -> None:
        world.running = {"rviz"}
        off("ja", "hu", "la")(world)
        world.dead.add("ja")

    here = await scene(system, Policy(attempts=2, **QUICK), before=all_off)
    await here.hear(Planned, 2)
    assert ("start_node(jn)", SKIPPED) in outcomes(here)
    down = {name for name in (*here.world.hardware, *here.world.nodes) if not here.world.serves(name)}
    assert down == {"ja", "jn"}
    await here.hear(GaveUp)
    await here.rest()
    assert {name for one in here.all(GaveUp) for name in one.components} >= {"ja"}


async def test_a_person_can_have_it_tried_again(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(attempts=1, **QUICK))
    await here.change(off("hu", dead=True))
    await here.hear(GaveUp)
    await here.rest()
    here.world.dead.clear()
    here.repairer.tell(RetryRepair(("hu",)))
    await here.hear(Repaired)
    assert here.world.is_healthy()


async def test_a_component_that_fails_again_and_again_is_given_up(system: hf.ActorSystem) -> None:
    # T62: the budget is of the component, not of the case.
    here = await scene(system, Policy(attempts=2, window=500.0, **QUICK))
    for count in (1, 2):
        await here.change(stopped("hm"))
        await here.hear(Repaired, count)
    await here.change(stopped("hm"))
    over = await here.hear(GaveUp)
    assert (over.components, here.done()) == (("hm",), ["start_node(hm)"] * 2)


async def test_attempts_are_counted_within_a_window(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(attempts=1, window=20.0, **QUICK))
    await here.change(stopped("hm"))
    await here.hear(Repaired)
    await asyncio.sleep(20.0)
    await here.change(stopped("hm"))
    await here.hear(Repaired, 2)
    assert here.all(GaveUp) == []


async def test_a_device_that_nothing_can_be_done_for_is_given_up_at_once(system: hf.ActorSystem) -> None:
    # T57
    only_power = lambda world: Repertoire([world.power_up()])  # noqa: E731
    here = await scene(system, Policy(**QUICK), actions=only_power)
    await here.change(stopped("hm"))
    over = await here.hear(GaveUp)
    assert (over.components, over.why, here.done()) == (("hm",), "there is no way to repair it", [])


async def test_attempts_cool_down(system: hf.ActorSystem) -> None:
    # T62
    def flaky(world: World) -> None:
        world.flaky.add("hm")
        stopped("hm")(world)

    here = await scene(system, Policy(verify=6.0, settle=1.0, cool_down=20.0))
    await here.change(flaky)
    await here.hear(Repaired)
    first, second = here.all(ActionBegan)
    assert outcomes(here) == [("start_node(hm)", FAILED), ("start_node(hm)", DONE)]
    assert second.time - first.time >= 20.0


# -- looking before and after ---------------------------------------------------------------------------------------


async def test_an_action_that_never_returns_is_ended(system: hf.ActorSystem) -> None:
    # T61
    async def never(act, n: str) -> None:
        await asyncio.Event().wait()

    only = lambda world: Repertoire([RepairAction("start_node", never, timeout=4.0, attempts=1)])  # noqa: E731
    here = await scene(system, Policy(**QUICK), actions=only)
    await here.change(stopped("hm"))
    over = await here.hear(GaveUp)
    assert outcomes(here) == [("start_node(hm)", FAILED)]
    assert "it did not return within 4 s" in over.why


async def test_an_action_that_says_it_is_done_is_not_believed(system: hf.ActorSystem) -> None:
    # D49, T60
    async def lies(act, n: str) -> None:
        pass

    only = lambda world: Repertoire(  # noqa: E731
        [RepairAction("start_node", lies, effect_timeout=4.0, attempts=1)],
    )
    here = await scene(system, Policy(**QUICK), actions=only)
    await here.change(stopped("hm"))
    await here.hear(GaveUp)
    assert outcomes(here) == [("start_node(hm)", UNVERIFIED)]


async def test_who_came_back_meanwhile_is_not_acted_upon(system: hf.ActorSystem) -> None:
    # T60: somebody else has started hm while the device was powered up.
    here = await scene(system, before=lambda world: (off("hu")(world), stopped("hn")(world)))
    await here.hear(ActionBegan)
    assert here.done() == ["power_up(hu)"]
    await here.change(lambda world: world.running.add("hn"))
    here.world.started["hn"] = now() + 2  # as if it had waited for its device
    await here.rest()
    assert outcomes(here)[:2] == [("power_up(hu)", DONE), ("start_node(hn)", SKIPPED)]
    assert here.world.is_healthy()


async def test_a_second_fault_that_was_hidden_is_found_and_repaired(system: hf.ActorSystem) -> None:
    # T56: while /scan is silent nobody can say that hm is hung.
    def both(world: World) -> None:
        stopped("hn")(world)
        world.hung.add("hm")

    here = await scene(system)
    await here.change(both)
    await here.rest()
    assert here.done() == ["start_node(hn)", "stop_node(hm)", "start_node(hm)"]
    assert here.world.is_healthy()


async def test_nothing_is_done_while_observers_contradict_each_other(system: hf.ActorSystem) -> None:
    # T49: another source says that hm's map is fine.
    here = await scene(system, Policy(unknown=5.0, **QUICK))
    await here.rest(1.0)
    await system.publish(OBSERVATIONS, Observation(ok("/map"), now(), "liar", 1000.0))
    await here.change(lambda world: world.hung.add("hm"))
    await here.rest()
    assert here.done() == []


async def test_blind_is_not_healthy(system: hf.ActorSystem) -> None:
    # T50: all observers fall silent in the middle of a case.
    here = await scene(system, Policy(unknown=5.0, **QUICK))
    await here.change(off("hu"))
    await here.hear(ActionBegan)
    await here.blind()
    over = await here.hear(GaveUp)
    assert over.why == "the observations are blind for 5 s"
    assert here.all(Repaired) == []
    assert here.done() == ["power_up(hu)"]


async def test_a_diagnosis_is_no_newer_than_what_was_observed(system: hf.ActorSystem) -> None:
    # T50: who diagnoses has ended, and so have the observers; the last diagnosis is no reason to act for ever.
    here = await scene(system, Policy(unknown=5.0, **QUICK))
    await here.change(off("hu", dead=True))
    await here.hear(ActionBegan)
    await system.ref("/t/diagnosis", hf.Supervisor).ask(hf.TerminateChild("diagnoser"))
    await here.blind()
    over = await here.hear(GaveUp)
    assert over.why == "nobody observes any more what was diagnosed for 5 s"
    assert here.all(Repaired) == []


async def test_a_contradiction_in_the_middle_of_a_case_is_waited_for_and_no_repair(system: hf.ActorSystem) -> None:
    # T49
    here = await scene(system, Policy(unknown=5.0, **QUICK))
    await here.change(off("hu", dead=True))
    await here.hear(ActionBegan)
    await system.publish(OBSERVATIONS, Observation(on("hu"), now(), "liar", 1000.0))
    held = await here.hear(Held)
    over = await here.hear(GaveUp)
    assert (held.why, over.why) == (
        "the observations are contradictory",
        "the observations are contradictory for 5 s",
    )
    assert here.done() == ["power_up(hu)"]
    assert here.all(Repaired) == []


async def test_a_symptom_that_nobody_looks_at_any_more_is_not_repaired(system: hf.ActorSystem) -> None:
    # T50: nothing is blamed any more, but only because the observer of /map has fallen silent.
    here = await scene(system, Policy(**QUICK))
    await here.change(lambda world: world.hung.add("hm"))
    await here.hear(ActionBegan, 2)
    await here.blind(watcher("/map"))
    over = await here.hear(GaveUp)
    assert over.components == ()
    assert over.why == "nothing is blamed any more, but not ok(/map) was not seen to have gone"
    assert here.all(Repaired) == []


# -- who decides ----------------------------------------------------------------------------------------------------


async def test_dangerous_actions_wait_for_a_person(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(dangerous=frozenset({"power_up"}), approval=60.0, **QUICK))
    await here.change(off("hu"))
    wanted = await here.hear(ApprovalWanted)
    await asyncio.sleep(30.0)
    assert here.done() == []
    await here.repairer.ask(Approve(wanted.case))
    await here.hear(Repaired)
    assert here.done()[0] == "power_up(hu)"
    with pytest.raises(NobodyWaits):
        await here.repairer.ask(Approve(wanted.case))


async def test_who_got_well_while_a_person_was_asked_is_left_alone(system: hf.ActorSystem) -> None:
    # T60: all that the action asks for still holds, but nobody blames hm any more.
    here = await scene(system, Policy(dangerous=frozenset({"stop_node"}), approval=60.0, **QUICK))
    await here.change(lambda world: world.hung.add("hm"))
    wanted = await here.hear(ApprovalWanted)
    await here.change(lambda world: world.hung.discard("hm"))
    await here.healthy()
    await here.repairer.ask(Approve(wanted.case))
    ended = await here.hear(ActionEnded)
    assert (ended.outcome, ended.why) == (SKIPPED, "a new diagnosis finds hm good")
    await here.hear(Repaired)
    assert here.done() == []


@pytest.mark.parametrize("says", ["no", "nothing"])
async def test_what_a_person_does_not_allow_is_not_done(system: hf.ActorSystem, says: str) -> None:
    here = await scene(system, Policy(dangerous=frozenset({"power_up"}), approval=20.0, **QUICK))
    await here.change(off("hu"))
    wanted = await here.hear(ApprovalWanted)
    if says == "no":
        await here.repairer.ask(Deny(wanted.case, "somebody works on it"))
    over = await here.hear(GaveUp)
    await here.rest()
    assert outcomes(here) == []
    assert ("somebody works on it" if says == "no" else "nobody has approved power_up(hu) within 20 s") in over.why
    assert here.done() == []


async def test_advice_is_told_once_and_nothing_is_done(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(**QUICK), stance="advise")
    await here.change(off("hu"))
    plan = await here.hear(Planned)
    await asyncio.sleep(30.0)
    assert (len(here.planned()), here.done(), plan.is_dry) == (1, [], True)


async def test_who_switches_repair_on_in_the_middle_of_a_case_has_it_repaired_at_once(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(**QUICK), stance="advise")
    await here.change(off("hu"))
    await here.hear(Planned)
    await here.repairer.ask(SetStance("on"))
    await here.hear(Repaired)
    assert here.world.is_healthy()
    with pytest.raises(BadStance, match="'advise'"):
        await here.repairer.ask(SetStance("loud"))


async def test_advice_that_a_person_follows_is_right_and_its_lead_is_counted(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(**QUICK), stance="advise")
    await here.change(lambda world: world.hung.add("hm"))
    await here.hear(Planned)
    await asyncio.sleep(10.0)
    await system.ref("/t/robot/hm", hf.Supervisor).ask(hf.RestartChild("node", running=True))
    scored = await here.hear(AdviceScored)
    status = await here.repairer.ask(GetRepairStatus())
    assert (scored.verdict, status.right, status.missed) == ("right", 1, 0)
    assert status.seconds_saved == scored.seconds_saved >= 10.0


async def test_advice_for_what_goes_by_itself_is_needless(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(**QUICK), stance="advise")
    await here.change(lambda world: world.hung.add("hm"))
    await here.hear(Planned)
    await here.change(lambda world: world.hung.discard("hm"))
    assert (await here.hear(AdviceScored)).verdict == "needless"


async def test_a_restart_by_order_for_which_nothing_was_advised_is_missed(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(**QUICK), stance="advise")
    await here.rest(2.0)
    await system.ref("/t/robot/hm", hf.Supervisor).ask(hf.RestartChild("node", running=True))
    await here.rest(2.0)
    assert (await here.repairer.ask(GetRepairStatus())).missed == 1


async def test_when_asked_repair_waits_for_each_plan_and_goes_on_when_it_may(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(**QUICK), stance="ask")
    await here.change(lambda world: world.hung.add("hm"))
    wanted = await here.hear(ApprovalWanted)
    assert [str(step) for step in wanted.steps] == ["stop_node(hm)", "start_node(hm)"]
    assert (await here.repairer.ask(GetRepairStatus())).waiting == wanted.case
    await here.repairer.ask(Approve(wanted.case))
    await here.hear(Repaired)
    assert here.done() == ["stop_node(hm)", "start_node(hm)"]


async def test_who_got_well_before_anybody_answered_is_not_given_up(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(approval=600.0, **QUICK), stance="ask")
    await here.change(lambda world: world.hung.add("hm"))
    await here.hear(ApprovalWanted)
    begun = now()
    await here.change(lambda world: world.hung.discard("hm"))
    await here.hear(Repaired)
    assert now() - begun < 20.0, "a person was asked about what was well"
    assert (here.all(GaveUp), here.done()) == ([], [])


async def test_what_was_denied_stays_so_in_later_cases_until_it_is_withdrawn(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(**QUICK), stance="ask")
    await here.change(lambda world: world.hung.add("hm"))
    wanted = await here.hear(ApprovalWanted)
    await here.repairer.ask(Deny(wanted.case, "we look at it"))
    over = await here.hear(GaveUp)
    assert "holdfast repair retry hm" in over.plan[0]
    await here.change(lambda world: world.hung.discard("hm"))
    await here.rest()
    await here.change(lambda world: world.hung.add("hm"))
    await here.rest()
    assert (len(here.all(ApprovalWanted)), here.done()) == (1, [])
    here.repairer.tell(RetryRepair(("hm",)))
    await here.hear(ApprovalWanted, 2)


async def test_no_more_actions_than_the_hour_allows(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(hour_actions=1, **QUICK))
    await here.change(stopped("hm"))
    await here.hear(Repaired)
    await here.change(stopped("lac"))
    over = await here.hear(GaveUp)
    assert (over.components, here.done()) == (("lac",), ["start_node(hm)"])


def vain(undone: list[str], attempts: int) -> Repertoire:
    """An action that does nothing, and notes that it was undone."""

    @action(
        "(:action reset :parameters (?n - node) :precondition (and (bad ?n) (running ?n))"
        " :effect (and (good ?n) (not (bad ?n))))",
        attempts=attempts,
    )
    async def reset(act, n: str):
        async def undo() -> None:
            undone.append(n)

        return undo

    return Repertoire([reset])


async def test_what_has_not_helped_is_undone_and_counted(system: hf.ActorSystem) -> None:
    undone: list[str] = []
    here = await scene(system, Policy(**QUICK), actions=lambda world: vain(undone, attempts=1))
    await here.change(lambda world: world.hung.add("hm"))
    await here.hear(GaveUp)
    assert [str(one.step) for one in here.all(Undone)] == ["reset(hm)"]
    assert undone == ["hm"]
    assert (await here.repairer.ask(GetRepairStatus())).useless == 1


async def test_what_has_not_helped_is_not_what_the_symptoms_went_by(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(approval=600.0, **QUICK), stance="ask", actions=lambda world: vain([], 3))
    await here.change(lambda world: world.hung.add("hm"))
    await here.repairer.ask(Approve((await here.hear(ApprovalWanted)).case))
    await here.hear(ApprovalWanted, 2)
    await here.change(lambda world: world.hung.discard("hm"))
    over = await here.hear(Repaired)
    assert (here.done(), over.actions) == (["reset(hm)"], ())
    assert (await here.repairer.ask(GetRepairStatus())).useless == 1


async def test_what_goes_by_itself_is_no_merit_of_an_action_behind_which_it_was_seen_again(
    system: hf.ActorSystem,
) -> None:
    here = await scene(system, Policy(**QUICK), actions=lambda world: vain([], 1))
    await here.change(lambda world: world.hung.add("hm"))
    await here.hear(ActionEnded)
    await asyncio.sleep(3.0)
    assert not here.all(GaveUp), "it has still time to help"
    await here.change(lambda world: world.hung.discard("hm"))
    assert (await here.hear(Repaired)).actions == ()
    assert (here.done(), here.all(Undone)) == (["reset(hm)"], [])
    assert (await here.repairer.ask(GetRepairStatus())).useless == 1


async def test_what_mends_one_symptom_of_two_has_its_credit(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(**QUICK))
    await here.change(off("hu"))
    over = await here.hear(Repaired)
    assert [str(step) for step in over.actions] == here.done()


async def test_what_is_seen_again_behind_a_moment_of_blindness_has_not_helped(system: hf.ActorSystem) -> None:
    here = await scene(system, Policy(unknown=60.0, **QUICK), actions=lambda world: vain([], 1))
    await here.change(lambda world: world.hung.add("hm"))
    await here.hear(ActionEnded)
    await here.blind()
    await here.hear(Held)
    await system.ref(OBSERVERS, hf.Supervisor).ask(hf.RestartChild(watcher("/map")))
    assert str((await here.hear(Undone)).step) == "reset(hm)"
    assert (await here.repairer.ask(GetRepairStatus())).useless == 1


async def test_in_safe_mode_nothing_is_done_until_it_is_left(system: hf.ActorSystem) -> None:
    # T65
    here = await scene(system, Policy(**QUICK))
    here.repairer.tell(SetMode("safe"))
    await here.change(off("hu"))
    await here.hear(Held)
    await asyncio.sleep(12.0)
    assert here.done() == []
    here.repairer.tell(SetMode("normal"))
    await here.hear(Repaired)
    assert here.world.is_healthy()


async def test_a_mode_that_is_left_while_it_is_planned_for_is_no_reason_to_give_up(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    # T65
    here = await scene(system, Policy(**QUICK))
    here.repairer.tell(SetMode("safe"))

    async def left_meanwhile(*args: Any, **options: Any) -> Any:
        outcome = await find_plan(*args, **options)
        here.repairer.tell(SetMode("normal"))
        await asyncio.sleep(0.1)
        return outcome

    monkeypatch.setattr(sys.modules[Repairer.__module__], "find_plan", left_meanwhile)
    await here.change(off("hu"))
    await here.hear(Repaired)
    assert here.all(GaveUp) == []
    assert here.world.is_healthy()


async def test_a_mode_stops_a_plan_before_its_next_step(system: hf.ActorSystem) -> None:
    # T65
    here = await scene(system, before=lambda world: (off("hu")(world), stopped("hn")(world)))
    await here.hear(ActionBegan)
    here.repairer.tell(SetMode("safe"))
    await here.hear(Held)
    assert here.done() == ["power_up(hu)"]
    here.repairer.tell(SetMode("normal"))
    await here.rest()
    assert here.world.is_healthy()


async def test_the_repairer_does_not_repair_its_own_base(system: hf.ActorSystem) -> None:
    # T64: by name, and by address: hm lives where the repairer lives, lac above a store that it needs.
    policy = Policy(exclude=frozenset({"jtn"}), **QUICK)
    addresses = {"hm": "/t/diagnosis/repairer", "lac": "/t/base"}
    here = await scene(system, policy, addresses=addresses, base=("/t/base/store",))
    await here.change(stopped("hm", "lac", "jtn", "hn"))
    await here.rest()
    assert here.done() == ["start_node(hn)"]


async def test_what_only_the_base_can_explain_is_left_to_people(system: hf.ActorSystem) -> None:
    # T64
    here = await scene(system, Policy(exclude=frozenset({"hu"}), **QUICK))
    await here.change(off("hu"))
    await here.rest()
    assert here.done() == []


async def test_another_model_counts_from_now_on(system: hf.ActorSystem) -> None:
    here = await scene(system)
    await system.publish(MODEL, ModelChanged(2, here.world.model.declaration))
    await here.change(off("hu"))
    await here.hear(Repaired)
    assert here.world.is_healthy()


async def test_an_action_of_ones_own_is_a_decorated_coroutine(system: hf.ActorSystem) -> None:
    resets: list[str] = []

    def own(world: World) -> Repertoire:
        @action(
            "(:action reset :parameters (?n - node) :precondition (and (bad ?n) (running ?n))"
            " :effect (and (good ?n) (not (bad ?n))))"
        )
        async def reset(act, n: str) -> None:
            resets.append(n)
            world.hung.discard(n)

        return Repertoire([*world.actions().actions.values(), reset])

    here = await scene(system, actions=own)
    await here.change(lambda world: world.hung.add("hm"))
    await here.hear(Repaired)
    # One step instead of two.
    assert (here.done(), resets) == (["reset(hm)"], ["hm"])


async def test_each_case_begins_and_ends(system: hf.ActorSystem) -> None:
    here = await scene(system)
    await here.change(stopped("hm"))
    await here.hear(Repaired)
    await here.change(stopped("lac"))
    await here.hear(Repaired, 2)
    assert [(one.case, one.bad) for one in here.all(RepairBegan)] == [(1, ("hm",)), (2, ("lac",))]
    assert [one.case for one in here.all(Repaired)] == [1, 2]


async def test_a_repairer_that_is_restarted_in_the_middle_goes_on(system: hf.ActorSystem) -> None:
    # T61: what its last life held is free again.
    here = await scene(system, Policy(**QUICK))
    await here.change(lambda world: world.hung.add("hm"))
    await here.hear(ActionBegan)
    assert here.done() == ["stop_node(hm)"]
    here.repairer.kill()
    await here.hear(Repaired)
    assert here.done()[-1] == "start_node(hm)"
    assert here.world.is_healthy()


async def test_repair_keeps_away_from_what_others_hold(system: hf.ActorSystem) -> None:
    # T63
    here = await scene(system, Policy(**QUICK))
    grant = arbiter_of(system._node).claim("/t/robot/hm", Hand.FAILOVER, "its node is gone")
    await here.change(stopped("hm"))
    ended = await here.hear(ActionEnded)
    assert (ended.outcome, ended.why) == (SKIPPED, "/t/robot/hm is in the hands of failover: its node is gone")
    assert here.done() == []
    arbiter_of(system._node).release(grant)
    await here.hear(Repaired)


async def test_an_action_ends_at_once_when_failover_takes_the_actor(system: hf.ActorSystem) -> None:
    # T63
    here = await scene(system, Policy(**QUICK))
    await here.change(stopped("hm"))
    began = await here.hear(ActionBegan)
    grant = arbiter_of(system._node).claim("/t/robot/hm", Hand.FAILOVER, "its node is gone")
    assert grant.epoch > began.epoch
    ended = await here.hear(ActionEnded)
    assert (ended.outcome, ended.why) == (LOST, "failover has it now: its node is gone")
    assert "hm" not in here.world.running
    arbiter_of(system._node).release(grant)
    await here.hear(Repaired)
