"""A restart by repair is whole: the actor runs again whatever happens, and nobody acts below an escalation."""

import asyncio
from collections.abc import AsyncIterator

import pytest

import holdfast as hf
from holdfast.actors.events import Event, SupervisorGaveUp
from holdfast.supervision.arbiter import Hand, InOtherHands, arbiter_of

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])


class Crash(hf.Message):
    """End by an error."""


class Part(hf.Actor):
    """Starts slowly; as many of its starts fail as are left in `failures`."""

    deterministic = False

    def __init__(self, failures: list[str] | None = None, takes: float = 0.0) -> None:
        self._failures, self._takes = failures if failures is not None else [], takes

    async def on_start(self, restored: bool) -> None:
        await asyncio.sleep(self._takes)
        if self._failures:
            raise RuntimeError(self._failures.pop())

    @hf.on(Crash)
    def _crash(self, message: Crash) -> None:
        raise RuntimeError("as it was told")


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("t", log=False, seed=1) as running:
        yield running


async def states(system: hf.ActorSystem, path: str) -> dict[str, str]:
    return {one.id: one.state for one in await system.ref(path, hf.Supervisor).ask(hf.WhichChildren())}


async def test_a_restart_by_order_whose_start_fails_is_tried_on_as_after_a_crash(system: hf.ActorSystem) -> None:
    failures: list[str] = []
    await system.start(hf.supervisor("s", children=[hf.child("a", hf.start(Part, failures))]))
    failures.append("its port is still taken")
    with pytest.raises(hf.StartFailed, match="its port is still taken"):
        await system.ref("/t/s", hf.Supervisor).ask(hf.RestartChild("a", running=True, unless_parked=True))
    await asyncio.sleep(1.0)
    assert await states(system, "/t/s") == {"a": "running"}


async def test_a_supervisor_that_escalates_during_a_restart_leaves_nobody_stopped(system: hf.ActorSystem) -> None:
    children = [hf.child("a", hf.start(Part, takes=0.5)), hf.child("b", hf.start(Part))]
    top = hf.supervisor("top", children=[hf.supervisor("pipe", intensity=0, children=children)])
    await system.start(top)
    repairing = asyncio.ensure_future(
        system.ref("/t/top/pipe", hf.Supervisor).ask(hf.RestartChild("a", running=True, unless_parked=True), 5.0)
    )
    await asyncio.sleep(0.2)
    system.ref("/t/top/pipe/b", Part).tell(Crash())
    with pytest.raises(hf.HoldfastError):
        await repairing
    await asyncio.sleep(3.0)
    assert await states(system, "/t/top/pipe") == {"a": "running", "b": "running"}


async def test_nothing_below_a_supervisor_that_escalates_is_granted(system: hf.ActorSystem) -> None:
    arbiter = arbiter_of(system._node)
    children = [hf.child("a", hf.start(Part, takes=0.5)), hf.child("b", hf.start(Part))]
    top = hf.supervisor("top", children=[hf.supervisor("pipe", intensity=0, children=children)])
    await system.start(top)
    tried: list[str] = []
    has_given_up = asyncio.Event()

    def heard(event: Event) -> None:
        if isinstance(event, SupervisorGaveUp):
            has_given_up.set()
            attempt()

    def attempt() -> None:
        try:
            arbiter.release(arbiter.claim("/t/top/pipe/a", Hand.REPAIR, "a test"))
            tried.append("granted")
        except InOtherHands:
            tried.append("refused")

    before = system._node.find("/t/top/pipe/a")
    system._node.events.add_sink(heard)
    system.ref("/t/top/pipe/b", Part).tell(Crash())
    await has_given_up.wait()
    while (
        (cell := system._node.find("/t/top/pipe/a")) is None
        or cell is before
        or cell.life < 1
        or cell.state != "running"
    ):
        attempt()
        await asyncio.sleep(0.01)
    system._node.events.remove_sink(heard)
    assert "refused" in tried
    assert "granted" not in tried, tried
