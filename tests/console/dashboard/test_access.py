"""Who may use the dashboard, and from where: tokens, roles, cookies, and pages that are not ours."""

import asyncio
import os
import ssl
import stat
import time
from pathlib import Path
from typing import Any

import httpx
import pytest
from starlette.applications import Starlette
from starlette.routing import Mount

import holdfast as hf
from holdfast.console.dashboard import Dashboard, dashboard, open_dashboard, token_of
from holdfast.console.dashboard import access as access_module
from tests.cluster.certificates import certificates
from tests.console.dashboard.conversing import HOME, OPERATORS, READERS, Browser

pytestmark = pytest.mark.usefixtures("system")
ASKED = {"ask": "about"}
SUSPEND = {"verb": "suspend", "paths": ["/app/left"]}


async def test_without_a_token_nothing_of_the_system_is_told(app: Dashboard) -> None:
    browser = Browser(app)
    told = (await browser.http.get("/session")).json()
    assert told == {"role": "", "csrf": "", "sees_state": False}
    for method, path in (("GET", "/live"), ("GET", "/trace"), ("DELETE", "/session")):
        assert (await browser.http.request(method, path)).status_code == 401
    for path in ("/ask", "/act", "/seek", "/watch"):
        assert (await browser.post(path, ASKED)).status_code == 401
    assert (await browser.log_in("something-else-0123456789")).status_code == 401
    page = await browser.http.get("/")
    assert page.status_code == 200
    assert "app" not in page.text.replace("apple", "")


async def test_a_token_is_exchanged_for_a_cookie_that_scripts_do_not_see(app: Dashboard) -> None:
    browser = Browser(app)
    answer = await browser.log_in(OPERATORS)
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    assert "path=/" in cookie
    assert "secure" not in cookie
    assert OPERATORS not in cookie
    assert OPERATORS not in answer.text
    assert (await browser.ask("about"))["name"] == "app"
    safe = Browser(app, HOME.replace("http:", "https:"))
    assert "secure" in (await safe.log_in(OPERATORS)).headers["set-cookie"].lower()


async def test_who_has_logged_out_asks_in_vain(operator: Browser) -> None:
    assert (await operator.http.delete("/session", headers={"x-holdfast-csrf": operator.csrf})).status_code == 204
    assert (await operator.post("/ask", ASKED)).status_code == 401


async def test_a_login_ends(operator: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    later = time.monotonic() + access_module.LASTS + 1.0
    monkeypatch.setattr(time, "monotonic", lambda: later)
    assert (await operator.post("/ask", ASKED)).status_code == 401


async def test_who_may_look_may_not_change(reader: Browser, operator: Browser) -> None:
    assert (await reader.ask("about"))["name"] == "app"
    refused = await reader.post("/act", SUSPEND)
    assert (refused.status_code, "look only" in refused.json()["text"]) == (403, True)
    assert (await operator.post("/act", SUSPEND)).status_code == 200


async def test_states_and_messages_are_for_operators_unless_it_is_said_otherwise(
    system: hf.ActorSystem, reader: Browser, operator: Browser
) -> None:
    asked = {"ask": "state", "path": "/app/left/a"}
    lines = {"ask": "logs", "question": {"path": "/app/**"}, "wait": 9.0}
    assert (await reader.post("/ask", asked)).status_code == 403
    assert (await reader.post("/ask", lines)).status_code == 403
    async with reader.stream("/trace", "path=/app/left/a") as stream:
        assert await stream.answer() == 403
    assert "count" in (await operator.post("/ask", asked)).json()["value"]
    system._node.emit(hf.events.LogLine("/app/left/a", "stdout", "printed", 1))
    assert [one["text"] for one in (await operator.post("/ask", lines)).json()["value"]["lines"]] == ["printed"]
    shown = Browser(dashboard(system, readers=READERS, readers_see_state=True))
    assert (await shown.log_in(READERS)).json()["sees_state"] is True
    assert "count" in (await shown.ask("state", path="/app/left/a"))


async def test_what_the_page_itself_has_not_sent_is_refused(operator: Browser) -> None:
    operator.csrf, right = "wrong", operator.csrf
    assert (await operator.post("/act", SUSPEND)).status_code == 403
    assert (await operator.post("/ask", ASKED)).status_code == 403
    operator.csrf = right
    assert (await operator.post("/ask", ASKED)).status_code == 200


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://evil.example"},
        {"origin": "http://127.0.0.1:9999"},
        {"origin": "null"},
        {"sec-fetch-site": "cross-site"},
        {"sec-fetch-site": "same-site"},
    ],
)
async def test_another_page_may_not_ask(operator: Browser, headers: dict[str, str]) -> None:
    assert (await operator.post("/ask", ASKED, **headers)).status_code == 403
    assert (await operator.http.get("/live", headers=headers)).status_code == 403
    assert (await operator.http.post("/session", json={"token": OPERATORS}, headers=headers)).status_code == 403
    assert (await operator.post("/ask", ASKED, origin=HOME)).status_code == 200


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8000", "127.0.0.1.evil.example", ""])
async def test_a_name_that_is_not_ours_is_refused(operator: Browser, host: str) -> None:
    """A page may have its own name lead to the loopback: what it asks for names that host."""
    for answer in (
        await operator.http.get("/", headers={"host": host}),
        await operator.post("/ask", ASKED, host=host),
    ):
        assert answer.status_code == 421
    assert (await operator.post("/ask", ASKED, host="localhost:1")).status_code == 200


