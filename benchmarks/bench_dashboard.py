"""What does the dashboard cost, and how soon does it show?

`frame` is what script and layout of a frame take in a real Chromium while it jumps through 10,000 actors, the median of
some runs; `rows` how many of them are elements then; `paint` the time from the opening of the page until the tree is
there; `change` the time from a change of the system until the screen shows it, and `request` that of one over HTTP
that does nothing; `viewers` the part of one processor that five viewers of a system of 100 actors take more than the
same system without viewers.

Command: python benchmarks/bench_dashboard.py [--quick]
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import statistics
import time
from collections.abc import AsyncGenerator

import httpx
from harness import Job, Run, main
from playwright.async_api import Page, async_playwright
from workload import Responder

import holdfast as hf
from holdfast.console.dashboard import dashboard, open_dashboard

TOKEN = "a-token-for-the-benchmark"
GROUP = 99
VIEWERS = 5
FRAMES = 200
SCROLL = """
async (frames) => {
  const tree = document.querySelector('[role=tree]');
  for (let at = 0; at < frames; at += 1) {
    tree.scrollTop = (at * 7919 * 28) % (tree.scrollHeight - tree.clientHeight);
    await new Promise(requestAnimationFrame);
  }
}
"""


@contextlib.asynccontextmanager
async def served(actors: int) -> AsyncGenerator[tuple[hf.ActorSystem, str]]:
    """A system of so many actors, with its dashboard."""
    async with hf.ActorSystem("bench", log=False) as system:
        for at in range(max(1, actors // (GROUP + 1))):
            crowd = [hf.child(f"echo{number}", hf.start(Responder)) for number in range(GROUP)]
            await system.start(hf.supervisor(f"group{at}", children=crowd))
        async with open_dashboard(dashboard(system, operators=TOKEN)) as url:
            yield system, url


@contextlib.asynccontextmanager
async def browsed(url: str) -> AsyncGenerator[Page]:
    """A page in Chromium that shows the dashboard."""
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = await browser.new_page(viewport={"width": 1280, "height": 900})
        await page.goto(f"{url}#token={TOKEN}")
        await page.get_by_role("treeitem").first.wait_for()
        yield page
        await browser.close()


async def scrolling(run: Run) -> None:
    """Frames while 10,000 actors pass by, and how many rows are elements then."""
    async with served(run.size(10_000)) as (_, url), browsed(url) as page:
        await page.get_by_role("button", name="Expand").click()
        session = await page.context.new_cdp_session(page)
        await session.send("Performance.enable")

        async def spent() -> float:
            told = {one["name"]: one["value"] for one in (await session.send("Performance.getMetrics"))["metrics"]}
            return float(told["ScriptDuration"] + told["LayoutDuration"] + told["RecalcStyleDuration"])

        frames: list[float] = []
        for _ in range(run.size(10)):
            before = await spent()
            await page.evaluate(SCROLL, FRAMES)
            frames.append(1e3 * (await spent() - before) / FRAMES)
        run.bound("frame", statistics.median(frames), unit="ms", target=8.0)
        run.bound("rows", await page.locator(".row").count(), unit="rows", target=200.0)


async def painting(run: Run) -> None:
    """From the opening of the page until the tree of 10,000 actors is there."""
    async with served(run.size(10_000)) as (_, url), browsed(url) as page:
        times: list[float] = []
        for _ in range(run.size(5)):
            begun = time.perf_counter()
            await page.reload()
            await page.get_by_role("treeitem").first.wait_for()
            times.append(time.perf_counter() - begun)
        run.bound("paint", statistics.median(times), unit="s", target=1.0)


async def changing(run: Run) -> None:
    """From a change until it is on the screen, in a system of 10,000 actors; beside a request that does nothing."""
    async with (
        served(run.size(10_000)) as (system, url),
        browsed(url) as page,
        httpx.AsyncClient(base_url=url) as client,
    ):
        echo = system.ref("/bench/group0/echo0", Responder)
        await page.get_by_role("searchbox").fill("/bench/group0/echo0")
        state = page.locator(".row.at .st")
        await state.get_by_text("running").wait_for()
        times, nothing = list[float](), list[float]()
        for number in range(run.size(20)):
            wanted = "running" if number % 2 else "suspended"
            begun = time.perf_counter()
            await (system.resume(echo) if number % 2 else system.suspend(echo))
            await page.wait_for_function("w => document.querySelector('.row.at .st').textContent === w", arg=wanted)
            times.append(time.perf_counter() - begun)
            begun = time.perf_counter()
            await client.get("/session")
            nothing.append(time.perf_counter() - begun)
        run.bound("change", 1e3 * statistics.median(times), unit="ms", target=200.0)
        run.bound("request", 1e3 * statistics.median(nothing), unit="ms", target=50.0)


async def viewing(run: Run) -> None:
    """The part of one processor that five viewers take, who read all they are sent, and have a screen."""
    seconds = 0.2 * run.size(100)
    async with served(100) as (_, url):
        begun = time.process_time()
        await asyncio.sleep(seconds)
        alone = (time.process_time() - begun) / seconds
        async with contextlib.AsyncExitStack() as stack:
            reading = [asyncio.ensure_future(_read(url, stack)) for _ in range(VIEWERS)]
            await asyncio.sleep(1.0)
            begun = time.process_time()
            await asyncio.sleep(seconds)
            watched = (time.process_time() - begun) / seconds
            for one in reading:
                one.cancel()
            await asyncio.gather(*reading, return_exceptions=True)
        run.bound("viewers", 100 * (watched - alone), unit="%", target=2.0)


async def _read(url: str, stack: contextlib.AsyncExitStack) -> None:
    """Read all that comes, and look at nothing of it: that would be the browser's work, and is not measured here."""
    client = await stack.enter_async_context(httpx.AsyncClient(base_url=url))
    login = await client.post("/session", json={"token": TOKEN})
    (name, value), *_ = client.cookies.items()
    host, port = url.removeprefix("http://").rstrip("/").split(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    writer.write(f"GET /live HTTP/1.1\r\nHost: {host}:{port}\r\nCookie: {name}={value}\r\n\r\n".encode())
    first = (await reader.readuntil(b'"viewer":') + await reader.readuntil(b",")).rpartition(b":")[2]
    seen = {"viewer": int(first.rstrip(b",")), "paths": [f"/bench/group0/echo{at}" for at in range(40)]}
    await client.post("/watch", json=seen, headers={"x-holdfast-csrf": login.json()["csrf"]})
    try:
        while await reader.read(1 << 16):
            pass
    finally:
        writer.close()


JOBS: tuple[Job, ...] = (scrolling, painting, changing, viewing)

if __name__ == "__main__":
    main(JOBS)
