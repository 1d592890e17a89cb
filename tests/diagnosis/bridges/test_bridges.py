"""Other systems hear of diagnoses, and are heard: real servers on loopback, and the definitions of ROS."""

import asyncio
import contextlib
import dataclasses
import io
import json
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from typing import Any

import aiohttp
import msgspec
import pytest
import uvicorn
from aiohttp import web

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis import observer
from holdfast.diagnosis.bridges import (
    ALERTS,
    AlertApp,
    AlertObserver,
    NotDelivered,
    OutsideAlert,
    RosBridge,
    WebhookAlert,
    WebhookBridge,
    WebhookPayload,
)
from holdfast.diagnosis.bridges.ros_diagnostics import as_ros
from holdfast.diagnosis.engine import State
from holdfast.diagnosis.literals import parse
from holdfast.diagnosis.observations import Observation
from holdfast.diagnosis.observers import Manner
from holdfast.testing import advance, probe

QUICK = Manner(every=0.1, time_to_live=1.0)


class Part(hf.Actor):
    """Does nothing; what is said of it is all that is known."""


@pytest.fixture
async def watching() -> AsyncIterator[tuple[hf.ActorSystem, diagnosis.Watch]]:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(
            hf.supervisor("desk", children=[hf.child(name, hf.start(Part)) for name in ("feed", "book")])
        )
        yield system, await diagnosis.watch(system, seconds=0.0, manner=QUICK, alerts=True, repair="off")


class TakenBack(hf.Actor):
    """Notes what an observer says no longer."""

    def __init__(self, noted: list[str]) -> None:
        self._noted = noted

    @hf.subscribe(diagnosis.OBSERVATIONS)
    @hf.on(Observation)
    def _note(self, message: Observation) -> None:
        if not message.time_to_live and "alerts" in str(message.literal):
            self._noted.append(str(message.literal))


async def accuse(system: hf.ActorSystem, name: str, *, is_good: bool = False) -> None:
    literal = parse(f"{'' if is_good else 'not '}progress(desk/{name})")
    await system.publish(diagnosis.OBSERVATIONS, Observation(literal, system._node.loop.time(), "test", 600.0))


class Receiver:
    """A webhook on loopback that notes what is posted, and answers what it is told to."""

    def __init__(self) -> None:
        self.posts: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self.answers: list[int] = []
        self.authorizations: set[str | None] = set()

    async def _take(self, request: web.Request) -> web.Response:
        self.authorizations.add(request.headers.get("Authorization"))
        status = self.answers.pop(0) if self.answers else 200
        if status == 200:
            await self.posts.put(await request.json())
        return web.Response(status=status)

    async def next(self) -> dict[str, Any]:
        async with asyncio.timeout(30.0):
            return await self.posts.get()

    @contextlib.asynccontextmanager
    async def served(self, port: int = 0) -> AsyncGenerator[int]:
        app = web.Application()
        app.router.add_post("/hook", self._take)
        runner = web.AppRunner(app)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", port)
        await site.start()
        try:
            yield runner.addresses[0][1]
        finally:
            await runner.cleanup()


async def test_suspects_are_posted_as_alertmanager_does_and_resolved(watching: Any) -> None:
    system, _ = watching
    receiver = Receiver()
    async with receiver.served() as port:
        bridge = hf.start(WebhookBridge, f"http://127.0.0.1:{port}/hook", token="secret", external_url="http://x/")
        await system.start(hf.child("webhook", bridge))
        await accuse(system, "feed")
        post = await receiver.next()
        assert {"version", "groupKey", "truncatedAlerts", "status", "receiver", "groupLabels", "commonLabels",
                "commonAnnotations", "externalURL", "alerts"} == post.keys()  # fmt: skip
        assert (post["version"], post["status"], post["groupLabels"]) == ("4", "firing", {"system": "app"})
        [alert] = post["alerts"]
        assert alert["labels"] == {
            "alertname": "HoldfastFault", "system": "app", "component": "desk/feed", "severity": "critical"
        }  # fmt: skip
        assert (alert["status"], alert["endsAt"], alert["generatorURL"]) == (
            "firing",
            "0001-01-01T00:00:00Z",
            "http://x/",
        )
        await accuse(system, "feed", is_good=True)
        post = await receiver.next()
        [over] = post["alerts"]
        assert (post["status"], over["status"], over["fingerprint"]) == ("resolved", "resolved", alert["fingerprint"])
        assert over["startsAt"] == alert["startsAt"] <= over["endsAt"]
        assert receiver.authorizations == {"Bearer secret"}
        await system.stop(system.ref("/app/webhook"))