async def test_a_host_that_is_named_is_served(system: hf.ActorSystem) -> None:
    browser = Browser(dashboard(system, readers=READERS, hosts=["Shop.example"]), "https://shop.example")
    assert (await browser.log_in(READERS)).is_success
    assert (await browser.ask("about"))["name"] == "app"


async def test_a_request_is_json_and_small(operator: Browser) -> None:
    headers = {"x-holdfast-csrf": operator.csrf}
    plain = await operator.http.post("/ask", content=b'{"ask": "about"}', headers=headers)
    assert plain.status_code == 415
    large = await operator.post("/ask", {"ask": "about", "x": "x" * 2_000_000})
    assert large.status_code == 413
    bodies: list[Any] = [{"ask": "terminate", "path": "/app"}, {"ask": "about", "more": 1}, [], {"ask": "control"}]
    for body in bodies:
        assert (await operator.post("/ask", body)).status_code == 400


async def test_tokens_are_not_guessed_fast(app: Dashboard) -> None:
    browser = Browser(app)
    for number in range(access_module.MOST_WRONG):
        assert (await browser.log_in(f"wrong-token-0123456789-{number}")).status_code == 401
    assert (await browser.log_in("wrong-token-0123456789-last")).status_code == 429
    assert (await browser.log_in(OPERATORS)).is_success  # Nobody is locked out by what others try.


async def test_each_answer_says_what_a_browser_may_do_with_it(operator: Browser) -> None:
    for answer in (
        await operator.http.get("/"),
        await operator.post("/ask", ASKED),
        await operator.http.get("/nobody"),
    ):
        assert "default-src 'self'" in answer.headers["content-security-policy"]
        assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
    assert (await operator.post("/ask", ASKED)).headers["cache-control"] == "no-store"


async def test_only_the_files_of_the_page_are_served(operator: Browser) -> None:
    assert (await operator.http.get("/style.css")).headers["content-type"].startswith("text/css")
    for path in (
        "/../access.py",
        "/%2e%2e/access.py",
        "/..%2faccess.py",
        "/access.py",
        "//etc/passwd",
        "/page",
        "/a/b",
    ):
        assert (await operator.http.get(path)).status_code == 404


async def test_it_works_below_any_path(app: Dashboard) -> None:
    outer = Starlette(routes=[Mount("/ops/holdfast", app)])
    async with httpx.AsyncClient(transport=httpx.ASGITransport(outer), base_url=HOME) as client:
        moved = await client.get("/ops/holdfast")
        assert (moved.is_redirect, moved.headers["location"].endswith("/ops/holdfast/")) == (True, True)
        page = await client.get("/ops/holdfast/")
        assert page.status_code == 200
        assert not [line for line in page.text.splitlines() if 'src="/' in line or 'href="/' in line]
        answer = await client.post("/ops/holdfast/session", json={"token": OPERATORS})
        assert "path=/ops/holdfast/" in answer.headers["set-cookie"].lower()
        headers = {"x-holdfast-csrf": answer.json()["csrf"]}
        told = await client.post("/ops/holdfast/ask", json=ASKED, headers=headers)
        assert told.json()["value"]["name"] == "app"


