"""Small programs whose schedules can all be tried, and what each of them comes to."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Coroutine
from typing import Any

import holdfast as hf
from holdfast.testing import GuardedSystem, advance, idle, probe
from tests.testing.schedules.planted import (
    Account,
    Adder,
    Alarm,
    Closer,
    Fragile,
    Get,
    Go,
    Killer,
    Lock,
    Note,
    Philosopher,
    Put,
    Slow,
    Step,
    Teller,
    Walker,
    Work,
)

Program = Callable[[GuardedSystem], Coroutine[Any, Any, object]]


def got(ref: hf.ActorRef[Any]) -> tuple[int, ...]:
    """What a note has taken; () if it has ended."""
    actor: Any = ref._cell.actor
    return tuple(actor.got) if actor is not None else ()


class Echo(hf.Actor):
    """Tells two things for each that it is told, and itself one."""

    def __init__(self, to: hf.ActorRef, number: int) -> None:
        self.to, self.number = to, number

    @hf.on(Step)
    def step(self, message: Step) -> None:
        self.to.tell(Step(10 * self.number + message.number))
        if message.number < 2:
            self.ctx.ref.tell(Step(message.number + 1))


async def two_tellers(system: GuardedSystem) -> object:
    note = system.spawn(hf.start(Note), "note")
    for number in range(2):
        system.spawn(hf.start(Teller, note, number), f"teller{number}").tell(Go())
    await idle(system)
    return got(note)


async def who_tell_themselves(system: GuardedSystem) -> object:
    note = system.spawn(hf.start(Note), "note")
    for number in range(2):
        system.spawn(hf.start(Echo, note, number), f"echo{number}").tell(Step(1))
    await idle(system)
    return got(note)


async def a_kill(system: GuardedSystem) -> object:
    system.expect_crashes()
    system.expect_dead_letters()
    note = system.spawn(hf.start(Note), "note")
    system.spawn(hf.start(Teller, note, 1), "teller").tell(Go())
    system.spawn(hf.start(Killer, note), "killer").tell(Go())
    await idle(system)
    return note._cell.is_dead


async def a_stop(system: GuardedSystem) -> object:
    system.expect_dead_letters()
    account = system.spawn(hf.start(Account), "account")
    system.spawn(hf.start(Closer, account), "closer").tell(Go())
    try:
        return await account.ask(Get())
    except hf.HoldfastError as error:
        return type(error)


async def a_kill_of_one_that_waits(system: GuardedSystem) -> object:
    system.expect_crashes()
    system.expect_dead_letters()
    account, adder = system.spawn(hf.start(Account), "account"), system.spawn(hf.start(Adder), "adder")
    killer = system.spawn(hf.start(Killer, adder), "killer")
    done = adder.ask(Work(account))
    killer.tell(Go())
    [ended] = await asyncio.gather(done, return_exceptions=True)
    await idle(system)
    return type(ended), await account.ask(Get())


async def one_writes_between(system: GuardedSystem) -> object:
    account, adder = system.spawn(hf.start(Account), "account"), system.spawn(hf.start(Adder), "adder")
    done = adder.ask(Work(account))
    await account.ask(Put(7))
    await done
    return await account.ask(Get())


async def the_test_looks_into_an_actor(system: GuardedSystem) -> object:
    note = system.spawn(hf.start(Note), "note")
    for number in range(2):
        note.tell(Step(number))
    held: Any = note._cell.actor
    seen = []
    for _ in range(2):
        await asyncio.sleep(0)
        seen.append(len(held.got))
    return seen


async def a_list_that_actors_share(system: GuardedSystem) -> object:
    shared: list[str] = []
    for name in ("one", "other"):
        system.spawn(hf.start(Walker, shared, 2), name).tell(Step(1))
    await idle(system)
    return shared


async def a_list_that_the_code_knows(system: GuardedSystem) -> object:
    shared: list[int] = []

    class Writer(hf.Actor):
        @hf.on(Step)
        def step(self, message: Step) -> None:
            shared.append(message.number)

    for number in range(2):
        system.spawn(hf.start(Writer), f"writer{number}").tell(Step(number))
    await asyncio.sleep(0)
    seen = len(shared)
    await idle(system)
    return seen, shared


async def numbers_of_one_source(system: GuardedSystem) -> object:
    class Drawer(hf.Actor):
        @hf.on(Get)
        def get(self, message: Get) -> int:
            return random.randrange(1000)

    return await asyncio.gather(*(system.spawn(hf.start(Drawer), name).ask(Get()) for name in ("one", "other")))


async def an_outcome_that_was_there(system: GuardedSystem) -> object:
    account, note = system.spawn(hf.start(Account), "account"), system.spawn(hf.start(Note), "note")
    asked = account.ask(Get())
    await asyncio.sleep(0)
    note.tell(Step(1))
    system.spawn(hf.start(Teller, note, 3), "teller").tell(Go())
    await asked
    note.tell(Step(2))
    await idle(system)
    return got(note)


async def the_first_of_two(system: GuardedSystem) -> object:
    accounts = [system.spawn(hf.start(Account), name) for name in ("one", "other")]
    asked = [asyncio.ensure_future(account.ask(Get())) for account in accounts]
    done, _ = await asyncio.wait(asked, return_when=asyncio.FIRST_COMPLETED)
    return [one in done for one in asked]


async def a_time_out(system: GuardedSystem) -> object:
    try:
        return await system.spawn(hf.start(Slow), "slow").ask(Get(), timeout=1.0)
    except hf.AskTimeout:
        return "late"


async def a_probe(system: GuardedSystem) -> object:
    told = probe(system)
    for number in range(2):
        system.spawn(hf.start(Teller, told.ref, number), f"teller{number}").tell(Go())
    return [(await told.expect(Step)).number for _ in range(2)]


async def an_end_before_all_is_done(system: GuardedSystem) -> object:
    account, note = system.spawn(hf.start(Account), "account"), system.spawn(hf.start(Note), "note")
    note.tell(Step(1))
    return await account.ask(Get())


# -- whose orders are many --------------------------------------------------------------------------------------------


async def two_lost_updates(system: GuardedSystem) -> object:
    account = system.spawn(hf.start(Account), "account")
    await asyncio.gather(*(system.spawn(hf.start(Adder), name).ask(Work(account)) for name in ("one", "other")))
    return await account.ask(Get())


async def tasks(system: GuardedSystem) -> object:
    account = system.spawn(hf.start(Account), "account")

    async def add(rounds: int) -> None:
        for _ in range(rounds):
            await asyncio.sleep(0)
        value = await account.ask(Get())
        await account.ask(Put(value + 1))

    await asyncio.gather(add(0), add(1))
    return await account.ask(Get())


async def timers(system: GuardedSystem) -> object:
    note = system.spawn(hf.start(Note), "note")
    for number in range(3):
        system.spawn(hf.start(Alarm, note, number), f"alarm{number}")
    await advance(2.0)
    return got(note)


async def a_restart(system: GuardedSystem) -> object:
    system.expect_crashes()
    note = system.spawn(hf.start(Note), "note")
    weak = await system.start(hf.child("weak", hf.start(Fragile, note, 5)))
    weak.tell(Go())
    system.spawn(hf.start(Teller, note, 1), "teller").tell(Go())
    await idle(system)
    return got(note)


async def two_locks(system: GuardedSystem) -> object:
    system.expect_crashes()
    system.expect_exceptions()
    locks = [system.spawn(hf.start(Lock), f"lock{number}") for number in range(2)]
    both = [system.spawn(hf.start(Philosopher, locks[n], locks[1 - n]), f"philosopher{n}") for n in range(2)]
    ends = await asyncio.gather(*(one.ask(Work(locks[0])) for one in both), return_exceptions=True)
    return [type(end) for end in ends]


FEW: list[Program] = [
    two_tellers,
    who_tell_themselves,
    a_kill,
    a_stop,
    a_kill_of_one_that_waits,
    the_test_looks_into_an_actor,
    a_list_that_actors_share,
    a_list_that_the_code_knows,
    numbers_of_one_source,
    an_outcome_that_was_there,
    the_first_of_two,
    a_time_out,
    a_probe,
    an_end_before_all_is_done,
    one_writes_between,
]
MANY: list[Program] = [two_lost_updates, tasks, timers, a_restart]
