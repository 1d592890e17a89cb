"""A till whose recorded clerk pays what it is told into an account of the bank, which is another system.

    python -m tests.cluster.till BANK STORE HOW

Both systems are kept on servers, and may be killed at any time: what the clerk has paid is in the account, once.
"""

from __future__ import annotations

import asyncio
import sys

import holdfast as hf
from tests.cluster.bank import Account, Gain


class Pay(hf.Message[int]):
    amount: int


class Clerk(hf.Actor):
    """Pays each amount into the account, by a tell or an ask."""

    def __init__(self, account: hf.ActorRef[Account], how: str) -> None:
        self._account, self._how = account, how
        self.paid = 0

    @hf.on(Pay)
    async def pay(self, message: Pay) -> int:
        self.paid += message.amount
        if self._how == "tell":
            self._account.tell(Gain(message.amount))
        else:
            await self._account.ask(Gain(message.amount), timeout=300.0)
        return self.paid


async def main() -> None:
    bank, store, how = sys.argv[1:4]
    async with (
        hf.ActorSystem("till", store=store, standby="warm", log=False) as system,
        hf.connect(bank, system="bank", within=system, timeout=60.0) as connection,
    ):
        account = connection.ref("/bank/account", Account)
        await system.start(hf.child("clerk", hf.start(Clerk, account, how), recovery=hf.hybrid()))
        print("leads", flush=True)
        await asyncio.Event().wait()


if __name__ == "__main__":
    from tests.cluster import till  # Here the messages would have other names than for those who send them.

    hf.run(till.main, again=True)
