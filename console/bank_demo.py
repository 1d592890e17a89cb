"""`holdfast demo`: a bank whose accounts live in processes that are killed again and again while customers pay in.

The first half is what a user of holdfast writes: messages, an actor, a supervision tree. The second half is the
experiment: customers who never stop, a killer with `SIGKILL`, and the judgement at the end.
"""

from __future__ import annotations

import asyncio
import os
import random
import signal
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import count, pairwise
from statistics import median
from time import monotonic
from typing import Literal

from rich.console import Console
from rich.table import Table

from .. import (
    Actor,
    ActorRef,
    ActorSystem,
    ChildSpec,
    HoldfastError,
    Message,
    child,
    fresh,
    hybrid,
    on,
    start,
    supervisor,
)
from ..errors import NoSuchActor

MethodName = Literal["hybrid", "fresh"]

OWNERS = ("alice", "bob", "carol")
CUSTOMERS = 6  # of each account; each asks its next question when the one before is answered
PATIENCE = 60.0  # seconds for one answer; a question outlives any recovery
PAUSE = 0.2  # seconds from one kill to the next, at the most
RETRY = 0.01  # seconds: the process of the last kill is not replaced yet


class Pay(Message[int]):
    """Pay one euro in. The reply repeats the payment's number as a receipt."""

    number: int


class GetStatement(Message[list[int]]):
    """Get the numbers of all payments, in the order in which they were booked."""


class BankAccount(Actor):
    """One account. Nothing here knows of processes, crashes or recovery."""

    def __init__(self) -> None:
        self.payments: list[int] = []

    @on(Pay)
    def pay(self, message: Pay) -> int:
        self.payments.append(message.number)
        return message.number

    @on(GetStatement, readonly=True)
    def get_statement(self, message: GetStatement) -> list[int]:
        return self.payments


def bank(method: MethodName) -> ChildSpec:
    """Describe the bank: each account in a process of its own, brought back by the given method."""
    recovery = hybrid(interval=1.0) if method == "hybrid" else fresh()
    accounts = [child(owner, start(BankAccount), isolation="process", recovery=recovery) for owner in OWNERS]
    return supervisor("bank", strategy="one_for_one", intensity=1000, period=1.0, children=accounts)


@dataclass
class Books:
    """What the outside knows of one account; times are seconds on the monotonic clock."""

    owner: str
    account: ActorRef[BankAccount]
    numbers: count[int] = field(default_factory=lambda: count(1))
    receipts: Counter[int] = field(default_factory=Counter)
    asked: int = 0
    answered_at: list[float] = field(default_factory=list)
    killed_at: list[float] = field(default_factory=list)
    killed_pid: int | None = None


@dataclass(frozen=True)
class BankReport:
    """What became of all payments. `gaps` has for each kill the seconds in which the account answered nobody."""

    asked: int
    answered: int
    lost: int
    doubled: int
    gaps: Sequence[float]

    @property
    def is_good(self) -> bool:
        """Say whether every payment was answered and booked once."""
        return self.answered == self.asked and self.lost == self.doubled == 0


def judge(asked: int, receipts: Counter[int], booked: Iterable[int]) -> tuple[int, int]:
    """Count the payments 1..asked that were lost, and those that were doubled.

    A payment is lost without a receipt, or if the account does not know it, although it gave a receipt. It is doubled
    with two receipts, or if it is booked twice.

    >>> judge(4, Counter([1, 2, 4]), [1, 2, 2])
    (2, 1)
    """
    books = Counter(booked)
    numbers = range(1, asked + 1)
    lost = sum(not receipts[number] or not books[number] for number in numbers)
    return lost, sum(receipts[number] > 1 or books[number] > 1 for number in numbers)


def longest_silences(killed_at: Sequence[float], answered_at: Sequence[float]) -> list[float]:
    """Find for each kill the longest time between two answers, from the last answer before it to the next kill.

    >>> longest_silences([1.0, 5.0], [0.9, 1.1, 3.0, 4.9, 5.5])
    [1.9, 0.6]
    """
    found: list[float] = []
    for kill, until in pairwise((*killed_at, float("inf"))):
        around = answered_at[max(bisect_left(answered_at, kill) - 1, 0) : bisect_right(answered_at, until) + 1]
        found.append(round(max((after - before for before, after in pairwise(around)), default=0.0), 6))
    return found


