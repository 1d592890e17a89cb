"""The actions that come with holdfast, done to real actors, a real board and real commands."""

import asyncio
import sys
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any, Literal

import pytest

import holdfast as hf
from holdfast.diagnosis.board import BoardActor, BoardSimulator, BoardState, GetBoard
from holdfast.diagnosis.planning import PlanningError, Step
from holdfast.diagnosis.repair import (
    Act,
    ActionFailed,
    RepairAction,
    Repertoire,
    action,
    bind_port,
    change_mechanism,
    power_up,
    restart_child,
    restart_subtree,
    roll_back,
    run_command,
    run_coroutine,
    shutdown,
    start_node,
    stop_node,
)
from holdfast.supervision.arbiter import Hand, InOtherHands, arbiter_of

LONG = 20.0
RESET = "(:action reset_usb :parameters (?d - device) :precondition (bad ?d) :effect (and (good ?d) (not (bad ?d))))"


class Ask(hf.Message[str]):
    """Who answers?"""


class Who(hf.Message[int]):
    """Which life is this?"""


class Node(hf.Actor):
    provider: hf.Binding[hf.Actor]

    @hf.on(Who)
    def _who(self, message: Who) -> int:
        return self.ctx.life

    @hf.on(Ask)
    async def _ask(self, message: Ask) -> str:
        return self.provider.path


class Note(hf.Message):
    """One more."""

    text: str


class Read(hf.Message[list[str]]):
    """All of them."""


class Notes(hf.Actor):
    def __init__(self) -> None:
        self.notes: list[str] = []

    @hf.on(Note)
    def _note(self, message: Note) -> None:
        self.notes.append(message.text)

    @hf.on(Read)
    def _read(self, message: Read) -> list[str]:
        return self.notes


class Caller(hf.Actor):
    """Carries actions out, as the repairer does."""

    def on_start(self, restored: bool) -> None:
        self.seen = self.ctx


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("t", log=False, seed=1) as running:
        yield running


async def do(system: hf.ActorSystem, one: RepairAction, *names: str, check=lambda: None) -> None:
    caller = system.spawn(hf.start(Caller))
    await system._node.settled()
    actor = caller._cell.actor
    assert actor is not None
    act = Act(Step(one.name, names), 1, "a test", actor.ctx, check)
    async with asyncio.timeout(LONG):
        await one(act, *names)


async def tree(system: hf.ActorSystem) -> dict[str, str]:
    children = [hf.child(name, hf.start(Node)) for name in ("a", "b")]
    await system.start(hf.supervisor("s", children=[hf.supervisor("low", children=children)]))
    return {name: f"/t/s/low/{name}" for name in ("a", "b")}


async def states(system: hf.ActorSystem) -> dict[str, str]:
    return {one.id: one.state for one in await system.ref("/t/s/low", hf.Supervisor).ask(hf.WhichChildren())}


async def life(system: hf.ActorSystem, path: str) -> int:
    return await system.ref(path, Node).ask(Who())


async def test_stop_and_start(system: hf.ActorSystem) -> None:
    addresses = await tree(system)
    await do(system, stop_node(addresses), "a")
    assert await states(system) == {"a": "stopped", "b": "running"}
    await do(system, start_node(addresses), "a")
    assert await states(system) == {"a": "running", "b": "running"}
    await do(system, start_node(addresses), "a")  # it runs already


async def test_restart_child(system: hf.ActorSystem) -> None:
    addresses = await tree(system)
    before = system.ref(addresses["a"], Node)._cell
    await do(system, restart_child(addresses), "a")
    assert system.ref(addresses["a"], Node)._cell is not before or await life(system, addresses["a"]) > 1
    assert await life(system, addresses["b"]) == 1


async def test_a_restart_does_not_begin_when_the_actor_was_taken_away(system: hf.ActorSystem) -> None:
    addresses = await tree(system)

    def taken() -> None:
        raise ActionFailed("restart_child(a)", "failover has it")

    with pytest.raises(ActionFailed, match="failover has it"):
        await do(system, restart_child(addresses), "a", check=taken)
    assert await states(system) == {"a": "running", "b": "running"}
    assert await life(system, addresses["a"]) == 1


class Slow(hf.Actor):
    """Its end waits until it is let go."""

    def __init__(self, ending: list[asyncio.Event]) -> None:
        self._ending = ending

    @hf.on(Who)
    def _who(self, message: Who) -> int:
        return self.ctx.life

    async def on_stop(self, reason: hf.ExitReason) -> None:
        began, ends = self._ending
        began.set()
        await ends.wait()


