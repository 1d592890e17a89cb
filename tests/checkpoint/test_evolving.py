"""Code that would misread what is recorded is refused, with the difference in words; other code goes on with it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

import holdfast as hf
from holdfast.checkpoint.schema import difference, shape_of
from tests.checkpoint.test_restart_root import PATHS

pytestmark = pytest.mark.usefixtures("warm_programs")

PLAYER = Path(__file__).with_name("evolving_player.py")
CODE = """
import holdfast as hf


class Add(hf.Message[int]):
    n: int
    b: int = 7


class Get(hf.Message[list[int]]): ...


class A(hf.Actor):
    def __init__(self) -> None:
        self.xs: list[int] = []
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.xs.append(message.n * 100 + message.b)
        self.late = len(self.xs)
        return len(self.xs)

    @hf.on(Get, readonly=True)
    def read(self, message: Get) -> list[int]:
        return self.xs
"""
WHOLE = str([107, 207, 307, 407, 507])


def run(folder: Path, code: str, what: str) -> subprocess.CompletedProcess[str]:
    (folder / "code.py").write_text(code)
    return subprocess.run(
        [sys.executable, str(PLAYER), str(folder / "code.py"), str(folder / "app.db"), what],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": PATHS, "PYTHONDONTWRITEBYTECODE": "1"},
    )


class Case(NamedTuple):
    """A change of the code, and what is said of it: "" if the new code goes on; `waits`: only if something waits."""

    old: str
    new: str
    problem: str
    waits: bool = False


FIELDS = "    n: int\n    b: int = 7\n"
CASES = {
    "swapped": Case(FIELDS, "    b: int\n    n: int = 7\n", ""),
    "inserted": Case(FIELDS, "    z: int = 0\n    n: int = 0\n    b: int = 7\n", ""),
    "removed": Case(FIELDS + "\n", "    n: int\n    b = 7\n\n", ""),
    "inserted without a default": Case(
        FIELDS, "    z: int\n    n: int\n    b: int = 7\n", "z is new and has no default", True
    ),
    "of another type": Case(FIELDS, "    n: int\n    b: str = ''\n", "Expected `str`, got `int`", True),
    "added": Case(FIELDS, FIELDS + "    why: str = ''\n", ""),
    "another variable": Case("self.total = 0", "self.total = 0; self.more = 1", ""),
    "another class": Case("class A(", "class A: ...\nclass B(", "it was recorded by evolving:A"),
    "a declared class": Case("class A(hf.Actor):", "@hf.renamed('A')\nclass B(hf.Actor):", ""),
}


@pytest.mark.parametrize("what", ["killed", "saved", "stopped"])
@pytest.mark.parametrize("name", CASES)
@pytest.mark.some(14)
def test_code_goes_on_with_what_it_can_read(tmp_path: Path, name: str, what: str) -> None:
    case = CASES[name]
    assert run(tmp_path, CODE, what).returncode == (0 if what == "stopped" else -9)
    code = CODE.replace(case.old, case.new)
    assert code != CODE
    if "class B(" in code:
        code = code.replace("class A: ...\n", "") + "\n\nA = B\n"
    done = run(tmp_path, code, "read")
    if case.problem and not (case.waits and what == "stopped"):
        assert (done.returncode, done.stdout) == (1, "")
        assert "does not fit the code" in done.stderr
        assert case.problem in done.stderr
        done = run(tmp_path, CODE, "read")  # Nothing was changed: the old code goes on.
    assert (done.stdout, done.stderr) == (WHOLE, "")


@pytest.mark.parametrize("what", ["saved", "stopped"])
def test_a_renamed_variable_is_refused_until_somebody_says_what_becomes_of_it(tmp_path: Path, what: str) -> None:
    run(tmp_path, CODE, what)
    renamed = CODE.replace("self.xs", "self.ys")
    done = run(tmp_path, renamed, "read")
    assert "its class had the variables (xs, total), evolving.A has (ys, total): xs would be lost" in done.stderr
    migrate = """class A(hf.Actor):
    schema_version = 2

    @classmethod
    def migrate(cls, state, from_version):
        return {"ys" if name == "xs" else name: value for name, value in state.items()}
