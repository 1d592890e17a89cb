"""Jobs in processes of their own, and task supervisors inside a process (otp.md 1.14 Task.Supervisor; W10)."""

import asyncio
import os
import time
from typing import Any

import pytest

import holdfast as hf
from tests.supervision.family import refused
from tests.supervision.test_tasks import Short, add, fail, opened, refuse

# -- processes ------------------------------------------------------------------------------------------------------


def pid_and(pair: tuple[int, str]) -> tuple[int, tuple[int, str]]:
    return os.getpid(), pair


async def pid_later() -> int:
    await asyncio.sleep(0)
    return os.getpid()


def say_nothing() -> object:
    return object()


def block_for_ever(path: str) -> None:
    with open(path, "w") as begun:
        begun.write(str(os.getpid()))
    while True:
        time.sleep(60.0)


def die(code: int) -> None:
    os._exit(code)


async def test_a_job_in_a_process_of_its_own() -> None:
    async with opened(max_children=1) as (_, jobs):  # Its place is free when `run` returns.
        pid, pair = await jobs.run(pid_and, (1, "x"), isolation="process")
        assert (pid != os.getpid(), pair) == (True, (1, "x")), "decoded as the function says, so a tuple is one"
        assert await jobs.run(pid_later, isolation="process") != os.getpid()
        crash = await refused(jobs.run(fail, "far", isolation="process"))
        assert isinstance(crash, hf.RemoteCrash)
        assert (crash.type_name, crash.text) == ("ValueError", "far")
        assert await refused(jobs.run(refuse, isolation="process")) == Short(by=3)
        assert isinstance(await refused(jobs.run(say_nothing, isolation="process")), hf.errors.BadMessage)
        assert isinstance(await refused(jobs.run(die, 3, isolation="process")), hf.AskFailed)
        assert await jobs.children() == []


async def test_blocking_work_in_a_process_can_be_killed(tmp_path: Any) -> None:
    path = tmp_path / "begun"
    async with opened() as (_, jobs):
        job = jobs.start(block_for_ever, str(path), isolation="process")
        async with asyncio.timeout(30.0):
            while not (path.exists() and path.read_text()):
                await job.outcome(0.02)
        job.kill()
        error = await refused(job)
        assert isinstance(error, hf.AskFailed)
        assert error.reason == "killed"
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.read_text()), 0)


async def test_processes_come_up_side_by_side_and_the_supervisor_answers_meanwhile() -> None:
    async with opened() as (_, jobs):
        many = [jobs.start(pid_later, isolation="process") for _ in range(3)]
        assert await jobs.run(add, 1) == 2
        assert not any(job.is_done for job in many)
        assert len({await job for job in many}) == 3


class Ask(hf.Message[str]):
    at: hf.ActorRef[hf.Actor]


class Far(hf.Actor):
    """In a process of its own, with a task supervisor there."""

    @hf.on(Ask)
    async def ask(self, message: Ask) -> str:
        there = "nothing"
        try:
            await hf.supervision.Tasks(message.at).run(pid_later)  # type: ignore[arg-type]
        except hf.SpecError as error:
            there = str(error)
        own = hf.supervision.Tasks(self.ctx.spawn(hf.supervision.tasks("jobs").start, "jobs"))
        same = await own.run(pid_later) == os.getpid()
        return f"{same} {there}"


async def test_an_actor_in_a_process_has_its_own_task_supervisor() -> None:
    async with opened() as (system, jobs):
        far = await system.start(hf.child("far", hf.start(Far), isolation="process"))
        assert (await far.ask(Ask(jobs.ref))).startswith("True job: /app/jobs lives in another process")
