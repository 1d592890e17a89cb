"""What Alertmanager posts to a webhook (version 4), as plain data: it is read here, and written the same way."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import Final, Literal

import msgspec

NEVER: Final = "0001-01-01T00:00:00Z"
"""How Alertmanager writes the end of what has not ended."""


class WebhookAlert(msgspec.Struct, frozen=True, rename="camel"):
    """One alert; times are texts of RFC 3339. The names of labels and annotations are anybody's."""

    status: Literal["firing", "resolved"]
    labels: dict[str, str]
    annotations: dict[str, str] = msgspec.field(default_factory=dict)
    starts_at: str = NEVER
    ends_at: str = NEVER
    generator_url: str = msgspec.field(default="", name="generatorURL")
    fingerprint: str = ""


class WebhookPayload(msgspec.Struct, frozen=True, rename="camel"):
    """What one POST carries: alerts that were grouped by some of their labels."""

    alerts: list[WebhookAlert]
    status: Literal["firing", "resolved"] = "firing"
    version: str = "4"
    group_key: str = ""
    truncated_alerts: int = 0
    receiver: str = ""
    group_labels: dict[str, str] = msgspec.field(default_factory=dict)
    common_labels: dict[str, str] = msgspec.field(default_factory=dict)
    common_annotations: dict[str, str] = msgspec.field(default_factory=dict)
    external_url: str = msgspec.field(default="", name="externalURL")


def payload_of(alerts: Iterable[WebhookAlert], system: str, receiver: str, external_url: str) -> WebhookPayload:
    """Group the alerts of a system as Alertmanager would that groups by system."""
    listed = list(alerts)
    group = {"system": system}
    return WebhookPayload(
        listed,
        "firing" if any(one.status == "firing" for one in listed) else "resolved",
        group_key=f'{{}}:{{system="{system}"}}',
        receiver=receiver,
        group_labels=group,
        common_labels=_common([one.labels for one in listed]),
        common_annotations=_common([one.annotations for one in listed]),
        external_url=external_url,
    )


def _common(every: list[dict[str, str]]) -> dict[str, str]:
    return {key: value for key, value in every[0].items() if all(one.get(key) == value for one in every)}


def fingerprint_of(labels: Mapping[str, str]) -> str:
    """Sixteen hexadecimal digits that are the same for the same labels, and for no others."""
    return hashlib.sha256(msgspec.json.encode(sorted(labels.items()))).hexdigest()[:16]


def rfc3339(unix: float) -> str:
    """A Unix time as Alertmanager writes it.

    >>> rfc3339(0.5)
    '1970-01-01T00:00:00.500Z'
    """
    return datetime.fromtimestamp(unix, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
