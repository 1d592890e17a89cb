"""A campaign: three recorded actors talk to each other while their lives are ended at random (promise 1 of DESIGN)."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from typing import Any

import pytest

import holdfast as hf

KILLS = 60
SENDERS = 4
SECONDS = 40.0


class Job(hf.Message[int]):
    """Handled: kept, passed on by tell, and asked of the next actor."""

    sender: int
    number: int


class Passed(hf.Message):
    sender: int
    number: int
    by: str


class Question(hf.Message[int]):
    sender: int
    number: int
    by: str


class History(hf.Message[dict[str, list[tuple[str, int, int]]]]): ...


class Peers(hf.Message):
    told: hf.ActorRef[Any]
    asked: hf.ActorRef[Any]


class Member(hf.Actor):
    """Keeps all it was given, in order."""

    def __init__(self) -> None:
        self.jobs: list[tuple[str, int, int]] = []
        self.passed: list[tuple[str, int, int]] = []
        self.questions: list[tuple[str, int, int]] = []
        self.replies: list[tuple[str, int, int]] = []
        self.peers: list[str] = []

    @hf.on(Peers)
    def meet(self, message: Peers) -> None:
        self.peers = [message.told.path, message.asked.path]

    @hf.on(Job)
    async def job(self, message: Job) -> int:
        sender, number, me = message.sender, message.number, self.ctx.path
        told, asked = (self.ctx.find(path, hf.Actor) for path in self.peers)
        told.tell(Passed(sender, number, me))
        if number % 3 == 0:
            reply = await asked.ask(Question(sender, number, me), timeout=SECONDS)
            self.replies.append((me, sender, reply))
        self.jobs.append(("", sender, number))
        return number

    @hf.on(Passed)
    def take(self, message: Passed) -> None:
        self.passed.append((message.by, message.sender, message.number))

    @hf.on(Question)
    def answer(self, message: Question) -> int:
        self.questions.append((message.by, message.sender, message.number))
        return message.number

    @hf.on(History, readonly=True)
    def history(self, message: History) -> dict[str, list[tuple[str, int, int]]]:
        return {
            "jobs": self.jobs,
            "passed": self.passed,
            "questions": self.questions,
            "replies": self.replies,
        }


def problems(given: list[tuple[str, int, int]], had: list[tuple[str, int, int]]) -> list[str]:
    """What is lost, doubled, invented or, per sender, reordered."""
    found: list[str] = []
    for source in sorted({(by, sender) for by, sender, _ in (*given, *had)}):
        wanted = [n for by, sender, n in given if (by, sender) == source]
        got = [n for by, sender, n in had if (by, sender) == source]
        if wanted != got:
            lost, invented = sorted(set(wanted) - set(got)), sorted(set(got) - set(wanted))
            doubled = sorted({n for n in got if got.count(n) > 1})
            found.append(
                f"{source}: lost {lost}, doubled {doubled}, invented {invented}, in order {got == sorted(got)}"
            )
    return found


def test_the_checker_sees_what_it_shall_see() -> None:
    given = [("", 1, 1), ("", 2, 1), ("", 1, 2)]
    assert not problems(given, [("", 2, 1), ("", 1, 1), ("", 1, 2)])
    for had in (given[:2], [*given, given[0]], [given[2], given[1], given[0]], [*given, ("", 1, 3)]):
        assert problems(given, had)


@pytest.mark.parametrize("seed", [11, 4711])
async def test_nothing_is_lost_doubled_or_reordered_whoever_dies(system: hf.ActorSystem, seed: int) -> None:
    chance = random.Random(seed)
    recovery = hf.hybrid(interval=0.05, max_deliveries=1000)
    members: list[hf.ActorRef[Member]] = [
        await system.start(hf.child(name, hf.start(Member), isolation=isolation, recovery=recovery))  # type: ignore[arg-type]
        for name, isolation in (("one", "process"), ("two", "process"), ("three", "task"))
    ]
    one, two, three = members
    # Questions go one way only, so that nobody waits for itself; tells go round.
    for member, told, asked in ((one, two, two), (two, three, three), (three, one, None)):
        member.tell(Peers(told, asked if asked is not None else await sink(system)))
    accepted: dict[str, list[tuple[str, int, int]]] = {member.path: [] for member in members}
    over = asyncio.Event()

    async def load(sender: int) -> None:
        number = 0
        while not over.is_set():
            number += 1
            to = members[number % 3]
            accepted[to.path].append(("", sender, number))
            if number % 5:
                to.tell(Job(sender, number))
            else:
                assert await to.ask(Job(sender, number), timeout=SECONDS) == number
            await asyncio.sleep(0.002)

    async def strike() -> None:
        for _ in range(KILLS):
            await asyncio.sleep(chance.uniform(0.0, 0.12))
            for victim in chance.sample(members, chance.choice((1, 1, 1, 2))):
                try:
                    pid = system.pid_of(victim)
                except hf.errors.NoSuchActor:
                    continue  # It is being recovered.
                if pid == os.getpid():
                    victim.kill()
                else:
                    try:
                        os.kill(pid, signal.SIGKILL)
                    except ProcessLookupError:
                        continue
        over.set()

    try:
        async with asyncio.timeout(SECONDS), asyncio.TaskGroup() as group:
            for sender in range(SENDERS):
                group.create_task(load(sender))
            group.create_task(strike())
        await settle(members)
        histories = {member.path: await member.ask(History(), timeout=SECONDS) for member in members}
    except BaseException:
        print(f"seed {seed}")
        raise
    found: list[str] = []
    for member, passed_by in ((one, three), (two, one), (three, two)):
        had = histories[member.path]
        source = histories[passed_by.path]
        given = [(passed_by.path, sender, n) for _, sender, n in source["jobs"]]
        found += [f"{member.path} jobs {p}" for p in problems(accepted[member.path], had["jobs"])]
        found += [f"{member.path} passed {p}" for p in problems(given, had["passed"])]
        mine = [(member.path, sender, n) for _, sender, n in had["jobs"] if n % 3 == 0]
        found += [f"{member.path} replies {p}" for p in problems(mine, had["replies"])]
        if member is not one:
            wanted = [entry for entry in given if entry[2] % 3 == 0]
            found += [f"{member.path} questions {p}" for p in problems(wanted, had["questions"])]
    assert not found, f"seed {seed}: {found}"
    assert min(member._cell.life for member in members) > 5, "each of them died several times"


class Answerer(hf.Actor):
    @hf.on(Question)
    def answer(self, message: Question) -> int:
        return message.number


async def sink(system: hf.ActorSystem) -> hf.ActorRef[Any]:
    return await system.start(hf.child("sink", hf.start(Answerer)))


async def settle(members: list[hf.ActorRef[Member]]) -> None:
    """Ask round until nothing is on its way: each pass empties the queues that were there before it."""
    for _ in range(2 * len(members)):
        for member in members:
            await member.ask(History(), timeout=SECONDS)
