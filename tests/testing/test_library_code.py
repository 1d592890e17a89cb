"""Whose code it is: what a user keeps in a checkout of holdfast, or in a folder of its name, is the user's."""

import os
import sys
import traceback
from pathlib import Path
from typing import Any

import pytest

import holdfast
from holdfast.testing import simulate
from holdfast.testing.library_code import MODULES, ROOMS
from tests.testing.suites import HEAD, run_suite

CHECKOUT = Path(holdfast.__file__).parent
SIMULATED = """
async def test_bank(system):
    fail()

def fail():
    raise ValueError("a bug of the user's")
"""


@pytest.mark.parametrize("file", ["bank.py", "shop/bank.py", "examples/bank.py", f"../{CHECKOUT.name}-bank/bank.py"])
def test_the_traceback_of_a_test_in_a_checkout_begins_at_the_test(file) -> None:
    name = os.path.normpath(CHECKOUT / file)
    of_user: dict[str, Any] = {}
    exec(compile(SIMULATED, name, "exec"), of_user)
    with pytest.raises(ValueError, match="a bug") as raised:
        simulate(of_user["test_bank"], seeds=1)()
    shown = [frame for frame in traceback.extract_tb(raised.tb) if frame.filename != __file__]
    assert [(frame.filename, frame.name) for frame in shown[-2:]] == [(name, "test_bank"), (name, "fail")]
    assert all("asyncio" not in frame.filename for frame in shown), shown


def test_a_module_whose_name_begins_as_the_librarys_is_guarded(pytester: pytest.Pytester) -> None:
    """Its messages and timers are its user's all the same, and what its objects hold is looked at."""
    bank = """
def later():
    pass

class Box:
    items = None

class Keeper(hf.Actor):
    def __init__(self):
        self.box = Box()

    @hf.on(Many)
    def many(self, message):
        self.box.items = message.items

    @hf.on(Add)
    def add(self, message):
        self.box.items.append(message.n)
"""
    tests = """
import asyncio, importlib.util, pathlib, sys
spec = importlib.util.spec_from_file_location("holdfast.bank", pathlib.Path(__file__).parent / "holdfast" / "bank.py")
bank = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(bank)
hf, Many, Add = bank.hf, bank.Many, bank.Add

async def test_message(actor_system):
    counter = actor_system.spawn(hf.start(bank.Counter), "counter")
    counter.tell(Many([]))
    await counter.ask(Add(1))

async def test_timer(actor_system):
    asyncio.get_running_loop().call_later(60, bank.later)

async def test_holder(actor_system):
    keeper = actor_system.spawn(hf.start(bank.Keeper), "keeper")
    keeper.tell(Many([]))
    keeper.tell(Add(1))
    await keeper.ask(Add(2))
"""
    (pytester.mkdir("holdfast") / "bank.py").write_text(HEAD + bank, encoding="utf-8")
    result = run_suite(pytester, tests)
    result.assert_outcomes(passed=3, errors=3)
    result.stdout.fnmatch_lines(
        [
            "*to /app/counter: sent Many(items=[[]]), after its turn it was Many(items=[[]1])*",
            "*a timer was left: holdfast.bank.later*",
            "*which /app/keeper holds as `box`*",
        ]
    )


def test_every_folder_of_the_package_is_the_librarys() -> None:
    loaded = {name.split(".")[1] for name in sys.modules if name.startswith("holdfast.")}
    with_modules = {file.parent.name for file in CHECKOUT.glob("*/__init__.py")}
    beside = {file.stem for file in CHECKOUT.glob("[a-z]*.py")}
    assert (with_modules, beside) == (set(ROOMS), set(MODULES))
    assert loaded <= with_modules | beside
