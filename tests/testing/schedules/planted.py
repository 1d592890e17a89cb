"""Planted bugs of concurrency, each in a small system: what a strategy has to find, and what a benchmark counts."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Coroutine
from typing import Any

import holdfast as hf
from holdfast.testing import GuardedSystem, advance, idle

Planted = Callable[[GuardedSystem], Coroutine[Any, Any, None]]


class Get(hf.Message[int]): ...


class Put(hf.Message[None]):
    value: int


class Work(hf.Message[None]):
    to: hf.ActorRef


class Go(hf.Message): ...


class Step(hf.Message):
    number: int


class Account(hf.Actor):
    def __init__(self) -> None:
        self.value = 0

    @hf.on(Get)
    def get(self, message: Get) -> int:
        return self.value

    @hf.on(Put)
    def put(self, message: Put) -> None:
        self.value = message.value


class Adder(hf.Actor):
    """Reads, and writes what it has read and one more: between the two anybody else may write."""

    @hf.on(Work)
    async def work(self, message: Work) -> None:
        value = await message.to.ask(Get())
        await message.to.ask(Put(value + 1))


async def lost_update(system: GuardedSystem) -> None:
    """Two read the same value and both write. The second begins so much later that production orders them."""
    account = system.spawn(hf.start(Account), "account")
    one, other = (system.spawn(hf.start(Adder), name) for name in ("one", "other"))
    done = one.ask(Work(account))
    for _ in range(16):
        await asyncio.sleep(0)
    await other.ask(Work(account))
    await done
    assert await account.ask(Get()) == 2


async def lost_update_of_tasks(system: GuardedSystem) -> None:
    """The same between two tasks of the program, of which one begins some ticks later."""
    account = system.spawn(hf.start(Account), "account")

    async def add(ticks: int) -> None:
        for _ in range(ticks):
            await asyncio.sleep(0)
        value = await account.ask(Get())
        await account.ask(Put(value + 1))

    await asyncio.gather(add(0), add(12))
    assert await account.ask(Get()) == 2


class Note(hf.Actor):
    def __init__(self) -> None:
        self.got: list[int] = []

    @hf.on(Step)
    def step(self, message: Step) -> None:
        self.got.append(message.number)


class Teller(hf.Actor):
    def __init__(self, to: hf.ActorRef, number: int) -> None:
        self.to, self.number = to, number

    @hf.on(Go)
    def go(self, message: Go) -> None:
        self.to.tell(Step(self.number))


def order_of(count: int) -> Planted:
    """What `count` actors send comes in the one order that breaks it: the reverse of how they were told."""

    async def order(system: GuardedSystem) -> None:
        note = system.spawn(hf.start(Note), "note")
        for number in range(count):
            system.spawn(hf.start(Teller, note, number), f"teller{number}").tell(Go())
        await idle(system)
        actor: Any = note._cell.actor
        assert actor.got != [*reversed(range(count))]

    order.__name__ = f"order_of_{count}"
    return order


class Wait(hf.Message[int]): ...


class Bell(hf.Actor):
    """Wakes who waits now, and forgets who comes later."""

    def __init__(self) -> None:
        self.waiting: Any = None

    @hf.on(Wait)
    def wait(self, message: Wait) -> Any:
        self.waiting = self.ctx.reply_handle()
        return self.waiting

    @hf.on(Go)
    def ring(self, message: Go) -> None:
        if self.waiting is not None:
            self.waiting.reply(1)


class Sleeper(hf.Actor):
    @hf.on(Work)
    async def work(self, message: Work) -> None:
        await message.to.ask(Wait(), timeout=5.0)


class Ringer(hf.Actor):
    def __init__(self, bell: hf.ActorRef) -> None:
        self.bell = bell

    @hf.on(Go)
    def go(self, message: Go) -> None:
        self.bell.tell(Go())


async def missed_wake_up(system: GuardedSystem) -> None:
    """Who begins to wait after the bell has rung waits for ever."""
    bell = system.spawn(hf.start(Bell), "bell")
    sleeper = system.spawn(hf.start(Sleeper), "sleeper")
    ringer = system.spawn(hf.start(Ringer, bell), "ringer")
    waits = sleeper.ask(Work(bell))
    ringer.tell(Go())
    await waits


class Take(hf.Message[None]): ...


class Release(hf.Message): ...


class Lock(hf.Actor):
    def __init__(self) -> None:
        self.waiting: list[Any] = []
        self.is_taken = False

    @hf.on(Take)
    def take(self, message: Take) -> Any:
        if not self.is_taken:
            self.is_taken = True
            return None
        self.waiting.append(self.ctx.reply_handle())
        return self.waiting[-1]

    @hf.on(Release)
    def release(self, message: Release) -> None:
        if self.waiting:
            self.waiting.pop(0).reply(None)
        else:
            self.is_taken = False


class Philosopher(hf.Actor):
    """Takes one lock and then the other, and lets both go."""

    def __init__(self, first: hf.ActorRef, second: hf.ActorRef) -> None:
        self.first, self.second = first, second

    @hf.on(Work)
    async def work(self, message: Work) -> None:
        await self.first.ask(Take(), timeout=5.0)
        await self.second.ask(Take(), timeout=5.0)
        self.second.tell(Release())
        self.first.tell(Release())


def deadlock_of(count: int) -> Planted:
    """Each of `count` takes the lock that its neighbour wants; one after the other all goes well."""

    async def deadlock(system: GuardedSystem) -> None:
        locks = [system.spawn(hf.start(Lock), f"lock{number}") for number in range(count)]

        async def dine(number: int) -> None:
            for _ in range(20 * number):
                await asyncio.sleep(0)
            start = hf.start(Philosopher, locks[number], locks[(number + 1) % count])
            await system.spawn(start, f"philosopher{number}").ask(Work(locks[0]))

        await asyncio.gather(*map(dine, range(count)))

    deadlock.__name__ = f"deadlock_of_{count}"
    return deadlock


class Alarm(hf.Actor):
    def __init__(self, to: hf.ActorRef, number: int) -> None:
        self.to, self.number = to, number

    def on_start(self, restored: bool) -> None:
        self.ctx.tell_after(1.0, Step(self.number))

    @hf.on(Step)
    def step(self, message: Step) -> None:
        self.to.tell(message)


async def timer_tie(system: GuardedSystem) -> None:
    """Two timers are due at the same moment; the one set first is believed to come first."""
    note = system.spawn(hf.start(Note), "note")
    for number in range(2):
        await system.start(hf.child(f"alarm{number}", hf.start(Alarm, note, number)))
    await advance(2.0)
    actor: Any = note._cell.actor
    assert actor.got == [0, 1]


class Fragile(hf.Actor):
    def __init__(self, to: hf.ActorRef, number: int) -> None:
        self.to, self.number = to, number

    def on_start(self, restored: bool) -> None:
        self.to.tell(Step(self.number))

    @hf.on(Go)
    def go(self, message: Go) -> None:
        raise RuntimeError("as planned")


async def restart_order(system: GuardedSystem) -> None:
    """Two that have crashed together are believed to come back in the order in which they were told."""
    system.expect_crashes()
    note = system.spawn(hf.start(Note), "note")
    refs = [await system.start(hf.child(f"weak{number}", hf.start(Fragile, note, number))) for number in range(2)]
    await idle(system)
    for ref in refs:
        ref.tell(Go())
    await idle(system)
    actor: Any = note._cell.actor
    assert actor.got[2:] == [0, 1]


class Find(hf.Message[None]): ...


class Directory(hf.Actor):
    """Knows who serves. The one who serves may have gone meanwhile."""

    def __init__(self, server: hf.ActorRef) -> None:
        self.server: hf.ActorRef | None = server

    @hf.on(Work)
    async def work(self, message: Work) -> None:
        server = self.server
        if server is not None:
            await message.to.ask(Get())  # Something else is looked up in between.
            await server.ask(Get())


class Closer(hf.Actor):
    def __init__(self, server: hf.ActorRef) -> None:
        self.server = server

    @hf.on(Go)
    def go(self, message: Go) -> None:
        self.server.stop()


async def stale_ref(system: GuardedSystem) -> None:
    """A ref is kept over an await, in which its actor ends."""
    server, other = (system.spawn(hf.start(Account), name) for name in ("server", "other"))
    directory = system.spawn(hf.start(Directory, server), "directory")
    closer = system.spawn(hf.start(Closer, server), "closer")
    found = directory.ask(Work(other))
    for _ in range(40):
        await asyncio.sleep(0)
    closer.tell(Go())
    await found


class Slow(hf.Actor):
    """Counts what it has done, and replies after a while."""

    def __init__(self) -> None:
        self.done = 0

    @hf.on(Get)
    async def get(self, message: Get) -> int:
        await asyncio.sleep(1.0)
        self.done += 1
        return self.done


class Impatient(hf.Actor):
    """Asks again when the reply has not come: what was asked may be done all the same."""

    @hf.on(Work)
    async def work(self, message: Work) -> None:
        try:
            await message.to.ask(Get(), timeout=1.0)
        except hf.AskTimeout:
            await message.to.ask(Get(), timeout=5.0)


async def late_reply(system: GuardedSystem) -> None:
    """The reply comes at the very moment at which the ask times out."""
    slow = system.spawn(hf.start(Slow), "slow")
    await system.spawn(hf.start(Impatient), "impatient").ask(Work(slow), timeout=10.0)
    await idle(system)
    actor: Any = slow._cell.actor
    assert actor.done == 1


class Lot(hf.Actor):
    """Draws from the world's random numbers instead of its own, which a replay would repeat."""

    def __init__(self) -> None:
        self.drawn = 0

    @hf.on(Go)
    def go(self, message: Go) -> None:
        self.drawn = random.randrange(1_000_000)  # the bug

    @hf.on(Get)
    def get(self, message: Get) -> int:
        return self.drawn