async def test_what_a_receiver_cannot_take_is_posted_again_and_what_it_refuses_is_told(watching: Any) -> None:
    system, _ = watching
    receiver = Receiver()
    receiver.answers = [503, 429, 200, 400]
    with system.events() as events:
        async with receiver.served() as port:
            await system.start(hf.child("webhook", hf.start(WebhookBridge, f"http://127.0.0.1:{port}/hook")))
            await accuse(system, "feed")
            assert len((await receiver.next())["alerts"]) == 1
            await accuse(system, "book")  # This is refused for good.
            async with asyncio.timeout(30.0):
                while not (told := await events.until(NotDelivered)).is_given_up:
                    pass
            assert told.why == "it answers 400"
        await accuse(system, "feed", is_good=True)  # Nobody listens there now.
        assert not (await events.until(NotDelivered)).is_given_up
        async with receiver.served(port):
            assert [one["status"] for one in (await receiver.next())["alerts"]] == ["resolved"]
        await system.stop(system.ref("/app/webhook"))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: WebhookBridge("http://example.org/hook", token="x"), "would go there in clear"),
        (lambda: WebhookBridge("example.org"), "must be http://HOST"),
        (lambda: RosBridge("http://127.0.0.1"), "must be ws://HOST"),
        (lambda: RosBridge(), "rclpy cannot be imported"),
        (lambda: AlertApp(None, token=""), "token must not be empty"),  # type: ignore[arg-type]  # refused before
    ],
)
def test_what_cannot_work_is_refused(make: Callable[[], object], said: str) -> None:
    with pytest.raises(hf.SpecError, match=said):
        make()
    WebhookBridge("http://example.org/hook", token="x", insecure=True)


# -- ROS ------------------------------------------------------------------------------------------------------------

DEFINITIONS = {
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header\nDiagnosticStatus[] status",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte level\nstring name\nstring message\nstring hardware_id\nKeyValue[] values"
    ),
    "diagnostic_msgs/KeyValue": "string key\nstring value",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
}
"""The fields of the messages of ROS 2; the constants of DiagnosticStatus are OK 0, WARN 1, ERROR 2 and STALE 3."""
NUMBERS = {"byte": range(256), "int32": range(-(2**31), 2**31), "uint32": range(2**32)}


def check(value: Any, kind: str, package: str) -> None:
    """Whether plain data is a message, field for field. Raises AssertionError."""
    if kind.endswith("[]"):
        for one in value:
            check(one, kind[:-2], package)
    elif kind == "string":
        assert isinstance(value, str)
    elif kind in NUMBERS:
        assert isinstance(value, int)
        assert value in NUMBERS[kind]
    else:
        name = kind if "/" in kind else f"{package}/{kind}"
        fields = {field: of for of, field in map(str.split, DEFINITIONS[name].splitlines())}
        assert value.keys() == fields.keys()
        for field, of in fields.items():
            check(value[field], of, name.partition("/")[0])


