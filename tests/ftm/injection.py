"""Faults in replicas, from outside: a page of memory says what is to go wrong at which step, and the replica does it.

The handlers of the bricks (and of the protected actor) are wrapped in each replica's process. As long as nothing is
armed they look at one byte. What is armed happens once, in whichever process comes to that step first; a permanent
fault happens each time, in the replica in which it has happened first, whatever life that lives.
"""

from __future__ import annotations

import asyncio
import dataclasses
import inspect
import mmap
import os
import signal
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import msgspec

import holdfast as hf
from holdfast.actors.kernel.actor import Start
from holdfast.actors.kernel.envelope import Envelope
from holdfast.checkpoint.protocol import OK, REPLY, Answer, TurnEnd
from holdfast.ftm.bricks.brick_messages import Done, Follow, Lead, Work
from holdfast.ftm.bricks.bricks import Brick
from holdfast.ftm.bricks.letters import Letter
from holdfast.ftm.bricks.replica_orders import SetPeer
from holdfast.ftm.bricks.sealed_frames import Sealed
from holdfast.ftm.group.detector import Detector
from holdfast.ftm.group.failover import FailoverManager
from holdfast.ftm.group.join import Joiner
from holdfast.ftm.group.proxy import Proxy
from holdfast.ftm.model.mechanism import BUILT_IN, find
from holdfast.ftm.replica.heartbeat import Heart
from holdfast.ftm.replica.replica import Replica
from holdfast.ftm.replica.state_manager import StateManager
from tests.ftm.accounts import Bank, Counter
from tests.ftm.stacks import HUGE
from tests.ftm.store import Store

ARMED, FIRED, UNIT, PID, LENGTH, BODY, SIZE = 0, 1, 2, 4, 8, 16, 4096
REQUEST, READ = "REQUEST", "READ"
"""In place of the messages that the workload's clients send most, and whose answers say most."""
SLOTS: dict[type[Any], str] = {
    StateManager: "state",
    Heart: "beat",
    Proxy: "proxy",
    Detector: "detector",
    FailoverManager: "failover",
    Joiner: "join",
}
DELAY = 0.03  # seconds of a message that is late


@dataclasses.dataclass(frozen=True)
class Fault:
    """What goes wrong: `action`, at the `nth` time that `slot` handles a `message`, before or after it does.

    crash    the process is killed                 raise      the brick crashes
    hang     the process does nothing any more     stop       it is stopped (SIGSTOP)
    wait     the turn waits for ever
    delay    the message waits                     reorder    others overtake it
    double   the message comes twice               lose       it never comes
    answer   the actor's answer is wrong           state      its state is wrong from now on
    message  what it is asked is wrong             alter      a bit of what is sealed is another one
    forge    somebody else says something too

    `permanent`: each time from then on, in that replica; `everywhere`: in all.
    """

    action: str
    slot: str
    message: str
    when: str = "before"
    nth: int = 1
    leads: bool | None = None
    permanent: bool = False
    everywhere: bool = False

    def __str__(self) -> str:
        return f"{self.action} {self.when} {self.slot}:{self.message}" + {None: "", True: " L", False: " F"}[self.leads]


class Page:
    """The page of memory that this process shares with those of the replicas."""

    def __init__(self, path: str) -> None:
        self.path = path
        with Path(path).open("r+b") as file:
            self.memory = mmap.mmap(file.fileno(), SIZE)
        self._left: dict[str, int] = {}
        self.unit = 0  # the number of the replica whose process this is
        self.leads: Callable[[], bool] = lambda: True

    @classmethod
    def new(cls, path: Path) -> Page:
        path.write_bytes(bytes(SIZE))
        return cls(str(path))

    def arm(self, fault: Fault) -> None:
        body = msgspec.json.encode(dataclasses.asdict(fault) | {"id": time.monotonic_ns()})
        memory = self.memory
        memory[FIRED], memory[PID : PID + 4] = 0, bytes(4)
        memory[BODY : BODY + len(body)] = body
        memory[LENGTH : LENGTH + 4] = len(body).to_bytes(4, "little")
        memory[ARMED] = 1

    def disarm(self) -> None:
        self.memory[ARMED] = 0

    @property
    def has_fired(self) -> bool:
        return bool(self.memory[FIRED])

    @property
    def pid(self) -> int:
        """The process in which it happened."""
        return int.from_bytes(self.memory[PID : PID + 4], "little")

    def strikes(self, slot: str, message: str, *, leads: bool, when: str) -> Fault | None:
        """What goes wrong here and now."""
        memory = self.memory
        length = int.from_bytes(memory[LENGTH : LENGTH + 4], "little")
        known = msgspec.json.decode(memory[BODY : BODY + length])
        number = str(known.pop("id"))
        fault = Fault(**known)
        if (fault.slot, fault.message, fault.when) != (slot, message, when):
            return None
        if fault.leads not in (None, leads):
            return None
        if fault.permanent and self.has_fired:
            return fault if fault.everywhere or memory[UNIT] == self.unit else None
        left = self._left.get(number, fault.nth) - 1
        self._left = {number: left}
        if left > 0:
            return None
        if not fault.permanent:
            memory[ARMED] = 0
        memory[PID : PID + 4], memory[UNIT] = os.getpid().to_bytes(4, "little"), self.unit
        memory[FIRED] = 1
        return fault


