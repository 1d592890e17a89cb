"""Diagnoses for ROS 2: `diagnostic_msgs/DiagnosticArray` on `/diagnostics`, by rclpy or by rosbridge."""

from __future__ import annotations

import asyncio
import copy
import importlib
import importlib.util
from collections.abc import Callable
from typing import Any, Final

import msgspec

from ...actors.backoff import Backoff
from ...actors.errors import SpecError
from ...actors.events import NotDelivered
from ...actors.kernel.actor import Actor, on, subscribe
from ..messages import ROS_DIAGNOSTICS, RosDiagnostics
from .delivery import PATIENCE, check_url, http_client, keep_trying

TYPE: Final = "diagnostic_msgs/msg/DiagnosticArray"
EVERY: Final = 1.0
"""Seconds after which the newest is said again: those who show `/diagnostics` take silence for a fault."""


class RosBridge(Actor):
    """Publishes what is diagnosed for ROS 2, each second; diagnosis never waits for it.

    Levels are 0 (OK), 1 (WARN: perhaps faulty), 2 (ERROR: faulty for certain) and 3 (STALE: nothing is known of it).

    Args:
        url: of a rosbridge server, `ws://host:9090` or `wss://`. None: this process is a node of ROS itself, by rclpy.
        topic: of ROS.
        every: seconds after which the newest is said again.

    Raises:
        SpecError: the address is none; or there is neither an address nor rclpy.
    """

    deterministic = False

    def __init__(self, url: str | None = None, *, topic: str = "/diagnostics", every: float = EVERY) -> None:
        if not every > 0:
            raise ValueError(f"every is {every!r}; it must be > 0 seconds")
        if url is not None:
            check_url("RosBridge", url, ("ws", "wss"), None, insecure=True)
            http_client()
        elif importlib.util.find_spec("rclpy") is None:
            raise SpecError(
                "RosBridge", "rclpy cannot be imported here: source ROS 2, or give url= of a rosbridge server"
            )
        self._url, self._topic, self._every = url, topic, every
        self._newest: dict[str, Any] | None = None
        self._changed = asyncio.Event()

    def on_start(self, restored: bool) -> None:
        """Begin to publish, in a task of its own."""
        self.ctx.create_task(self._by_rclpy() if self._url is None else self._by_rosbridge(self._url))

    @subscribe(ROS_DIAGNOSTICS)
    @on(RosDiagnostics)
    def _hear(self, message: RosDiagnostics) -> None:
        self._newest = message.array
        self._changed.set()

    async def _next(self) -> dict[str, Any]:
        """The newest, when there is a new one or it is time to say it again, with the time of now."""
        while True:
            try:
                async with asyncio.timeout(None if self._newest is None else self._every):
                    await self._changed.wait()
            except TimeoutError:
                pass  # It is time to say it again.
            self._changed.clear()
            if self._newest is not None:
                return stamped(self._newest, self.ctx._cell.node.clock.wall())

    async def _by_rosbridge(self, url: str) -> None:
        async with http_client().ClientSession() as session:
            backoff = Backoff(initial=0.2, maximum=10.0)
            await keep_trying(lambda: self._converse(session, url), backoff, self.ctx.random)

    async def _converse(self, session: Any, url: str) -> None:
        """One connection, until it ends. Raises ConnectionError: it is to be made again."""
        try:
            async with asyncio.timeout(PATIENCE):
                socket = await session.ws_connect(url, heartbeat=PATIENCE)
            async with socket:
                hearing = asyncio.create_task(_until_closed(socket))
                try:
                    await _say(socket, {"op": "advertise", "topic": self._topic, "type": TYPE})
                    self._changed.set()  # Whoever is new there is told at once.
                    while (array := await self._next_unless(hearing)) is not None:
                        await _say(socket, {"op": "publish", "topic": self._topic, "msg": array})
                finally:
                    hearing.cancel()
            raise ConnectionError("the connection has ended")
        except (http_client().ClientError, OSError, TimeoutError) as error:
            self.ctx._cell.node.emit(NotDelivered(self.ctx.path, url, str(error) or "it does not answer"))
            raise ConnectionError(str(error)) from error

    async def _next_unless(self, over: asyncio.Task[None]) -> dict[str, Any] | None:
        """What is to be said next; None: the connection has ended before."""
        following = asyncio.create_task(self._next())
        try:
            await asyncio.wait((following, over), return_when=asyncio.FIRST_COMPLETED)
            return None if over.done() else following.result()
        finally:
            following.cancel()

    async def _by_rclpy(self) -> None:
        """Publish as a node of ROS; a publisher needs no spinning."""
        rclpy = importlib.import_module("rclpy")
        messages = importlib.import_module("diagnostic_msgs.msg")
        context = rclpy.context.Context()
        rclpy.init(context=context)
        try:
            node = rclpy.create_node("holdfast_diagnosis", context=context)
            publisher = node.create_publisher(messages.DiagnosticArray, self._topic, 10)
            while True:
                array = await self._next()
                publisher.publish(as_ros(array, messages.DiagnosticArray, messages.DiagnosticStatus, messages.KeyValue))
        finally:
            rclpy.shutdown(context=context)


async def _say(socket: Any, words: dict[str, Any]) -> None:
    async with asyncio.timeout(PATIENCE):
        await socket.send_str(msgspec.json.encode(words).decode())


async def _until_closed(socket: Any) -> None:
    """Hear the other side, which may say what it wants, until it has gone."""
    async for _ in socket:
        pass


def stamped(array: dict[str, Any], unix: float) -> dict[str, Any]:
    """The array again, with another time in its header (Unix seconds)."""
    nanoseconds = round(unix * 1e9)
    again = copy.copy(array)
    again["header"] = {**array["header"], "stamp": {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}}
    return again


def as_ros(
    array: dict[str, Any], make_array: Callable[[], Any], make_status: Callable[[], Any], make_pair: Callable[[], Any]
) -> Any:
    """An array of plain data as messages of ROS; a `byte` is one byte in them."""
    made = make_array()
    made.header.stamp.sec = array["header"]["stamp"]["sec"]
    made.header.stamp.nanosec = array["header"]["stamp"]["nanosec"]
    made.header.frame_id = array["header"]["frame_id"]
    for one in array["status"]:
        status = make_status()
        status.level = bytes([one["level"]])
        status.name, status.message, status.hardware_id = one["name"], one["message"], one["hardware_id"]
        for each in one["values"]:
            pair = make_pair()
            pair.key, pair.value = each["key"], each["value"]
            status.values.append(pair)
        made.status.append(status)
    return made
