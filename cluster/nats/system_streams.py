"""What a system has in JetStream: the names of its subjects and streams, and how the streams have to be set."""

from __future__ import annotations

from typing import Any

from nats.js import api


class SubjectNames:
    """What a system's subjects and streams are called.

    Args:
        system: its name on the servers: letters, digits, hyphens and underscores.
    """

    def __init__(self, system: str) -> None:
        self.log = f"hf.{system}.root.log"
        self.lease = f"hf.{system}.root.lease"
        self.blobs = f"hf.{system}.blob"
        self.inbox = f"hf.{system}.root.in"
        self.log_stream = f"hf-{system}-log"
        self.lease_stream = f"hf-{system}-lease"
        self.blob_stream = f"hf-{system}-blob"


def stream_settings(names: SubjectNames, replicas: int) -> list[api.StreamConfig]:
    """The streams of a system, as they have to be."""
    common: dict[str, Any] = {
        "storage": api.StorageType.FILE,
        "num_replicas": replicas,
        "allow_direct": False,
        "discard": api.DiscardPolicy.NEW,
    }
    newest: dict[str, Any] = {**common, "max_msgs_per_subject": 1}
    return [
        api.StreamConfig(name=names.log_stream, subjects=[names.log], **common),
        api.StreamConfig(name=names.blob_stream, subjects=[f"{names.blobs}.>"], **newest),
        api.StreamConfig(name=names.lease_stream, subjects=[names.lease], allow_msg_ttl=True, **newest),
    ]
