"""Chapter 3 of the tutorial: an account in a process of its own."""

import os
import signal

from chapter_1 import Account, Balance, Deposit

import holdfast as hf

branch = hf.supervisor(
    "branch",
    children=[
        hf.child("alice", hf.start(Account, 100), isolation="process"),
        hf.child("bob", hf.start(Account)),
    ],
)


async def main() -> None:
    async with hf.ActorSystem("bank", log=False) as system:
        await system.start(branch)
        alice = system.ref("/bank/branch/alice", Account)
        bob = system.ref("/bank/branch/bob", Account)

        first = system.pid_of(alice)
        print(first == os.getpid())  # False
        print(system.pid_of(bob) == os.getpid())  # True

        print(await alice.ask(Deposit(20)))  # 120

        os.kill(first, signal.SIGKILL)
        print(await alice.ask(Balance()))  # 100
        print(system.pid_of(alice) == first)  # False


if __name__ == "__main__":
    hf.run(main())
