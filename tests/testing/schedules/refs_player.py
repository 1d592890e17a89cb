"""Prints the order of a set of refs, whose addresses as strings have another order in each process."""

from __future__ import annotations

import asyncio

import holdfast as hf
from holdfast.testing import GuardedSystem


class Leaf(hf.Actor):
    """Is there."""


async def main() -> None:
    async with GuardedSystem() as system:
        leaves = [system.spawn(hf.start(Leaf), f"leaf{number}") for number in range(20)]
        print([ref.path for ref in set(leaves)])
        print(sorted(map(hash, leaves)) == sorted(hash(system.ref(ref.path)) for ref in leaves))


if __name__ == "__main__":
    asyncio.run(main())
