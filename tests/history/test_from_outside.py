"""The history from another process: over the control endpoint, by `RemoteSystem`, and by commands."""

import asyncio
import json
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import pytest

import holdfast as hf
from holdfast.console.endpoint import control_endpoint
from holdfast.console.remote import RemoteSystem
from holdfast.console.wire import AskHistory
from holdfast.system.history.pages import HistoryQuestion
from tests.console.commands import holdfast
from tests.history.players import Do, Worker, failed, until

pytestmark = pytest.mark.usefixtures("warm_programs")

T = TypeVar("T")


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    """A system in which something has happened."""
    async with hf.ActorSystem("app", log=False, intensity=100, log_payloads=True) as running:
        worker = await running.start(hf.child("worker", hf.start(Worker)))
        await failed(worker, "crash")
        await worker.ask(Do("well"))
        yield running


@pytest.fixture
async def path(system: hf.ActorSystem, tmp_path: Path) -> AsyncIterator[Path]:
    """Where its control endpoint is."""
    async with control_endpoint(system, tmp_path / "app.sock") as where:
        yield where


async def far(path: Path, work: Callable[[RemoteSystem], T]) -> T:
    """What another process would do: what blocks there must not block us."""

    def run() -> T:
        with RemoteSystem(path) as remote:
            return work(remote)

    return await asyncio.to_thread(run)


async def command(path: Path, *arguments: str) -> tuple[int, str, str]:
    """What a command of the command line says."""
    return await holdfast(*arguments, "--socket", path)


async def test_the_same_is_known_from_outside(system: hf.ActorSystem, path: Path) -> None:
    assert await far(path, lambda remote: remote.history("/app/worker")) == system.history("/app/worker")
    assert await far(path, lambda remote: remote.lives("/app/worker")) == system.lives("/app/worker")
    said = await far(path, lambda remote: asyncio.run(remote.why("/app/worker")))
    assert "/app/worker ended" in said[0]
    page = await far(path, lambda remote: remote.history("/app/**", kinds=["ActorStarted"], after=0, limit=2))
    assert len(page.events) == 2


async def test_following_from_outside(system: hf.ActorSystem, path: Path) -> None:
    worker = system.ref("/app/worker", Worker)
    after = system.history().next

    def follow(remote: RemoteSystem) -> list[str]:
        page = asyncio.run(remote.follow_history("/app/worker", after=after, kinds=["ActorCrashed"], timeout=20.0))
        return [one.kind for one in page.events]

    following = asyncio.create_task(far(path, follow))
    recorder = system._history
    assert recorder is not None
    await until(lambda: recorder.followers)
    await failed(worker, "crash")
    assert await following == ["ActorCrashed"]


async def test_a_follower_that_goes_leaves_nothing_behind(system: hf.ActorSystem, path: Path) -> None:
    recorder = system._history
    assert recorder is not None

    def follow(remote: RemoteSystem) -> None:
        async def run() -> None:
            async with asyncio.timeout(1.0):
                await remote.follow_history(after=recorder.last + 1_000, timeout=60.0)

        with pytest.raises(TimeoutError):
            asyncio.run(run())

    await far(path, follow)
    await until(lambda: not recorder.followers)


@pytest.mark.parametrize("asked", [{"limit": 0}, {"path": "x" * 2_000}, {"since": float("nan")}])
async def test_a_question_from_outside_is_checked_there(path: Path, asked: dict[str, Any]) -> None:
    def ask(remote: RemoteSystem) -> None:
        remote._client.call(AskHistory(HistoryQuestion(**asked)), 10.0)

    with pytest.raises(hf.SpecError, match="history"):
        await far(path, ask)


async def test_an_operator_is_named_as_who_stopped_it(system: hf.ActorSystem, path: Path) -> None:
    await system.start(hf.child("other", hf.start(Worker), restart="temporary"))

    def change(remote: RemoteSystem) -> None:
        async def run() -> None:
            await remote.terminate("/app/worker")
            async with remote.transaction() as change:
                change.remove("/app/other")

        asyncio.run(run())

    await far(path, change)
    ended = system.lives("/app/worker")[1]
    assert (ended.by, ended.because) == ("an operator", "it was terminated")
    assert system.lives("/app/other")[-1].by == "a transaction of an operator"


async def test_the_commands_in_words(system: hf.ActorSystem, path: Path) -> None:
    system.ref("/app/worker", Worker).tell(Do("well"))
    code, said, _ = await command(path, "why", "/app/worker")
    assert (code, said.count("\n")) == (0, 1)
    assert "ZeroDivisionError: nothing to divide" in said
    code, said, _ = await command(path, "history", "/app/worker")
    assert code == 0
    assert [line.split(":")[0] for line in said.splitlines()] == ["life 1", "life 2"]
    assert "handling tests.history.players.Do" in said
    code, said, _ = await command(path, "events", "/app/worker", "--kind", "ActorCrashed")
    assert code == 0
    assert "/app/worker ActorCrashed life=1 reason=ZeroDivisionError: nothing to divide" in said
    for verb in ("history", "why"):  # A typo is told, not taken for "all is well".
        code, said, errors = await command(path, verb, "/app/nobody")
        assert (code, said) == (1, "")
        assert f"holdfast {verb}:" in errors
        assert "the history knows of no life" in errors
    code, said, errors = await command(path, "events", "--kind", "ActorCrash")
    assert (code, said) == (2, "")
    assert "there is no kind of event 'ActorCrash'; there are ActorCrashed" in errors


