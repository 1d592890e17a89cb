"""The diagnoser and the model server as actors, on the virtual clock."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest

import holdfast as hf
from holdfast.diagnosis import (
    DIAGNOSIS,
    EXPLANATION,
    GRACE,
    OBSERVATIONS,
    ROS_DIAGNOSTICS,
    TOUCHED,
    ChangeModel,
    DiagnoserActor,
    Explained,
    GetDiagnosis,
    GetExplanation,
    GetModel,
    GetObserved,
    GetVersions,
    Grace,
    LoadModel,
    ModelRefused,
    ModelServer,
    RollBackModel,
    RosDiagnostics,
    Touched,
    ValidateModel,
    tree,
)
from holdfast.diagnosis.engine import Diagnosis, State
from holdfast.diagnosis.literals import parse
from holdfast.diagnosis.model import Component, Flaw, Put, Remove, System
from holdfast.diagnosis.observations import Observation
from holdfast.testing import advance, probe
from tests.diagnosis.robot import ELEVEN, POWERED_DOWN, paper_robot

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

DOWN = ("not on(ja)", "not ok(/odom)")


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("t", log=False, seed=1) as running:
        yield running


async def diagnosing(system: hf.ActorSystem, model: System | None = None, **options: Any) -> hf.ActorRef[Any]:
    await system.start(tree(model or paper_robot(), **options))
    return system.ref("/t/diagnosis/diagnoser", DiagnoserActor)


async def observe(system: hf.ActorSystem, *literals: str, source: str = "test", time_to_live: float = 1000.0) -> None:
    now = asyncio.get_running_loop().time()
    for literal in literals:
        await system.publish(OBSERVATIONS, Observation(parse(literal), now, source, time_to_live))


def bad(diagnosis: Diagnosis) -> list[set[str]]:
    return [set(one.bad) for one in diagnosis.candidates]


async def test_power_up_of_the_paper_s_robot(system: hf.ActorSystem) -> None:
    # D8, D32, D52, O1
    diagnoser = await diagnosing(system)
    heard = probe(system)
    heard.subscribe(DIAGNOSIS)
    await observe(system, *POWERED_DOWN)
    found = await heard.expect(Diagnosis)
    assert bad(found) == [ELEVEN]
    assert set(found.good(found.candidates[0])) == {"js", "imu", "rviz"}
    assert await diagnoser.ask(GetDiagnosis()) == found


async def test_changes_that_come_together_are_one_diagnosis_and_what_is_the_same_is_not_told_again(
    system: hf.ActorSystem,
) -> None:
    # D42
    await diagnosing(system)
    heard = probe(system)
    heard.subscribe(DIAGNOSIS)
    for literal in POWERED_DOWN:
        await observe(system, literal)
        await advance(0.001)
    await advance(10.0)
    assert len(heard.waiting) == 1
    await observe(system, *POWERED_DOWN)  # renewed
    await observe(system, "running(rviz)")  # new, and changes nothing
    await advance(10.0)
    assert len(heard.waiting) == 1
    await observe(system, *(one.removeprefix("not ") for one in POWERED_DOWN))
    await advance(1.0)
    last = heard.waiting[-1]
    assert isinstance(last, Diagnosis)
    assert last.state is State.HEALTHY


async def test_a_diagnosis_waits_until_changes_have_come_to_rest_but_not_for_ever(system: hf.ActorSystem) -> None:
    # D42, T52: a symptom that is seen a moment before its cause is not diagnosed without it.
    await diagnosing(system, quiet=1.0)
    heard = probe(system)
    heard.subscribe(DIAGNOSIS)
    await observe(system, "on(la)")
    await advance(0.9)
    await observe(system, "not ok(/map)")
    await advance(0.9)
    assert not heard.waiting
    await observe(system, "not ok(/scan)", "on(hu)", "running(hn)")
    await advance(1.1)
    (found,) = heard.waiting
    assert isinstance(found, Diagnosis)
    assert bad(found) == [{"hn"}, {"hu"}]
    for number in range(10):
        await observe(system, ("not " if number % 2 else "") + "running(hm)")
        await advance(0.5)
    assert len(heard.waiting) > 1


async def test_a_diagnosis_says_why_and_what_to_look_at_next(system: hf.ActorSystem) -> None:
    # T54
    diagnoser = await diagnosing(system)
    await observe(system, "on(ja)", "running(jn)", "not ok(/odom)")
    found = await diagnoser.ask(GetDiagnosis())
    assert bad(found) == [{"jn"}, {"ja"}]
    why = await diagnoser.ask(GetExplanation())
    assert why.conflicts == ("not ok(/odom): at least one of ja and jn is faulty",)
    await observe(system, "not ok(/map)", "running(hn)", "running(hm)", "on(hu)")
    await diagnoser.ask(GetDiagnosis())
    why = await diagnoser.ask(GetExplanation())
    assert "ok(/scan)" in {str(one.atom) for one in why.next_best}


async def test_the_same_in_the_form_of_ros_diagnostics(system: hf.ActorSystem) -> None:
    # D33
    await diagnosing(system)
    heard = probe(system)
    heard.subscribe(ROS_DIAGNOSTICS)
    await observe(system, *DOWN)
    array: Any = (await heard.expect(RosDiagnostics)).array
    levels = {one["name"]: one["level"] for one in array["status"]}
    assert levels["ja"] == 2
    assert set(levels.values()) == {2, 3}  # of the others nothing is seen


async def test_what_is_not_said_again_is_unknown_and_in_the_end_all_is(system: hf.ActorSystem) -> None:
    # T50
    diagnoser = await diagnosing(system)
    heard = probe(system)
    heard.subscribe(DIAGNOSIS)
    assert (await diagnoser.ask(GetDiagnosis())).state is State.BLIND
    await observe(system, "not ok(/imu_data)", time_to_live=8.0)
    await observe(system, *DOWN, time_to_live=2.0)
    await advance(4.0)
    await advance(8.0)
    said = [one for one in heard.waiting if isinstance(one, Diagnosis)]
    assert [(one.state, bad(one)) for one in said] == [
        (State.FAULTY, [{"in", "ja"}]),
        (State.FAULTY, [{"in"}]),
        (State.BLIND, []),
    ]


async def test_between_equals_that_contradict_each_other_it_is_unknown_who_is_right(system: hf.ActorSystem) -> None:
    # T49, O5
    diagnoser = await diagnosing(system)
    await observe(system, "running(hm)", source="/t/a")
    await observe(system, "not running(hm)", source="/t/b")
    found = await diagnoser.ask(GetDiagnosis())
    assert found.state is State.CONTRADICTORY
    assert {one.source for torn in found.contradictions for one in torn.observations} == {"/t/a", "/t/b"}
    assert "/t/a says running(hm)" in (await diagnoser.ask(GetExplanation())).text
    await observe(system, "not running(hm)", source="/t/a")
    assert bad(await diagnoser.ask(GetDiagnosis())) == [{"hm"}]


async def test_of_two_that_contradict_each_other_who_is_worth_less_is_not_believed(system: hf.ActorSystem) -> None:
    # T49
    diagnoser = await diagnosing(system, trust={"/t/b": 0.1})
    for _ in range(3):  # it says so again and again
        await observe(system, "not running(hm)", source="/t/b")
        await observe(system, "running(hm)", source="/t/a")
        await advance(1.0)
        assert (await diagnoser.ask(GetDiagnosis())).state is State.HEALTHY
        await observe(system, "not running(hm)", source="/t/b")
        await advance(1.0)
        assert (await diagnoser.ask(GetDiagnosis())).state is State.HEALTHY


async def test_a_word_that_the_model_does_not_know_is_told_once_and_does_no_harm(system: hf.ActorSystem) -> None:
    # T53
    diagnoser = await diagnosing(system)
    heard = probe(system)
    heard.subscribe(EXPLANATION)
    for _ in range(3):
        await observe(system, "not ok(/odmo)")
    why = await heard.expect(Explained)
    assert len(why.refused) == 1
    assert "did you mean" in why.refused[0]
    await heard.expect_no_message()
    await observe(system, *DOWN)
    assert bad(await diagnoser.ask(GetDiagnosis())) == [{"ja"}]


async def test_what_was_just_repaired_is_suspected_last_for_a_while(system: hf.ActorSystem) -> None:
    # O3, T54
    diagnoser = await diagnosing(system)
    await observe(system, "on(ja)", "running(jn)", "not ok(/odom)")
    assert bad(await diagnoser.ask(GetDiagnosis())) == [{"jn"}, {"ja"}]
    await system.publish(TOUCHED, Touched(("jn",), "start_node", asyncio.get_running_loop().time()))
    assert bad(await diagnoser.ask(GetDiagnosis())) == [{"ja"}, {"jn"}]
    await advance(40.0)
    await observe(system, "ok(/map)")
    assert bad(await diagnoser.ask(GetDiagnosis())) == [{"jn"}, {"ja"}]


async def test_grace_goes_to_all_that_depends_on_what_was_repaired(system: hf.ActorSystem) -> None:
    # T51
    await diagnosing(system)
    heard = probe(system)
    heard.subscribe(GRACE)
    await system.publish(TOUCHED, Touched(("hu",), "power_up", 0.0, grace=5.0))
    told = await heard.expect(Grace)
    assert {"hu", "/scan", "/map"} <= set(told.names)  # its driver's topic, and what is made of that
    assert not {"/odom", "jn"} & set(told.names)
    await system.publish(TOUCHED, Touched(("hu",), "shutdown", 0.0))
    await heard.expect_no_message()


async def test_a_diagnoser_that_is_killed_knows_again_what_is_renewed(system: hf.ActorSystem) -> None:
    diagnoser = await diagnosing(system)
    await observe(system, *DOWN)
    await diagnoser.ask(GetDiagnosis())
    diagnoser._cell.kill()
    await advance(1.0)
    assert (await diagnoser.ask(GetDiagnosis())).state is State.BLIND
    await observe(system, *DOWN)
    assert bad(await diagnoser.ask(GetDiagnosis())) == [{"ja"}]
    assert parse("ok(/odom)") in (await diagnoser.ask(GetObserved())).negative


# -- the model server -------------------------------------------------------------------------------------------------


def server_of(system: hf.ActorSystem) -> hf.ActorRef[ModelServer]:
    return system.ref("/t/diagnosis/model", ModelServer)


async def test_the_model_changes_while_the_system_runs(system: hf.ActorSystem) -> None:
    # D31
    diagnoser = await diagnosing(system)
    server = server_of(system)
    await observe(system, *DOWN)
    assert bad(await diagnoser.ask(GetDiagnosis())) == [{"ja"}]
    camera = Component(name="camera", out={"/image": ()})
    assert await server.ask(ChangeModel((Put(camera),), "a camera was plugged in")) == 2
    await advance(0.1)
    await observe(system, "not ok(/image)")
    found = await diagnoser.ask(GetDiagnosis())
    assert (bad(found), found.version) == ([{"camera", "ja"}], 2)  # what was observed before still counts
    assert await server.ask(RollBackModel()) == 3
    await advance(0.1)
    found = await diagnoser.ask(GetDiagnosis())
    assert (bad(found), found.version) == ([{"ja"}], 3)
    assert [one.reason for one in await server.ask(GetVersions())][1] == "a camera was plugged in"


async def test_a_change_that_makes_no_model_is_refused_and_changes_nothing(system: hf.ActorSystem) -> None:
    await diagnosing(system)
    server = server_of(system)
    before = await server.ask(GetModel())
    wrong = (
        ChangeModel((Put(Component(name="x", on=("nobody",))),)),
        ChangeModel((Remove("nobody"),)),
        LoadModel("components: [", "wrong.yaml"),
        RollBackModel(7),
        ValidateModel((Remove("nobody"),)),
    )
    for message in wrong:
        with pytest.raises(ModelRefused) as refused:
            await server.ask(message)
        assert refused.value.problems
    assert await server.ask(GetModel()) == before


async def test_a_model_is_validated_without_being_changed(system: hf.ActorSystem) -> None:
    await diagnosing(system)
    server = server_of(system)
    findings = await server.ask(ValidateModel((Put(Component(name="mute")),)))
    assert any(one.flaw is Flaw.ONLY_WHEN_ENDED and "mute" in one.components for one in findings)
    assert (await server.ask(GetModel())).number == 1


async def test_a_model_server_that_is_killed_has_its_versions_again(system: hf.ActorSystem) -> None:
    diagnoser = await diagnosing(system)
    server = server_of(system)
    await server.ask(ChangeModel((Put(Component(name="camera", out={"/image": ()})),)))
    server._cell.kill()
    await advance(1.0)
    assert [one.number for one in await server.ask(GetVersions())] == [1, 2]
    diagnoser._cell.kill()
    await advance(1.0)
    await observe(system, "not ok(/image)")
    assert bad(await diagnoser.ask(GetDiagnosis())) == [{"camera"}]


async def test_an_observation_in_words_that_a_change_took_away_does_no_harm(system: hf.ActorSystem) -> None:
    diagnoser = await diagnosing(system)
    await observe(system, "not ok(/imu_data)", *DOWN)
    await server_of(system).ask(ChangeModel((Remove("in"),)))  # while the diagnosis is under way
    await advance(0.1)
    found = await diagnoser.ask(GetDiagnosis())
    assert (bad(found), found.version) == ([{"ja"}], 2)
    assert diagnoser._cell.life == 1