class StruckReplica(Replica):
    """A replica in which things go wrong."""

    def __init__(self, setting: Any, start: Start[Any], layers: Any, page: str) -> None:
        super().__init__(setting, start, layers)
        one = Page(page)
        one.unit, one.leads = int(setting.name[1:]), lambda: self._standing.leads
        wrap(one, start.kind)


def recipe(page: Page) -> Any:
    """What stands in for `holdfast.ftm.group.group_place.replica`."""

    def replica(setting: Any, start: Start[Any], layers: tuple[Any, ...]) -> Start[Any]:
        return Start(StruckReplica, (setting, start, layers, page.path))

    return replica


def subclasses(kind: type) -> Iterable[type]:
    found: list[type] = kind.__subclasses__()
    for one in found:
        yield one
        yield from subclasses(one)


def wrap(page: Page, kind: type[hf.Actor]) -> None:
    """Have things go wrong in the bricks of this process, and in the protected actor."""
    for name in BUILT_IN:
        find(name)
    bricks: set[Any] = {*subclasses(Brick), StateManager, Heart}
    for one in bricks:
        wrap_table(page, one, SLOTS.get(one, ""))
    wrap_table(page, kind, "server")


def wrap_root(page: Page) -> list[tuple[Any, dict[Any, Any]]]:
    """Have things go wrong in the parts of the root; returns what `unwrap` needs."""
    kinds = (Proxy, Detector, FailoverManager, Joiner)
    saved = [(kind._table, dict(kind._table)) for kind in kinds]
    for kind in kinds:
        wrap_table(page, kind, SLOTS[kind])
    return saved


def unwrap(saved: list[tuple[Any, dict[Any, Any]]]) -> None:
    for table, before in saved:
        table.clear()
        table.update(before)


def wrap_table(page: Page, kind: type[hf.Actor], slot: str) -> None:
    table: Any = kind._table
    for message in kind._declared:
        if not hasattr(table[message], "__struck__"):
            table[message] = struck(page, table[message], slot, message.__name__)


def struck(page: Page, handler: Any, slot: str, message: str) -> Any:
    memory = page.memory

    def wrapped(actor: Any, item: Any) -> Any:
        if not memory[ARMED]:
            return handler(actor, item)
        here, leads = slot or actor.slot, page.leads()
        fault = page.strikes(here, message, leads=leads, when="before")
        if fault is not None:
            return before(fault, handler, actor, item)
        result = handler(actor, item)
        if not memory[ARMED]:
            return result
        if inspect.iscoroutine(result):
            return afterwards(result, actor, here, leads)
        fault = page.strikes(here, message, leads=leads, when="after")
        return result if fault is None else after(fault, actor, result)

    async def afterwards(result: Any, actor: Any, here: str, leads: bool) -> Any:
        outcome = await result
        fault = page.strikes(here, message, leads=leads, when="after") if memory[ARMED] else None
        return outcome if fault is None else after(fault, actor, outcome)

    wrapped.__struck__ = True  # type: ignore[attr-defined]
    return wrapped


def happen(fault: Fault) -> None:
    """What ends or stops us."""
    match fault.action:
        case "crash":
            os.kill(os.getpid(), signal.SIGKILL)
            time.sleep(60)
        case "raise":
            raise RuntimeError(f"injected: {fault}")
        case "hang":
            time.sleep(3600)
        case "stop":
            os.kill(os.getpid(), signal.SIGSTOP)


