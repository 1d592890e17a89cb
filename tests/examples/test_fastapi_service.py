"""The web service, on a real server: endpoints in threads and on the loop reach one actor, and nothing is lost."""

import http.client
import importlib
import json
import socket
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="needs pip install 'holdfast[web]'")
uvicorn = pytest.importorskip("uvicorn", reason="needs pip install 'holdfast[web]'")

EXAMPLES = str(Path(__file__).parents[2] / "examples")
SEATS = 50


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Where the service listens."""
    monkeypatch.syspath_prepend(EXAMPLES)
    app = importlib.import_module("fastapi_service").app
    listening = socket.create_server(("127.0.0.1", 0), backlog=2 * SEATS)  # Whoever comes too early waits in there.
    server = uvicorn.Server(uvicorn.Config(app, log_level="error"))
    thread = threading.Thread(target=server.run, args=([listening],))
    thread.start()
    try:
        yield listening.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join()
        listening.close()
        sys.modules.pop("fastapi_service")


def call(port: int, method: str, path: str) -> tuple[int, Any]:
    """Status and body of the answer."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    try:
        connection.request(method, path)
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())
    finally:
        connection.close()


def test_no_ticket_is_sold_twice_and_none_is_lost(port: int) -> None:
    with ThreadPoolExecutor(16) as clients:
        answers = list(clients.map(lambda _: call(port, "POST", "/tickets/opera"), range(SEATS - 1)))
    assert sorted(body["ticket"] for _, body in answers) == list(range(1, SEATS))
    assert call(port, "GET", "/tickets/opera") == (200, {"left": 1})
    assert call(port, "POST", "/tickets/opera") == (200, {"ticket": SEATS})
    assert call(port, "POST", "/tickets/opera") == (409, {"detail": "opera is sold out"})
    assert call(port, "GET", "/tickets/ballet") == (200, {"left": SEATS})
