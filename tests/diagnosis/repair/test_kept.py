"""What repair knows beyond the program: the scores of its advice, and what people have denied to it."""

import shutil
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.actors.events import EventStream
from holdfast.diagnosis.literals import parse
from holdfast.diagnosis.observations import Observation
from holdfast.diagnosis.repair import Policy, RepairTold, RetryRepair
from holdfast.testing import advance

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])


class Part(hf.Actor):
    """Does nothing; what is said of it is all that is known."""


async def watched(system: hf.ActorSystem, file: Path, **options: Any) -> diagnosis.Watch:
    await system.start(hf.supervisor("all", children=[hf.child(name, hf.start(Part)) for name in ("a", "b")]))
    policy = Policy(look=0.1, settle=0.5, verify=2.0)
    return await diagnosis.watch(system, seconds=0.1, policy=policy, repair_file=file, **options)


async def accuse(system: hf.ActorSystem, name: str, seconds: float, *, is_good: bool = False) -> None:
    text = f"{'' if is_good else 'not '}progress(all/{name})"
    seen = Observation(parse(text), system._node.loop.time(), "test", seconds)
    await system.publish(diagnosis.OBSERVATIONS, seen)


def told(events: EventStream, what: str) -> list[str]:
    return [one.text for one in events.take() if isinstance(one, RepairTold) and one.what == what]


async def test_a_denial_holds_in_the_next_program_also_after_a_kill(tmp_path: Path) -> None:
    file, as_killed = tmp_path / "repair.json", tmp_path / "killed.json"
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        watching = await watched(system, file, repair="ask", approve=lambda wanted: "it is being moved")
        await accuse(system, "a", 20.0)
        await advance(10.0)
        assert (await watching.repair_status()).denied == ("all/a",)
        shutil.copy(file, as_killed)  # What stands there if the program is killed now.
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        watching = await watched(system, as_killed, repair="on")
        status = await watching.repair_status()
        assert (status.denied, status.reasons, status.cases) == (("all/a",), {"all/a": "it is being moved"}, 1)
        await accuse(system, "a", 20.0)
        await advance(10.0)
        assert (await system.get_status(system.ref("/t/all/a"))).life == 1, "nobody touches it"
        await watching.repairer.ask(RetryRepair(("all/a",)))
        await accuse(system, "a", 20.0)
        await advance(10.0)
        assert (await system.get_status(system.ref("/t/all/a"))).life > 1
        await accuse(system, "b", 20.0)
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        assert (await (await watched(system, as_killed)).repair_status()).denied == ()


async def test_scores_of_advice_are_added_up_over_programs(tmp_path: Path) -> None:
    for number in (1, 2):
        async with hf.ActorSystem("t", log=False, seed=1) as system:
            watching = await watched(system, tmp_path / "repair.json", repair="advise")
            await accuse(system, "a", 5.0)
            await advance(3.0)
            await system.ref("/t/all", hf.Supervisor).ask(hf.RestartChild("a", running=True))
            await advance(4.0)
            await accuse(system, "a", 20.0, is_good=True)
            await advance(15.0)
            status = await watching.repair_status()
            assert (status.right + status.needless + status.wrong, status.cases) == (number, number)


async def test_a_file_that_holds_something_else_is_refused_and_one_that_cannot_be_written_is_told(
    tmp_path: Path,
) -> None:
    (tmp_path / "repair.json").write_text("[1]")
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        with pytest.raises(ValueError, match="has no scores of repair"):
            await watched(system, tmp_path / "repair.json")
        with system.events() as events:
            policy = Policy(look=0.1)
            file = tmp_path / "nowhere" / "repair.json"
            await diagnosis.watch(system, seconds=0.1, policy=policy, repair_file=file)
            await accuse(system, "a", 20.0)
            await advance(5.0)
            [text] = told(events, "NotKept")
            assert "nowhere/repair.json: No such file or directory" in text