def before(fault: Fault, handler: Any, actor: Any, item: Any) -> Any:
    happen(fault)
    match fault.action:
        case "wait":
            return asyncio.Event().wait()
        case "delay":
            return late(handler, actor, item)
        case "double":
            again(actor, item)
            return handler(actor, item)
        case "lose":
            return actor.ctx.reply_handle() if is_ask(actor) else None
        case "reorder":
            return overtaken(actor, item)
        case "message":
            return handler(actor, other(item))
        case "alter":
            return handler(actor, altered(item))
        case "forge":
            forge(actor)
    return handler(actor, item)


def after(fault: Fault, actor: Any, result: Any) -> Any:
    happen(fault)
    match fault.action:
        case "answer":
            return result + 1 if isinstance(result, int) else 12345
        case "state":
            spoil(actor)
    return result


def spoil(actor: Any) -> None:
    """Something in the protected actor's memory is another value."""
    match actor:
        case Counter():
            actor.total += 1000
        case Bank():
            actor.done.append(-1)
        case Store():
            actor.values = {key: value + HUGE for key, value in actor.values.items()} or {"k0": HUGE}


def is_ask(actor: Any) -> bool:
    item = actor.ctx._item
    return item is not None and not isinstance(item, Envelope) and hasattr(item, "future")


def again(actor: Any, item: Any) -> None:
    """The same message once more, as a copy from the same sender would come."""
    ref = actor.ctx._cell.ref
    if is_ask(actor):
        ref.ask(item, timeout=10.0).add_done_callback(lambda done: done.cancelled() or done.exception())
    else:
        ref.tell(item)


async def late(handler: Any, actor: Any, item: Any) -> Any:
    await asyncio.sleep(DELAY)
    result = handler(actor, item)
    return await result if inspect.iscoroutine(result) else result


def overtaken(actor: Any, item: Any) -> Any:
    ref, loop = actor.ctx._cell.ref, actor.ctx._cell.node.loop
    if not is_ask(actor):
        loop.call_later(DELAY, ref.tell, item)
        return None
    handle = actor.ctx.reply_handle()

    async def asked() -> None:
        await asyncio.sleep(DELAY)
        try:
            handle.reply(await ref.ask(item, timeout=60.0))
        except hf.HoldfastError as error:
            handle.fail(error)

    actor.ctx.create_task(asked())
    return handle


def other(item: Any) -> Any:
    """A batch whose first request says something else: its last byte is another small number."""
    if not isinstance(item, Work) or not item.requests:
        return item
    first = item.requests[0]
    body = bytearray(first.feed.body)
    if not body:
        return item
    body[-1] ^= 2
    feed = msgspec.structs.replace(first.feed, body=bytes(body))
    return msgspec.structs.replace(item, requests=[msgspec.structs.replace(first, feed=feed), *item.requests[1:]])


def altered(item: Any) -> Any:
    """One bit of what is sealed is another one."""
    body = item.frame if isinstance(item, Sealed) else item.body
    if len(body) < 40:
        return item
    wrong = body[:-30] + bytes([body[-30] ^ 4]) + body[-29:]
    return Sealed(wrong) if isinstance(item, Sealed) else msgspec.structs.replace(item, body=wrong)


def forge(actor: Any) -> None:
    """What somebody else would like this actor to believe: in plain words, and as if it were sealed."""
    ref = actor.ctx._cell.ref
    asked: list[Any] = [Sealed(os.urandom(200)), Sealed(b"")]
    if isinstance(actor, Proxy):
        group = actor._group
        wrong = Answer(REPLY, "", msgspec.msgpack.encode(-7))
        ends = [TurnEnd(group.switch.turn + 1, key, OK, [], wrong) for key in list(group.switch.open)[:1]]
        ref.tell(Done(group.membership.epoch, group.adaptation.config, group.delivery.number, ends, True))
    elif actor.slot == "protocol":
        standing = actor._standing
        epoch, config = standing.epoch, standing.config
        ref.tell(Work(epoch, config, 1 << 40, []))
        asked += [SetPeer(epoch, None), Follow(epoch + 5, config), Lead(epoch + 5, config)]
    else:
        standing = actor._standing
        asked = [Letter(standing.epoch, standing.config, kind, os.urandom(100)) for kind in ("sealed", "x:Checkpoint")]
    for message in asked:
        ref.ask(message, timeout=10.0).add_done_callback(lambda done: done.cancelled() or done.exception())
