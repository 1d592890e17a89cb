"""What comes back after a crash or a kill, in a task and in a process (DESIGN 4 and 6, T9-T28).

What is stored is used after the crash (R2): messages are recorded as they come (R14, R22, R23), the life is started
again (R35) and handles them again (R37); none is lost on the way to isolation (R42), and who asked is answered (R43).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Do, Doer, Hooks, No, Note, Notes, Seen, Sink, start, until
from tests.checkpoint.strikes import NEVER, doer, event, let_through, sink, snapshot_after, strike, struck

pytestmark = pytest.mark.pairs

# -- state, mailbox, the message in hand ------------------------------------------------------------------------------


async def test_state_and_queued_messages_come_back_after_kills(system: hf.ActorSystem, isolation: str) -> None:
    ref = await doer(system, isolation)
    expected: list[str] = []
    for kill in range(3):
        for n in range(5):
            ref.tell(Note(f"{kill}.{n}"))
            expected.append(f"{kill}.{n}")
        strike(system, ref)
        asked = ref.ask(Note(f"{kill}.asked"), timeout=30.0)
        expected.append(f"{kill}.asked")
        assert await asked == len(expected)
    assert await ref.ask(Seen()) == expected


async def test_a_message_whose_handler_crashes_is_not_run_again(system: hf.ActorSystem, isolation: str) -> None:
    ref, notes = await doer(system, isolation), await sink(system)
    await ref.ask(Note("before"))
    failing = ref.ask(Do(["tell unreleased", "add bad", "raise no luck"], notes))
    after = ref.ask(Note("after"), timeout=30.0)
    with pytest.raises(hf.RemoteCrash, match="no luck"):
        await failing
    assert await after == 2
    await struck(system, ref)
    assert await ref.ask(Seen()) == ["before", "after"], "what the failed turn did is gone"
    assert await notes.ask(Notes()) == [], "and so is what it had not released"


async def test_a_message_whose_life_is_killed_is_run_again_and_answered(
    system: hf.ActorSystem, isolation: str, gate: Path
) -> None:
    ref = await doer(system, isolation)
    asked = ref.ask(Do(["add one", f"gate {gate}"]), timeout=30.0)
    behind = ref.ask(Note("two"), timeout=30.0)
    await until(gate.exists)
    recovered = await struck(system, ref)
    let_through(gate)
    assert (await asked, await behind) == ("1", 2)
    assert await ref.ask(Seen()) == ["one", "two"]
    assert recovered.life == 2
    assert set(recovered.phases) == {"detect", "isolate", "restart", "restore", "replay", "release"}


async def test_a_refusal_is_an_answer_and_no_crash(system: hf.ActorSystem, isolation: str) -> None:
    ref = await doer(system, isolation)
    with pytest.raises(No, match="not today"):
        await ref.ask(Do(["add kept", "refuse not today"]))
    await struck(system, ref)
    assert await ref.ask(Seen()) == ["kept"]


async def test_an_expired_ask_is_not_begun(system: hf.ActorSystem, isolation: str, gate: Path) -> None:
    ref = await doer(system, isolation)
    busy = ref.ask(Do([f"gate {gate}"]), timeout=30.0)
    await until(gate.exists)
    with pytest.raises(hf.AskTimeout):
        await ref.ask(Note("expired"), timeout=0.05)
    let_through(gate)
    await busy
    assert await ref.ask(Seen()) == []
    await struck(system, ref)
    assert await ref.ask(Seen()) == []


# -- outputs ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("release", ["ask", "send", "flush"])
async def test_what_left_before_the_kill_leaves_once_and_in_order(
    system: hf.ActorSystem, isolation: str, gate: Path, release: str
) -> None:
    """T19: the crash falls between what is released in the turn and the turn's end."""
    ref, notes = await doer(system, isolation), await sink(system)
    middle = "flush" if release == "flush" else f"{release} 2"
    asked = ref.ask(Do(["tell 1", middle, "tell 3", f"gate {gate}", "tell 4"], notes), timeout=30.0)
    await until(gate.exists)
    for _ in range(2):
        gate.unlink()
        await struck(system, ref)
        await until(gate.exists)
    let_through(gate)
    await asked
    await struck(system, ref)
    sent = ["1", "3", "4"] if release == "flush" else ["1", "2", "3", "4"]
    assert await notes.ask(Notes()) == sent