def test_a_token_comes_from_a_file_that_nobody_else_reads(tmp_path: Path) -> None:
    file = tmp_path / "token"
    made = token_of(file, "operators")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert len(made) >= 40
    assert token_of(file, "operators") == made
    file.chmod(0o640)
    with pytest.raises(hf.errors.SpecError, match="others may read"):
        token_of(file, "operators")
    file.chmod(0o600)
    file.write_text("short\n")
    with pytest.raises(hf.errors.SpecError, match="16 printable signs"):
        token_of(file, "operators")
    link = tmp_path / "link"
    os.symlink(file, link)
    with pytest.raises(hf.errors.SpecError, match="cannot be read"):
        token_of(link, "operators")
    with pytest.raises(hf.errors.SpecError, match="cannot be made"):
        token_of(tmp_path / "nowhere" / "token", "operators")


async def test_a_dashboard_without_tokens_or_with_one_for_both_is_refused(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.errors.SpecError, match="operators= or readers="):
        dashboard(system)
    with pytest.raises(hf.errors.SpecError, match="different tokens"):
        dashboard(system, operators=OPERATORS, readers=OPERATORS)
    with pytest.raises(hf.errors.SpecError, match="16 printable signs"):
        dashboard(system, operators="short")


async def test_others_reach_it_with_tls_only(app: Dashboard, tmp_path: Path) -> None:
    with pytest.raises(hf.errors.SpecError, match=r"others can reach 0\.0\.0\.0.*insecure=True"):
        async with open_dashboard(app, host="0.0.0.0"):
            pass
    with pytest.raises(hf.errors.SpecError, match="there is no file"):
        async with open_dashboard(app, host="0.0.0.0", certfile=tmp_path / "cert.pem", keyfile=tmp_path / "key.pem"):
            pass
    async with open_dashboard(app) as url:
        assert url.startswith("http://127.0.0.1:")
        async with httpx.AsyncClient(base_url=url) as client:
            assert (await client.get("/")).status_code == 200
            assert (await client.get("/live")).status_code == 401
        with pytest.raises(hf.errors.SpecError, match="in use"):
            async with open_dashboard(app, port=int(url.rstrip("/").rpartition(":")[2])):
                pass


async def test_over_tls_the_cookie_goes_over_tls_only(app: Dashboard, tmp_path: Path) -> None:
    """A real handshake; whoever speaks plain text to it gets nothing, and holds up nobody."""
    files = certificates(tmp_path / "tls")
    async with open_dashboard(app, host="0.0.0.0", certfile=files.certificate, keyfile=files.key) as url:
        there = url.replace("0.0.0.0", "127.0.0.1")
        assert there.startswith("https://")
        trusting = ssl.create_default_context(cafile=files.ca)
        async with httpx.AsyncClient(base_url=there, verify=trusting) as client:
            headers = {"Origin": there.rstrip("/"), "Content-Type": "application/json"}
            answer = await client.post("/session", headers=headers, json={"token": OPERATORS})
            assert answer.is_success, answer.text
            assert "; secure" in answer.headers["set-cookie"].lower()
            assert (await client.get("/session")).json()["role"] == "operate"
        async with httpx.AsyncClient(base_url=there) as stranger:
            with pytest.raises(httpx.ConnectError, match=r"(?i)certificate"):
                await stranger.get("/")
        async with httpx.AsyncClient(base_url=there.replace("https:", "http:")) as plain:
            with pytest.raises(httpx.TransportError):
                await plain.get("/")


async def test_a_system_on_another_loop_is_told_so(system: hf.ActorSystem) -> None:
    """The loop of the system is not to be touched from another thread."""

    async def elsewhere() -> httpx.Response:
        browser = Browser(dashboard(system, readers=READERS))
        await browser.log_in(READERS)
        return await browser.post("/ask", ASKED)

    answer = await asyncio.to_thread(lambda: asyncio.run(elsewhere()))
    assert (answer.status_code, "another thread" in answer.json()["text"]) == (409, True)
