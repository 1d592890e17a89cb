"""Chapter 4 of the tutorial: a bank that loses no money, whoever dies."""

import asyncio
import os
import signal

from chapter_1 import Account, Balance
from chapter_2 import Teller, Transfer

import holdfast as hf

branch = hf.supervisor(
    "branch",
    intensity=10,
    period=5.0,
    children=[
        hf.child("alice", hf.start(Account, 100), isolation="process", recovery=hf.hybrid()),
        hf.child("bob", hf.start(Account), isolation="process", recovery=hf.hybrid()),
        hf.child(
            "teller",
            hf.start(Teller),
            isolation="process",
            recovery=hf.hybrid(),
            bindings={"source": "/bank/branch/alice", "target": "/bank/branch/bob"},
        ),
    ],
)


async def main() -> None:
    async with hf.ActorSystem("bank", log=False) as system:
        await system.start(branch)
        alice = system.ref("/bank/branch/alice", Account)
        bob = system.ref("/bank/branch/bob", Account)
        teller = system.ref("/bank/branch/teller", Teller)

        transfers = [teller.ask(Transfer(1)) for _ in range(50)]
        print(await transfers[9])  # 10
        for victim in (teller, alice, bob):
            os.kill(system.pid_of(victim), signal.SIGKILL)
        print(max(await asyncio.gather(*transfers)))  # 50
        print(await alice.ask(Balance()), await bob.ask(Balance()))  # 50 50


if __name__ == "__main__":
    hf.run(main())
