"""An ask has exactly one outcome (DESIGN 3 "Sending", 4 "Deadlocks"; T20)."""

import asyncio
import contextlib
import gc
import time
import weakref
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.kernel.node import Node

IN_TIME = 20.0  # seconds


class Work(hf.Message[str]):
    """Wait for a gate, then answer."""

    name: str = ""


class Quick(hf.Message[str]):
    name: str = ""


class Seen(hf.Message[list[str]]): ...


class Answer(hf.Message[None]):
    text: str


class Ring(hf.Message[str]):
    """Ask along a list of actors."""

    way: list[hf.ActorRef[Any]]


class No(hf.Refusal):
    code: int


class Worker(hf.Actor):
    """Waits for its gate in `Work`; `Quick` is a plain function."""

    def __init__(self, gate: asyncio.Event | None = None) -> None:
        self._gate = gate or asyncio.Event()
        self.seen: list[str] = []
        self._handle: hf.ReplyHandle[str] | None = None

    @hf.on(Work)
    async def work(self, message: Work) -> str:
        self.seen.append(f"begun {message.name}")
        await self._gate.wait()
        self.seen.append(f"done {message.name}")
        return message.name

    @hf.on(Quick)
    def quick(self, message: Quick) -> str | hf.ReplyHandle[str]:
        self.seen.append(message.name)
        match message.name:
            case "no":
                raise No(7)
            case "crash":
                raise ValueError("broken")
            case "later":
                self._handle = self.ctx.reply_handle()
                return self._handle
        return message.name

    @hf.on(Answer)
    def answer(self, message: Answer) -> None:
        assert self._handle is not None
        if message.text == "no":
            self._handle.fail(No(8))
        self._handle.reply(message.text)

    @hf.on(Seen)
    def look(self, message: Seen) -> list[str]:
        return list(self.seen)

    @hf.on(Ring)
    async def ring(self, message: Ring) -> str:
        if not message.way:
            return self.ctx.path
        return await message.way[0].ask(Ring(message.way[1:]))


virtual = pytest.mark.asyncio(loop_factories=["virtual"])


async def test_a_reply_is_the_outcome(system: hf.ActorSystem) -> None:
    assert await system.spawn(hf.start(Worker)).ask(Quick("x")) == "x"


async def test_a_refusal_is_an_answer_and_nothing_restarts(system: hf.ActorSystem) -> None:
    worker = system.spawn(hf.start(Worker))
    with pytest.raises(No) as no:
        await worker.ask(Quick("no"))
    assert no.value.code == 7
    assert await worker.ask(Seen()) == ["no"]


async def test_a_crash_arrives_as_remote_crash_with_its_traceback(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.RemoteCrash) as crash:
        await system.spawn(hf.start(Worker)).ask(Quick("crash"))
    assert (crash.value.type_name, crash.value.text) == ("ValueError", "broken")
    assert "def quick" in crash.value.traceback or "in quick" in crash.value.traceback


@virtual
async def test_an_ask_whose_turn_has_begun_times_out_with_handled_unknown(system: hf.ActorSystem) -> None:
    gate = asyncio.Event()
    worker = system.spawn(hf.start(Worker, gate))
    with pytest.raises(hf.AskTimeout) as late:
        await worker.ask(Work("x"), timeout=2.0)
    assert (late.value.handled, late.value.seconds, late.value.actor) == (None, 2.0, worker.path)
    gate.set()


@virtual
async def test_an_expired_ask_is_not_run_and_says_so(system: hf.ActorSystem) -> None:
    gate = asyncio.Event()
    worker = system.spawn(hf.start(Worker, gate))
    slow = worker.ask(Work("slow"), timeout=10.0)
    with pytest.raises(hf.AskTimeout) as late:
        await worker.ask(Quick("expired"), timeout=1.0)
    assert late.value.handled is False
    gate.set()
    assert await slow == "slow"
    assert await worker.ask(Seen()) == ["begun slow", "done slow"]


