"""`holdfast ask` and `holdfast tell`: a message from an operator's hand."""

from __future__ import annotations

import json
import re
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.console.endpoint import control_endpoint
from holdfast.console.remote import RemoteSystem
from tests.console.commands import holdfast

pytestmark = pytest.mark.usefixtures("warm_programs")


class Far(hf.Message[str]):
    text: str = "nothing"


class Farther(Far):
    by: int = 1


class Everything(hf.Message[dict[str, Any]]):
    whole: int
    names: tuple[str, ...]
    to: hf.ActorRef[hf.Actor]
    more: dict[str, float] | None = None


class Pair(hf.Message[tuple[int, int]]): ...


class Grades(hf.Message[dict[str, tuple[float, int]]]): ...


class Seats(hf.Message[dict[int, str]]): ...


class Never(hf.Message): ...


class SoldOut(hf.Refusal, text="only {left} are left"):
    left: int


class Refuse(hf.Message): ...


class Clerk(hf.Actor):
    def __init__(self) -> None:
        self.last = "nothing"

    @hf.on(Far)
    def far(self, message: Far) -> str:
        before, self.last = self.last, message.text
        return before

    @hf.on(Everything)
    def everything(self, message: Everything) -> dict[str, Any]:
        return {"whole": message.whole, "names": list(message.names), "to": message.to.path, "more": message.more}

    @hf.on(Grades)
    def grades(self, message: Grades) -> dict[str, tuple[float, int]]:
        return {"ann": (0.5, 1)}

    @hf.on(Seats)
    def seats(self, message: Seats) -> dict[int, str]:
        return {1: "ann"}

    @hf.on(Pair)
    def pair(self, message: Pair) -> tuple[int, int]:
        return 1, 2

    @hf.on(Never)
    def never(self, message: Never) -> hf.ReplyHandle[None]:
        return self.ctx.reply_handle()

    @hf.on(Refuse)
    def refuse(self, message: Refuse) -> None:
        raise SoldOut(3)


KINDS: dict[str, dict[str, Any]] = {
    "plain": {},
    "recorded": {"recovery": hf.hybrid()},
    "process": {"isolation": "process"},
    "protected": {"mechanism": hf.ftm.PBR()},
}
PATHS = [*(f"/app/{kind}" for kind in KINDS), "/app/far/one"]


@pytest.fixture
async def socket(tmp_path: Path) -> AsyncIterator[Path]:
    async with hf.ActorSystem("app", log=False) as system, control_endpoint(system, tmp_path / "s") as path:
        for name, options in KINDS.items():
            await system.start(hf.child(name, hf.start(Clerk), **options))
        template = hf.child(None, hf.start(Clerk))
        await system.start(hf.dynamic("clerks", template=template))
        await system.start(hf.supervisor("far", isolation="process", children=[hf.child("one", hf.start(Clerk))]))
        yield path


async def said(socket: Path, *words: str) -> tuple[int, str]:
    status, output, errors = await holdfast(*words, "--socket", socket)
    return status, (output or errors).strip()


async def test_each_kind_of_actor_is_asked_and_told(socket: Path) -> None:
    for path in PATHS:
        assert await said(socket, "tell", path, "Far", '{"text": "told"}') == (0, f"told {path}")
        assert await said(socket, "ask", path, "tests.console.test_asking:Far") == (0, '"told"')


async def test_fields_are_json_and_refs_are_addresses(socket: Path) -> None:
    given = {"whole": 7, "names": ["a", "ü"], "to": "/app/process", "more": {"x": 1}}
    status, output = await said(socket, "ask", "/app/plain", "Everything", json.dumps(given))
    assert (status, json.loads(output)) == (0, {**given, "more": {"x": 1.0}})
    assert await said(socket, "ask", "/app/plain", "Pair") == (0, "[1, 2]")
    assert await said(socket, "ask", "/app/plain", "Grades", "--json") == (0, '{"reply": {"ann": [0.5, 1]}}')
    assert await said(socket, "ask", "/app/plain", "Seats") == (0, "{1: 'ann'}")
    assert await said(socket, "ask", "/app/plain", "Seats", "--json") == (0, '{"text": "{1: \'ann\'}"}')
    assert await said(socket, "ask", "/app/plain", "Far", "--json") == (0, '{"reply": "nothing"}')
    assert await said(socket, "ask", "/app/plain", "Farther", '{"by": 2}') == (0, '"nothing"')


async def test_a_supervisor_is_asked_too(socket: Path) -> None:
    status, output = await said(socket, "ask", "/app/clerks", "StartChild", '{"id": "ann"}')
    assert (status, "/app/clerks/ann" in output) == (0, True)
    assert await said(socket, "ask", "/app/clerks/ann", "Far") == (0, '"nothing"')


BAD = {
    "no actor": (("/app/nobody", "Far"), "there is no actor at /app/nobody"),
    "no class": (
        ("/app/plain", "Near"),
        "it does not handle 'Near', but Everything, Far, Grades, Never, Pair, Refuse",
    ),
    "no json": (("/app/plain", "Far", "{text"), "malformed"),
    "no object": (("/app/plain", "Far", "[1]"), "the fields are a JSON object"),
    "no field": (("/app/plain", "Far", '{"txt": "a"}'), "it has no field 'txt', but text"),
    "no value": (("/app/plain", "Everything", '{"whole": 1, "names": []}'), "it lacks the field 'to'"),
    "another type": (("/app/plain", "Far", '{"text": 1}'), "field 'text': Expected `str`, got `int`"),
    "no ref": (
        ("/app/plain", "Everything", '{"whole": 1, "names": [], "to": "/app/x"}'),
        "there is no actor at /app/x",
    ),
    "a number for a ref": (("/app/plain", "Everything", '{"whole": 1, "names": [], "to": 1}'), "no JSON becomes"),
    "refused": (("/app/plain", "Refuse"), "only 3 are left"),
    "no reply": (("/app/plain", "Never"), "did not reply within 0.1 s"),
}


async def test_what_is_wrong_is_said(socket: Path) -> None:
    with RemoteSystem(socket) as remote:
        for (path, message, *fields), why in BAD.values():
            for asks in (True, False):
                if not asks and message in ("Refuse", "Never"):
                    continue
                with pytest.raises(hf.errors.HoldfastError, match=re.escape(why)):
                    await remote.send_message(path, message, *fields or ["{}"], asks=asks, timeout=0.1)
    status, text = await said(socket, "ask", "/app/plain", "Refuse")
    assert (status, "\n" in text, text) == (
        1,
        False,
        "holdfast ask: tests.console.test_asking.SoldOut: only 3 are left",
    )


async def test_no_system_is_another_exit_status(tmp_path: Path) -> None:
    status, text = await said(tmp_path / "none", "tell", "/app/plain", "Far")
    assert status == 2
    assert "no system answers" in text
