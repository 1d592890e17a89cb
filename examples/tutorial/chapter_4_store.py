"""Chapter 4 of the tutorial, continued: the whole program is killed. Run it several times in the same folder."""

import os
import signal

from chapter_2 import Teller, Transfer
from chapter_4 import branch

import holdfast as hf


async def main() -> None:
    async with hf.ActorSystem("bank", store="sqlite:bank.db", log=False) as system:
        await system.start(branch)
        teller = system.ref("/bank/branch/teller", Teller)
        print("transfer", await teller.ask(Transfer(1)), flush=True)
        os.kill(os.getpid(), signal.SIGKILL)  # the program itself, and all its processes with it


if __name__ == "__main__":
    hf.run(main())
