"""The frames of real traffic: each shape once, kept in `corpus.txt`. Run as a module, it adds what is new.

python -m tests.actors.process.hostile.corpus
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import msgspec

import holdfast as hf
from holdfast.actors.process.wire import frames
from holdfast.actors.process.wire.connection import Connection
from holdfast.ftm.mechanisms.pbr import PBR
from tests.actors.process.hostile.players import Add, Evil, Ping, Victim

FILE = Path(__file__).with_name("corpus.txt")
LONGEST = 2048


def corpus() -> list[bytes]:
    """All frames that are kept."""
    return [bytes.fromhex(line) for line in FILE.read_text().splitlines()]


def shape(data: bytes) -> str:
    """What two frames have in common that differ in their values only."""

    def of(value: Any) -> str:
        if isinstance(value, list):
            return f"[{' '.join(map(of, value[:8]))}]"
        if isinstance(value, dict):
            return f"{{{' '.join(f'{key}:{of(one)}' for key, one in sorted(value.items(), key=str))}}}"
        return type(value).__name__

    whole = msgspec.msgpack.decode(data)
    verb = whole[2] if whole[0] in (frames.Command.__struct_config__.tag, 3) and len(whole) > 2 else ""
    return f"{whole[0]} {verb} {of(whole)}"


class Chatter(hf.Actor):
    """Does what actors in processes do."""

    @hf.on(Ping)
    async def chat(self, message: Ping) -> int:
        ctx = self.ctx
        victim = ctx.find("/app/victim", Victim)
        ctx.subscribe("/news")
        monitor = ctx.monitor(victim)
        ctx.watch(victim)
        ctx.link(victim)
        victim.tell(Add())
        await victim.send(Add())
        await victim.ask(Add())
        await ctx.publish("/news", Add())
        ctx.spawn(hf.start(Victim), "below").tell(Add())
        await asyncio.sleep(0)
        ctx.unlink(victim)
        monitor.cancel()
        ctx.unsubscribe("/news")
        return 1

    @hf.on(Add)
    def news(self, message: Add) -> int:
        raise ValueError("no news")


async def main() -> None:
    """Have a system talk, and keep what is new."""
    known = {shape(data): data for data in corpus()} if FILE.exists() else {}
    frames_in = Connection._take_frames

    def listening(self: Connection, left: int) -> None:
        buffer = self._buffer
        at, end = buffer.begin, buffer.end
        while self._guarded and end - at >= 4:
            size = int.from_bytes(buffer.data[at : at + 4], "little")
            if end - at - 4 < size:
                break
            data = bytes(buffer.data[at + 4 : at + 4 + size])
            if size <= LONGEST:
                known.setdefault(shape(data), data)
            at += 4 + size
        frames_in(self, left)

    Connection._take_frames = listening  # type: ignore[method-assign]
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        await system.start(hf.child("victim", hf.start(Victim)))
        for name, recovery in (("plain", None), ("recorded", hf.hybrid(interval=0.1))):
            options: Any = {"isolation": "process", "recovery": recovery, "limits": hf.Limits(hung_after=5)}
            spec = hf.child(name, hf.start(Chatter), **options)
            one = await system.start(spec)
            try:
                await one.ask(Ping(), timeout=10)
            except hf.HoldfastError as error:
                print(name, error)
            try:
                await one.ask(Add(), timeout=10)
            except hf.HoldfastError as error:
                print(name, error)
            await asyncio.sleep(0.5)
            await system.get_state(one)
        below = [hf.child("a", hf.start(Victim), recovery=hf.hybrid()), hf.child("b", hf.start(Evil))]
        await system.start(hf.supervisor("top", isolation="process", children=below))
        await system.ref("/app/top/a", Victim).ask(Add(), timeout=10)
        system.ref("/app/top/b", Evil).kill()
        protected = await system.start(hf.child("safe", hf.start(Victim), recovery=hf.hybrid(), mechanism=PBR()))
        await protected.ask(Add(), timeout=30)
        await system.set_isolation(system.ref("/app/plain", Chatter), "task")
    FILE.write_text("".join(f"{data.hex()}\n" for data in sorted(known.values())))
    print(f"{len(known)} frames, {FILE.stat().st_size} bytes")


if __name__ == "__main__":
    hf.run(main())