RESTARTS = pytest.mark.parametrize("restart", [restart_child, roll_back])


async def start_slow(system: hf.ActorSystem, ending: list[asyncio.Event], intensity: int = 3) -> str:
    """A recorded actor with two snapshots, and another one, below a supervisor below another one."""

    class SlowNotes(Notes):
        async def on_stop(self, reason: hf.ExitReason) -> None:
            began, ends = ending
            began.set()
            await ends.wait()

    slow = hf.child("a", hf.start(SlowNotes), recovery=hf.hybrid(interval=1000.0), shutdown=LONG)
    low = hf.supervisor("low", children=[slow, hf.child("b", hf.start(Node))], intensity=intensity)
    await system.start(hf.supervisor("s", children=[low]))
    notes = system.ref("/t/s/low/a", Notes)
    for text in ("a", "b"):
        await notes.ask(Note(text))
        await system.checkpoint(notes)
    await notes.ask(Note("c"))
    return "/t/s/low/a"


@RESTARTS
@pytest.mark.parametrize("who", ["its caller is killed", "its caller is cancelled"])
async def test_a_restart_that_has_begun_is_carried_out_whoever_ends_meanwhile(
    system: hf.ActorSystem, who: str, restart: Callable[[dict[str, str]], RepairAction]
) -> None:
    # T63: between the stop and the start nobody has the actor but its supervisor.
    ending = [asyncio.Event(), asyncio.Event()]
    path = await start_slow(system, ending)

    class Repairing(hf.Actor):
        async def on_start(self, restored: bool) -> None:
            act = Act(Step("restart", ("a",)), 1, "a test", self.ctx, lambda: None)
            self.work = self.ctx.create_task(restart({"a": path})(act, "a"))

    caller = system.spawn(hf.start(Repairing))
    async with asyncio.timeout(LONG):
        await ending[0].wait()
        if who == "its caller is killed":
            caller._cell.kill()
        else:
            actor = caller._cell.actor
            assert isinstance(actor, Repairing)
            actor.work.cancel()
        with pytest.raises(InOtherHands, match="its supervisor"):
            arbiter_of(system._node).claim(path, Hand.REPAIR, "somebody else")
        ending[1].set()
        kept = ["a", "b"] if restart is roll_back else ["a", "b", "c"]  # Its end in good order has saved all three.
        assert await system.ref(path, Notes).ask(Read()) == kept


@RESTARTS
async def test_a_supervisor_that_gives_up_in_the_middle_of_a_restart_leaves_nobody_stopped(
    system: hf.ActorSystem, restart: Callable[[dict[str, str]], RepairAction]
) -> None:
    """The restart has failed, for whoever asked for it; the one above brings all back."""
    ending = [asyncio.Event(), asyncio.Event()]
    path = await start_slow(system, ending, intensity=0)
    async with asyncio.timeout(LONG), asyncio.TaskGroup() as group:
        restarting = group.create_task(failing(do(system, restart({"a": path}), "a")))
        await ending[0].wait()
        with system.events() as events:
            system.ref("/t/s/low/b", Node).kill()
            async for event in events:
                if isinstance(event, hf.events.SupervisorGaveUp):
                    break
            with pytest.raises(InOtherHands, match="its supervisor"):
                arbiter_of(system._node).claim(path, Hand.REPAIR, "somebody else")
            ending[1].set()
            await restarting
            async for event in events:
                if isinstance(event, hf.events.ActorStarted) and event.address == "/t/s/low/b":
                    break
        assert await system.ref(path, Notes).ask(Read()) == ["a", "b", "c"]
        assert await life(system, "/t/s/low/b") == 1
        assert await states(system) == {"a": "running", "b": "running"}
        arbiter_of(system._node).release(arbiter_of(system._node).claim(path, Hand.REPAIR, "somebody else"))


async def failing(work: Coroutine[Any, Any, None]) -> None:
    with pytest.raises(hf.HoldfastError):
        await work


async def test_what_an_operator_has_stopped_is_started_by_an_operator_only(system: hf.ActorSystem) -> None:
    addresses = await tree(system)
    keeper = system.ref("/t/s/low", hf.Supervisor)
    for _ in range(2):
        await keeper.ask(hf.TerminateChild("a"))
        for one in (restart_child(addresses), start_node(addresses)):
            with pytest.raises(InOtherHands, match="an operator: it was stopped by order"):
                await do(system, one, "a")
        for address in (addresses["a"], "/t/s/low", "/t/s"):  # Nor with those above it: it would come with them.
            with pytest.raises(InOtherHands, match="an operator"):
                arbiter_of(system._node).claim(address, Hand.REPAIR, "slow")
        assert await states(system) == {"a": "stopped", "b": "running"}
        await keeper.ask(hf.RestartChild("a"))
        await do(system, restart_child(addresses), "a")
        arbiter_of(system._node).release(arbiter_of(system._node).claim("/t/s", Hand.REPAIR, "slow"))