@virtual
async def test_a_late_reply_is_dropped_and_counted(system: hf.ActorSystem) -> None:
    worker = system.spawn(hf.start(Worker))
    asked = worker.ask(Quick("later"), timeout=1.0)
    with pytest.raises(hf.AskTimeout):
        await asked
    assert system.late_replies == 0
    await worker.ask(Answer("too late"))
    assert system.late_replies == 1
    assert isinstance(asked.exception(), hf.AskTimeout)
    assert await worker.ask(Quick("on")) == "on"


@virtual
async def test_deadlines_of_different_lengths_each_end_at_their_time(system: hf.ActorSystem) -> None:
    loop = asyncio.get_running_loop()
    gate = asyncio.Event()
    worker = system.spawn(hf.start(Worker, gate))
    ended: dict[float, float] = {}

    def note(done: asyncio.Future[str]) -> None:
        error = done.exception()
        assert isinstance(error, hf.AskTimeout)
        ended[error.seconds] = loop.time()

    for seconds in (3.0, 1.0, 2.0, 1.0):
        worker.ask(Work(), timeout=seconds).add_done_callback(note)
    begin = loop.time()
    await asyncio.sleep(4.0)
    assert {s: pytest.approx(t - begin, abs=0.01) for s, t in ended.items()} == {1.0: 1.0, 2.0: 2.0, 3.0: 3.0}
    gate.set()


async def test_asking_an_actor_that_has_stopped_fails_at_once(system: hf.ActorSystem) -> None:
    worker = system.spawn(hf.start(Worker))
    await system.stop(worker)
    with pytest.raises(hf.ActorStopped) as stopped:
        await worker.ask(Quick())
    assert stopped.value.actor == worker.path


@pytest.mark.parametrize("end", ["stop", "kill"])
async def test_queued_asks_fail_when_the_actor_ends_for_good(system: hf.ActorSystem, end: str) -> None:
    gate = asyncio.Event()
    worker = system.spawn(hf.start(Worker, gate))
    first = worker.ask(Work("x"))
    queued = [worker.ask(Quick("never")) for _ in range(3)]
    await system._node.loop.create_task(asyncio.sleep(0))
    getattr(worker, end)()
    gate.set()
    for ask in queued:
        with pytest.raises(hf.ActorStopped):
            await ask
    if end == "stop":
        assert await first == "x"
    else:
        with pytest.raises(hf.AskFailed):
            await first


async def test_a_turn_that_is_killed_fails_its_ask_at_once(system: hf.ActorSystem) -> None:
    """Not at the deadline: nobody will answer any more."""
    worker = system.spawn(hf.start(Worker))
    asked = worker.ask(Work(), timeout=1000.0)
    await asyncio.sleep(0)
    worker.kill()
    with pytest.raises(hf.AskFailed, match="killed"):
        await asked


async def test_asking_oneself_in_a_turn_is_refused_at_once(system: hf.ActorSystem) -> None:
    worker = system.spawn(hf.start(Worker))
    with pytest.raises(hf.RemoteCrash) as crash:
        await worker.ask(Ring([worker]))
    assert crash.value.type_name.endswith("AskDeadlock")


@pytest.mark.parametrize("length", [2, 3, 5])
async def test_a_circle_of_asks_is_refused_at_once(system: hf.ActorSystem, length: int) -> None:
    class Careful(Worker):
        @hf.on(Ring)
        async def ring(self, message: Ring) -> str:
            try:
                return await message.way[0].ask(Ring(message.way[1:]))
            except hf.errors.AskDeadlock as error:
                return f"{error.actor} {error.chain}"

    ring = [system.spawn(hf.start(Careful), f"a{n}") for n in range(length)]
    told = await ring[0].ask(Ring([*ring[1:], ring[0]]))
    assert told == f"/t/a0 {tuple(f'/t/a{n}' for n in reversed(range(length)))}"


async def test_asks_that_meet_without_a_circle_are_not_refused(system: hf.ActorSystem) -> None:
    one, two, three = (system.spawn(hf.start(Worker), name) for name in ("one", "two", "three"))
    ways = [(one, [three]), (two, [three]), (one, [two, three])]
    assert await asyncio.gather(*(asked.ask(Ring(list(way))) for asked, way in ways)) == ["/t/three"] * 3


