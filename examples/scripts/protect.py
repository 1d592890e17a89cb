"""A reconfiguration script: alice is protected, in several steps. `holdfast apply protect.py --socket bank.sock`"""

import holdfast as hf


async def reconfigure(system) -> None:
    async with system.transaction(timeout=60.0) as change:
        change.protect("/app/bank/alice", hf.ftm.PBR())
        change.protect(
            "/app/bank/alice", ("pbr", hf.ftm.TR())
        )  # one more inside; a file "my_mechanism.py" would do, too
        change.protect("/app/bank/alice", ("lfr", "tr"))  # "tr" is the one that it has
        change.protect("/app/bank/alice", "lfr")
