"""The dashboard as an ASGI app: a page, a stream of what changes, questions, and orders."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Iterable
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import Message, Receive, Scope, Send

from ...actors.errors import HoldfastError, NoSuchActor, type_name
from ...system.system import ActorSystem
from ..operate.patterns import select
from ..remote import NotAnswering, NotReached
from ..wire import (
    About,
    AskDiagnosis,
    AskHistory,
    AskLives,
    AskLogs,
    AskQuarantined,
    AskWhy,
    ControlActor,
    FollowActor,
    InspectActor,
    NextEvents,
    OrderRepair,
)
from .access import Access, Login, NotAllowed, Role, check_role, token_of
from .answers import Answers, Endpoint, OwnAnswers, SocketAnswers
from .gathering import BEAT, Gathering, Viewer, framed
from .orders import PageOrder, carry_out
from .picture import plain

PAGE: Final = Path(__file__).parent / "page"
KINDS: Final = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
MOST_BYTES: Final = 1024 * 1024
"""Bytes of a request."""
ANSWER: Final = 15.0
"""Seconds for an answer to a question."""
UNREAD: Final = 15.0
"""Seconds after which a viewer is dropped that takes nothing of what it is sent."""
HEADERS: Final = {
    "content-security-policy": (
        "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; object-src 'none'; "
        "require-trusted-types-for 'script'; trusted-types 'none'"
    ),
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
}
"""What is said with each answer: nothing is loaded from elsewhere, framed by others, or made a script of."""

Question = About | InspectActor | AskHistory | AskLives | AskLogs | AskWhy | AskQuarantined | AskDiagnosis
"""What whoever may look may ask."""
Body = TypeVar("Body")
Handler = Callable[[Request, Login], Awaitable[Response]]


class ShowState(msgspec.Struct, tag_field="ask", tag="state", frozen=True, forbid_unknown_fields=True):
    """Asks for the state of an actor in outline."""

    path: str


class ShowRepair(msgspec.Struct, tag_field="ask", tag="repair", frozen=True, forbid_unknown_fields=True):
    """Asks how repair stands."""


class Token(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A token, to be exchanged for a cookie."""

    token: str