async def test_an_actor_whose_turn_has_ended_can_be_asked_by_whom_it_asked(system: hf.ActorSystem) -> None:
    """A turn that is over waits for nobody, whatever the chain says."""

    class Hear(hf.Message[None]):
        text: str

    class Piper(hf.Actor):
        def __init__(self, other: hf.ActorRef[Worker]) -> None:
            self._other = other
            self.heard = ""

        @hf.on(Work)
        def work(self, message: Work) -> str:
            ring = Ring([self.ctx.ref])
            self.ctx.pipe_to_self(self._other.ask(ring), Hear, lambda error: Hear(repr(error)))
            return "begun"

        @hf.on(Ring)
        def ring(self, message: Ring) -> str:
            return "not busy"

        @hf.on(Hear)
        def hear(self, message: Hear) -> None:
            self.heard = message.text
            heard.set_result(message.text)

    heard: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    piper = system.spawn(hf.start(Piper, system.spawn(hf.start(Worker))))
    await piper.ask(Work())
    assert await heard == "not busy"


@pytest.mark.parametrize("how", ["task", "pipe"])
async def test_background_work_asks_beside_a_turn_that_does_not_wait_for_it(system: hf.ActorSystem, how: str) -> None:
    """Whoever waits for that later turn is asked when it is done waiting; so is the actor itself."""

    class Told(hf.Message):
        answers: list[str]

    class Owner(hf.Actor):
        def __init__(self, way: list[hf.ActorRef[Any]]) -> None:
            self._way = way

        @hf.on(Work)
        def work(self, message: Work) -> str:
            if how == "task":
                self.ctx.create_task(self._tell())
            else:
                self.ctx.pipe_to_self(self._report(), Told)
            return "begun"

        async def _tell(self) -> None:
            heard.set_result(await self._report())

        @hf.on(Told)
        def told(self, message: Told) -> None:
            heard.set_result(message.answers)

        async def _report(self) -> list[str]:
            await asked.wait()
            answers = [one.ask(Quick(one.path)) for one in (*self._way, self.ctx.ref)]
            gate.set()
            return await asyncio.gather(*answers)

        @hf.on(Ring)
        async def ring(self, message: Ring) -> str:
            asked.set()
            await gate.wait()
            return "done"

        @hf.on(Quick)
        def quick(self, message: Quick) -> str:
            return message.name

    asked, gate = asyncio.Event(), asyncio.Event()
    heard: asyncio.Future[list[str]] = asyncio.get_running_loop().create_future()
    asker = system.spawn(hf.start(Worker), "asker")
    owner = system.spawn(hf.start(Owner, [asker]), "owner")
    await owner.ask(Work())
    assert await asker.ask(Ring([owner])) == "done"
    async with asyncio.timeout(30):
        assert await heard == ["/t/asker", "/t/owner"]


async def test_a_background_task_may_ask_its_own_idle_actor(system: hf.ActorSystem) -> None:
    class Owner(hf.Actor):
        @hf.on(Work)
        def work(self, message: Work) -> str:
            self.ctx.create_task(self._report())
            return "begun"

        async def _report(self) -> None:
            heard.set_result(await self.ctx.ref.ask(Quick()))

        @hf.on(Quick)
        def quick(self, message: Quick) -> str:
            return "own"

    heard: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    await system.spawn(hf.start(Owner)).ask(Work())
    assert await heard == "own"


async def test_cancelling_an_ask_ends_the_wait_and_never_the_turn(system: hf.ActorSystem) -> None:
    gate = asyncio.Event()
    worker = system.spawn(hf.start(Worker, gate))
    running, queued = worker.ask(Work("running")), worker.ask(Quick("queued"))
    await asyncio.sleep(0)
    running.cancel()
    queued.cancel()
    gate.set()
    assert await worker.ask(Seen()) == ["begun running", "done running", "queued"]


async def test_a_reply_can_be_given_in_a_later_turn_and_only_once(system: hf.ActorSystem) -> None:
    worker = system.spawn(hf.start(Worker))
    asked = worker.ask(Quick("later"))
    assert await worker.ask(Quick("between")) == "between"
    assert not asked.done()
    worker.tell(Answer("first"))
    worker.tell(Answer("second"))
    assert await asked == "first"