async def show_bank(console: Console, *, seconds: float, method: MethodName, seed: int) -> BankReport:
    """Run the bank for so many seconds under kills, and print each kill and a summary.

    Raises:
        HoldfastError: the system gave up.
    """
    # Its log would run through the lines below, which tell of the same.
    async with ActorSystem("demo", log=False) as system:
        await system.start(bank(method))
        books = [Books(owner, system.ref(f"/demo/bank/{owner}", BankAccount)) for owner in OWNERS]
        closing = asyncio.Event()
        console.print(f"{len(books)} accounts in processes, {CUSTOMERS} customers each, method {method}")
        async with asyncio.TaskGroup() as tasks:
            for one in books:
                for _ in range(CUSTOMERS):
                    tasks.create_task(keep_paying(one, closing))
            try:
                await keep_killing(system, books, console, seconds, random.Random(seed))
            finally:
                closing.set()
        report = await audit(books)
    console.print(summary(report))
    if report.is_good:
        console.print("Nothing was lost, nothing was doubled.", style="bold green")
    else:
        console.print("Payments were lost or doubled.", style="bold red")
    return report


async def keep_paying(books: Books, closing: asyncio.Event) -> None:
    """Pay in again and again, as one customer does."""
    while not closing.is_set():
        number = next(books.numbers)
        books.asked += 1
        try:
            receipt = await books.account.ask(Pay(number), timeout=PATIENCE)
        except HoldfastError:
            continue  # A payment without a receipt counts as lost.
        # A receipt counts for the payment it names: one that went to the wrong customer is one lost, one doubled.
        books.receipts[receipt] += 1
        books.answered_at.append(monotonic())


async def keep_killing(
    system: ActorSystem, books: Sequence[Books], console: Console, seconds: float, draw: random.Random
) -> None:
    """Kill the process of one account after another with SIGKILL, each process once, for so many seconds."""
    end = monotonic() + seconds
    while monotonic() < end:
        victim = draw.choice(books)
        pid = kill(system, victim)
        if pid is None:
            await asyncio.sleep(RETRY)
            continue
        console.print(
            f"  SIGKILL to process {pid} of {victim.owner}, who has {victim.asked:,} payments", highlight=False
        )
        await asyncio.sleep(draw.uniform(0.0, PAUSE))


def kill(system: ActorSystem, victim: Books) -> int | None:
    """Kill the process of an account, and return its pid; None if the process of the last kill is not replaced yet."""
    try:
        pid = system.pid_of(victim.account)
        if pid == victim.killed_pid:
            return None
        os.kill(pid, signal.SIGKILL)
    except (NoSuchActor, ProcessLookupError):
        return None
    victim.killed_pid = pid
    victim.killed_at.append(monotonic())
    return pid


async def audit(books: Sequence[Books]) -> BankReport:
    """Compare what the accounts have booked with the receipts of their customers."""
    judged: list[tuple[int, int]] = []
    gaps: list[float] = []
    for one in books:
        booked = await one.account.ask(GetStatement(), timeout=PATIENCE)
        judged.append(judge(one.asked, one.receipts, booked))
        gaps += longest_silences(one.killed_at, one.answered_at)
    return BankReport(
        asked=sum(one.asked for one in books),
        answered=sum(one.receipts.total() for one in books),
        lost=sum(lost for lost, _ in judged),
        doubled=sum(doubled for _, doubled in judged),
        gaps=gaps,
    )


def summary(report: BankReport) -> Table:
    """Draw the report as a table."""
    table = Table(show_header=False)
    table.add_column()
    table.add_column(justify="right")
    table.add_row("asks", f"{report.asked:,}")
    table.add_row("answered", f"{report.answered:,}")
    table.add_row("lost", f"{report.lost:,}")
    table.add_row("doubled", f"{report.doubled:,}")
    table.add_row("kills", str(len(report.gaps)))
    if report.gaps:
        table.add_row("median gap", f"{1000 * median(report.gaps):.0f} ms")
        table.add_row("longest gap", f"{1000 * max(report.gaps):.0f} ms")
    return table
