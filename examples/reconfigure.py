"""A running system is changed by a script that another process sends to it, all of it or nothing."""

import asyncio
import sys
import tempfile
from pathlib import Path

import holdfast as hf
from holdfast.console.endpoint import control_endpoint

SCRIPT = Path(__file__).parent / "scripts" / "audit.py"


class Account(hf.Actor): ...


bank = hf.supervisor("bank", children=[hf.child(name, hf.start(Account)) for name in ("alice", "bob")])


async def holdfast(*arguments: str) -> tuple[str, int]:
    """The command, as an operator types it in another terminal."""
    command = (sys.executable, "-m", "holdfast.console.cli", *arguments)
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    output, _ = await process.communicate()
    return output.decode(), process.returncode or 0


async def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        async with hf.ActorSystem("app", log=False) as system, control_endpoint(system, f"{folder}/app.sock") as socket:
            await system.start(bank)
            target = ("--socket", str(socket))

            said, _ = await holdfast("apply", str(SCRIPT), *target, "--dry-run")
            print(said.splitlines()[0])  # 1. add /app/bank/auditor
            print("/app/bank/auditor" in system.tree())  # False

            _, status = await holdfast("apply", str(SCRIPT), *target)
            print(status, system.whereis("auditor").path)  # 0 /app/bank/auditor

            said, _ = await holdfast("tree", "--paths", *target)
            print(said.split())  # ['/app', '/app/bank', '/app/bank/auditor', '/app/bank/alice']

            said, status = await holdfast("apply", str(SCRIPT), *target)  # Twice is refused; nothing changes.
            print(status, "is known already" in said)  # 1 True


if __name__ == "__main__":
    hf.run(main())