async def test_a_delayed_refusal_is_an_answer(system: hf.ActorSystem) -> None:
    worker = system.spawn(hf.start(Worker))
    asked = worker.ask(Quick("later"))
    worker.tell(Answer("no"))
    with pytest.raises(No):
        await asked


async def test_a_reply_handle_of_a_tell_answers_nobody(system: hf.ActorSystem) -> None:
    worker = system.spawn(hf.start(Worker))
    worker.tell(Quick("later"))
    await worker.ask(Answer("x"))


class Front(hf.Actor):
    """Hands everything on, and may fail after that."""

    def __init__(self, back: hf.ActorRef[Any]) -> None:
        self._back = back

    @hf.on(Quick)
    def quick(self, message: Quick) -> str:
        self.ctx.forward(self._back)
        return "not the reply"

    @hf.on(Work)
    async def work(self, message: Work) -> str:
        self.ctx.forward(self._back)
        await asyncio.sleep(0)
        if message.name == "then crash":
            raise ValueError
        return "not the reply"


class Back(hf.Actor):
    @hf.on(Quick)
    def quick(self, message: Quick) -> str:
        return f"back, from {self.ctx.sender.path if self.ctx.sender else 'outside'}"

    @hf.on(Work)
    async def work(self, message: Work) -> str:
        for _ in range(10):
            await asyncio.sleep(0)
        return "back"


async def test_a_forwarded_ask_is_answered_by_whom_it_is_forwarded_to(system: hf.ActorSystem) -> None:
    front = system.spawn(hf.start(Front, system.spawn(hf.start(Back))))
    assert await front.ask(Quick()) == "back, from outside"
    assert await front.ask(Work()) == "back"


async def test_a_crash_after_forwarding_does_not_answer_in_the_other_s_place(system: hf.ActorSystem) -> None:
    front = system.spawn(hf.start(Front, system.spawn(hf.start(Back))))
    assert await front.ask(Work("then crash")) == "back"


async def test_forwarding_keeps_the_original_sender(system: hf.ActorSystem) -> None:
    class Sender(hf.Actor):
        @hf.on(Seen)
        async def look(self, message: Seen) -> list[str]:
            return [await front.ask(Quick())]

    front = system.spawn(hf.start(Front, system.spawn(hf.start(Back))))
    assert await system.spawn(hf.start(Sender), "origin").ask(Seen()) == ["back, from /t/origin"]


async def test_forwarding_a_timer_s_message_delivers_it(system: hf.ActorSystem) -> None:
    class Timed(Front):
        @hf.on(Seen)
        def look(self, message: Seen) -> list[str]:
            self.ctx.tell_after(0, Quick("tick"))
            return []

    worker = system.spawn(hf.start(Worker))
    timed = system.spawn(hf.start(Timed, worker))
    await timed.ask(Seen())
    await asyncio.sleep(0.01)  # the timer is due
    await system._node.settled()
    assert await worker.ask(Seen()) == ["tick"]


async def test_forwarding_to_an_actor_without_handler_is_the_forwarder_s_error(system: hf.ActorSystem) -> None:
    class Deaf(hf.Actor): ...

    with pytest.raises(hf.RemoteCrash) as crash:
        await system.spawn(hf.start(Front, system.spawn(hf.start(Deaf)))).ask(Quick())
    assert crash.value.type_name.endswith("UnknownMessage")


async def test_many_asks_behind_one_slow_one_do_not_accumulate(system: hf.ActorSystem) -> None:
    gate = asyncio.Event()
    slow, quick = system.spawn(hf.start(Worker, gate)), system.spawn(hf.start(Worker))
    waiting = slow.ask(Work("slow"), timeout=1000.0)
    asked: asyncio.Future[str] | None = None
    replies: list[weakref.ref[asyncio.Future[str]]] = []
    for number in range(3000):
        asked = quick.ask(Quick(str(number)), timeout=1000.0)
        replies.append(weakref.ref(asked))
        await asked
    asked = None
    gc.collect()
    assert sum(reply() is not None for reply in replies) <= 1024 + 1
    gate.set()
    assert await waiting == "slow"


