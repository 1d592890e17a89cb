"""A reconfiguration script: from now on every deposit is audited. `holdfast apply audit.py --socket bank.sock`"""

import holdfast as hf


class Audit(hf.Message[str]):
    text: str


class Auditor(hf.Actor):
    """Is defined here: the running system loads this very file, if nobody else could have written it."""

    def __init__(self) -> None:
        self.seen = 0

    @hf.on(Audit)
    def audit(self, message: Audit) -> str:
        self.seen += 1
        return f"{self.seen}: {message.text}"


async def reconfigure(system) -> None:
    async with system.transaction() as change:
        auditor = change.add("/app/bank", hf.child("auditor", hf.start(Auditor)))
        change.register("auditor", auditor)
        change.reorder("/app/bank", ["auditor", "alice"])
        change.intensity("/app/bank", 10, 60.0)
        change.remove("/app/bank/bob")
