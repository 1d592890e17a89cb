"""A counter that survives the death of its process. It counts until you press Ctrl+C: kill it meanwhile."""

import asyncio
import os
import sys

import holdfast as hf


class Next(hf.Message[int]): ...


class Counter(hf.Actor):
    def __init__(self) -> None:
        self.number = 0

    @hf.on(Next)
    def count(self, message: Next) -> int:
        self.number += 1
        return self.number


async def main() -> None:
    store = sys.argv[1] if len(sys.argv) > 1 else None  # "sqlite:counter.db", say
    async with hf.ActorSystem("app", store=store) as system:
        spec = hf.child("counter", hf.start(Counter), isolation="process", recovery=hf.hybrid())
        counter = await system.start(spec)
        print("the program is process", os.getpid())
        while True:
            number = await counter.ask(Next())
            print(f"{number} from process {system.pid_of(counter)}", flush=True)
            await asyncio.sleep(1)


if __name__ == "__main__":
    hf.run(main())
