"""Remove what a system has on its servers: the log first, so that what may be left of it is no store any more."""

from __future__ import annotations

from collections.abc import Mapping

from nats.js import JetStreamContext
from nats.js.errors import NotFoundError

from ...checkpoint.journal import StoreInUse
from ..leadership import leader_name
from .access import access_of
from .connecting import ANSWER_SECONDS, SystemClient, answering
from .nats_engine import CONNECT_SECONDS, NatsLease
from .system_streams import SubjectNames


async def remove_store(store: str, settings: Mapping[str, str | bool | int] | None = None) -> list[str]:
    """Delete the streams of a system; return the names of those that there were.

    Args:
        store: `nats://host,host/system?...`, see `access_of`.
        settings: beside it.

    Raises:
        StoreInUse: a program leads the system. Nothing was removed.
        SpecError, AccessRefused, Unanswered: as on opening the store. Of what was removed nothing comes back.
    """
    client = SystemClient(access_of(store, settings))
    try:
        await client.enter(CONNECT_SECONDS)
        await client.probe(is_node=True)
        return await client.unless_denied(_remove(client))
    finally:
        await client.close()


async def _remove(client: SystemClient) -> list[str]:
    access = client.access
    names, stream = SubjectNames(access.system), client.jetstream(timeout=5 * ANSWER_SECONDS)
    with answering(access.name, client):
        wanted = (names.log_stream, names.blob_stream, names.lease_stream)
        there = [one for one in wanted if await _is_there(stream, one)]
    if names.lease_stream in there:  # Whoever has it is the only one that may lead.
        lease = NatsLease(client, stream, names, access.name)
        if await lease.acquire(leader_name()) is None:
            raise StoreInUse(access.name, 0, await lease.holder() or "another program")
    with answering(access.name, client):
        for one in there:
            await stream.delete_stream(one)
    return there


async def _is_there(stream: JetStreamContext, name: str) -> bool:
    try:
        await stream.stream_info(name)
    except NotFoundError:
        return False
    return True