async def test_what_an_operator_stops_while_repair_restarts_it_stays_stopped(system: hf.ActorSystem) -> None:
    ending = [asyncio.Event(), asyncio.Event()]
    await system.start(hf.supervisor("s", children=[hf.child("a", hf.start(Slow, ending))]))
    keeper = system.ref("/t/s", hf.Supervisor)
    async with asyncio.timeout(LONG):
        restart = asyncio.create_task(do(system, restart_child({"a": "/t/s/a"}), "a"))
        await ending[0].wait()
        stopped = keeper.ask(hf.TerminateChild("a"))
        await keeper.ask(hf.WhichChildren())  # By then it has come to the order before.
        ending[1].set()
        await stopped
        with pytest.raises(hf.StartFailed):
            await restart
        assert [one.state for one in await keeper.ask(hf.WhichChildren())] == ["stopped"]


async def test_a_child_of_a_dynamic_supervisor_is_restarted_where_it_is(system: hf.ActorSystem) -> None:
    keeper = await system.start(hf.dynamic("d"))
    await keeper.ask(hf.StartChild(hf.child("a", hf.start(Node))))
    await do(system, restart_child({"a": "/t/d/a"}), "a")
    assert await life(system, "/t/d/a") == 2


async def test_repair_leaves_those_alone_that_an_operator_has_stopped_and_that_are_forgotten(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("holdfast.supervision.supervisor.DISMISSED", 2)
    arbiter = arbiter_of(system._node)

    def is_free(address: str) -> bool:
        try:
            arbiter.release(arbiter.claim(address, Hand.REPAIR, "a test"))
        except InOtherHands:
            return False
        return True

    top = await system.start(hf.supervisor("s", children=[hf.child("b", hf.start(Node))]))
    dynamic = await system.start(hf.dynamic("d"))
    cases: list[tuple[hf.ActorRef[Any], Literal["temporary", "permanent"]]]
    cases = [(top, "temporary"), (dynamic, "permanent")]
    for keeper, restart in cases:
        for name in ("x", "y", "z"):
            await keeper.ask(hf.StartChild(hf.child(name, hf.start(Node), restart=restart)))
            await keeper.ask(hf.TerminateChild(name, parks=name != "y"))
        assert [is_free(f"{keeper.path}/{name}") for name in "xyz"] == [False, True, False]
        assert is_free(keeper.path), "nobody of them would come back with it"
        await keeper.ask(hf.StartChild(hf.child("x", hf.start(Node), restart=restart)))
        assert is_free(f"{keeper.path}/x"), "it was started by order"
        for name in ("y", "v"):
            await keeper.ask(hf.StartChild(hf.child(name, hf.start(Node), restart=restart)))
            await keeper.ask(hf.TerminateChild(name))
        assert [is_free(f"{keeper.path}/{name}") for name in "zyv"] == [True, False, False], "the oldest is forgotten"


async def test_restart_subtree(system: hf.ActorSystem) -> None:
    addresses = await tree(system)
    cells = {name: system.ref(path, Node)._cell for name, path in addresses.items()}
    one = restart_subtree(dict.fromkeys(addresses, "/t/s/low"))
    assert one.reach is not None
    assert one.reach("a") == "/t/s/low"
    await do(system, one, "a")
    assert {name: system.ref(path, Node)._cell is cells[name] for name, path in addresses.items()} == {
        "a": False,
        "b": False,
    }


async def test_a_supervisor_that_is_not_there_is_told(system: hf.ActorSystem) -> None:
    with pytest.raises(ActionFailed, match="the supervisor of /t/none/a is not there"):
        await do(system, start_node({"a": "/t/none/a"}), "a")


async def test_rebind(system: hf.ActorSystem) -> None:
    addresses = await tree(system)
    system.spawn(hf.start(Node), name="standin")
    await do(system, bind_port({"a": (addresses["a"], "provider", "/t/standin")}), "a")
    assert await system.ref(addresses["a"], Node).ask(Ask()) == "/t/standin"


async def test_roll_back_to_an_older_snapshot(system: hf.ActorSystem) -> None:
    path = "/t/s/notes"
    spec = hf.child("notes", hf.start(Notes), recovery=hf.hybrid(interval=1000.0))
    await system.start(hf.supervisor("s", children=[spec]))
    notes = system.ref(path, Notes)
    for text in ("a", "b", "c"):
        await notes.ask(Note(text))
        if text != "c":
            await system.checkpoint(notes)
    await do(system, roll_back({"n": path}), "n")
    # The stop in good order has taken one more snapshot, with all three.
    assert await system.ref(path, Notes).ask(Read()) == ["a", "b"]
    with pytest.raises(hf.errors.ControlFailed, match="stop it first"):
        system.roll_back(path)


@pytest.mark.parametrize("recovery", [None, hf.hybrid(interval=1000.0)], ids=["unrecorded", "recorded"])
async def test_if_there_is_nothing_to_go_back_to_the_actor_runs_again(system: hf.ActorSystem, recovery: Any) -> None:
    await system.start(hf.supervisor("s", children=[hf.child("notes", hf.start(Notes), recovery=recovery)]))
    with pytest.raises(hf.errors.ControlFailed, match="roll_back of /t/s/notes failed"):
        await do(system, roll_back({"n": "/t/s/notes"}), "n")
    assert await system.ref("/t/s/notes", Notes).ask(Read()) == []


async def test_change_a_mechanism(system: hf.ActorSystem) -> None:
    seen: list[str] = []

    async def attach(address: str) -> None:
        seen.append(address)

    await do(system, change_mechanism(attach, {"a": "/t/a"}), "a")
    assert seen == ["/t/a"]


async def test_channels_of_a_board(system: hf.ActorSystem) -> None:
    simulator = system.spawn(hf.start(BoardSimulator), name="simulator")
    before: BoardState = await simulator.ask(GetBoard())
    system.spawn(hf.start(BoardActor, before.url), name="board")
    await do(system, power_up("/t/board", {"ja": 0}), "ja")
    assert (await simulator.ask(GetBoard())).on == {0, 1}
    await do(system, shutdown("/t/board", {"ja": 0}), "ja")
    assert (await simulator.ask(GetBoard())).on == {1}


async def test_a_command_gets_its_arguments_and_no_shell(system: hf.ActorSystem, tmp_path) -> None:
    # D11: the paper's USB reset is such a command.
    mark = tmp_path / "mark"
    text = f"import sys, pathlib; pathlib.Path({str(mark)!r}).write_text(sys.argv[1])"
    await do(system, run_command(RESET, sys.executable, "-c", text, "{0}; exit 3"), "js")
    assert mark.read_text() == "js; exit 3"


async def test_a_command_that_fails_says_what_it_said(system: hf.ActorSystem) -> None:
    text = "import sys; print('no such device'); sys.exit(3)"
    with pytest.raises(ActionFailed, match=r"ended with 3: no such device"):
        await do(system, run_command(RESET, sys.executable, "-c", text), "js")


async def test_a_command_that_hangs_is_killed(system: hf.ActorSystem, tmp_path) -> None:
    # T61: the fixtures fail when a process is left.
    mark = tmp_path / "mark"
    text = f"import pathlib, time; pathlib.Path({str(mark)!r}).write_text('up'); time.sleep(600)"
    task = asyncio.ensure_future(do(system, run_command(RESET, sys.executable, "-c", text), "js"))
    async with asyncio.timeout(LONG):
        while not mark.exists():
            await asyncio.sleep(0.01)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


async def test_any_coroutine(system: hf.ActorSystem) -> None:
    seen: list[str] = []

    async def reset(act: Act, device: str) -> None:
        seen.append(f"{act.step} because of {act.reason}")

    await do(system, run_coroutine(RESET, reset, attempts=1), "js")
    await do(system, action(RESET)(reset), "js")
    assert seen == ["reset_usb(js) because of a test"] * 2


def test_what_is_not_implemented_is_not_planned() -> None:
    domain = Repertoire([start_node({"a": "/t/a"})]).domain
    assert [one.name for one in domain.actions] == ["start_node"]


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: action("(:action broken"), "parentheses"),
        (lambda: action(""), "one action"),
        (lambda: Repertoire([start_node({}), start_node({})]), "there twice"),
        (lambda: Repertoire([RepairAction("dance", start_node({}).run)]), "no PDDL text"),
    ],
)
def test_wrong_actions_are_refused(make, says: str) -> None:
    with pytest.raises(PlanningError, match=says):
        make()
