"""A kill from outside counts against the message in hand, as a death does; an end that a supervisor orders does not."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.supervision.admin import CountChildren, RestartChild
from tests.checkpoint.players import Do, Doer, Note, Notes, Seen, Sink, until
from tests.checkpoint.strikes import NEVER, doer, event, home, let_through
from tests.effects.patient import Call, Count, Go, patient

IN_TIME = 15.0
WHOM = "/app/team/doer"


class Kill(hf.Message): ...


class Killer(hf.Actor):
    """A watchdog, wherever it lives."""

    whom: hf.Binding[Doer]

    @hf.on(Kill)
    def kill(self, message: Kill) -> None:
        self.ctx.find(WHOM, Doer).kill()


def team(
    isolation: str, *others: hf.ChildSpec[Any], strategy: Any = "one_for_one", deliveries: int = 2, **options: Any
) -> hf.ChildSpec[Any]:
    """A supervisor with an actor of which a message is put aside after so many deaths in its turn."""
    own: Any = "process" if isolation == "process" else "task"
    mechanism = hf.ftm.PBR() if isolation == "PBR" else None
    method = hf.hybrid(interval=NEVER, max_deliveries=deliveries)
    spec = hf.child("doer", hf.start(Doer), isolation=own, recovery=method, mechanism=mechanism, **options)
    above: Any = "process" if isolation == "subtree" else "task"
    return hf.supervisor("team", strategy=strategy, children=[spec, *others], isolation=above, intensity=99)


@pytest.mark.parametrize("killer", ["root", "sibling", "process"])
@pytest.mark.parametrize("isolation", ["task", "process", "subtree", "PBR"])
async def test_a_turn_that_is_killed_again_and_again_is_put_aside(
    system: hf.ActorSystem, gate: Path, isolation: str, killer: str
) -> None:
    await system.start(team(isolation, hf.child("sibling", hf.start(Killer))))
    await system.start(hf.child("far", hf.start(Killer), isolation="process", bindings={"whom": WHOM}))
    ref = system.ref(WHOM, Doer)
    bad = asyncio.ensure_future(ref.ask(Do([f"gate {gate}"]), timeout=IN_TIME))
    for _ in range(2):
        await until(gate.exists, IN_TIME)
        gate.unlink()
        match killer:
            case "root":
                ref.kill()
            case "sibling":
                system.ref("/app/team/sibling", Killer).tell(Kill())
            case _:
                system.ref("/app/far", Killer).tell(Kill())
    with pytest.raises(hf.Quarantined):
        await bad
    assert [one.attempts for one in system.quarantined(ref)] == [2]
    assert await ref.ask(Note("behind"), timeout=IN_TIME) == 1


async def test_what_a_supervisor_ends_is_not_counted(system: hf.ActorSystem, gate: Path, isolation: str) -> None:
    """It is killed because another child has failed, and its turn begins anew each time."""
    other = hf.child("other", hf.start(Doer))
    await system.start(team(isolation, other, strategy="one_for_all", shutdown="brutal_kill"))
    ref = system.ref(WHOM, Doer)
    asked = asyncio.ensure_future(ref.ask(Do([f"gate {gate}"]), timeout=IN_TIME))
    for _ in range(4):
        await until(gate.exists, IN_TIME)
        gate.unlink()
        system.ref("/app/team/other", Doer).tell(Do(["raise now"]))
    await until(gate.exists, IN_TIME)
    let_through(gate)
    assert await asked == "0"


@pytest.mark.parametrize("isolation", ["task", "process", "subtree", "PBR"])
async def test_a_turn_that_is_cut_off_twice_because_it_hangs_is_put_aside(
    system: hf.ActorSystem, gate: Path, isolation: str
) -> None:
    """Repair says with its order that the actor works badly; without that word it is an operator's, and counts not."""
    await system.start(team(isolation, deliveries=3, shutdown=0.2))
    ref, above = system.ref(WHOM, Doer), system.ref("/app/team", hf.Supervisor)
    bad = asyncio.ensure_future(ref.ask(Do([f"gate {gate}"]), timeout=IN_TIME))
    for blames in (False, False, True, True):
        await until(gate.exists, IN_TIME)
        gate.unlink()
        assert not system.quarantined(ref)
        await above.ask(RestartChild("doer", running=True, blames_turn=blames), timeout=IN_TIME)
    with pytest.raises(hf.Quarantined):
        await bad
    assert [one.attempts for one in system.quarantined(ref)] == [2]
    assert await ref.ask(Note("behind"), timeout=IN_TIME) == 1


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_turn_that_ends_when_repair_wants_it_to_counts_nothing(
    system: hf.ActorSystem, gate: Path, isolation: str
) -> None:
    await system.start(team(isolation, deliveries=1))
    ref, above = system.ref(WHOM, Doer), system.ref("/app/team", hf.Supervisor)
    asked = asyncio.ensure_future(ref.ask(Do([f"gate {gate}"]), timeout=IN_TIME))
    await until(gate.exists, IN_TIME)
    again = asyncio.ensure_future(above.ask(RestartChild("doer", running=True, blames_turn=True), timeout=IN_TIME))
    await above.ask(CountChildren())  # It has taken the order by now.
    let_through(gate)
    await again
    assert await asked == "0"
    assert await ref.ask(Note("behind"), timeout=IN_TIME) == 1


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_turn_that_rests_is_killed_as_often_as_anybody_likes(system: hf.ActorSystem, isolation: str) -> None:
    ref = await system.start(patient(isolation, recovery=hf.hybrid(interval=NEVER, max_deliveries=1)))
    asked = asyncio.ensure_future(ref.ask(Go(["c"]), timeout=IN_TIME))
    for _ in range(3):
        await until(lambda: home(ref).calls.rests.is_busy, IN_TIME)
        with system.events() as stream:
            ref.kill()
            await event(stream, hf.events.Recovered)
    ref.tell(Call("now"))
    assert await asked == "call now"
    assert await ref.ask(Count(), timeout=IN_TIME) == 1


@pytest.mark.parametrize("isolation", ["process", "subtree"])
async def test_deaths_count_in_a_row_without_progress(system: hf.ActorSystem, tmp_path: Path, isolation: str) -> None:
    """Each life of a turn comes one ask further than the last before it dies; then one dies twice at one place."""
    ref = await doer(system, isolation, max_deliveries=2)
    sink = await system.start(hf.child("sink", hf.start(Sink)))
    steps = [step for number in range(4) for step in (f"ask {number}", f"once {tmp_path}/fuse{number}")]
    await ref.ask(Do(steps, sink), timeout=IN_TIME)
    assert await ref.ask(Seen(), timeout=IN_TIME) == ["0:1", "1:2", "2:3", "3:4"]
    with pytest.raises(hf.Quarantined):
        await ref.ask(Do(["ask on", f"die {tmp_path}/deaths"], sink), timeout=IN_TIME)
    assert (tmp_path / "deaths").read_text() == "xx"
    assert await sink.ask(Notes()) == ["0", "1", "2", "3", "on"]