async def recorded_non_determinism(system: GuardedSystem) -> None:
    """A recorded actor draws outside of its record; a crash before the next snapshot shows it."""
    system.expect_crashes()
    lot = await system.start(hf.child("lot", hf.start(Lot), recovery=hf.hybrid()))
    lot.tell(Go())
    before = await lot.ask(Get())
    lot.kill()
    assert await lot.ask(Get()) == before


class Cashier(hf.Actor):
    """Is told to pay, and keeps in mind that it has before the other knows."""

    def __init__(self, to: hf.ActorRef) -> None:
        self.to, self.paid = to, 0

    @hf.on(Step)
    async def pay(self, message: Step) -> None:
        self.paid += message.number
        await asyncio.sleep(0.0)
        self.to.tell(message)

    @hf.on(Get)
    def get(self, message: Get) -> int:
        return self.paid


async def lost_output(system: GuardedSystem) -> None:
    """An unrecorded actor is killed between what it has noted and what it sends: the other never hears of it."""
    system.expect_crashes()
    system.expect_dead_letters()
    note = system.spawn(hf.start(Note), "note")
    cashier = await system.start(hf.child("cashier", hf.start(Cashier, note)))
    killer = system.spawn(hf.start(Killer, cashier), "killer")
    cashier.tell(Step(1))
    for _ in range(60):
        await asyncio.sleep(0)
    killer.tell(Go())
    await idle(system)
    actor: Any = note._cell.actor
    assert actor.got == [1]


