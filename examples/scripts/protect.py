"""A reconfiguration script: alice is protected, in several steps. `holdfast apply protect.py --socket bank.sock`"""

import holdfast as hf


async def reconfigure(system) -> None:
    async with system.transaction(timeout=60.0) as change:
        change.attach("/app/bank/alice", hf.ftm.PBR())
        change.compose("/app/bank/alice", hf.ftm.TR())  # inside; a file "my_mechanism.py" would do, too
        change.transition("/app/bank/alice", hf.ftm.LFR())
        change.detach("/app/bank/alice", "tr")