class RosServer:
    """A rosbridge server on loopback that notes what it hears."""

    def __init__(self) -> None:
        self.heard: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self.sockets: list[web.WebSocketResponse] = []

    async def _serve(self, request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse()
        await socket.prepare(request)
        self.sockets.append(socket)
        async for message in socket:
            await self.heard.put(json.loads(message.data))
        return socket

    async def until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        async with asyncio.timeout(30.0):
            while not wanted(heard := await self.heard.get()):
                pass
        return heard

    @contextlib.asynccontextmanager
    async def served(self, port: int = 0) -> AsyncGenerator[int]:
        app = web.Application()
        app.router.add_get("/", self._serve)
        runner = web.AppRunner(app, shutdown_timeout=0.1)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", port)
        await site.start()
        try:
            yield runner.addresses[0][1]
        finally:
            for socket in self.sockets:
                await socket.close()
            await runner.cleanup()


def level(message: dict[str, Any], name: str) -> int | None:
    if message["op"] != "publish":
        return None
    return next((one["level"] for one in message["msg"]["status"] if one["name"] == name), None)


async def test_ros_hears_of_each_component_by_rosbridge_and_again_after_a_cut(watching: Any) -> None:
    system, _ = watching
    server = RosServer()
    async with server.served() as port:
        await system.start(hf.child("ros", hf.start(RosBridge, f"ws://127.0.0.1:{port}", every=0.1)))
        advertised = await server.until(lambda heard: True)
        assert advertised == {"op": "advertise", "topic": "/diagnostics", "type": "diagnostic_msgs/msg/DiagnosticArray"}
        await accuse(system, "feed")
        told = await server.until(lambda heard: level(heard, "desk/feed") == 2)
        check(told["msg"], "diagnostic_msgs/DiagnosticArray", "diagnostic_msgs")
        assert (told["topic"], level(told, "desk/book")) == ("/diagnostics", 3)
    async with server.served(port):
        await server.until(lambda heard: heard["op"] == "advertise")
        await server.until(lambda heard: level(heard, "desk/feed") == 2)
        await system.stop(system.ref("/app/ros"))


def test_messages_of_ros_get_each_field_and_a_byte_is_a_byte() -> None:
    stamp = dataclasses.make_dataclass("Time", [("sec", int, 0), ("nanosec", int, 0)])
    header = dataclasses.make_dataclass(
        "Header", [("stamp", stamp, dataclasses.field(default_factory=stamp)), ("frame_id", str, "")]
    )
    pair = dataclasses.make_dataclass("KeyValue", [("key", str, ""), ("value", str, "")])
    texts = [(name, str, "") for name in ("name", "message", "hardware_id")]
    values: tuple[str, Any, Any] = ("values", list[Any], dataclasses.field(default_factory=list))
    status = dataclasses.make_dataclass("DiagnosticStatus", [("level", bytes, b"\0"), *texts, values])
    array = dataclasses.make_dataclass(
        "DiagnosticArray",
        [
            ("header", header, dataclasses.field(default_factory=header)),
            ("status", list[Any], dataclasses.field(default_factory=list)),
        ],
    )
    plain = {
        "header": {"stamp": {"sec": 7, "nanosec": 8}, "frame_id": ""},
        "status": [
            {"level": 2, "name": "a", "message": "faulty", "hardware_id": "a",
             "values": [{"key": "probability", "value": "1.000"}]}
        ],
    }  # fmt: skip
    check(plain, "diagnostic_msgs/DiagnosticArray", "diagnostic_msgs")
    made = dataclasses.asdict(as_ros(plain, array, status, pair))
    assert made["status"][0].pop("level") == b"\x02"
    assert plain["status"][0].pop("level") == 2  # type: ignore[index]  # plain data
    assert made == plain


# -- alerts from outside --------------------------------------------------------------------------------------------


def fired(component: str, status: str = "firing", name: str = "HighLatency") -> WebhookAlert:
    labels = {"alertname": name, "component": component}
    return WebhookAlert("firing" if status == "firing" else "resolved", labels, fingerprint=f"{name}{component}")


def body(*alerts: WebhookAlert) -> bytes:
    return msgspec.json.encode(WebhookPayload(list(alerts)))


@contextlib.asynccontextmanager
async def served(app: AlertApp) -> AsyncGenerator[str]:
    """The application under a real server on loopback."""
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="error", lifespan="on"))
    server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign,assignment]  # pytest has them
    serving = asyncio.create_task(server.serve())
    while not server.started:
        await asyncio.sleep(0.005)
    try:
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}/"
    finally:
        server.should_exit = True
        await serving