class Killer(hf.Actor):
    def __init__(self, to: hf.ActorRef) -> None:
        self.to = to

    @hf.on(Go)
    def go(self, message: Go) -> None:
        self.to.kill()


class Walker(hf.Actor):
    """Notes each of its steps before it tells itself the next one."""

    def __init__(self, got: list[str], steps: int) -> None:
        self.got, self.steps = got, steps

    @hf.on(Step)
    def step(self, message: Step) -> None:
        self.got.append(f"{self.ctx.path.rpartition('/')[2]}{message.number}")
        if message.number < self.steps:
            self.ctx.ref.tell(Step(message.number + 1))


async def between_two_steps(system: GuardedSystem) -> None:
    """One comes between the third and the fourth step of another: no order of priorities does that."""
    got: list[str] = []
    for name, steps in (("long", 6), ("short", 1)):
        system.spawn(hf.start(Walker, got, steps), name).tell(Step(1))
    await idle(system)
    assert "long3 short1 long4" not in " ".join(got)


class Gate(hf.Actor):
    """Lets on who comes in the right order, and nobody else."""

    def __init__(self, rounds: int) -> None:
        self.rounds, self.number, self.first = rounds, 0, -1

    @hf.on(Go)
    def open(self, message: Go) -> None:
        if self.number == self.rounds:
            raise RuntimeError("every gate is open")
        self.first = -1
        for number in range(2):
            self.ctx.spawn(hf.start(Teller, self.ctx.ref, number), f"round{self.number}teller{number}").tell(Go())

    @hf.on(Step)
    def step(self, message: Step) -> None:
        if self.first < 0:
            self.first = message.number
            if self.first == 1:
                self.number += 1
                self.ctx.ref.tell(Go())


async def one_gate_after_the_other(system: GuardedSystem) -> None:
    """In each of twelve rounds the last of two has to come first, and the next round begins only then."""
    gate = system.spawn(hf.start(Gate, 12), "gate")
    gate.tell(Go())
    await idle(system)
    assert not gate._cell.is_dead


PLANTED: dict[str, Planted] = {
    planted.__name__: planted
    for planted in (
        lost_update,
        lost_update_of_tasks,
        order_of(3),
        order_of(4),
        order_of(5),
        order_of(6),
        missed_wake_up,
        deadlock_of(2),
        deadlock_of(3),
        timer_tie,
        restart_order,
        stale_ref,
        late_reply,
        recorded_non_determinism,
        lost_output,
    )
}
"""By name."""
