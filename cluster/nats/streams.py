"""What a system has in JetStream: the names of its subjects and streams, and how the streams have to be set."""

from __future__ import annotations

from typing import Any
from urllib.parse import quote

from nats.js import api


def token_of(name: str) -> str:
    """A name as a part of a subject or of a stream's name: no dots, blanks, stars or slashes.

    >>> token_of("shop.eu 1")
    'shop%2Eeu%201'
    """
    return quote(name, safe="-_").replace(".", "%2E").replace("~", "%7E")


class Names:
    """What a system's subjects and streams are called.

    Args:
        system: its name.
    """

    def __init__(self, system: str) -> None:
        token = token_of(system)
        self.log = f"hf.{token}.root.log"
        self.lease = f"hf.{token}.root.lease"
        self.blobs = f"hf.{token}.blob"
        self.log_stream = f"HF-{token}-LOG"
        self.lease_stream = f"HF-{token}-LEASE"
        self.blob_stream = f"HF-{token}-BLOB"


def stream_settings(names: Names, replicas: int) -> list[api.StreamConfig]:
    """The streams of a system, as they have to be."""
    common: dict[str, Any] = {"storage": api.StorageType.FILE, "num_replicas": replicas, "allow_direct": False}
    keeps: dict[str, Any] = {**common, "discard": api.DiscardPolicy.NEW}
    return [
        api.StreamConfig(name=names.log_stream, subjects=[names.log], **keeps),
        api.StreamConfig(name=names.blob_stream, subjects=[f"{names.blobs}.>"], max_msgs_per_subject=1, **keeps),
        api.StreamConfig(
            name=names.lease_stream,
            subjects=[names.lease],
            max_msgs_per_subject=1,
            allow_msg_ttl=True,
            discard=api.DiscardPolicy.OLD,
            **common,
        ),
    ]
