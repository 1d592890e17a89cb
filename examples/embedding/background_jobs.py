"""Background jobs, as one has them from Celery: without a broker, and none is lost once it is accepted.

A job is a message to a recorded worker: `await worker.send(job)` returns when it is in the store. A worker that dies,
with or without the whole program, goes on with the jobs that wait. What a task does to the outside is an effect: it is
tried again after an error, and its outcome is kept, so that a job that is done is not done again.

`python background_jobs.py`, then `echo "note 5" | nc localhost 8000`.
"""

import asyncio
import os
from collections.abc import Callable
from pathlib import Path

from ledger import Ledger, Note, Notes, ledger, make_system
from lines import serve_lines

import holdfast as hf
from holdfast.console.service.health import Service

WORKERS = 4
OUTBOX = Path(os.environ.get("NOTES_FOLDER", "."), "outbox")


def send_mail(number: int) -> int:
    """Send one mail. It runs in a thread, and may raise what networks raise."""
    with OUTBOX.open("a") as outbox:
        outbox.write(f"{number}\n")
    return number


TASKS: dict[str, Callable[[int], int]] = {"send_mail": send_mail}
"""What can be asked for by name: a job outlives the program that has accepted it."""


class Job(hf.Message):
    """Do a task with a number."""

    task: str
    number: int


class Rest(hf.Message[None]):
    """Answer when all jobs before this are done."""


class Worker(hf.Actor):
    """Does one job after another."""

    results: hf.Binding[Ledger]

    @hf.on(Job)
    async def work(self, job: Job) -> None:
        retry = hf.Retry(attempts=5, backoff=hf.Backoff(initial=0.1, maximum=60.0), on=(OSError,))
        try:
            done = await self.ctx.effect(TASKS[job.task], job.number, retry=retry, timeout=30.0)
        except hf.errors.EffectFailed as failed:
            self.results.tell(Note(-job.number))  # Somebody has to look: that, too, is kept.
            print(f"{job.task} {job.number}: {failed}")
        else:
            self.results.tell(Note(done))

    @hf.on(Rest, readonly=True)
    def rest(self, message: Rest) -> None: ...


def workers() -> hf.ChildSpec[hf.Supervisor]:
    """Say how the workers live: each is recorded, and no more than a thousand jobs wait for one."""
    return hf.supervisor(
        "workers",
        intensity=10,
        period=60.0,
        children=[
            hf.child(
                f"{number}",
                hf.start(Worker),
                recovery=hf.hybrid(),
                mailbox=hf.bounded(1000),
                bindings={"results": "/notes/ledger"},
                backoff=hf.Backoff(),
            )
            for number in range(WORKERS)
        ],
    )


async def main() -> None:
    """Accept jobs until a signal comes."""
    async with Service(make_system(), probes=os.environ.get("PROBES")) as service:
        done = await service.system.start(ledger())
        await service.system.start(workers())
        all_workers = [service.system.ref(f"/notes/workers/{number}", Worker) for number in range(WORKERS)]

        async def answer(words: list[str]) -> str:
            match words:
                case ["note", number]:
                    await all_workers[int(number) % WORKERS].send(Job("send_mail", int(number)))
                    return f"kept {number}"
                case ["notes"]:
                    await asyncio.gather(*(worker.ask(Rest(), 60.0) for worker in all_workers))
                    return " ".join(map(str, await done.ask(Notes())))
                case _:
                    return "note NUMBER, or notes"

        async with serve_lines(answer):
            service.up()
            await asyncio.Event().wait()


if __name__ == "__main__":
    hf.run(main())
