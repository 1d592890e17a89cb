"""Test suites of a user, each run in a directory of its own."""

import pytest

CONFTEST = """
from importlib.metadata import entry_points
pytest_plugins = [] if entry_points(group="pytest11", name="holdfast") else ["holdfast.testing.plugin"]
"""
HEAD = """
import asyncio, pytest
import holdfast as hf

class Add(hf.Message[int]):
    n: int

class Many(hf.Message):
    items: list[int]

class Counter(hf.Actor):
    def __init__(self):
        self.total = 0

    @hf.on(Add)
    def add(self, message):
        if message.n < 0:
            raise ValueError("negative")
        self.total += message.n
        return self.total

    @hf.on(Many)
    async def many(self, message):
        await asyncio.sleep(0)
        message.items.append(1)
"""


def run_suite(pytester: pytest.Pytester, tests: str, *args: str, **options: str) -> pytest.RunResult:
    """Run test functions of a user; `options` go into the pytest configuration."""
    pytester.makeconftest(CONFTEST)
    lines = {"asyncio_mode": "auto", "asyncio_default_fixture_loop_scope": "function", **options}
    pytester.makeini("[pytest]\n" + "\n".join(f"{name} = {value}" for name, value in lines.items()))
    pytester.makepyfile(tests)
    return pytester.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:randomly", *args)
