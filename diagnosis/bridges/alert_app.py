"""An ASGI application that takes the alerts of Alertmanager, and gives them to diagnosis by a topic."""

from __future__ import annotations

import hmac
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, Final, Protocol, TypeAlias

import msgspec

from ...actors.errors import SpecError
from ...actors.kernel.message import Message
from .alerts import ALERTS, outside_alerts
from .payload import WebhookPayload

MOST_BYTES: Final = 1024 * 1024
"""Bytes that one request may have."""
Scope: TypeAlias = MutableMapping[str, Any]
Receive: TypeAlias = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send: TypeAlias = Callable[[MutableMapping[str, Any]], Awaitable[None]]


class Publishing(Protocol):
    """What an application needs of an `ActorSystem`."""

    async def publish(self, topic: str, message: Message[Any]) -> None:
        """Publish a message on a topic."""
        ...


class AlertApp:
    """Takes POST requests of Alertmanager (`webhook_configs`) on the loop of the system.

    Each alert becomes an `OutsideAlert` on `/alerts`. It answers 200 when all were published, 400 to what is no such
    payload, 401 without the token, 405 and 413.

    Args:
        system: where they are published.
        token: what `Authorization: Bearer` has to say.
        label: of an alert: says which component it is about, by its name or its address.

    Raises:
        SpecError: the token is empty.
    """

    def __init__(self, system: Publishing, *, token: str, label: str = "component") -> None:
        if not token:
            raise SpecError("AlertApp", "token must not be empty: whoever reaches the port could accuse anybody")
        self._system, self._label = system, label
        self._authorization = f"Bearer {token}".encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request, or the life of the server."""
        if scope["type"] == "lifespan":
            while (await receive())["type"] != "lifespan.shutdown":
                await send({"type": "lifespan.startup.complete"})
            await send({"type": "lifespan.shutdown.complete"})
            return
        if scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1003})
            return
        status, text = await self._answered(scope, receive)
        headers = [(b"content-type", b"text/plain; charset=utf-8")]
        await send({"type": "http.response.start", "status": status, "headers": headers})
        await send({"type": "http.response.body", "body": text.encode() + b"\n"})

    async def _answered(self, scope: Scope, receive: Receive) -> tuple[int, str]:
        if scope["method"] != "POST":
            return 405, "POST alerts here, as Alertmanager does"
        given = dict(scope["headers"]).get(b"authorization", b"")
        if not hmac.compare_digest(given, self._authorization):
            return 401, "say the token: Authorization: Bearer ..."
        body = bytearray()
        has_more = True
        while has_more:
            part = await receive()
            if part["type"] != "http.request":
                return 400, "the request was not whole"
            body += part.get("body", b"")
            has_more = part.get("more_body", False)
            if len(body) > MOST_BYTES:
                return 413, f"a request has at most {MOST_BYTES} bytes"
        try:
            payload = msgspec.json.decode(bytes(body), type=WebhookPayload)
            if payload.version != "4":
                return 400, f"version {payload.version!r} is not known, only '4' is"
            alerts = outside_alerts(payload, self._label)
        except (msgspec.DecodeError, ValueError) as error:
            return 400, f"this is no payload of Alertmanager: {error}"
        for alert in alerts:
            await self._system.publish(ALERTS, alert)
        return 200, f"{len(alerts)} alerts were taken"