async def test_the_commands_in_json(system: hf.ActorSystem, path: Path) -> None:
    spec = hf.child("poisoned", hf.start(Worker), isolation="process", recovery=hf.hybrid(max_deliveries=1))
    await failed(await system.start(spec), "kill")
    gone = await system.start(hf.child("gone", hf.start(Worker)))
    await system.stop(gone)
    gone.tell(Do("well"))
    _, said, _ = await command(path, "why", "/app/worker", "--json")
    assert json.loads(said)["address"] == "/app/worker"
    _, said, _ = await command(path, "history", "/app/worker", "--json")
    assert msgspec.convert(json.loads(said)["lives"], list[hf.system.PastLife]) == system.lives("/app/worker")
    _, said, _ = await command(path, "events", "/app/worker", "--json", "--last", "2")
    assert [json.loads(line)["number"] for line in said.splitlines()] == [
        one.number for one in system.history("/app/worker").events[-2:]
    ]
    _, said, _ = await command(path, "dead-letters", "--json")
    [letter] = [json.loads(line) for line in said.splitlines()]
    assert (letter["address"], letter["fields"]["message"]) == ("/app/gone", "tests.history.players.Do")
    assert letter["fields"]["payload"] == "Do(what='well')"
    _, said, _ = await command(path, "quarantine", "--json")
    [message] = json.loads(said)["quarantine"]
    assert (message["address"], message["attempts"]) == ("/app/poisoned", 1)
    assert message["payload"] == "Do(what='kill')"
    _, said, _ = await command(path, "quarantine")
    assert f"/app/poisoned {message['id']} tests.history.players.Do, 1 deaths: Do(what='kill')" in said


async def test_what_is_in_quarantine_is_retried_and_dropped(system: hf.ActorSystem, path: Path) -> None:
    spec = hf.child("poisoned", hf.start(Worker), isolation="process", recovery=hf.hybrid(max_deliveries=1))
    await failed(await system.start(spec), "kill")
    [first] = system.quarantined()
    code, _, said = await command(path, "quarantine", "retry", "/app/worker")
    assert (code, "/app/worker: nothing of it is in quarantine" in said) == (1, True)
    code, _, said = await command(path, "quarantine", "retry", "/app/poisoned", str(first.id + 99))
    assert (code, f"no message {first.id + 99} of it is in quarantine" in said) == (1, True)
    code, said, _ = await command(path, "quarantine", "retry", "/app/poisoned", str(first.id))
    assert (code, said.startswith("handled again: ")) == (0, True)
    await until(lambda: [one.id for one in system.quarantined() if one.id != first.id])  # It has killed again.
    code, _, said = await command(path, "quarantine", "drop", "/app/poisoned")
    assert (code, "this needs a yes: say --yes" in said) == (1, True)
    code, said, _ = await command(path, "quarantine", "drop", "/app/poisoned", "--yes", "--json")
    told = json.loads(said)
    assert (code, [one["address"] for one in told["done"]], told["failed"]) == (0, ["/app/poisoned"], [])
    assert system.quarantined() == []


async def test_last_is_a_number_since_is_a_time_and_nothing_is_said_in_words(path: Path) -> None:
    async with asyncio.timeout(20.0):
        code, said, errors = await command(path, "events", "/app/worker", "--kind", "ActorStarted", "--last", "1")
    assert (code, said.count("\n"), errors) == (0, 1, "")
    for words in (["events", "--kind", "SupervisorGaveUp"], ["events", "--since", "2999-01-01"], ["dead-letters"]):
        code, said, errors = await command(path, *words)
        assert (code, said) == (0, "")
        assert errors == f"no such {'dead letter' if words == ['dead-letters'] else 'event'} is kept\n"
        code, said, errors = await command(path, *words, "--json")
        assert (code, said, errors) == (0, "", "")
    code, said, errors = await command(path, "events", "--since", "lately")
    assert (code, said) == (2, "")
    assert "holdfast events: --since: 'lately' is neither" in errors
    for name, none in (("quarantine", "no such message is in quarantine"), ("connections", "no program is connected")):
        code, said, errors = await command(path, name)
        assert (code, said) == (0, "")
        assert errors.startswith(none)


async def test_events_that_are_followed_come_as_they_are_told(system: hf.ActorSystem, path: Path) -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "holdfast.console.cli", "events", "/app/worker", "--follow", "--json"),
        *("--last", "1", "--socket", str(path)),
        stdout=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    first = json.loads(await asyncio.wait_for(process.stdout.readline(), 30.0))
    await failed(system.ref("/app/worker", Worker), "crash")
    second = json.loads(await asyncio.wait_for(process.stdout.readline(), 30.0))
    assert second["number"] > first["number"]
    assert second["kind"] == "ActorCrashed"
    process.terminate()
    await process.wait()


async def test_the_exit_codes(path: Path, tmp_path: Path) -> None:
    code, _, said = await command(path, "events", "x" * 2_000)
    assert code == 1
    assert said.startswith("holdfast events: ")
    for name in ("why", "history", "events", "dead-letters", "quarantine"):
        arguments = ["/app/worker"] if name in ("why", "history") else []
        code, out, said = await command(tmp_path / "nobody.sock", name, *arguments)
        assert (code, out) == (2, "")
        assert "no system answers at" in said


async def test_what_a_terminal_would_obey_is_not_printed(system: hf.ActorSystem, path: Path) -> None:
    system._node.emit(hf.events.RecoveryFailed("/app/worker", "red \x1b[31m\x07 and a\nline"))
    code, said, _ = await command(path, "events", "--kind", "RecoveryFailed")
    assert code == 0
    assert "red ?[31m? and a?line" in said
    assert said.count("\n") == 1