async def test_asks_inside_turns_are_answered_from_the_journal(system: hf.ActorSystem, isolation: str) -> None:
    """T23: every reply says how many the sink had got, so a second question would be seen in both."""
    ref, notes = await doer(system, isolation), await sink(system)
    for n in range(4):
        await ref.ask(Do([f"ask a{n}", f"ask b{n}"], notes))
        await struck(system, ref)
    assert await ref.ask(Seen()) == [f"{x}{n}:{2 * n + i}" for n in range(4) for i, x in enumerate("ab", 1)]
    noted = await notes.ask(Notes())
    assert len(noted) == 8


async def test_a_turn_that_raises_keeps_what_an_ask_has_released(system: hf.ActorSystem, isolation: str) -> None:
    ref, notes = await doer(system, isolation), await sink(system)
    for n in range(2):
        with pytest.raises(hf.RemoteCrash):
            await ref.ask(Do([f"tell out{n}", f"ask in{n}", f"tell lost{n}", "raise x"], notes), timeout=30.0)
        await ref.ask(Note(f"good{n}"), timeout=30.0)
    await struck(system, ref)
    assert await notes.ask(Notes()) == ["out0", "in0", "out1", "in1"]
    assert await ref.ask(Seen()) == ["good0", "good1"]


async def test_an_ask_between_two_recorded_actors_survives_both(
    system: hf.ActorSystem, isolation: str, gate: Path
) -> None:
    """The asker is struck first, then the asked, then both; the one question has one answer."""
    asker, asked = await doer(system, isolation, "asker"), await doer(system, isolation, "asked")
    through = await doer(system, "task", "through")
    busy = asked.ask(Do([f"gate {gate}"]), timeout=30.0)
    await until(gate.exists)
    answer = asker.ask(Do(["add begun", "ask hello"], asked), timeout=30.0)
    await through.ask(Note("x"))
    for victims in ([asker], [asked], [asker, asked]):
        lives = {victim: victim._cell.life for victim in victims}
        for victim in victims:
            strike(system, victim)
        for victim, life in lives.items():
            cell: Any = victim._cell
            await until(lambda c=cell, n=life: c.life > n and c.host.home.switch.life.is_released)
    let_through(gate)
    await busy
    assert await answer == "2"
    assert await asker.ask(Seen()) == ["begun", "hello:1"]
    assert await asked.ask(Seen()) == ["hello"]


async def test_an_ask_that_timed_out_times_out_again_under_replay(
    system: hf.ActorSystem, isolation: str, gate: Path
) -> None:
    ref, slow = await doer(system, isolation), await system.start(hf.child("slow", hf.start(Doer)))
    await ref.ask(Do([f"hurry {gate}"], slow), timeout=30.0)
    let_through(gate)
    await struck(system, ref)
    assert await ref.ask(Seen()) == ["timeout"]


async def test_a_recorded_actor_asks_one_in_a_plain_process(system: hf.ActorSystem, isolation: str) -> None:
    ref = await doer(system, isolation)
    other = await system.start(hf.child("other", hf.start(Sink), isolation="process"))
    await ref.ask(Do(["ask one", "ask two"], other))
    await struck(system, ref)
    assert await ref.ask(Seen()) == ["one:1", "two:2"]


async def test_an_ask_to_oneself_is_refused_at_once(system: hf.ActorSystem, isolation: str) -> None:
    ref = await doer(system, isolation)
    with pytest.raises(hf.RemoteCrash, match="AskDeadlock"):
        await ref.ask(Do(["ask me"], ref))


