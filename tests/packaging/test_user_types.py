"""The types of the wheel in a user's project: it is clean, and mistakes are found where they are made.

The project (`bank_app/`) is checked with mypy --strict and with pyright in strict mode, against an environment that
holds the wheel and no source.
"""

import json
import re
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.packaging.wheel import build, copy_sources

APP = Path(__file__).parent / "bank_app"
BOTH = ("mypy", "pyright")

HEAD = """
import holdfast as hf
from holdfast.testing import Probe
from .bank import Account, Clerk, Close, Deposit, Owner, Overdrawn, Teller
"""


class Mistake(NamedTuple):
    """What is wrong, the code, and who finds it. The line that ends in `# here` is the wrong one, else the last."""

    what: str
    code: str
    found_by: tuple[str, ...] = BOTH


MISTAKES = [
    Mistake("a field of another type", 'Deposit("five")'),
    Mistake("a field left out", "Deposit()"),
    Mistake("a field that there is not", 'Deposit(5, memo="rent")'),
    Mistake("a message that is changed", "message.amount = 6"),
    Mistake("a reply used as another type", "name: str = await account.ask(Deposit(5))"),
    Mistake("a reply that is not awaited", "balance: int = account.ask(Deposit(5))"),
    Mistake("a reply that is None", "balance: int = await account.ask(Close())"),
    Mistake("a reply of an untyped ref", "name: str = await anyone.ask(Deposit(5))"),
    Mistake("an option of ask that is misspelt", "await account.ask(Deposit(5), timout=1.0)"),
    Mistake("the class of a message instead of one", "account.tell(Deposit)"),
    Mistake("something that is no message", 'await account.send("hello")'),
    Mistake(
        "a handler that returns another type",
        """
        class Wrong(hf.Actor):
            @hf.on(Deposit)  # here
            def deposit(self, message: Deposit) -> str:
                return "paid"
        """,
    ),
    Mistake(
        "an async handler that returns another type",
        """
        class Wrong(hf.Actor):
            @hf.on(Owner)  # here
            async def tell_owner(self, message: Owner) -> int:
                return 5
        """,
    ),
    Mistake(
        "a handler that promises another type",
        """
        class Wrong(hf.Actor):
            @hf.on(Deposit)  # here
            def deposit(self, message: Deposit) -> hf.ReplyHandle[str]:
                return self.ctx.reply_handle()
        """,
    ),
    Mistake("a promise kept with another type", 'clerk.waiting[0].reply("paid")'),
    Mistake("an argument of start of another type", "hf.start(Account, 5)"),
    Mistake("an argument of start left out", "hf.start(Account)"),
    Mistake("an argument of start that there is not", 'hf.start(Account, "Alice", credit=5)'),
    Mistake("start of something that is no actor", "hf.start(Deposit, 5)"),
    Mistake("a class instead of a start", 'hf.child("alice", Account)'),
    Mistake("an unknown restart", 'hf.child("alice", hf.start(Account, "Alice"), restart="always")'),
    Mistake("an unknown isolation", 'hf.child("alice", hf.start(Account, "Alice"), isolation="thread")'),
    Mistake("a recovery method that is not called", 'hf.child("alice", hf.start(Clerk), recovery=hf.hybrid)'),
    Mistake("a recovery method by its name", 'hf.child("alice", hf.start(Clerk), recovery="hybrid")'),
    Mistake("a mechanism that is not made", 'hf.child("alice", hf.start(Clerk), mechanism=hf.ftm.PBR)'),
    Mistake("a method in the place of a mechanism", 'hf.child("alice", hf.start(Clerk), mechanism=hf.hybrid())'),
    Mistake("a mailbox that is a number", 'hf.child("alice", hf.start(Clerk), mailbox=100)'),
    Mistake("an unknown strategy", 'hf.supervisor("bank", strategy="one_for_two")'),
    Mistake("a child that is no spec", 'hf.supervisor("bank", children=[hf.start(Clerk)])'),
    Mistake("a ref to another class", 'teller: hf.ActorRef[Teller] = system.ref("/app/alice", Account)'),
    Mistake("another class than was started", "teller: hf.ActorRef[Teller] = await system.start(spec)"),
    Mistake("another class than was spawned", "teller: hf.ActorRef[Teller] = system.spawn(hf.start(Clerk))"),
    Mistake("a protection that is no mechanism", "change.protect(account, hf.fresh())"),
    Mistake("a refusal with another field", 'raise Overdrawn(lacking="5")'),
    Mistake("what a probe expects, taken as another", "owner: Owner = await probe.expect(Deposit)"),
]

UNSEEN = [
    Mistake(
        "a message that the actor has no handler for: UnknownMessage at the call", "account.tell(Overdraft(5))", ()
    ),
    Mistake(
        "a handler that takes another message than `@on` names: TypeError when the class is made",
        """
        class Wrong(hf.Actor):
            @hf.on(Deposit)
            def deposit(self, message: Overdraft) -> int:
                return 5
        """,
        (),
    ),
    Mistake("a binding that the class has not: SpecError", 'hf.child("c", hf.start(Clerk), bindings={"x": "/a"})', ()),
]
"""What types cannot tell, and what refuses it instead; here so that nobody takes it for found."""


