"""Chapter 5 of the tutorial: replicas, and a wrong value that is outvoted."""

import os
import signal

from chapter_1 import Account, Balance, Deposit

import holdfast as hf


class Corrupt(hf.Message[int]):
    """Adds a million, but only in the process with this pid: a memory error that we make ourselves."""

    pid: int


class FaultyAccount(Account):
    @hf.on(Corrupt)
    def corrupt(self, message: Corrupt) -> int:
        if os.getpid() == message.pid:
            self.balance += 1_000_000
        return self.balance


branch = hf.supervisor(
    "branch",
    children=[
        hf.child("alice", hf.start(Account, 100), mechanism=hf.ftm.PBR()),
        hf.child("carol", hf.start(FaultyAccount, 100)),
    ],
)


async def main() -> None:
    async with hf.ActorSystem("bank", log=False) as system:
        await system.start(branch)
        alice = system.ref("/bank/branch/alice", Account)
        carol = system.ref("/bank/branch/carol", FaultyAccount)

        # One replica dies.
        print(await alice.ask(Deposit(20)))  # 120
        with system.events() as events:
            os.kill(system.pid_of(system.ref("/bank/branch/alice/ftm/r1", hf.Actor)), signal.SIGKILL)
            print(await alice.ask(Deposit(1)))  # 121
            async for event in events:
                if isinstance(event, hf.events.FailedOver):
                    print(event.replica, "leads now")  # r2 leads now
                    break

        # One replica computes a wrong value.
        async with system.transaction() as change:
            change.protect(carol, hf.ftm.TMR())
        wrong = system.pid_of(system.ref("/bank/branch/carol/ftm/r1", hf.Actor))
        print(await carol.ask(Corrupt(wrong)))  # 100
        print(await carol.ask(Balance()))  # 100

        # Back to one life.
        async with system.transaction() as change:
            change.protect(carol, None)
        print(await carol.ask(Deposit(1)))  # 101


if __name__ == "__main__":
    hf.run(main())
