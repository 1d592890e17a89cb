"""`holdfast apply`: a script of its user, and of nobody else, changes a running system, as it would in process."""

import hashlib
import os
import re
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.actors.kernel.cell import GivenName
from holdfast.console.client_session import OPERATIONS
from holdfast.console.endpoint import control_endpoint
from holdfast.console.remote import RemoteChange
from holdfast.system import script as script_module
from holdfast.system.script import UntrustedFile, read_source
from holdfast.system.transaction.change import Change
from tests.console.commands import holdfast
from tests.system.trees import Add, counter, picture, ref

pytestmark = pytest.mark.usefixtures("warm_programs")

ROOT = Path(__file__).parents[2]
DONE, FAILED, UNUSABLE = 0, 1, 2
GROW = """
import holdfast as hf


class Ask(hf.Message[str]):
    what: str


class Greeter(hf.Actor):
    @hf.on(Ask)
    def ask(self, message: Ask) -> str:
        return f"hello {message.what}"


def hundred(state):
    return {"count": state["count"] + 100}


async def reconfigure(system):
    async with system.transaction() as change:
        greeter = change.add("/app/left", hf.child("greeter", hf.start(Greeter)))
        change.register("greeter", greeter)
        change.move("/app/left/b", "/app/right")
        change.replace_state("/app/left/a", hundred)
        change.remove("/app/left/c")
"""

RESPECIFY = """
import holdfast as hf


async def reconfigure(system):
    async with system.transaction() as change:
        change.respecify("/app/left/a", restart="transient", backoff=hf.Backoff(initial=0.5), register="first")
"""

OF_A_REF = "async def reconfigure(system):\n await system.ref('/app/left/a').{call}"
NO_STEP = """
async def reconfigure(system):
    async with system.transaction() as change:
        change.respecifi("/app/left/a", restart="transient")
"""

OF_ITS_OWN = """
async def reconfigure(system):
    "text".respecify()
"""

CHANGED_MIND = """
async def reconfigure(system):
    async with system.transaction() as change:
        change.remove("/app/left/b")
        raise RuntimeError("changed my mind")
"""


@pytest.fixture
def grow(tmp_path: Path) -> Path:
    return written(tmp_path / "grow.py", GROW)


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    path.chmod(0o600)
    return path