def program(mistakes: list[Mistake]) -> tuple[str, dict[int, Mistake]]:
    """A module with one function for each mistake, and its wrong lines, counted from 1."""
    lines = [*HEAD.strip().splitlines(), "class Overdraft(hf.Message[int]):", "    amount: int"]
    wrong: dict[int, Mistake] = {}
    for number, mistake in enumerate(mistakes):
        lines += [
            f"async def mistake_{number}(",
            "    system: hf.ActorSystem, account: hf.ActorRef[Account], anyone: hf.ActorRef, message: Deposit,",
            "    clerk: Clerk, spec: hf.ChildSpec[Account], change: hf.system.Change, probe: Probe",
            ") -> None:",
            f"    # {mistake.what}",
        ]
        body = mistake.code.replace("\n        ", "\n").strip().splitlines()
        lines += [f"    {line}" for line in body]
        marked = [place for place, line in enumerate(body, 1) if line.endswith("# here")]
        wrong[len(lines) - len(body) + (marked or [len(body)])[0]] = mistake
    return "\n".join(lines) + "\n", wrong


def test_the_place_of_a_mistake_is_known() -> None:
    text, wrong = program(MISTAKES)
    lines = text.splitlines()
    assert [lines[place - 1].strip() for place in wrong][:2] == ['Deposit("five")', "Deposit()"]
    assert lines[[*wrong][11] - 1].strip() == "@hf.on(Deposit)  # here"


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment with the wheel; what that needs comes from the environment of the tests."""
    folder = tmp_path_factory.mktemp("user")
    [wheel] = build(copy_sources(folder / "source"), "--wheel", "--outdir", str(folder / "dist"))
    venv.create(folder / "venv", symlinks=True)
    python = folder / "venv/bin/python"
    pip = [sys.executable, "-m", "pip", "--python", str(python)]
    subprocess.run([*pip, "install", "-q", "--no-index", "--no-deps", str(wheel)], check=True, timeout=120)
    [site] = (folder / "venv").glob("lib/python*/site-packages")
    (site / "needed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return python


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The user's project, with all mistakes in a module of their own."""
    folder = tmp_path_factory.mktemp("project")
    (folder / "bank_app").mkdir()
    for file in APP.glob("*.py"):
        (folder / "bank_app" / file.name).write_bytes(file.read_bytes())
    (folder / "bank_app/__init__.py").touch()
    (folder / "bank_app/mistakes.py").write_text(program([*MISTAKES, *UNSEEN])[0])
    strict = {"include": ["bank_app"], "typeCheckingMode": "strict", "reportUnusedClass": False}  # mistakes are unused
    (folder / "pyrightconfig.json").write_text(json.dumps(strict))
    return folder


def run_mypy(python: Path, project: Path) -> set[tuple[str, int]]:
    options = ["--strict", "--python-executable", str(python), "--cache-dir", str(project / "cache")]
    command = [sys.executable, "-m", "mypy", *options, "-p", "bank_app"]
    done = subprocess.run(command, cwd=project, capture_output=True, text=True, timeout=300, check=False)
    found = re.findall(r"^bank_app/(\w+)\.py:(\d+): error", done.stdout, re.MULTILINE)
    assert done.returncode in (0, 1), done.stdout + done.stderr
    assert len(found) == done.stdout.count(": error"), done.stdout
    return {(name, int(line)) for name, line in found}


def run_pyright(python: Path, project: Path) -> set[tuple[str, int]]:
    command = [sys.executable, "-m", "pyright", "--pythonpath", str(python), "--outputjson"]
    done = subprocess.run(command, cwd=project, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode in (0, 1), done.stdout + done.stderr
    reports = json.loads(done.stdout)["generalDiagnostics"]
    errors = [one for one in reports if one["severity"] == "error"]
    assert {Path(one["file"]).parent.name for one in errors} <= {"bank_app"}, errors
    return {(Path(one["file"]).stem, one["range"]["start"]["line"] + 1) for one in errors}


@pytest.mark.parametrize("checker", BOTH)
def test_a_project_is_clean_and_its_mistakes_are_found(checker: str, python: Path, project: Path) -> None:
    text, wrong = program([*MISTAKES, *UNSEEN])
    found = {"mypy": run_mypy, "pyright": run_pyright}[checker](python, project)
    lines = text.splitlines()
    assert {name for name, _ in found} <= {"mistakes"}, "the project itself is clean"
    places = {line for _, line in found}
    missed = [mistake.what for line, mistake in wrong.items() if checker in mistake.found_by and line not in places]
    other_lines = [line for line in places if line not in wrong or checker not in wrong[line].found_by]
    other = [f"{line}: {lines[line - 1].strip()}" for line in sorted(other_lines)]
    assert (missed, other) == ([], [])


def test_the_fixtures_come_with_the_wheel(python: Path, project: Path) -> None:
    options = ["-q", "-p", "no:cacheprovider", "-o", "asyncio_mode=auto"]
    command = [str(python), "-m", "pytest", *options, "bank_app/bank_tests.py"]
    done = subprocess.run(command, cwd=project, capture_output=True, text=True, timeout=120, check=False)
    assert "3 passed" in done.stdout, done.stdout + done.stderr


def test_it_is_the_wheel_that_is_checked(python: Path, project: Path) -> None:
    show = "import holdfast; print(holdfast.__file__)"
    done = subprocess.run([python, "-c", show], cwd=project, capture_output=True, text=True, timeout=60, check=True)
    assert Path(done.stdout.strip()).is_relative_to(python.parents[1])
