"""Orders from the page do what the commands do, and warn in the same words."""

import asyncio
from typing import Any, get_args

import pytest

import holdfast as hf
from holdfast.console.dashboard.orders import VERBS, PageOrder, Verb
from holdfast.console.overview import look_at
from tests.console.dashboard.conversing import Browser
from tests.system.trees import Add, Life, ref


async def states(system: hf.ActorSystem) -> dict[str, str]:
    return {row.path: row.state for row in (await look_at(system, parts=False)).rows}


async def refused(browser: Browser, verb: str, *paths: str, **fields: Any) -> str:
    answer = await browser.post("/act", {"verb": verb, "paths": paths, **fields})
    assert answer.status_code in (400, 404, 409), answer.text
    return str(answer.json()["text"])


async def test_suspend_and_resume(system: hf.ActorSystem, operator: Browser) -> None:
    done = await operator.act("suspend", "/app/left/a", "/app/left/b")
    assert done["steps"] == ["suspend /app/left/a", "suspend /app/left/b"]
    assert (await states(system))["/app/left/b"] == "suspended"
    await operator.act("resume", "/app/left/a", "/app/left/b")
    assert (await states(system))["/app/left/b"] == "running"


async def test_a_dry_run_says_what_would_be_done(system: hf.ActorSystem, operator: Browser) -> None:
    done = await operator.act("suspend", "/app/left/a", is_dry_run=True)
    assert done["steps"] == ["suspend /app/left/a"]
    assert (await states(system))["/app/left/a"] == "running"


async def test_the_root_is_asked_about(system: hf.ActorSystem, operator: Browser) -> None:
    [warning] = (await operator.act("suspend", "/app"))["warnings"]
    assert "while /app is suspended it starts, stops and restarts none of its 3 children" in warning
    assert (await states(system))["/app"] == "running"


async def test_a_restart_warns_of_a_state_that_is_lost(system: hf.ActorSystem, operator: Browser) -> None:
    target = ref(system, "/app/left/a")
    await target.ask(Add(3))
    done = await operator.act("restart", "/app/left/a")
    assert done["warnings"] == ["without recovery, the state is lost of /app/left/a"]
    assert await target.ask(Life()) == 1
    done = await operator.act("restart", "/app/left/a", is_confirmed=True)
    assert (done["warnings"], done["said"][0].startswith("restarted /app/left/a")) == ([], True)
    assert await target.ask(Life()) == 2
    await operator.act("kill", "/app/left/a", is_confirmed=True)
    assert await target.ask(Life()) == 3


async def test_stop_start_and_remove(system: hf.ActorSystem, operator: Browser) -> None:
    assert (await operator.act("stop", "/app/left/b"))["warnings"]
    done = await operator.act("stop", "/app/left/b", is_confirmed=True)
    assert any(line.startswith("- /app/left/b") for line in done["difference"])
    assert (await states(system))["/app/left/b"] == "stopped"
    await operator.act("start", "/app/left/b")
    assert (await states(system))["/app/left/b"] == "running"
    await operator.act("remove", "/app/left/b", "/app/left/c", is_confirmed=True)
    assert "/app/left/b" not in await states(system)


async def test_bind_and_unbind(system: hf.ActorSystem, operator: Browser) -> None:
    await operator.act("unbind", "/app/right/client", words=["peer"])
    await operator.act("bind", "/app/right/client", words=["peer", "/app/left/b"])
    assert (await operator.ask("inspect", path="/app/right/client"))["bindings"] == {"peer": "/app/left/b"}


async def test_protect_takes_names_and_no_files(system: hf.ActorSystem, operator: Browser) -> None:
    for name in ("evil.py", "evil.py:Mechanism", "../x", "a b", ""):
        assert "by name" in await refused(operator, "protect", "/app/left/a", words=[name])
    done = await operator.act("protect", "/app/left/a", words=["pbr"], is_dry_run=True)
    [step] = done["steps"]
    assert step.startswith("protect /app/left/a by PBR: in a process /app/left/a may give orders to nobody but")


async def test_a_checkpoint_of_who_has_none_is_refused(operator: Browser) -> None:
    assert "/app/left/a" in await refused(operator, "checkpoint", "/app/left/a")


TREE = """
below = "/app/left"
["/app/left"]
supervisor = "one_for_one"
intensity = 4
period = 10.0
["/app/left/a"]
class = "tests.system.trees:Counter"
"""


async def test_a_tree_is_planned_asked_about_and_applied(system: hf.ActorSystem, operator: Browser) -> None:
    plan = await operator.act("apply", text=TREE, is_dry_run=True, is_confirmed=True)
    assert plan["steps"]
    assert plan["lost"] == ["without recovery, the state is lost of /app/left/b, /app/left/c"]
    assert "/app/left/b" in await states(system)
    assert (await operator.act("apply", text=TREE))["warnings"] == plan["lost"]
    assert "/app/left/b" in await states(system)
    done = await operator.act("apply", text=TREE, is_confirmed=True)
    assert done["steps"] == plan["steps"]
    assert "/app/left/b" not in await states(system)
    assert "the page" in await refused(operator, "apply", text="below =")


@pytest.mark.parametrize(
    ("verb", "fields", "said"),
    [
        ("suspend", {"paths": []}, "for nobody"),
        ("suspend", {"paths": ["/app/nobody"]}, "no actor at /app/nobody"),
        ("suspend", {"paths": ["/app/left/*"]}, "no actor"),
        ("suspend", {"words": ["more"]}, "does not take more"),
        ("bind", {"words": ["peer"]}, "does not take peer"),
        ("quarantine-drop", {"words": ["x"]}, "the number of a message"),
        ("quarantine-retry", {}, "in quarantine"),
        ("repair-approve", {"words": ["1"]}, "no repair of app runs"),
        ("terminate", {}, "Invalid enum value"),
    ],
)
async def test_what_cannot_be_done_is_said(operator: Browser, verb: str, fields: dict[str, Any], said: str) -> None:
    body = {"verb": verb, "paths": ["/app/left/a"], **fields}
    answer = await operator.post("/act", body)
    assert (answer.status_code >= 400, said in answer.json()["text"]) == (True, True), answer.text


async def test_an_order_is_an_operators_in_the_history(system: hf.ActorSystem, operator: Browser) -> None:
    await operator.act("restart", "/app/left/a", is_confirmed=True)
    [sentence] = await system.why("/app/left/a")
    assert sentence.startswith("/app/left/a was ended by an operator ")


async def test_many_orders_at_once_are_all_answered(system: hf.ActorSystem, operator: Browser) -> None:
    done = await asyncio.gather(*(operator.act("suspend", f"/app/left/{name}") for name in "abc"))
    assert [one["steps"] for one in done] == [[f"suspend /app/left/{name}"] for name in "abc"]


async def test_an_order_is_for_so_many_actors(operator: Browser) -> None:
    assert "1000 actors at most" in await refused(operator, "suspend", *["/app/left/a"] * 1001)


def test_each_verb_is_listed() -> None:
    assert get_args(Verb) == VERBS
    assert PageOrder("suspend").is_confirmed is False
