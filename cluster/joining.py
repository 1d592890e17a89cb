"""How a program comes to lead a system whose journal is replicated: connect, stand by, lead."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Mapping
from importlib.util import find_spec
from typing import TypeVar

from ..actors.errors import SpecError
from ..checkpoint.engine_calls import Called
from ..checkpoint.journal import DamagedStore, StoreEngine, StoreFailed, StoreInUse
from ..checkpoint.store_opening import open_journal
from .engine_thread import EngineThread
from .leadership import LeaderElsewhere, Standby, lead, leader_name
from .log_records import DamagedLog
from .log_writer import FIRST_PAUSE, LONGEST_PAUSE, Deposed
from .ports import Engine, Unanswered
from .replicated_journal import ReplicatedJournal

T = TypeVar("T")


def is_replicated(store: object) -> bool:
    """Whether this names a store that several machines keep.

    >>> [is_replicated(store) for store in ("nats://a,b/app", "sqlite:app.db", None)]
    [True, False, False]
    """
    return isinstance(store, str) and store.startswith(("nats://", "tls://"))


async def join(
    store: str,
    system: str,
    standby: Standby | None,
    settings: Mapping[str, str | bool | int],
    *,
    waits: Callable[[str], None],
    deposed: Callable[[Deposed], None],
) -> ReplicatedJournal:
    """Wait until this program leads the system, and return the journal of its store.

    Args:
        store: "nats://HOST,HOST/NAME".
        system: the name of the system.
        standby: how to wait while another program leads; `None` does not.
        settings: how the servers are reached, see `access_of`.
        waits: told who leads, on the running loop, each time that this changes.
        deposed: told on the running loop that another program leads.

    Raises:
        SpecError: the store cannot be read, or the library for it is missing.
        StoreInUse: another program leads, and this one was not to wait.
        StoreFailed: no server can be reached, and this program was not to wait.
        UnsafeServer: the servers may lose what they have acknowledged.
        DamagedStore: what the log holds cannot be used.
    """
    if find_spec("nats") is None:
        kind = store.partition(":")[0]
        raise SpecError("store", f"{kind}:// needs the library nats-py: pip install 'holdfast[nats]'")
    from .nats.access import access_of
    from .nats.nats_engine import open_engine  # only now: it imports that library

    access = access_of(store, settings)
    loop = asyncio.get_running_loop()
    me = leader_name()
    thread = EngineThread(f"holdfast {system}")
    engine: Engine | None = None
    try:
        joined: Engine = await thread.run(_connected(lambda: open_engine(access), insists=standby is not None))
        engine = joined
        leading = await thread.run(lead(joined, me, standby=standby, waits=lambda leader: _tell(loop, waits, leader)))

        def lost(error: Exception) -> None:
            if isinstance(error, Deposed):
                _tell(loop, deposed, error)

        return ReplicatedJournal(joined, thread, leading, lost=lost)
    except BaseException as error:
        if engine is not None:
            with contextlib.suppress(asyncio.CancelledError, TimeoutError):
                await asyncio.wait_for(thread.run(engine.close()), 2.0)
        await asyncio.to_thread(thread.close)
        named = store.partition("?")[0] if engine is None else engine.name
        match error:
            case LeaderElsewhere():
                raise StoreInUse(named, 0, error.leader) from error
            case Unanswered():
                raise StoreFailed(named, error.problem) from error
            case DamagedLog():
                raise DamagedStore(named, None, None, str(error)) from error
            case _:
                raise


def _tell(loop: asyncio.AbstractEventLoop, call: Callable[[T], None], what: T) -> None:
    with contextlib.suppress(RuntimeError):  # That loop has ended.
        loop.call_soon_threadsafe(call, what)


async def _connected(connect: Callable[[], Awaitable[Engine]], *, insists: bool) -> Engine:
    """Connect; again and again if somebody waits for it."""
    pause = FIRST_PAUSE
    while True:
        try:
            return await connect()
        except Unanswered:
            if not insists:
                raise
        await asyncio.sleep(pause)
        pause = min(2 * pause, LONGEST_PAUSE)


def open_store(store: str, settings: Mapping[str, str | bool | int] | None = None) -> StoreEngine:
    """Open a store by itself, for a tool: no system may have it open, and none may open it meanwhile.

    Args:
        store: "sqlite:PATH" or "nats://HOST,HOST/NAME".
        settings: how servers are reached, see `access_of`.

    Raises:
        SpecError: the name cannot be read. StoreInUse, StoreFailed, DamagedStore, UnsafeServer: it cannot be opened.
    """
    if not is_replicated(store):
        return open_journal(store)

    async def joined() -> ReplicatedJournal:
        return await join(store, "tool", None, settings or {}, waits=lambda leader: None, deposed=lambda error: None)

    return Called(asyncio.run(joined()))
