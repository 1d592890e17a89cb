"""What viewers are told: a picture, then what changes; one gathering for all, and none when nobody looks."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.errors import HoldfastError
from holdfast.console.dashboard import dashboard, web_app
from holdfast.console.dashboard import gathering as gathering_module
from holdfast.console.dashboard.answers import Answers, OwnAnswers, SocketAnswers
from holdfast.console.dashboard.gathering import (
    MOST_OF_ONE,
    MOST_PENDING,
    MOST_VIEWERS,
    Gathering,
    TooManyViewers,
    Viewer,
)
from holdfast.console.endpoint import control_endpoint
from holdfast.console.overview import look_at
from holdfast.console.wire import About, AnyRequest, Overview
from tests.console.dashboard.conversing import READERS, Browser, EventReader
from tests.system.trees import Boom, counter, ref


class Counted:
    """Answers as somebody else does, and counts what was answered."""

    def __init__(self, inner: Answers) -> None:
        self.inner, self.asked = inner, list[AnyRequest]()
        self.fails = False
        self.holds: asyncio.Event | None = None  # what is asked waits for it
        self.session = inner.session

    async def ask(self, request: AnyRequest, timeout: float) -> Any:
        if self.fails:
            raise HoldfastError("it is away")
        if self.holds is not None:
            await self.holds.wait()
        value = await self.inner.ask(request, timeout)
        self.asked.append(request)
        return value

    async def close(self) -> None:
        await self.inner.close()

    def looks(self) -> int:
        return sum(isinstance(one, Overview) for one in self.asked)


def paths(told: dict[str, Any]) -> list[str]:
    return [row[0] for row in told["rows"]]


async def seen(reader: EventReader) -> dict[str, Any]:
    return await reader.until("snapshot")


async def test_a_viewer_sees_the_whole_and_then_what_changes(system: hf.ActorSystem, reader: Browser) -> None:
    async with reader.stream() as stream:
        first = await seen(stream)
        assert (first["system"], first["problem"]) == ("app", "")
        assert paths(first)[:3] == ["/app", "/app/left", "/app/left/a"]
        await system.suspend(ref(system, "/app/left/b"))
        told = await stream.until("change", lambda data: data.get("rows"))
        assert [(row[0], row[2], behind) for row, behind in told["rows"]] == [("/app/left/b", "suspended", None)]
        async with system.transaction() as change:
            change.add("/app/left", counter("d"))
        told = await stream.until(
            "change", lambda data: any(row[0][0] == "/app/left/d" for row in data.get("rows", []))
        )
        assert [behind for row, behind in told["rows"] if row[0] == "/app/left/d"] == ["/app/left/c"]
        async with system.transaction() as change:
            change.remove("/app/left/d")
        assert (await stream.until("change", lambda data: data.get("gone")))["gone"] == ["/app/left/d"]


async def test_what_is_told_is_heard_of_at_once_and_asked_why(system: hf.ActorSystem, reader: Browser) -> None:
    async with reader.stream() as stream:
        await seen(stream)
        ref(system, "/app/left/a").tell(Boom())
        events = await stream.until("events", lambda data: any(one["kind"] == "ActorCrashed" for one in data))
        assert "/app/left/a" in {one["address"] for one in events}
        told = await stream.until(
            "troubles", lambda data: any(one["address"] == "/app/left/a" for one in data["troubles"])
        )
        troubles = {one["address"]: one for one in told["troubles"]}
        assert set(troubles) <= {"/app/left/a", "/app/right/e"}  # The latter was stopped before.
        assert troubles["/app/left/a"]["grade"] == "odd"
        assert "RuntimeError: boom at" in troubles["/app/left/a"]["sentences"][0]


async def test_parts_of_the_runtime_are_not_shown(system: hf.ActorSystem, operator: Browser) -> None:
    """Their events are heard of as all are, and a look at their addresses finds nobody."""
    async with operator.stream() as stream:
        first = await seen(stream)
        await system.start(counter("kept", recovery=hf.hybrid()))
        found: list[str] = []
        while "/app/kept" not in found:
            told = await stream.until("change", lambda data: data.get("rows"))
            found += [row[0] for row, _ in told["rows"]]
        assert system.ref("/app/recovery", hf.Actor).path == "/app/recovery"
        assert not [path for path in found if "recovery" in path]
        look = await look_at(system, parts=False, paths=["/app/recovery", "/app/kept", "/app/recovery/controller"])
        assert [row.path for row in look.rows] == ["/app/kept"]
        assert (await look_at(system, parts=True, paths=["/app/recovery"])).rows != []
        # What is nobody's is not looked at either: a look that fails would be everybody's loss.
        answer = await operator.post("/watch", {"viewer": first["viewer"], "paths": ["", "x", "/app/left/a"]})
        assert answer.status_code == 204
        await system.suspend(ref(system, "/app/left/a"))
        await stream.until("change", lambda data: any(row[0][2] == "suspended" for row in data.get("rows", [])))


async def test_another_order_is_a_new_picture(system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch) -> None:
    """A transaction may have changed all: it is looked at all, however rarely that is done."""
    monkeypatch.setattr(gathering_module, "SHARE_OF_ALL", 1e-9)
    monkeypatch.setattr(gathering_module, "RAREST", 3600.0)
    answers = Counted(OwnAnswers(system))
    gathering = Gathering(answers)
    viewer = gathering.add("one")
    await told_by(viewer, b"snapshot")
    while answers.looks() < 2:
        await asyncio.sleep(0)
    async with system.transaction() as change:
        change.reorder("/app/left", ["c", "a", "b"])
    told = (await told_by(viewer, b"event: snapshot")).partition(b"event: snapshot")[2]
    found = [told.index(f'"/app/left/{name}"'.encode()) for name in "cab"]
    assert found == sorted(found)
    await gathering.close()


async def test_five_viewers_cost_one_gathering_and_nobody_costs_none(system: hf.ActorSystem) -> None:
    answers = Counted(OwnAnswers(system))
    gathering = Gathering(answers)
    viewers = [gathering.add("one") for _ in range(5)]
    for viewer in viewers:
        assert b"snapshot" in await viewer.next()
    while answers.looks() < 3:
        await asyncio.sleep(0)
    assert len({id(viewer) for viewer in viewers}) == 5
    asked = answers.looks()
    for viewer in viewers:
        await gathering.remove(viewer)
    assert not gathering.picture.rows
    assert answers.looks() <= asked + 1
    await gathering.close()
    assert {task.get_name() for task in asyncio.all_tasks()} & {"holdfast dashboard"} == set()


async def test_who_does_not_read_is_dropped_and_others_are_not(system: hf.ActorSystem) -> None:
    gathering = Gathering(OwnAnswers(system))
    slow, quick = gathering.add("one"), gathering.add("one")
    await quick.next()
    for number in range(MOST_PENDING + 1):
        gathering._tell("problem", {"text": str(number)})
        await quick.next()
    assert (slow.gone.is_set(), quick.gone.is_set()) == (True, False)
    await gathering.close()


async def test_a_stream_that_takes_nothing_ends(
    system: hf.ActorSystem, reader: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The connection is there, and whoever is at its other end reads nothing: it is closed after a while."""
    monkeypatch.setattr(web_app, "UNREAD", 0.05)
    async with reader.stream() as stream:
        await seen(stream)
        stream.stop_reading()
        await system.suspend(ref(system, "/app/left/b"))
        async with asyncio.timeout(30.0):
            await asyncio.wait((stream.task,))
        assert stream.task.exception() is None