async def certain(watch: diagnosis.Watch, *names: str) -> None:
    async with asyncio.timeout(30.0):
        while (await watch.diagnosis()).certain != names:
            await asyncio.sleep(0.02)


@pytest.mark.asyncio(loop_factories=["asyncio"])
async def test_an_alert_of_prometheus_accuses_a_component_until_it_is_resolved(watching: Any) -> None:
    system, watch = watching
    good = {"Authorization": "Bearer secret"}
    async with served(AlertApp(system, token="secret")) as url, aiohttp.ClientSession() as client:

        async def post(data: bytes | io.BytesIO, headers: dict[str, str] = good) -> int:
            async with client.post(url, data=data, headers=headers) as answer:
                return answer.status

        feed, by_address = fired("desk/feed"), fired("/app/desk/feed", name="Errors")
        assert await post(body(feed), {}) == 401
        assert await post(body(feed), {"Authorization": "Bearer other"}) == 401
        assert await post(b"{}") == 400
        assert await post(body(WebhookAlert("firing", {"alertname": "x"}))) == 400
        assert await post(io.BytesIO(b" " * (1024 * 1024 + 1))) == 413
        async with client.get(url) as answer:
            assert answer.status == 405
        assert (await watch.diagnosis()).state is not State.FAULTY
        assert await post(body(feed, by_address)) == 200
        await certain(watch, "desk/feed")
        assert "not ok(desk/feed.alerts)" in {str(one) for one in (await watch.diagnosis()).symptoms}
        assert await post(body(fired("desk/feed", "resolved"))) == 200
        await asyncio.sleep(0)
        await certain(watch, "desk/feed")  # The other one still fires.
        assert await post(body(fired("/app/desk/feed", "resolved", "Errors"))) == 200
        await certain(watch)
        assert await post(body(fired("nobody"))) == 200
        async with asyncio.timeout(30.0):
            while not any("nobody.alerts" in text for text in (await watch.why()).refused):
                await asyncio.sleep(0.02)


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_an_alert_by_the_topic_lasts_until_it_is_resolved_or_forgotten(watching: Any) -> None:
    system, watch = watching
    await system.publish(ALERTS, OutsideAlert("/app/desk/book", True, "Errors", "1"))
    await advance(60.0)
    assert (await watch.diagnosis()).certain == ("desk/book",)
    await system.publish(ALERTS, OutsideAlert("desk/book", False, "Errors", "1"))
    await advance(1.0)
    assert (await watch.diagnosis()).state is not State.FAULTY


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_of_two_alerts_the_first_that_ends_takes_nothing_back(watching: Any) -> None:
    system, _ = watching
    for key in ("1", "2"):
        await system.publish(ALERTS, OutsideAlert("desk/book", True, "Errors", key))
    await advance(1.0)
    taken_back: list[str] = []
    system.spawn(hf.start(TakenBack, taken_back))
    for key, ended in (("1", []), ("2", ["not ok(desk/book.alerts)"])):
        await system.publish(ALERTS, OutsideAlert("desk/book", False, "Errors", key))
        await advance(1.0)
        assert taken_back == ended


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_an_alert_that_is_not_said_again_is_forgotten() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        heard = probe(system)
        heard.subscribe(diagnosis.OBSERVATIONS)
        await system.start(observer("alerts", hf.start(AlertObserver, {}, keeps=20.0, manner=QUICK)))
        await system.publish(ALERTS, OutsideAlert("book", True))
        seen = await heard.expect(Observation)
        assert (str(seen.literal), seen.time_to_live) == ("not ok(book.alerts)", 1.0)
        while seen.time_to_live:
            seen = await heard.expect(Observation)
        assert 20.0 <= system._node.loop.time() <= 21.0