async def test_a_script_may_use_the_modules_beside_it(
    system: hf.ActorSystem, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    helper = f"helper_{tmp_path.name}"  # No other test has imported it.
    written(tmp_path / f"{helper}.py", GROW.partition("async def reconfigure")[0])
    script = written(
        tmp_path / "uses.py",
        f"""
import holdfast as hf
from {helper} import Greeter


async def reconfigure(system):
    async with system.transaction() as change:
        change.add("/app/left", hf.child("greeter", hf.start(Greeter)))
""",
    )
    status, _, errors = await holdfast("apply", script, "--socket", path)
    assert (status, errors) == (DONE, "")
    assert "/app/left/greeter" in system.tree()


async def test_a_script_may_use_the_modules_of_the_current_folder(
    system: hf.ActorSystem, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, scripts = tmp_path / "code", tmp_path / "scripts"
    code.mkdir()
    scripts.mkdir()
    monkeypatch.setattr(sys, "path", [*sys.path, str(code)])  # of the running system
    monkeypatch.setenv("PYTHONSAFEPATH", "1")  # The command is started as a program, not by `python -m`.
    monkeypatch.chdir(code)
    helper = f"near_{tmp_path.name}"
    written(code / f"{helper}.py", GROW.partition("async def reconfigure")[0])
    script = written(
        scripts / "uses.py",
        f"""
import holdfast as hf
from {helper} import Greeter


async def reconfigure(system):
    async with system.transaction() as change:
        change.add("/app/left", hf.child("greeter", hf.start(Greeter)))
""",
    )
    status, _, errors = await holdfast("apply", script, "--socket", path)
    assert (status, errors) == (DONE, "")
    assert "/app/left/greeter" in system.tree()


async def test_a_script_is_carried_out_in_the_running_system(system: hf.ActorSystem, path: Path, grow: Path) -> None:
    with system.events() as stream:
        status, output, errors = await holdfast("apply", grow, "--socket", path)
        loaded = [event for event in stream.take() if isinstance(event, hf.events.ScriptLoaded)]
    assert (status, errors) == (DONE, "")
    assert "1. add /app/left/greeter\n2. register /app/left/greeter as 'greeter'\n" in output
    assert output.endswith("done\n")
    assert [(event.path, event.sha256) for event in loaded] == [
        (os.path.realpath(grow), hashlib.sha256(grow.read_bytes()).hexdigest())
    ]
    module = sys.modules[read_source(grow).module]
    assert await system.whereis("greeter").ask(module.Ask("you")) == "hello you"
    assert await ref(system, "/app/left/a").ask(Add()) == 101
    assert "/app/right/b" in system.tree()
    assert "/app/left/c" not in system.tree()


async def test_a_dry_run_says_what_would_be_done(system: hf.ActorSystem, path: Path, grow: Path) -> None:
    before = picture(system)
    status, output, _ = await holdfast("apply", grow, "--socket", path, "--dry-run")
    assert status == DONE
    assert "+ /app/left/greeter: Greeter, permanent, task, named 'greeter'" in output
    assert output.endswith("nothing was done: this was a dry run\n")
    assert picture(system) == before


OWN = """
import holdfast as hf
{imported}
from tests.system.trees import Counter, Double



class Own(Double): ...


class Value(hf.Message):
    n: int = 0


async def reconfigure(system):
    async with system.transaction() as change:
        {step}
"""
STEPS = {
    "a class of its own": "change.add('/app/left', hf.child('x', hf.start(Own)))",
    "one below a supervisor": "change.add('/app/left', hf.supervisor('s', children=[hf.child('x', hf.start(Own))]))",
    "one under a supervisor that keeps a journal": "change.add('/app/noted', hf.child('x', hf.start(Own)))",
    "an instance of one": "change.add('/app/left', hf.child('x', hf.start(Counter, Value())))",
    "other code": "change.replace_code('/app/left/a', Own)",
    "a class from beside it": "change.add('/app/left', hf.child('x', hf.start(Beside)))",
}


@pytest.mark.parametrize("name", STEPS)
async def test_what_the_next_program_could_not_have_is_refused_where_there_is_a_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    module = f"beside_{tmp_path.name}"  # No other test has imported it.
    defined = written(tmp_path / f"{module}.py", "from tests.system.trees import Double\nclass Beside(Double): ...\n")
    imported = f"from {module} import Beside" if "beside" in name else ""
    script = written(tmp_path / "own.py", OWN.format(step=STEPS[name], imported=imported))
    async with stored(tmp_path) as system:
        with pytest.raises(hf.TransactionRefused, match="into a module that the program can import") as refused:
            await system.apply(str(script))
        assert f"is defined in {os.path.realpath(defined if imported else script)}" in str(refused.value)
        if imported:
            monkeypatch.syspath_prepend(str(tmp_path))  # Where the next program looks, too.
            await system.apply(str(script))
    if imported:
        async with stored(tmp_path) as system:
            assert system._node.find("/app/left/x") is not None


@asynccontextmanager
async def stored(folder: Path) -> AsyncGenerator[hf.ActorSystem]:
    """A program with a store."""
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{folder}/app.db") as system:
        await system.start(hf.supervisor("left", children=[counter("a")]))
        await system.start(hf.dynamic("noted", journal=True))
        yield system


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_such_a_script_is_refused_in_a_dry_run_too(tmp_path: Path) -> None:
    script = written(tmp_path / "own.py", OWN.format(step=STEPS["a class of its own"], imported=""))
    async with stored(tmp_path) as system, control_endpoint(system, tmp_path / "app.sock") as path:
        for options in (("--dry-run",), ()):
            status, _, errors = await holdfast("apply", script, "--socket", path, *options)
            assert (status, "is defined in" in errors) == (FAILED, True), errors


async def test_the_same_script_runs_in_process(system: hf.ActorSystem, grow: Path) -> None:
    await system.apply(str(grow))
    assert await ref(system, "/app/left/a").ask(Add()) == 101
    assert system.whereis("greeter").path == "/app/left/greeter"


@pytest.mark.parametrize(
    ("text", "status", "error"),
    [
        ("def reconfigure(system): ...", UNUSABLE, "it has no `async def reconfigure(system)`"),
        ("import nothing_there", UNUSABLE, "ModuleNotFoundError: No module named 'nothing_there'"),
        ("async def reconfigure(system): 1 / 0", FAILED, "ZeroDivisionError"),
        (
            "async def reconfigure(system):\n async with system.transaction() as change: change.remove('/app/x')",
            FAILED,
            "transaction refused at: remove /app/x (there is no actor at /app/x); nothing was done",
        ),
        (
            CHANGED_MIND,
            FAILED,
            "changed my mind",
        ),
        (NO_STEP, FAILED, "script.py:4: a transaction has no 'respecifi' in a script; did you mean respecify?"),
        (
            OF_A_REF.format(call="ask(None)"),
            FAILED,
            "script.py:2: a script sends no messages, so that its refs have no 'ask'",
        ),
        (OF_A_REF.format(call="kill()"), FAILED, "an actor has no 'kill' in a script. There is path, and nothing else"),
        (OF_ITS_OWN, FAILED, "AttributeError: 'str' object has no attribute 'respecify'"),
    ],
)
async def test_what_goes_wrong_is_said_and_changes_nothing(
    system: hf.ActorSystem, path: Path, tmp_path: Path, text: str, status: int, error: str
) -> None:
    before = picture(system)
    done = await holdfast("apply", written(tmp_path / "script.py", text), "--socket", path)
    assert done[0] == status
    assert error in done[2]
    assert picture(system) == before


async def test_a_script_respecifies_a_child(system: hf.ActorSystem, path: Path, tmp_path: Path) -> None:
    done = await holdfast("apply", written(tmp_path / "script.py", RESPECIFY), "--socket", path)
    assert done[0] == DONE, done
    spec = system.ref("/app/left/a")._cell.spec
    assert isinstance(spec, hf.ChildSpec)
    assert (spec.restart, spec.backoff, spec.register) == ("transient", hf.Backoff(initial=0.5), GivenName("first"))


def test_scripts_have_every_step_that_the_page_lists() -> None:
    """What a program can do in a transaction a script can do, too: the page, the program and the wire have one list."""
    page = (ROOT / "docs" / "transactions.md").read_text().partition("\n## The steps\n")[2].partition("\n**")[0]
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    listed = {name for row in rows for name in re.findall(r"`(\w+)", row)}
    assert len(listed) > 15
    assert listed == OPERATIONS
    for kind in (Change, RemoteChange):
        assert listed <= {name for name, value in vars(kind).items() if callable(value)}, kind


async def test_a_script_that_others_may_write_is_not_loaded(
    system: hf.ActorSystem, path: Path, grow: Path, tmp_path: Path
) -> None:
    before = picture(system)
    grow.chmod(0o622)
    status, _, errors = await holdfast("apply", grow, "--socket", path)
    assert (status, "others may write it (mode 0622)" in errors) == (UNUSABLE, True)
    folder = tmp_path / "shared"
    folder.mkdir()
    other = written(folder / "grow.py", GROW)
    folder.chmod(0o777)
    status, _, errors = await holdfast("apply", other, "--socket", path)
    assert (status, f"{folder} is not used: others may write it" in errors) == (UNUSABLE, True)
    assert picture(system) == before


def test_a_script_of_another_user_is_not_read(grow: Path) -> None:
    with pytest.raises(UntrustedFile, match=f"belongs to the user with uid {os.geteuid()}, not to you"):
        read_source(grow, uid=os.geteuid() + 1)


def test_a_link_is_followed_to_what_is_checked(grow: Path, tmp_path: Path) -> None:
    folder = tmp_path / "shared"
    folder.mkdir()
    hidden = written(folder / "grow.py", GROW)
    folder.chmod(0o777)
    link = tmp_path / "link.py"
    link.symlink_to(hidden)
    with pytest.raises(UntrustedFile, match="shared is not used"):
        read_source(link)


def test_a_large_script_is_not_read(grow: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script_module, "LARGEST", 10)
    with pytest.raises(hf.SpecError, match="at most 10 bytes"):
        read_source(grow)


async def test_a_module_that_others_may_write_is_not_imported(
    system: hf.ActorSystem, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the command nor the system does so."""
    library = tmp_path / "library"
    library.mkdir()
    module = written(library / "shady_actors.py", "import holdfast as hf\nclass Shady(hf.Actor): ...\n")
    text = (
        "import holdfast as hf\nfrom shady_actors import Shady\nasync def reconfigure(system):\n"
        " async with system.transaction() as change: change.add('/app/left', hf.child('x', hf.start(Shady)))\n"
    )
    script = written(tmp_path / "script.py", text)
    monkeypatch.syspath_prepend(str(library))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(library), os.environ.get("PYTHONPATH", "")]))
    before = picture(system)
    module.chmod(0o666)
    status, _, errors = await holdfast("apply", script, "--socket", path)
    assert (status, "others may write it (mode 0666)" in errors) == (UNUSABLE, True)
    assert "shady_actors" not in sys.modules
    assert picture(system) == before
    module.chmod(0o600)
    with system.events() as stream:
        status, _, errors = await holdfast("apply", script, "--socket", path)
        told = [event.path for event in stream.take() if isinstance(event, hf.events.ScriptLoaded)]
    assert (status, errors) == (DONE, "")
    assert os.path.realpath(module) in told
    assert "/app/left/x" in system.tree()
    del sys.modules["shady_actors"]


async def test_nobody_answers(grow: Path, tmp_path: Path) -> None:
    for command in (("apply", grow), ("tree",), ("inspect", "/app")):
        status, _, errors = await holdfast(*command, "--socket", tmp_path / "gone.sock")
        assert (status, "no system answers at" in errors) == (UNUSABLE, True)
