"""How a program comes to lead a system whose journal is replicated: connect, stand by, lead."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import math
import os
from collections.abc import Callable, Mapping
from typing import Final, TypeVar
from urllib.parse import urlsplit

from ..actors.errors import HoldfastError, SpecError
from ..checkpoint.engine_calls import Called
from ..checkpoint.journal import DamagedStore, StoreEngine, StoreFailed, StoreInUse
from ..checkpoint.store_key import StoreKey, read_store_key
from ..checkpoint.store_opening import open_journal, systems_in
from .leadership import LeaderElsewhere, Leading, Patience, Standby, give_up, lead, leader_name
from .log_records import DamagedLog
from .log_writer import Deposed
from .ports import Engine, LogGone, Unanswered
from .replicated_journal import ReplicatedJournal
from .sealed_engine import sealed
from .servers import JoinLoop, Servers, servers_of
from .silence import SilenceOfServers

T = TypeVar("T")
TOOL_SECONDS: Final = 30.0
"""How long a tool waits for servers that take nothing."""
BEARABLE_SECONDS: Final = 3.0
"""How long servers may be silent before a leader says so: so long they may take to elect one of them."""


def is_replicated(store: object) -> bool:
    """Whether this names a store that several machines keep.

    >>> [is_replicated(store) for store in ("nats://a,b/app", "sqlite:app.db", None)]
    [True, False, False]
    """
    return isinstance(store, Servers) or (isinstance(store, str) and store.startswith(("nats://", "tls://")))


async def join(
    store: str | Servers,
    system: str,
    standby: Standby | None,
    settings: Mapping[str, str | bool | int],
    *,
    waits: Callable[[str], None],
    silent: Callable[[str], None],
    answered: Callable[[float], None],
    deposed: Callable[[Deposed], None],
    gone: Callable[[StoreFailed], None],
    is_new: bool = True,
    key: StoreKey | None = None,
    patience: float = math.inf,
) -> ReplicatedJournal:
    """Wait until this program leads the system, and return the journal of its store.

    Args:
        store: "nats://HOST,HOST/NAME", or such servers.
        system: the name of the system.
        standby: how to wait while another program leads; `None` does not.
        settings: how the servers are reached, see `access_of`.
        waits: told who leads, on the running loop, each time that this changes.
        silent: told on the running loop why no server answers, and each SILENT_SECONDS, while that is so: at once while
            this program waits, and after BEARABLE_SECONDS when it leads.
        answered: told on the running loop after how many seconds they answer again.
        deposed: told on the running loop that another program leads.
        gone: told on the running loop that the log is not on the servers any more.
        is_new: whether it is made if it is not there.
        key: encrypts what is kept there, see `read_store_key`.
        patience: seconds after which a `sync` of which the servers take nothing fails.

    Raises:
        SpecError: the store cannot be read, or the library for it is missing; or the key is none.
        WrongStoreKey: the key is not the one that the store was made with; nothing was changed.
        AccessRefused: the servers do not let this program in.
        StoreInUse: another program leads, and this one was not to wait.
        StoreFailed: no server can be reached, and this program was not to wait; or the store is not there.
        UnsafeServer: the servers may lose what they have acknowledged.
        DamagedStore: what the log holds cannot be used.
    """
    servers, secret = servers_of(store, settings), read_store_key(key)
    loop, me = asyncio.get_running_loop(), leader_name()
    thread = servers.engine_loop(f"holdfast {system}")
    opened: list[Engine] = []  # filled in there: whoever is cancelled here would not get to know of it

    def silence(moment: float = 0.0) -> SilenceOfServers:
        return SilenceOfServers(
            lambda problem: _tell(loop, silent, problem), lambda after: _tell(loop, answered, after), moment=moment
        )

    waiting = silence()
    patient = Patience(waits=standby is not None)

    async def connect() -> Engine:
        attempt = functools.partial(_open_sealed, servers, secret, is_new=is_new)
        opened.append(await patient.answered(attempt, waiting.unanswered))
        waiting.answered()
        return opened[0]

    def told(leader: str) -> None:
        _tell(loop, waits, leader)

    def lost(error: Exception) -> None:
        if isinstance(error, Deposed):
            _tell(loop, deposed, error)
        elif isinstance(error, LogGone):
            _tell(loop, gone, StoreFailed(opened[0].name, str(error)))

    async def led() -> Leading:
        leading = await lead(engine, me, standby=standby, waits=told, unanswered=waiting.unanswered)
        waiting.answered()
        return leading

    try:
        engine = await thread.run(connect())
        leading = await thread.run(led())
        journal = ReplicatedJournal(
            engine, thread, leading, lost=lost, silence=silence(BEARABLE_SECONDS), patience=patience
        )
        if patience == math.inf:  # A tool reads all, one after another.
            await _fetch_all(journal, thread)
    except BaseException as error:
        with contextlib.suppress(asyncio.CancelledError, TimeoutError):
            await asyncio.wait_for(thread.run(_let_go(opened, me)), 2.0)
        await asyncio.to_thread(thread.close)
        problem = _of_store(error, opened[0].name if opened else str(store).partition("?")[0])
        if problem is None:
            raise
        raise problem from error
    return journal


async def _open_sealed(servers: Servers, secret: bytes | None, *, is_new: bool) -> Engine:
    """The engine of the store, through which nothing passes that is not encrypted, if it has a key."""
    engine = await servers.open_engine(is_new=is_new)
    try:
        return await sealed(engine, secret, servers.system)
    except BaseException:
        await engine.close()
        raise


async def _fetch_all(journal: ReplicatedJournal, thread: JoinLoop) -> None:
    """Have the journal hold all that it has; it is ended if that cannot be."""
    try:
        await thread.run(journal.fetch())
    except BaseException:
        with contextlib.suppress(asyncio.CancelledError, HoldfastError):
            await thread.run(journal.end())
        raise


def _of_store(error: BaseException, name: str) -> HoldfastError | None:
    """What has kept a program from leading, as users of a store know it; None: they know it as it is."""
    match error:
        case LeaderElsewhere():
            return StoreInUse(name, 0, error.leader)
        case Unanswered():
            return StoreFailed(name, error.problem)
        case LogGone():
            return StoreFailed(name, str(error))
        case DamagedLog():
            return DamagedStore(name, None, None, str(error))
        case _:
            return None


async def _let_go(opened: list[Engine], me: str) -> None:
    """Wait for what was cancelled, for a moment, and let go of the engine, if one was opened."""
    if cancelled := [task for task in asyncio.all_tasks() if task.cancelling()]:
        await asyncio.wait(cancelled, timeout=1.0)
    for engine in opened:
        try:
            await give_up(engine, me)  # Else whoever starts next waits for its end, or is told that this program leads.
        finally:
            await engine.close()


def _tell(loop: asyncio.AbstractEventLoop, call: Callable[[T], None], what: T) -> None:
    with contextlib.suppress(RuntimeError):  # That loop has ended.
        loop.call_soon_threadsafe(call, what)


def open_store(
    store: str,
    settings: Mapping[str, str | bool | int] | None = None,
    *,
    is_new: bool = True,
    key: StoreKey | None = None,
) -> StoreEngine:
    """Open a store by itself, for a tool: no system may have it open, and none may open it meanwhile.

    Args:
        store: "sqlite:PATH" or "nats://HOST,HOST/NAME".
        settings: how servers are reached, see `access_of`.
        is_new: whether it is made if it is not there.
        key: of an encrypted store, see `read_store_key`.

    Raises:
        SpecError: the name cannot be read, or is that of memory; or the key is none.
        WrongStoreKey: the key is not the store's.
        StoreFailed: it is not there, or cannot be reached. AccessRefused: the servers do not let this program in.
        StoreInUse, DamagedStore, UnsafeServer: it cannot be opened.
    """
    kind, _, path = store.partition(":")
    if kind == "memory":
        raise SpecError("store", "what is in memory belongs to one program: name sqlite:PATH or nats://HOST/NAME")
    if not is_replicated(store):
        if not is_new and kind == "sqlite" and path and not os.path.exists(path):
            raise StoreFailed(path, "there is no such file; name the database, as in store='sqlite:PATH'")
        return open_journal(store, key=key)

    def pass_over(what: object) -> None:
        """Nobody waits here to whom it would matter."""

    async def joined() -> ReplicatedJournal:
        nobody = dict.fromkeys(("waits", "silent", "answered", "deposed", "gone"), pass_over)
        return await join(store, "tool", None, settings or {}, is_new=is_new, key=key, patience=TOOL_SECONDS, **nobody)

    return Called(asyncio.run(joined()))


def other_systems(store: StoreEngine, source: str, dest: str) -> str:
    """Of which systems a store is that is to be copied to servers, if they are not those of that name there.

    Args:
        store: open.
        source: its name; one on servers may go wherever the same name is.
        dest: where it is to be copied.
    """
    if not is_replicated(dest):
        return ""
    name = urlsplit(dest).path.strip("/")
    systems = systems_in(store)
    is_theirs = name in systems or (is_replicated(source) and urlsplit(source).path.strip("/") == name)
    return "" if is_theirs else ", ".join(sorted(systems))


def is_same_store(one: str, other: str) -> bool:
    """Whether two names are of one store, as far as the names tell.

    >>> is_same_store("nats://a,b/app?nkey=x", "nats://b:4222/app"), is_same_store("sqlite:a.db", "sqlite:./a.db")
    (True, True)
    >>> is_same_store("nats://a/app", "nats://a/shop"), is_same_store("sqlite:a.db", "nats://a/app")
    (False, False)
    """
    if is_replicated(one) != is_replicated(other):
        return False
    if not is_replicated(one):
        return os.path.realpath(one.partition(":")[2]) == os.path.realpath(other.partition(":")[2])
    first, second = urlsplit(one), urlsplit(other)
    hosts = [{host if ":" in host else f"{host}:4222" for host in each.netloc.split(",")} for each in (first, second)]
    return first.path.strip("/") == second.path.strip("/") and bool(hosts[0] & hosts[1])