@pytest.mark.parametrize("target", ["task", "process", "recorded"])
async def test_a_forwarded_ask_is_answered_by_the_receiver(system: hf.ActorSystem, isolation: str, target: str) -> None:
    ref = await doer(system, isolation)
    kind: Any = "task" if target == "recorded" else target
    recovery = hf.hybrid() if target == "recorded" else None
    other = await system.start(hf.child("other", hf.start(Doer), isolation=kind, recovery=recovery))

    asked = ref.ask(Do(["forward", "add here"], other), timeout=30.0)
    assert await asked == "1"
    await struck(system, ref)
    assert await ref.ask(Seen()) == ["here"]
    assert await other.ask(Seen()) == ["here"]


# -- others hear of it ------------------------------------------------------------------------------------------------


async def test_a_monitor_hears_of_each_crash_and_that_it_is_being_recovered(
    system: hf.ActorSystem, isolation: str
) -> None:
    watcher, ref = await doer(system, "task", "watcher"), await doer(system, isolation)
    await watcher.ask(Do(["monitor"], ref))
    for _ in range(2):
        await struck(system, ref)
    await system.stop(ref)
    assert await watcher.ask(Seen()) == ["down True", "down True", "down False"]


async def test_links_do_not_fire_when_the_other_is_recovered(system: hf.ActorSystem, isolation: str) -> None:
    linked, ref = await doer(system, "task", "linked"), await doer(system, isolation)
    await linked.ask(Do(["link"], ref))
    await struck(system, ref)
    await system._node.settled()
    assert linked._cell.life == 1


async def test_links_fire_when_the_other_is_gone_for_good(system: hf.ActorSystem, isolation: str) -> None:
    ref, other = await doer(system, isolation), await system.start(hf.child("x", hf.start(Doer), restart="temporary"))
    await ref.ask(Do(["add kept", "link"], other))
    with system.events() as stream:
        other.kill()
        await event(stream, hf.events.Recovered)
    assert await ref.ask(Seen()) == ["kept"]


# -- hooks, and crashes inside recovery -------------------------------------------------------------------------------


async def test_hooks_run_in_their_order(system: hf.ActorSystem, isolation: str, tmp_path: Path) -> None:
    log, fuse = tmp_path / "log", tmp_path / "fuse"
    recovery = hf.hybrid(interval=0.01)
    ref = await start(system, isolation, "hooks", hf.start(Hooks, str(log), str(fuse)), recovery=recovery)
    assert log.read_text().split("\n")[:-1] == ["init", "start False"]
    log.write_text("")
    await ref.ask(Note("1"))
    await snapshot_after(system, ref, 1)
    with system.events() as stream:
        await ref.ask(Note("2"))
        strike(system, ref)
        await event(stream, hf.events.Recovered)
    told = log.read_text().split("\n")[:-1]
    replayed = ["note 2"] if "note 2" in told[2:] and told.count("note 2") == 2 else []
    assert told == ["note 1", "note 2", "init", "start True", *replayed, "recovered 2"]


@pytest.mark.parametrize("phase", ["init", "start False", "start True", "note 2", "recovered 2"])
@pytest.mark.parametrize("death", ["crash", "kill"])
async def test_a_crash_inside_recovery_is_recovered_from(
    system: hf.ActorSystem, isolation: str, tmp_path: Path, phase: str, death: str
) -> None:
    """T17: every phase can be entered again."""
    if death == "kill" and isolation == "task":
        death = "crash"
    with_snapshot = phase == "start True"
    log, fuse = tmp_path / "log", tmp_path / "fuse"
    recovery = hf.hybrid(interval=0.01 if with_snapshot else NEVER)
    ref = await start(system, isolation, "hooks", hf.start(Hooks, str(log), str(fuse)), recovery=recovery)
    await ref.ask(Note("1"))
    await ref.ask(Note("2"))
    if with_snapshot:
        await snapshot_after(system, ref, 2)
    if death == "kill":
        Path(f"{fuse}.kill").touch()
    fuse.write_text(phase)
    await struck(system, ref)
    assert not fuse.exists(), "it really died there"
    assert await ref.ask(Note("3")) == 3
    assert log.read_text().count("init") >= 3 or phase == "init"
