"""The lender of docs/pools.md: a worker is lent to one at a time, whoever is killed, and is free again in the end."""

from __future__ import annotations

import asyncio
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Barrier, Let

pytestmark = pytest.mark.usefixtures("warm_programs")

PAGE = Path(__file__).parents[2] / "docs" / "pools.md"
BORROWERS = """
from tests.checkpoint.players import Barrier, Let, Pass

class Go(hf.Message[str]):
    patience: float
    gives_back: int = 1


class Borrower(hf.Actor):
    lender: hf.Binding[Lender]

    @hf.on(Go)
    async def go(self, message: Go) -> str:
        try:
            loan, worker = await self.lender.ask(Borrow(), timeout=message.patience)
        except hf.AskTimeout:
            return "gave up"
        try:
            await self.ctx.find("/app/barrier", Barrier).ask(Pass(), timeout=600.0)
            return worker
        finally:
            for _ in range(message.gives_back):
                self.lender.tell(GiveBack(loan))
"""
PROGRAM = """

import os, sys

async def main(store: str, run: str) -> None:
    async with hf.ActorSystem("app", store=store, log=False, intensity=50) as system:
        barrier = await system.start(hf.child("barrier", hf.start(Barrier), recovery=hf.hybrid()))
        lender = await system.start(hf.child("lender", hf.start(Lender, ["w"]), recovery=hf.hybrid()))
        one, two = [
            await system.start(
                hf.child(name, hf.start(Borrower), recovery=hf.hybrid(), bindings={"lender": "/app/lender"})
            )
            for name in ("one", "two")
        ]
        if run == "first":
            one.tell(Go(600.0))
            while not (await system.get_state(barrier))["waiting"]:
                await asyncio.sleep(0.01)
            os.kill(os.getpid(), 9)
        assert await two.ask(Go(0.2), timeout=60.0) == "gave up"  # The first one has it.
        await barrier.ask(Let())
        assert await two.ask(Go(60.0), timeout=60.0) == "w"
        print((await system.get_state(lender))["free"])

hf.run(main(*sys.argv[1:]))
"""


def block() -> str:
    found = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    code = next(code for code in found if "class Lender" in code)
    return "import holdfast as hf\nclass Worker(hf.Actor): ...\nclass Resize(hf.Message[str]):\n    image: str\n" + (
        code[: code.index("async def lending")] + BORROWERS
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The page's code, as a module."""
    path = tmp_path_factory.mktemp("page") / "lender_page.py"
    path.write_text(block())
    spec = importlib.util.spec_from_file_location("lender_page", path)
    assert spec is not None
    assert spec.loader is not None
    module: ModuleType = importlib.util.module_from_spec(spec)
    sys.modules["lender_page"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["lender_page"]


class House:
    """One worker, a lender, and three borrowers."""

    def __init__(self, system: hf.ActorSystem, page: Any) -> None:
        self.system, self.page = system, page

    async def open(self, recovery: Any = None) -> None:
        page, start = self.page, self.system.start
        self.barrier = await start(hf.child("barrier", hf.start(Barrier)))
        lent = hf.hybrid(durability="memory")
        self.lender = await start(hf.child("lender", hf.start(page.Lender, ["w"]), recovery=lent))
        self.borrowers = [
            await start(
                hf.child(f"b{n}", hf.start(page.Borrower), recovery=recovery, bindings={"lender": "/app/lender"})
            )
            for n in range(3)
        ]

    async def first_has_it(self, **options: Any) -> asyncio.Future[str]:
        going = asyncio.ensure_future(self.borrowers[0].ask(self.page.Go(600.0, **options), timeout=600.0))
        barrier: Any = self.barrier._cell
        while not barrier.actor.waiting:
            await asyncio.sleep(0.005)
        return going

    async def nobody_else_gets_it(self) -> None:
        assert await self.borrowers[1].ask(self.page.Go(0.2), timeout=60.0) == "gave up"

    async def somebody_gets_it(self) -> None:
        assert await self.borrowers[1].ask(self.page.Go(60.0), timeout=60.0) == "w"

    async def is_back_once(self) -> None:
        await self.barrier.ask(Let())
        await self.somebody_gets_it()
        state = await self.system.get_state(self.lender, timeout=60.0)
        assert (state["free"], state["lent"]) == (["w"], {})


@pytest.fixture
async def house(page: Any) -> Any:
    async with hf.ActorSystem("app", log=False, intensity=50) as system:
        yield House(system, page)


@pytest.mark.parametrize("is_saved", [False, True])
async def test_the_lender_may_die_while_a_worker_is_lent(house: House, *, is_saved: bool) -> None:
    await house.open()
    going = await house.first_has_it()
    if is_saved:
        await house.system.checkpoint(house.lender, timeout=60.0)
    house.lender.kill()
    await house.nobody_else_gets_it()
    await house.barrier.ask(Let())
    assert await going == "w"
    await house.is_back_once()


async def test_a_loan_that_is_given_back_twice_is_one_worker(house: House) -> None:
    await house.open()
    going = await house.first_has_it(gives_back=2)
    await house.barrier.ask(Let())
    await going
    await house.is_back_once()


async def test_a_borrower_that_dies_gives_back(house: House) -> None:
    await house.open()
    going = await house.first_has_it()
    house.borrowers[0].kill()
    with pytest.raises(hf.HoldfastError):
        await going
    await house.is_back_once()


async def test_a_recorded_borrower_that_is_killed_goes_on_with_its_worker(house: House) -> None:
    await house.open(hf.hybrid())
    going = await house.first_has_it()
    house.borrowers[0].kill()
    await house.nobody_else_gets_it()
    await house.barrier.ask(Let())
    assert await going == "w"
    await house.is_back_once()


async def test_who_has_given_up_is_lent_nothing(house: House) -> None:
    await house.open()
    going = await house.first_has_it()
    await house.nobody_else_gets_it()
    await house.barrier.ask(Let())
    await going
    await house.is_back_once()


def test_recorded_borrowers_go_on_in_the_next_program_and_nobody_has_their_worker(tmp_path: Path) -> None:
    program = tmp_path / "lending.py"
    program.write_text(block() + PROGRAM)
    for run, code, out in (("first", -9, ""), ("next", 0, "['w']\n")):
        command = [sys.executable, str(program), f"sqlite:{tmp_path / 'app.db'}", run]
        environment = {**os.environ, "PYTHONPATH": str(PAGE.parents[1])}
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert (done.returncode, done.stdout) == (code, out), done.stderr