@virtual
async def test_time_outs_that_are_all_different_do_not_accumulate(system: hf.ActorSystem) -> None:
    worker = system.spawn(hf.start(Worker))
    for number in range(100):
        await worker.ask(Quick(), timeout=1.0 + number / 1000)
    await asyncio.sleep(2.0)
    assert not system._node.deadlines._queues


async def test_every_ask_under_churn_has_one_outcome(system: hf.ActorSystem) -> None:
    """Actors crash, stop and are killed while they are asked; nobody waits to the deadline."""
    asks: list[asyncio.Future[str]] = []
    for number in range(60):
        worker = system.spawn(hf.start(Worker))
        asks += [worker.ask(Quick(name), timeout=1000.0) for name in ("a", "b")]
        asks.append(worker.ask(Work("c") if number % 2 else Quick("crash"), timeout=1000.0))
        asks.append(worker.ask(Quick("d"), timeout=1000.0))
        if number % 3 == 0:
            await asyncio.sleep(0)
        (worker.stop, worker.kill)[number % 2]()
    async with asyncio.timeout(10):
        outcomes = await asyncio.gather(*asks, return_exceptions=True)
    kinds = {type(outcome) for outcome in outcomes}
    assert kinds <= {str, hf.ActorStopped, hf.RemoteCrash, hf.AskFailed}
    assert {str, hf.ActorStopped} <= kinds


def test_a_deadline_is_over_when_the_machine_says_so_though_the_loop_is_late() -> None:
    """The loop of an actor's process may be late: whoever has asked has been told already that it was not run."""

    class Late(asyncio.SelectorEventLoop):
        def time(self) -> float:
            return super().time() - 0.005

    loop = Late()
    try:
        node = Node("late", loop)
        assert node.clock.is_past(time.monotonic())
        assert not node.clock.is_past(time.monotonic() + 60.0)
    finally:
        loop.close()


class Late(hf.Actor):
    """It starts slowly, and takes a while for each message."""

    async def on_start(self, restored: bool) -> None:
        await asyncio.sleep(0.05)

    @hf.on(Work)
    async def work(self, message: Work) -> str:
        await asyncio.sleep(0.001)
        return "done"


async def insistently(ref: hf.ActorRef[Late], how: str) -> str:
    """Ask or send until that gets through, as fast as that can be."""
    while True:
        with contextlib.suppress(hf.ActorStopped, hf.MailboxFull, hf.errors.ActorRestarting):
            if how == "send":
                await ref.send(Work())
                return "done"
            return await ref.ask(Work(), restarting="fail" if how == "fail" else "wait")


@pytest.mark.parametrize("by", ["nobody", "an actor"])
@pytest.mark.parametrize("how", ["ask", "send", "fail", "full"])
async def test_who_insists_leaves_the_loop_to_those_for_whom_it_waits(how: str, by: str) -> None:
    """Whatever is refused at the call ends in the next pass of the loop."""

    class Insists(hf.Actor):
        @hf.on(Work)
        async def work(self, message: Work) -> str:
            return await insistently(late, how)

    mailbox = hf.bounded(2, overflow="reject") if how == "full" else None
    spec = hf.child("late", hf.start(Late), mailbox=mailbox, backoff=hf.Backoff(initial=0.01, maximum=0.01))
    async with hf.ActorSystem("t", log=False, intensity=99) as system:
        inner = hf.supervisor("inner", children=[spec], intensity=9 if how == "fail" else 0)
        await system.start(inner)
        late = system.ref("/t/inner/late", Late)
        insisting = [system.spawn(hf.start(Insists), f"i{number}") for number in range(3)]
        if how != "full":
            late.kill()
            if how != "fail":  # Its supervisor ends with it, and is started again.
                async with asyncio.timeout(IN_TIME):
                    while not late._cell.is_dead:
                        await asyncio.sleep(0)
        if by == "nobody":
            said = await asyncio.gather(*(insistently(late, how) for _ in range(6)))
        else:
            said = await asyncio.gather(*(one.ask(Work(), IN_TIME) for one in insisting))
        assert {*said} == {"done"}
