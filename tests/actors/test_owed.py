"""What an ended life owed fails at once with the reason of its end, wherever it was lived."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf

pytestmark = pytest.mark.pairs

LONG = 30.0  # Nothing waits for this: what is owed for ever fails then, before the test run is ended.


class Question(hf.Message[str]): ...


class Answer(hf.Message): ...


class Count(hf.Message[int]): ...


class End(hf.Message):
    how: str


class Begin(hf.Message): ...


class Came(hf.Message[list[str]]): ...


class Hang(hf.Message[None]): ...


class Promises(hf.Actor):
    """Answers later, if ever."""

    def __init__(self) -> None:
        self.waiting: list[hf.ReplyHandle[str]] = []

    @hf.on(Question)
    def ask(self, message: Question) -> hf.ReplyHandle[str]:
        self.waiting.append(self.ctx.reply_handle())
        return self.waiting[-1]

    @hf.on(Answer)
    def answer(self, message: Answer) -> None:
        for handle in self.waiting:
            handle.reply("late")

    @hf.on(Count)
    def count(self, message: Count) -> int:
        return len(self.waiting)

    @hf.on(Hang)
    async def hang(self, message: Hang) -> None:
        await asyncio.Event().wait()

    @hf.on(End)
    def end(self, message: End) -> None:
        if message.how == "crash":
            raise ValueError("boom")
        self.ctx.stop()


REASONS = {
    "crash": "ValueError: boom",
    "stop": "normal",
    "kill": "killed",
    "terminate": "shutdown",
    "its supervisor": "shutdown",
    "the system": "shutdown",
}


async def end(system: hf.ActorSystem, ref: hf.ActorRef[Promises], how: str) -> None:
    top = system.ref(ref.path.rpartition("/")[0], hf.Supervisor)
    match how:
        case "kill":
            ref.kill()
        case "terminate":
            await top.ask(hf.TerminateChild("a"), LONG)
        case "its supervisor":
            await system.stop(top)
        case "the system":
            await system.shutdown()
        case _:
            ref.tell(End(how))


async def started(
    system: hf.ActorSystem, place: str, restart: Any, recovery: Any, kind: type[Promises] = Promises
) -> hf.ActorRef[Promises]:
    isolation: Any = "process" if place == "process" else "task"
    child = hf.child("a", hf.start(kind), restart=restart, isolation=isolation, recovery=recovery)
    await system.start(hf.supervisor("top", children=[child], isolation="process" if place == "subtree" else "task"))
    return system.ref("/t/top/a", kind)


async def promise_and_end(system: hf.ActorSystem, place: str, restart: Any, how: str, recovery: Any = None) -> None:
    ref = await started(system, place, restart, recovery)
    asked = [ref.ask(Question(), LONG) for _ in range(3)]
    assert await ref.ask(Count(), LONG) == 3
    await end(system, ref, how)
    for one in asked:
        with pytest.raises(hf.AskFailed, match=REASONS[how]):
            await one


@pytest.mark.parametrize("how", REASONS)
@pytest.mark.parametrize("restart", ["permanent", "temporary"])
async def test_a_promised_reply_fails_with_the_end(system: hf.ActorSystem, restart: Any, how: str) -> None:
    await promise_and_end(system, "task", restart, how)


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("how", ["crash", "stop", "kill"])
@pytest.mark.parametrize("place", ["process", "subtree"])
async def test_so_does_one_in_another_process(system: hf.ActorSystem, place: str, how: str) -> None:
    await promise_and_end(system, place, "permanent", how)


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("how", ["stop", "kill", "its supervisor", "the system"])
@pytest.mark.parametrize("place", ["task", "process", "subtree"])
async def test_so_does_one_of_a_recorded_actor_that_ends_for_good(system: hf.ActorSystem, place: str, how: str) -> None:
    await promise_and_end(system, place, "temporary", how, hf.hybrid(3600.0))


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("place", ["task", "process", "subtree"])
async def test_what_a_recorded_actor_had_begun_and_what_waited_fail_otherwise(
    system: hf.ActorSystem, place: str
) -> None:
    ref = await started(system, place, "temporary", hf.hybrid(3600.0))
    begun = ref.ask(Hang(), LONG)
    while (await system.get_status(ref)).turn is None:
        await asyncio.sleep(0)
    waits = ref.ask(Question(), LONG)
    ref.kill()
    with pytest.raises(hf.AskFailed, match="killed"):
        await begun
    with pytest.raises(hf.ActorStopped):
        await waits


async def test_on_stop_may_still_answer(system: hf.ActorSystem) -> None:
    class Polite(Promises):
        async def on_stop(self, reason: hf.ExitReason) -> None:
            await asyncio.sleep(0)
            self.answer(Answer())

    ref = system.spawn(hf.start(Polite))
    asked = ref.ask(Question(), LONG)
    await system._node.settled()
    await system.stop(ref)
    assert await asked == "late"


async def test_a_recorded_actor_keeps_its_promises_over_a_crash(system: hf.ActorSystem) -> None:
    """Its handles come back with its state."""
    ref = await system.start(hf.child("a", hf.start(Promises), recovery=hf.hybrid(60.0)))
    asked = ref.ask(Question(), LONG)
    ref.tell(End("crash"))
    ref.tell(Answer())
    assert await asked == "late"


class Forgetful(Promises):
    """Holds its handles where no snapshot keeps them."""

    key_variables = ()


class Asker(hf.Actor):
    """Asks in a recorded turn, and keeps what came of it."""

    def __init__(self) -> None:
        self.came: list[str] = []

    @hf.on(Begin)
    async def begin(self, message: Begin) -> None:
        try:
            self.came.append(await self.ctx.find("/t/top/a", Promises).ask(Question(), LONG))
        except hf.AskFailed as error:
            self.came.append(str(error))

    @hf.on(Came)
    def what_came(self, message: Came) -> list[str]:
        return self.came


FORGOTTEN = "the handle was in nothing that the next one has"


async def save_and_end(system: hf.ActorSystem, ref: hf.ActorRef[Promises], how: str) -> None:
    if how == "stop":  # The last snapshot of a life comes then.
        ref.tell(End("stop"))
        return
    await system.checkpoint(ref)
    await end(system, ref, how)


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("how", ["stop", "crash", "kill"])
@pytest.mark.parametrize("place", ["task", "process", "subtree"])
async def test_what_the_next_life_of_a_recorded_actor_has_no_handle_for_fails_at_once(
    system: hf.ActorSystem, place: str, how: str
) -> None:
    ref = await started(system, place, "permanent", hf.hybrid(3600.0), Forgetful)
    asked = [ref.ask(Question(), LONG) for _ in range(3)]
    assert await ref.ask(Count(), LONG) == 3
    await save_and_end(system, ref, how)
    for one in asked:
        with pytest.raises(hf.AskFailed, match=FORGOTTEN):
            await one
    again = ref.ask(Question(), LONG)
    ref.tell(Answer())
    assert await again == "late"


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("place", ["task", "process"])
async def test_a_replay_makes_the_handle_again(system: hf.ActorSystem, place: str) -> None:
    """No snapshot has come in between: it does not matter where the handle is."""
    ref = await started(system, place, "permanent", hf.hybrid(3600.0), Forgetful)
    asked = ref.ask(Question(), LONG)
    assert await ref.ask(Count(), LONG) == 1
    ref.kill()
    ref.tell(Answer())
    assert await asked == "late"


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("kind", [Promises, Forgetful])
async def test_a_turn_hears_once_that_nobody_will_answer_it_also_when_the_root_is_started_again(
    tmp_path: Path, kind: type[Promises]
) -> None:
    store = f"sqlite:{tmp_path / 's.db'}"
    top = hf.supervisor(
        "top",
        children=[
            hf.child("a", hf.start(kind), recovery=hf.hybrid(3600.0)),
            hf.child("b", hf.start(Asker), recovery=hf.hybrid(3600.0)),
        ],
    )
    async with hf.ActorSystem("t", store=store, log=False) as system:
        await system.start(top)
        promises, asker = system.ref("/t/top/a", kind), system.ref("/t/top/b", Asker)
        asker.tell(Begin())
        while await promises.ask(Count(), LONG) == 0:
            await asyncio.sleep(0)
        await system.checkpoint(promises)
    for _ in range(2):
        async with hf.ActorSystem("t", store=store, log=False) as system:
            await system.start(top)
            promises, asker = system.ref("/t/top/a", kind), system.ref("/t/top/b", Asker)
            promises.tell(Answer())
            [came] = await asker.ask(Came(), LONG)
            assert came == "late" if kind is Promises else FORGOTTEN in came


async def test_who_waits_for_a_lock_hears_that_the_registry_is_gone(system: hf.ActorSystem) -> None:
    """Its locks belong to its address: they outlive its lives, and end with it."""
    spec = hf.supervision.registry("names")
    names: hf.supervision.Registry[str, Any] = hf.supervision.Registry(await system.start(spec), LONG)
    async with names.lock("k"):
        waiting = asyncio.ensure_future(names.lock("k").__aenter__())
        await system._node.settled()
        names.ref.kill()
        await system._node.settled()
        assert not waiting.done()
        await system.stop(names.ref)
        with pytest.raises(hf.ActorStopped):
            await waiting


async def test_an_actor_that_moves_takes_its_promises_along(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("a", hf.start(Promises)))
    asked = ref.ask(Question(), LONG)
    await system.set_isolation(ref, "process")
    await system.set_isolation(ref, "task")
    ref.tell(Answer())
    assert await asked == "late"