class WatchedRows(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is on the screen of a viewer."""

    viewer: int
    paths: list[str]


class Sought(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A pattern of addresses, as the commands take it."""

    pattern: str


def dashboard(
    target: ActorSystem | Endpoint,
    *,
    operators: str | Path | None = None,
    readers: str | Path | None = None,
    hosts: Iterable[str] = (),
    readers_see_state: bool = False,
) -> Dashboard:
    """Make the dashboard of a running system, as an ASGI app: `app.mount("/holdfast", dashboard(system, ...))`.

    It is served on the event loop of the system. Nothing is gathered while nobody looks.

    Args:
        target: the running system; or the path of its control endpoint, if that is in another process, or a function
            that finds it each time that it is connected to.
        operators: the token of those who may change the system, of at least 16 signs; or the `Path` of a file with it,
            which is made with a new one, for this user alone, if it is not there.
        readers: the same of those who may only look.
        hosts: the names under which browsers reach it, such as "shop.example", beside those of the loopback.
        readers_see_state: whether those who may only look see the states of actors, and the content of messages too.

    Raises:
        SpecError: there is no token, it is too short, or others may read its file.
    """
    given: dict[Role, str | Path | None] = {"operate": operators, "read": readers}
    names: dict[Role, str] = {"operate": "operators", "read": "readers"}
    tokens: dict[Role, str] = {role: token_of(token, names[role]) for role, token in given.items() if token is not None}
    answers: Answers = OwnAnswers(target) if isinstance(target, ActorSystem) else SocketAnswers(target)
    return Dashboard(answers, Access(tokens, hosts), readers_see_state=readers_see_state)


class Dashboard:
    """The ASGI app. `close` drops the viewers; a program that ends need not call it."""

    def __init__(self, answers: Answers, access: Access, *, readers_see_state: bool = False) -> None:
        self._answers, self._access = answers, access
        self._state_role: Role = "read" if readers_see_state else "operate"
        self._gathering = Gathering(answers)
        self._traces: set[asyncio.Event] = set()
        routes = [
            Route("/session", self._session, methods=["GET", "POST", "DELETE"]),
            Route("/live", self._guarded("read", self._live), methods=["GET"]),
            Route("/trace", self._guarded("read", self._trace), methods=["GET"]),
            Route("/watch", self._guarded("read", self._watch), methods=["POST"]),
            Route("/seek", self._guarded("read", self._seek), methods=["POST"]),
            Route("/ask", self._guarded("read", self._ask), methods=["POST"]),
            Route("/act", self._guarded("operate", self._act), methods=["POST"]),
            Route("/{name:path}", self._file, methods=["GET"]),
        ]
        handlers: dict[Any, Any] = {HoldfastError: _refused, HTTPException: _not_found}
        self._app = Starlette(routes=routes, exception_handlers=handlers)

    async def close(self) -> None:
        """Drop all viewers, and close what was opened."""
        for over in self._traces:
            over.set()
        await self._gathering.close()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request; the headers that keep the page safe go with every answer."""
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1000})
            return
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                told = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
                message = {**message, "headers": [*message.get("headers", ()), *told]}
            await send(message)

        await self._app(scope, receive, send_safely)

    # -- who asks -----------------------------------------------------------------------------------------------------

    def _guarded(self, needed: Role, handler: Handler) -> Callable[[Request], Awaitable[Response]]:
        """A handler for those who have logged in, and may."""

        async def checked(request: Request) -> Response:
            self._access.check_origin(request)
            login = self._access.login_of(request)
            if request.method != "GET":
                self._access.check_page(request, login)
            check_role(login, needed)
            return await handler(request, login)

        return checked

    async def _session(self, request: Request) -> Response:
        """GET: who one is; the role is empty before the login. POST: exchange a token for a cookie. DELETE: log out."""
        self._access.check_origin(request)
        if request.method == "POST":
            key, login = self._access.log_in((await _body(request, Token)).token)
            response = await self._told(login)
            is_secure = request.url.scheme == "https"
            response.set_cookie(
                self._access.cookie, key, path=_home(request), secure=is_secure, httponly=True, samesite="strict"
            )
            return response
        if request.method == "GET" and not self._access.is_known(request):
            return answered({"role": "", "csrf": "", "sees_state": False})
        login = self._access.login_of(request)
        if request.method == "DELETE":
            self._access.check_page(request, login)
            self._access.log_out(request)
            return Response(status_code=204)
        return await self._told(login)

    async def _told(self, login: Login) -> Response:
        sees_state = self._state_role == "read" or login.role == "operate"
        return answered({"role": login.role, "csrf": login.csrf, "sees_state": sees_state})

    # -- the page -----------------------------------------------------------------------------------------------------

    async def _file(self, request: Request) -> Response:
        """A file of the page. They are the same for all, and hold nothing of the system."""
        self._access.check_host(request)
        name = request.path_params["name"]
        if not request.url.path.endswith("/") and not name:
            return RedirectResponse(_home(request))
        file = PAGE / (name or "index.html")
        if file.parent != PAGE or file.suffix not in KINDS or not file.is_file():
            raise HTTPException(404)
        return FileResponse(file, media_type=KINDS[file.suffix], headers={"cache-control": "no-cache"})

    # -- what changes -------------------------------------------------------------------------------------------------

    async def _live(self, request: Request, login: Login) -> Response:
        return ViewerStream(self._gathering, login)

    async def _watch(self, request: Request, login: Login) -> Response:
        seen = await _body(request, WatchedRows)
        self._gathering.watch(seen.viewer, seen.paths)
        return Response(status_code=204)

    async def _trace(self, request: Request, login: Login) -> Response:
        """Follow the messages of one actor; their content is shown, so that it needs the right to see states."""
        check_role(login, self._state_role)
        over = asyncio.Event()
        self._traces.add(over)
        return Trace(self._answers, request.query_params.get("path", ""), over, lambda: self._traces.discard(over))

    # -- questions and orders -----------------------------------------------------------------------------------------

    async def _seek(self, request: Request, login: Login) -> Response:
        """The addresses that a pattern means, as they were seen last."""
        sought = await _body(request, Sought)
        rows = self._gathering.picture.rows.values()
        return answered({"paths": [row.path for row in select(rows, [sought.pattern])]})

    async def _ask(self, request: Request, login: Login) -> Response:
        asked = await _body(request, Question | ShowState | ShowRepair)  # type: ignore[arg-type]  # a union is no class
        if isinstance(asked, ShowState | AskLogs):  # What is printed may be the content of messages.
            check_role(login, self._state_role)
        if isinstance(asked, ShowState):
            question: Any = ControlActor("outline", asked.path, [], ANSWER)
        else:
            question = OrderRepair("status", (), ANSWER) if isinstance(asked, ShowRepair) else _bounded(asked)
        return answered({"value": await self._answers.ask(question, ANSWER)})

    async def _act(self, request: Request, login: Login) -> Response:
        order = await _body(request, PageOrder)
        try:
            return answered(await carry_out(self._answers, order))
        finally:
            self._gathering.hurry(order.paths)


def _bounded(asked: Any) -> Any:
    """A question that is answered in good time, and waits for nothing."""
    if isinstance(asked, AskHistory | AskLogs):
        return msgspec.structs.replace(asked, wait=0.0)
    if isinstance(asked, InspectActor | AskWhy | AskDiagnosis):
        return msgspec.structs.replace(asked, timeout=min(max(asked.timeout, 0.1), ANSWER / 2))
    return asked


class ViewerStream(Response):
    """The stream of one viewer: it is dropped when it takes nothing for `UNREAD` seconds, and waits for nobody else."""

    def __init__(self, gathering: Gathering, login: Login) -> None:
        super().__init__()
        self._gathering, self._login = gathering, login

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send what changes until the viewer goes, or is dropped."""
        viewer = self._gathering.add(self._login.csrf)
        try:
            await sent_until_gone(receive, send, viewer.gone, lambda: self._send(viewer, send))
        finally:
            await self._gathering.remove(viewer)

    async def _send(self, viewer: Viewer, send: Send) -> None:
        while not viewer.gone.is_set():
            message = await viewer.next()
            async with asyncio.timeout(UNREAD):
                await send({"type": "http.response.body", "body": message, "more_body": True})


class Trace(Response):
    """The stream of the messages of one actor, in a session of its own, which ends with it."""

    def __init__(self, answers: Answers, path: str, over: asyncio.Event, done: Callable[[], None]) -> None:
        super().__init__()
        self._answers, self._path, self._over, self._done = answers, path, over, done

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send what the actor does until the viewer goes, or the actor has ended for good."""
        try:
            await sent_until_gone(receive, send, self._over, lambda: self._send(send))
        finally:
            self._done()

    async def _send(self, send: Send) -> None:
        async with self._answers.session() as session:
            try:
                await session.ask(FollowActor(self._path), ANSWER)
                await self._put(send, "trace", {"events": [], "missed": 0, "is_over": False})  # It is followed now.
                while True:
                    told = await session.ask(NextEvents(BEAT / 2), ANSWER)
                    await self._put(send, "trace", told)
                    if told["is_over"]:
                        return
            except HoldfastError as error:
                await self._put(send, "problem", {"text": str(error)})

    async def _put(self, send: Send, event: str, value: Any) -> None:
        async with asyncio.timeout(UNREAD):
            await send({"type": "http.response.body", "body": framed(event, value), "more_body": True})


async def sent_until_gone(
    receive: Receive, send: Send, gone: asyncio.Event, work: Callable[[], Awaitable[None]]
) -> None:
    """Begin a stream of events, and send until `work` is done, the other side has gone, or `gone` is set."""
    headers = [(b"content-type", b"text/event-stream"), (b"cache-control", b"no-store"), (b"x-accel-buffering", b"no")]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    tasks = [asyncio.ensure_future(one) for one in (work(), gone.wait(), _gone(receive))]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        is_read = tasks[0].done() or not gone.is_set()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    failed = tasks[0].exception() if not tasks[0].cancelled() else None
    if failed is not None and not isinstance(failed, TimeoutError | OSError):
        raise failed
    if is_read and failed is None:
        with contextlib.suppress(TimeoutError, OSError):
            async with asyncio.timeout(1.0):
                await send({"type": "http.response.body", "body": b"", "more_body": False})


async def _gone(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


async def _body(request: Request, kind: type[Body]) -> Body:
    """The body of a request, which is JSON of a known shape. Raises NotAllowed: it is not, or too large."""
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise NotAllowed(415, "send JSON")
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > MOST_BYTES:
            raise NotAllowed(413, f"a request has {MOST_BYTES} bytes at most")
    try:
        return msgspec.json.decode(bytes(body), type=kind)
    except (msgspec.DecodeError, RecursionError) as error:
        raise NotAllowed(400, f"this is no request: {error}") from error


def _home(request: Request) -> str:
    """The path of the page, below whatever root it is mounted at."""
    return f"{request.scope.get('root_path', '').rstrip('/')}/"


def answered(value: Any, status: int = 200) -> Response:
    """An answer in JSON that nobody keeps."""
    return Response(plain(value), status, {"cache-control": "no-store"}, "application/json")


async def _refused(request: Request, error: Exception) -> Response:
    """What goes wrong is told in a sentence; the page shows it."""
    match error:
        case NotAllowed():
            status = error.status
        case NoSuchActor():
            status = 404
        case NotReached() | NotAnswering():
            status = 503
        case _:
            status = 409
    return answered({"error": type_name(type(error)), "text": str(error)}, status)


async def _not_found(request: Request, error: Exception) -> Response:
    status = error.status_code if isinstance(error, HTTPException) else 500
    return answered({"error": "HTTP", "text": f"there is no such page (status {status})"}, status)