"""
    done = run(tmp_path, renamed.replace("class A(hf.Actor):", migrate), "read")
    assert (done.stdout, done.stderr) == (WHOLE, "")


def test_code_that_was_rolled_back_goes_on(tmp_path: Path) -> None:
    """A field that was added, and is in the journal, is dropped for it, and is there for the newer code again."""
    added = CODE.replace(FIELDS, FIELDS + "    why: str = ''\n")
    run(tmp_path, added, "killed")
    for code in (CODE, added):
        assert run(tmp_path, code, "read").stdout == WHOLE


ASKING = """
import holdfast as hf


class Pair(hf.Message):
    n: int
    b: int = 7


class No(hf.Refusal):
    m: int
    c: int = 7


class Add(hf.Message[int]):
    n: int
    b: int = 7


class Ask(hf.Message[list[Pair]]):
    n: int


class Get(hf.Message[list[int]]): ...


class Teller(hf.Actor):
    @hf.on(Ask)
    def tell(self, message: Ask) -> list[Pair]:
        if message.n % 2:
            raise No(message.n, 7)
        return [Pair(message.n, 7)]


class A(hf.Actor):
    def __init__(self) -> None:
        self.xs: list[int] = []

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        try:
            (pair,) = await self.ctx.find("/app/teller", Teller).ask(Ask(message.n))
            self.xs.append(pair.n * 100 + pair.b)
        except No as no:
            self.xs.append(no.m * 100 + no.c)
        return len(self.xs)

    @hf.on(Get, readonly=True)
    def read(self, message: Get) -> list[int]:
        return self.xs


PLAIN = {"teller": Teller}
"""
OUTCOMES = {
    "swapped in the reply": (
        "    n: int\n    b: int = 7\n\n\nclass No",
        "    b: int\n    n: int = 7\n\n\nclass No",
        "",
    ),
    "swapped in the refusal": (
        "    m: int\n    c: int = 7\n",
        "    c: int\n    m: int = 7\n",
        "",
    ),
    "another type in the reply": (
        "class Pair(hf.Message):\n    n: int\n    b: int = 7",
        "class Pair(hf.Message):\n    n: int\n    b: str = ''",
        "[]: its fields were (n: int, b: int = ...), now they are (n: int, b: str = ...): Expected `str`, got `int`",
    ),
    "added to the refusal without a default": (
        "    m: int\n    c: int = 7\n",
        "    m: int\n    d: int\n    c: int = 7\n",
        "d is new and has no default",
    ),
    "added": ("    c: int = 7\n", "    c: int = 7\n    why: str = ''\n", ""),
}


@pytest.mark.parametrize("what", ["killed", "saved", "stopped"])
@pytest.mark.parametrize("change", OUTCOMES)
@pytest.mark.some(8)
def test_replies_and_refusals_in_the_journal_are_not_misread(tmp_path: Path, change: str, what: str) -> None:
    assert run(tmp_path, ASKING, what).returncode == (0 if what == "stopped" else -9)
    old, new, problem = OUTCOMES[change]
    code = ASKING.replace(old, new)
    assert code != ASKING
    done = run(tmp_path, code, "read")
    if problem and what != "stopped":
        assert (done.returncode, done.stdout) == (1, "")
        assert problem in done.stderr
        done = run(tmp_path, ASKING, "read")
    assert (done.stdout, done.stderr) == (WHOLE, "")


@pytest.mark.parametrize("what", ["killed", "saved"])
def test_a_refusal_and_what_was_asked_may_be_renamed(tmp_path: Path, what: str) -> None:
    assert run(tmp_path, ASKING, what).returncode == -9
    code = re.sub(r"\bNo\b", "Never", re.sub(r"\bAsk\b", "Question", ASKING)).replace("no.m", "no.k")
    code = code.replace("    m: int\n    c: int = 7\n", "    c: int\n    k: int\n").replace(
        "(message.n, 7)\n        return [", "(7, message.n)\n        return ["
    )
    undeclared = run(tmp_path, code, "read")
    assert undeclared.returncode == 1
    code = code.replace("class Never(", '@hf.renamed("No", k="m")\nclass Never(')
    done = run(tmp_path, code.replace("class Question(", '@hf.renamed("Ask")\nclass Question('), "read")
    assert (done.stdout, done.stderr) == (WHOLE, "")


class Add(hf.Message[int]):
    n: int = 1


class Get(hf.Message[int]): ...


class Account(hf.Actor):
    def __init__(self) -> None:
        self.euros = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.euros += message.n
        return self.euros

    @hf.on(Get, readonly=True)
    def get(self, message: Get) -> int:
        return self.euros


class Double(Account):
    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.euros += 2 * message.n
        return self.euros


@hf.renamed(f"{__name__}:Double")
class Heir(Double):
    """Takes the records of what it replaces over."""


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_code_that_was_replaced_is_not_replayed_by_the_old_one(tmp_path: Path, isolation: str) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"

    def spec(kind: type[Account]) -> hf.ChildSpec:
        recovery = hf.hybrid(interval=1000.0)
        return hf.child("a", hf.start(kind), isolation=isolation, recovery=recovery)  # type: ignore[arg-type]

    async with hf.ActorSystem("app", store=store, log=False) as system:
        account = await system.start(spec(Account))
        for _ in range(5):
            await account.ask(Add())
        await system.suspend(account)
        await system.replace_code(account, Double)
        await system.resume(account)
        assert [await account.ask(Add()) for _ in range(5)][-1] == 15
    async with hf.ActorSystem("app", store=store, log=False) as system:
        for _ in range(2):
            with pytest.raises(
                hf.StartFailed, match=r"it was recorded by .*:Double, and is to be started as .*:Account"
            ):
                await system.start(spec(Account))
        account = await system.start(spec(Double))
        assert await account.ask(Get()) == 15
    async with hf.ActorSystem("app", store=store, log=False) as system:
        account = await system.start(spec(Heir))
        assert await account.ask(Add()) == 17
    async with hf.ActorSystem("app", store=store, log=False) as system:
        account = await system.start(spec(Account), fresh=True)
        assert await account.ask(Get()) == 0


class Inner(hf.Message):
    x: int
    y: int


class Outer(hf.Message):
    one: Inner
    many: list[Inner]
    by_name: dict[str, Inner | None]


def test_structs_in_a_message_count_too() -> None:
    shape = shape_of(Outer)
    assert [row.place for row in shape] == ["", "one", "many[]", "by_name[]"]
    swapped = tuple(row._replace(fields=row.fields[::-1]) if row.place else row for row in shape)
    assert difference(shape, swapped) == "one: its fields were (x: int, y: int), now they are (y: int, x: int)"
    assert difference(shape, shape) == ""


SENDS = """
import holdfast as hf
import msgspec



