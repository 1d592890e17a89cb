"""How the tests talk with a dashboard in their own process: requests by httpx, streams by hand."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncGenerator, Callable
from typing import Any

import httpx
from starlette.types import Message

from holdfast.console.dashboard import Dashboard

OPERATORS, READERS = "operators-token-0123456789", "readers-token-0123456789"
HOME = "http://127.0.0.1:8000"


class Browser:
    """A client that logs in, keeps its cookie, and says what a page says with each request."""

    def __init__(self, app: Dashboard, home: str = HOME) -> None:
        self._app = app
        self.http = httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url=home)
        self.csrf = ""

    async def log_in(self, token: str) -> httpx.Response:
        answer = await self.http.post("/session", json={"token": token})
        if answer.is_success:
            self.csrf = answer.json()["csrf"]
        return answer

    async def post(self, path: str, body: Any, **headers: str) -> httpx.Response:
        return await self.http.post(path, json=body, headers={"x-holdfast-csrf": self.csrf, **headers})

    async def ask(self, ask: str, **fields: Any) -> Any:
        answer = await self.post("/ask", {"ask": ask, **fields})
        assert answer.is_success, answer.text
        return answer.json()["value"]

    async def act(self, verb: str, *paths: str, **fields: Any) -> Any:
        answer = await self.post("/act", {"verb": verb, "paths": paths, **fields})
        assert answer.is_success, answer.text
        return answer.json()

    @contextlib.asynccontextmanager
    async def stream(self, path: str = "/live", query: str = "") -> AsyncGenerator[EventReader]:
        """Open a stream of events, and leave it at the end of the block."""
        cookies = "; ".join(f"{name}={value}" for name, value in self.http.cookies.items())
        reader = EventReader(self._app, path, query, cookies)
        try:
            yield reader
        finally:
            await reader.leave()


class EventReader:
    """The other end of a stream, which may stop reading."""

    def __init__(self, app: Dashboard, path: str, query: str, cookies: str) -> None:
        self.status = 0
        self._left, self._reads, self._answered = asyncio.Event(), asyncio.Event(), asyncio.Event()
        self._reads.set()
        self._parts: asyncio.Queue[bytes] = asyncio.Queue()
        self._rest = b""
        headers = [(b"host", b"127.0.0.1:8000"), (b"cookie", cookies.encode())]
        scope = {"type": "http", "method": "GET", "path": path, "raw_path": path.encode(), "scheme": "http"}
        more = {"query_string": query.encode(), "headers": headers, "http_version": "1.1", "root_path": ""}
        addresses = {"server": ("127.0.0.1", 8000), "client": ("127.0.0.1", 1)}
        self.task = asyncio.create_task(app({**scope, **more, **addresses}, self._receive, self._send))

    async def _receive(self) -> Message:
        await self._left.wait()
        return {"type": "http.disconnect"}

    async def _send(self, message: Message) -> None:
        await self._reads.wait()
        self.status = message.get("status", self.status)
        self._answered.set()
        self._parts.put_nowait(message.get("body", b""))

    async def answer(self) -> int:
        """The status of the answer, as soon as there is one."""
        await self._answered.wait()
        return self.status

    def stop_reading(self) -> None:
        self._reads.clear()

    async def next(self) -> tuple[str, Any]:
        """The next event and its data; what only says that the stream is there is passed over."""
        while True:
            block, end, rest = self._rest.partition(b"\n\n")
            if not end:
                self._rest += await self._parts.get()
                continue
            self._rest = rest
            if not block.startswith(b":"):
                kind, _, data = block.partition(b"\ndata: ")
                return kind.removeprefix(b"event: ").decode(), json.loads(data)

    async def until(self, kind: str, is_meant: Callable[[Any], bool] = lambda data: True) -> Any:
        """The data of the next event of a kind for which something is true."""
        async with asyncio.timeout(30.0):
            while True:
                told, data = await self.next()
                if told == kind and is_meant(data):
                    return data

    async def leave(self) -> None:
        self._left.set()
        self._reads.set()
        await asyncio.wait((self.task,))
