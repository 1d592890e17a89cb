"""Posts what is faulty to a webhook, as Alertmanager does: whoever takes its alerts takes these."""

from __future__ import annotations

import asyncio
from typing import Any, Final

import msgspec

from ...actors.backoff import Backoff
from ...actors.events import NotDelivered
from ...actors.kernel.actor import Actor, on, subscribe
from ..engine import Diagnosis
from ..messages import DIAGNOSIS
from .delivery import PATIENCE, check_url, http_client, keep_trying
from .payload import WebhookAlert, fingerprint_of, payload_of, rfc3339

MOST_ALERTS: Final = 1000
"""Alerts that wait to be delivered at most; of more, the oldest are dropped."""
AGAIN: Final = (408, 425, 429)
"""Refusals of HTTP that may end."""


class WebhookBridge(Actor):
    """Posts an alert for each suspect, and again when it is none any more; diagnosis never waits for it.

    The labels are `alertname` ("HoldfastFault"), `system`, `component`, and `severity`: "critical" where the component
    is faulty for certain, "warning" where it may be. What cannot be delivered is tried again, with growing pauses of
    up to a minute; of each alert only the newest word is kept. A receiver that refuses for good (most 4xx) loses it,
    which is the event `NotDelivered`.

    Args:
        url: `https://host/path`, or `http://`.
        token: is sent as `Authorization: Bearer`; None: nothing is.
        receiver: what the payload calls the receiver.
        external_url: where a person finds more, such as a dashboard.
        insecure: whether a token may go to another machine in clear.

    Raises:
        SpecError: the address is none, or the token would go over a network in clear. ImportError: aiohttp is missing.
    """

    deterministic = False

    def __init__(
        self,
        url: str,
        *,
        token: str | None = None,
        receiver: str = "holdfast",
        external_url: str = "",
        insecure: bool = False,
    ) -> None:
        check_url("WebhookBridge", url, ("http", "https"), token, insecure=insecure)
        http_client()
        self._url, self._token, self._receiver, self._external_url = url, token, receiver, external_url
        self._firing: dict[str, WebhookAlert] = {}
        self._outbox: dict[str, WebhookAlert] = {}
        self._filled = asyncio.Event()

    def on_start(self, restored: bool) -> None:
        """Begin to deliver, in a task of its own."""
        self.ctx.create_task(self._deliver())

    @subscribe(DIAGNOSIS)
    @on(Diagnosis)
    def _hear(self, message: Diagnosis) -> None:
        system = self.ctx.path.split("/")[1]
        now = rfc3339(self.ctx._cell.node.clock.wall())
        certain, firing = set(message.certain), dict[str, WebhookAlert]()
        for name in message.suspects:
            severity = "critical" if name in certain else "warning"
            labels = {"alertname": "HoldfastFault", "system": system, "component": name, "severity": severity}
            key = fingerprint_of(labels)
            annotations = {
                "summary": f"{name} is {'' if name in certain else 'perhaps '}faulty",
                "description": str(message),
            }
            starts = rfc3339(message.since[name]) if name in message.since else now
            firing[key] = self._firing.get(key) or WebhookAlert(
                "firing", labels, annotations, starts, generator_url=self._external_url, fingerprint=key
            )
        news = {key: one for key, one in firing.items() if key not in self._firing}
        gone = {key: one for key, one in self._firing.items() if key not in firing}
        news |= {key: msgspec.structs.replace(one, status="resolved", ends_at=now) for key, one in gone.items()}
        self._firing = firing
        for key, one in news.items():
            self._outbox.pop(key, None)
            self._outbox[key] = one
        while len(self._outbox) > MOST_ALERTS:
            del self._outbox[next(iter(self._outbox))]
        if news:
            self._filled.set()

    async def _deliver(self) -> None:
        aiohttp = http_client()
        headers = {"Content-Type": "application/json"}
        if self._token is not None:
            headers["Authorization"] = f"Bearer {self._token}"
        timeout = aiohttp.ClientTimeout(total=PATIENCE)
        async with aiohttp.ClientSession(headers=headers, timeout=timeout) as session:
            backoff = Backoff(initial=0.2, maximum=60.0)
            await keep_trying(lambda: self._post(session), backoff, self.ctx.random)

    async def _post(self, session: Any) -> None:
        """Post all that waits in one request. Raises OSError, TimeoutError: it is to be tried again."""
        await self._filled.wait()
        sent = dict(self._outbox)
        system = self.ctx.path.split("/")[1]
        body = msgspec.json.encode(payload_of(sent.values(), system, self._receiver, self._external_url))
        try:
            # A redirect is not followed: it would take the token elsewhere.
            async with session.post(self._url, data=body, allow_redirects=False) as answer:
                status = answer.status
        except (http_client().ClientError, OSError, TimeoutError) as error:
            self._tell(str(error) or "it does not answer")
            raise ConnectionError(str(error)) from error
        is_taken, is_refused = status < 300, 300 <= status < 500 and status not in AGAIN
        if not is_taken:
            self._tell(f"it answers {status}", is_given_up=is_refused)
        if not (is_taken or is_refused):
            raise ConnectionError(f"it answers {status}")
        for key, one in sent.items():
            if self._outbox.get(key) is one:  # Else there is a newer word of it.
                del self._outbox[key]
        if not self._outbox:
            self._filled.clear()

    def _tell(self, why: str, *, is_given_up: bool = False) -> None:
        self.ctx._cell.node.emit(NotDelivered(self.ctx.path, self._url, why, is_given_up))