async def test_there_are_so_many_viewers_and_no_more(system: hf.ActorSystem) -> None:
    gathering = Gathering(OwnAnswers(system))
    for number in range(MOST_VIEWERS):
        gathering.add(f"{number // MOST_OF_ONE}")
    with pytest.raises(TooManyViewers):
        gathering.add("one")
    await gathering.close()


async def test_one_viewer_too_many_is_told(reader: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gathering_module, "MOST_VIEWERS", 0)
    async with reader.stream() as stream:
        async with asyncio.timeout(30.0):
            await asyncio.wait((stream.task,))
        assert stream.status == 409


async def test_a_system_that_does_not_answer_is_told_and_asked_again(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gathering_module, "AGAIN", 0.01)
    answers = Counted(OwnAnswers(system))
    gathering = Gathering(answers)
    viewer = gathering.add("one")
    assert b"event: snapshot" in await told_by(viewer, b"snapshot")
    answers.fails = True
    assert b"it is away" in await told_by(viewer, b"problem")
    late = gathering.add("one")
    assert b'"problem":"it is away"' in await late.next()
    answers.fails = False
    assert b'"problem":""' in await told_by(viewer, b"snapshot")
    await gathering.close()


async def test_a_system_that_is_silent_is_told_before_its_time_is_over(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one that is stopped by SIGSTOP: nothing fails, and nothing comes."""
    monkeypatch.setattr(gathering_module, "SILENT", 0.01)
    answers = Counted(OwnAnswers(system))
    gathering = Gathering(answers)
    viewer = gathering.add("one")
    assert b'"is_judged":false' in await told_by(viewer, b"snapshot")
    await told_by(viewer, b"event: troubles")
    answers.holds = asyncio.Event()
    assert b"nothing for more than 0.01 s" in await told_by(viewer, b"event: problem")
    answers.holds.set()
    told = await told_by(viewer, b"event: snapshot")
    assert b'"problem":""' in told
    assert b'"is_judged":true' in told
    await gathering.close()


async def test_one_login_does_not_take_all_views(system: hf.ActorSystem) -> None:
    gathering = Gathering(OwnAnswers(system))
    for _ in range(MOST_OF_ONE):
        gathering.add("greedy")
    with pytest.raises(TooManyViewers):
        gathering.add("greedy")
    gathering.add("other")
    await gathering.close()


async def test_the_next_program_of_a_name_is_found(tmp_path: Path) -> None:
    at = [tmp_path / "first.sock"]
    answers = SocketAnswers(lambda: at[0])
    for number, name in enumerate(("first", "second")):
        at[0] = tmp_path / f"{name}.sock"
        async with hf.ActorSystem(f"app{number}", log=False) as system, control_endpoint(system, at[0]):
            about = await answers.ask(About(), 10.0)
            assert about["name"] == f"app{number}"
    await answers.close()


async def told_by(viewer: Viewer, what: bytes) -> bytes:
    async with asyncio.timeout(30.0):
        while what not in (told := await viewer.next()):
            pass
    return told


async def test_in_a_large_system_the_screen_is_looked_at_more_often(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All actors are looked at rarely here; a mailbox that is on somebody's screen is seen to grow all the same."""
    monkeypatch.setattr(gathering_module, "SHARE", 1e-9)
    monkeypatch.setattr(gathering_module, "SHARE_OF_ALL", 1e-9)
    monkeypatch.setattr(gathering_module, "RAREST", 3600.0)
    monkeypatch.setattr(gathering_module, "RAREST_SOME", 0.05)
    answers = Counted(OwnAnswers(system))
    gathering = Gathering(answers)
    viewer = gathering.add("one")
    await told_by(viewer, b"snapshot")
    await system.suspend(ref(system, "/app/left/c"))
    gathering.watch(viewer.number, ["/app/left/c"])
    await told_by(viewer, b'"suspended"')
    ref(system, "/app/left/c").tell(Boom())
    await told_by(viewer, b"event: change")
    wholes = [one for one in answers.asked if isinstance(one, Overview) and one.paths is None]
    assert len(wholes) <= 2  # the first two
    await gathering.close()


async def test_a_system_without_a_history_is_shown(tmp_path: Path) -> None:
    async with hf.ActorSystem("app", log=False, history=False) as system:
        await system.start(counter("alone"))
        await system.suspend(ref(system, "/app/alone"))
        app = dashboard(system, readers=READERS)
        browser = Browser(app)
        await browser.log_in(READERS)
        async with browser.stream() as stream:
            assert "/app/alone" in paths(await seen(stream))
            told = await stream.until("troubles", lambda data: data["troubles"])
            assert [one["sentences"] for one in told["troubles"]] == [
                ["/app/alone is suspended: it handles nothing, and what comes waits for `resume`."]
            ]
        await app.close()
        await browser.http.aclose()


async def test_it_is_the_same_over_the_control_endpoint(system: hf.ActorSystem, path: Path) -> None:
    app = dashboard(path, operators=READERS)
    browser = Browser(app)
    await browser.log_in(READERS)
    async with browser.stream() as stream:
        assert paths(await seen(stream)) == [row["path"] for row in await in_tree(system)]
        await browser.act("suspend", "/app/left/a")
        await stream.until("change", lambda data: any(row[0][2] == "suspended" for row in data.get("rows", [])))
        await stream.until("troubles", lambda data: data["troubles"])
    assert await browser.ask("why", path="/app/left/a", timeout=5.0) == await system.why("/app/left/a")
    async with browser.stream("/trace", "path=/app/left/b") as trace:
        await trace.until("trace")
        ref(system, "/app/left/b").tell(Boom())
        told = await trace.until("trace", lambda data: data["events"])
        assert told["events"][0]["what"] in ("MessageIn", "TurnBegan")
    await app.close()
    await browser.http.aclose()


async def in_tree(system: hf.ActorSystem) -> list[dict[str, Any]]:
    return [{"path": row.path} for row in (await look_at(system, parts=False)).rows]


async def test_a_connection_that_was_closed_is_replaced(system: hf.ActorSystem, tmp_path: Path) -> None:
    where = tmp_path / "again.sock"
    answers = SocketAnswers(where)
    async with control_endpoint(system, where):
        assert (await answers.ask(About(), 5.0))["name"] == "app"
    with pytest.raises(hf.errors.HoldfastError, match="no system answers"):
        await answers.ask(About(), 5.0)
    async with control_endpoint(system, where):
        assert (await answers.ask(About(), 5.0))["name"] == "app"
        await answers.close()