class Note(hf.Message):
    n: int


class Sum(msgspec.Struct):
    total: int


class Packed(msgspec.Struct, array_like=True):
    total: int


class Add(hf.Message[Sum]):
    n: int
    b: int = 7


class Get(hf.Message[list[int]]): ...


class Sink(hf.Actor):
    @hf.on(Note)
    def note(self, message: Note) -> None: ...


PLAIN = {"sink": Sink}


class A(hf.Actor):
    def __init__(self) -> None:
        self.xs: list[int] = []

    @hf.on(Add)
    async def add(self, message: Add) -> Sum:
        self.xs.append(message.n)
        self.ctx.find("/app/sink", Sink).tell(Note(message.n))
        await self.ctx.sleep(0.001)
        return Sum(len(self.xs))

    @hf.on(Get, readonly=True)
    def read(self, message: Get) -> list[int]:
        return self.xs
"""


@pytest.mark.parametrize("reply", ["Sum", "Packed"])
def test_what_turns_have_sent_and_answered_may_get_more_fields(tmp_path: Path, reply: str) -> None:
    code = SENDS.replace("hf.Message[Sum]", f"hf.Message[{reply}]").replace("return Sum(", f"return {reply}(")
    assert run(tmp_path, code, "killed").returncode == -9
    field = "    n: int\n\n\nclass Sum"
    more = code.replace(field, field.replace("int\n", "int\n    why: str = ''\n    at: float = 0.0\n", 1))
    more = more.replace("    total: int\n", "    total: int\n    mean: float = 0.5\n")
    assert more.count("why") == 1
    done = run(tmp_path, more, "read")
    assert (done.stdout, done.stderr) == (str([1, 2, 3, 4, 5]), "")


def test_another_value_in_what_was_sent_diverges_and_says_what_it_is(tmp_path: Path) -> None:
    assert run(tmp_path, SENDS, "killed").returncode == -9
    done = run(tmp_path, SENDS.replace("Note(message.n)", "Note(message.n + 1)"), "read")
    assert "output 1 (tell of evolving:Note to /app/sink): it is not what it was before the crash" in done.stderr
