"""The commands that look at a running system and change it, each in a process of its own, as an operator types them."""

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.console.endpoint import control_endpoint
from holdfast.console.runtime_folder import runtime_folder
from holdfast.console.wire import BadRequest, SettleQuarantined, frame
from tests.cluster.shelves import Grow, Shelf
from tests.console.commands import holdfast
from tests.system.trees import Add, Counter, ref

pytestmark = pytest.mark.usefixtures("warm_programs")

DONE, FAILED, UNUSABLE = 0, 1, 2
PATHS = (
    "a program opens an endpoint by control_endpoint(system), and with a path of its own it is reached by --socket FILE"
)


@pytest.fixture(autouse=True)
def own_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder for sockets that no other test has; its path is short, as that of a socket must be."""
    monkeypatch.delenv("HOLDFAST_SYSTEM", raising=False)
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield Path(folder)


@pytest.fixture
async def named(system: hf.ActorSystem) -> AsyncIterator[hf.ActorSystem]:
    """The system, found by its name."""
    async with control_endpoint(system):
        yield system


async def as_json(*arguments: object) -> Any:
    status, output, errors = await holdfast(*arguments, "--json")
    assert (status, errors) == (DONE, "")
    return json.loads(output)


# -- by name ----------------------------------------------------------------------------------------------------------


async def test_a_system_is_found_by_its_name_and_by_its_pid(named: hf.ActorSystem) -> None:
    (one,) = await as_json("ls")
    assert (one["name"], one["pid"], one["actors"]) == ("app", os.getpid(), len(named.tree()))
    for more in ((), ("--system", "app"), ("--system", os.getpid())):
        status, output, _ = await holdfast("tree", "--paths", *more)
        assert (status, output.split()[0]) == (DONE, "/app")


async def test_why_without_an_address_is_that_of_the_root(named: hf.ActorSystem) -> None:
    status, output, _ = await holdfast("why")
    assert (status, output) == (DONE, (await holdfast("why", "/app"))[1])
    assert output.startswith("/app ")


async def test_no_system_and_several_are_told_apart(named: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch) -> None:
    status, _, errors = await holdfast("tree", "--system", "till")
    assert status == UNUSABLE
    assert (
        errors == f"holdfast tree: no system 'till' is found by its name; there are app (pid {os.getpid()}); {PATHS}\n"
    )
    async with hf.ActorSystem("other", log=False) as other, control_endpoint(other):
        status, _, errors = await holdfast("tree")
        assert (status, "several systems run: app" in errors) == (UNUSABLE, True)
        monkeypatch.setenv("HOLDFAST_SYSTEM", "other")
        assert (await holdfast("tree", "--paths"))[:2] == (DONE, "/other\n")


async def test_a_program_with_a_path_of_its_own_is_said_to_be_reached_by_it(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    async with control_endpoint(system, tmp_path / "own.sock") as where:
        status, _, errors = await holdfast("tree")
        assert (status, errors) == (UNUSABLE, f"holdfast tree: no system of yours is found by its name; {PATHS}\n")
        assert (await holdfast("ls"))[::2] == (DONE, f"no system of yours is found by its name; {PATHS}\n")
        assert (await holdfast("tree", "--paths", "--socket", where))[0] == DONE


DIES = """
import asyncio, os, sys
import holdfast as hf
from holdfast.console.endpoint import control_endpoint


async def main():
    async with hf.ActorSystem("till one", log=False) as system, control_endpoint(system) as path:
        print(path, flush=True)
        os._exit(9)

asyncio.run(main())
"""


async def test_what_a_dead_system_has_left_is_removed(own_folder: Path) -> None:
    died = subprocess.run([sys.executable, "-c", DIES], check=False, capture_output=True, text=True, timeout=60)
    left = Path(died.stdout.strip())
    assert left.parent == own_folder / "holdfast"
    assert left.is_socket()
    assert await as_json("ls") == []
    assert list(left.parent.iterdir()) == []


LIVES = DIES.replace("os._exit(9)", "await asyncio.Event().wait()")


async def test_a_system_that_is_there_and_does_not_answer_is_told_from_none(own_folder: Path) -> None:
    lives = subprocess.Popen([sys.executable, "-c", LIVES], stdout=subprocess.PIPE)
    try:
        assert lives.stdout is not None
        assert lives.stdout.readline()
        lives.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, lives.pid, os.WSTOPPED | os.WNOWAIT)
        said = await asyncio.gather(holdfast("why", "/x"), holdfast("restart", "/x"), holdfast("ls"))
        for status, _, errors in said[:2]:
            assert status == UNUSABLE
            assert f"(process {lives.pid}) is there and does not answer within 4 s: it is stopped; kill -CONT" in errors
        assert "does not answer" in said[2][1]
    finally:
        lives.kill()
        lives.communicate()


async def test_a_number_that_is_too_large_is_refused_in_words() -> None:
    status, _, errors = await holdfast("quarantine", "retry", "/x", "99999999999999999999")
    assert (status, "Traceback" in errors) == (UNUSABLE, False), errors
    with pytest.raises(BadRequest, match="more than 64 bits"):
        frame(SettleQuarantined("retry", "/x", 1 << 64))


async def test_who_asks_why_of_a_pattern_is_told_that_it_is_none(named: hf.ActorSystem) -> None:
    for command in ("why", "history"):
        status, _, errors = await holdfast(command, "/app/**")
        assert (status, "is taken for one address" in errors) == (FAILED, True), errors


async def test_a_folder_that_others_may_enter_is_refused(own_folder: Path) -> None:
    runtime_folder().chmod(0o755)
    status, _, errors = await holdfast("ls")
    assert (status, "others may enter it (mode 0755); chmod 700" in errors) == (UNUSABLE, True)


def test_a_link_in_the_place_of_the_folder_is_refused(own_folder: Path) -> None:
    (own_folder / "elsewhere").mkdir(mode=0o700)
    (own_folder / "holdfast").symlink_to(own_folder / "elsewhere")
    with pytest.raises(hf.errors.UntrustedFile, match="it is no folder"):
        runtime_folder()


# -- looking ----------------------------------------------------------------------------------------------------------


async def test_the_tree_shows_what_runs_and_what_is_stopped(named: hf.ActorSystem) -> None:
    await named.suspend(ref(named, "/app/left/a"))
    status, output, _ = await holdfast("tree")
    assert status == DONE
    lines = output.splitlines()
    assert re.fullmatch(rf"/app  Supervisor  running, task {os.getpid()}, \d+ MB", lines[0])
    assert "├── left  Supervisor  running" in lines
    assert "│   ├── a  Counter  suspended, named first" in lines
    assert "│   ├── e  Counter  stopped" in lines


async def test_a_pattern_with_conditions_selects(named: hf.ActorSystem) -> None:
    await named.suspend(ref(named, "/app/left/a"))
    told = await as_json("tree", "/app/**[state=suspended]", "/app/right/e")
    assert [one["path"] for one in told["actors"]] == ["/app/left/a", "/app/right/e"]
    status, _, errors = await holdfast("tree", "/app/**[restarts>3]")
    assert (status, errors) == (FAILED, "holdfast tree: there is no actor at /app/**[restarts>3]\n")
    status, _, errors = await holdfast("tree", "/app/**[colour=red]")
    assert (status, "there is no field 'colour'; there are kind, state" in errors) == (FAILED, True)


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_state_that_is_too_large_to_be_sent_is_told_with_what_to_do(
    named: hf.ActorSystem, isolation: Any
) -> None:
    large = await named.start(hf.child("large", hf.start(Shelf), isolation=isolation))
    await large.ask(Grow(20))
    status, output, errors = await holdfast("inspect", "/app/large", "--state", "--json")
    assert (status, output) == (FAILED, "")
    assert errors.startswith("holdfast inspect: get_state of /app/large failed: what it gives is too large")
    assert "--state` without --json" in errors
    assert "holdfast store export" in errors
    status, output, errors = await holdfast("inspect", "/app/large", "--state")
    assert (status, "state bulk: bytes of 20971520" in output) == (DONE, True), errors


async def test_inspect_tells_all_of_an_actor(named: hf.ActorSystem) -> None:
    status, output, _ = await holdfast("inspect", "first", "/app/right/client", "/app/right", "--state")
    assert status == DONE
    for line in (
        "address: /app/left/a",
        "kind: tests.system.trees.Counter",
        "state: running",
        f"place: task, pid {os.getpid()}",
        "state count: 0",
        "binding peer: /app/left/a",
        "supervises: 3 children, one_for_all, 0 of 5 restarts within 5 s used up",
    ):
        assert line in output.splitlines()
    status, _, errors = await holdfast("inspect", "/app/nowhere")
    assert (status, errors) == (FAILED, "holdfast inspect: there is no actor at /app/nowhere\n")


async def test_actors_in_processes_say_themselves_how_they_are(named: hf.ActorSystem) -> None:
    far = hf.supervisor("far", isolation="process", children=[hf.child("one", hf.start(Counter))])
    await named.start(far)
    alone = await named.start(hf.child("alone", hf.start(Counter), isolation="process", recovery=hf.hybrid()))
    await named.suspend(alone)
    await named.suspend(ref(named, "/app/far/one"))
    told = {one["path"]: one for one in (await as_json("tree"))["actors"]}
    assert told["/app/alone"]["pid"] == named.pid_of(alone) != os.getpid()
    assert [told[path]["state"] for path in ("/app/alone", "/app/far/one")] == ["suspended", "suspended"]
    assert (told["/app/alone"]["place"], told["/app/alone"]["recovery"]) == ("process", "hybrid")
    assert told["/app/far/one"]["pid"] == told["/app/far"]["pid"] != os.getpid()
    assert not any(path.startswith("/app/recovery") for path in told)


# -- changing ---------------------------------------------------------------------------------------------------------


async def test_an_address_with_signs_of_patterns_is_meant_alone(named: hf.ActorSystem) -> None:
    ids = ["ann", "*", "[x]", "a[state=running]", "back\\slash"]
    guests = await named.start(hf.dynamic("guests", template=hf.child(None, hf.start(Counter))))
    for name in ids:
        await guests.ask(hf.StartChild(id=name))
    _, output, _ = await holdfast("tree", "--paths", "/app/guests/**")
    quoted = output.splitlines()
    assert quoted == [
        "/app/guests/ann",
        r"/app/guests/\*",
        r"/app/guests/\[x\]",
        r"/app/guests/a\[state=running\]",
        r"/app/guests/back\\slash",
    ]
    for name, path in zip(ids, quoted, strict=True):
        (seen,) = await as_json("inspect", path)
        assert seen["actor"]["path"] == f"/app/guests/{name}"
        status, output, _ = await holdfast("why", path)
        assert (status, output.split()[0]) == (DONE, f"/app/guests/{name}")
    status, output, errors = await holdfast("remove", "/app/guests/*", "--yes")
    assert (status, output) == (FAILED, "")
    assert errors.endswith("an actor has this very address; to mean it alone write '/app/guests/\\*'\n"), errors
    status, _, _ = await holdfast("remove", r"/app/guests/\*", r"/app/guests/\[x\]", "--yes")
    assert status == DONE
    assert [one.id for one in await guests.ask(hf.WhichChildren())] == ["ann", "a[state=running]", "back\\slash"]


async def test_suspend_and_resume_by_pattern_are_one_transaction(named: hf.ActorSystem) -> None:
    with named.events() as stream:
        status, output, _ = await holdfast("suspend", "/app/left/*")
        begun = [one for one in stream.take() if isinstance(one, hf.events.TransactionBegan)]
    assert (status, len(begun), len(begun[0].steps)) == (DONE, 1, 3)
    assert output.endswith("3. suspend /app/left/c\ndone\n")
    assert (await named.get_status(ref(named, "/app/left/b"))).state == "suspended"
    assert (await holdfast("resume", "/app/**[state=suspended]"))[0] == DONE
    assert (await named.get_status(ref(named, "/app/left/b"))).state == "running"


async def test_a_restart_asks_before_state_is_lost(named: hf.ActorSystem) -> None:
    assert await ref(named, "/app/left/a").ask(Add(5)) == 5
    status, _, errors = await holdfast("restart", "/app/left/a")
    assert status == FAILED
    assert errors.splitlines() == [
        "without recovery, the state is lost of /app/left/a",
        "holdfast restart: this needs a yes: say --yes",
    ]
    assert await ref(named, "/app/left/a").ask(Add(1)) == 6
    assert (await holdfast("restart", "/app/left/a", "--yes"))[:2] == (DONE, "restarted /app/left/a\n")
    assert await ref(named, "/app/left/a").ask(Add(1)) == 1


async def test_a_restart_keeps_what_is_recorded_and_what_waits(named: hf.ActorSystem) -> None:
    kept = hf.child("kept", hf.start(Counter), recovery=hf.hybrid(), restart="transient")
    one = await named.start(kept)
    assert await one.ask(Add(5)) == 5
    await named.suspend(one)
    waiting = one.ask(Add(2), timeout=60.0)
    assert (await holdfast("restart", "/app/kept"))[0] == DONE
    assert await waiting == 7


class Hang(hf.Message): ...


class Hangs(Counter):
    @hf.on(Hang)
    async def hang(self, message: Hang) -> None:
        await asyncio.Event().wait()


async def test_a_restart_of_who_hangs_says_in_which_turn_it_is_and_what_ends_it(named: hf.ActorSystem) -> None:
    one = await named.start(hf.child("hangs", hf.start(Hangs)))
    one.tell(Hang())
    status, _, errors = await holdfast("restart", "/app/hangs", "--yes", "--timeout", 0.5)
    assert status == FAILED
    assert (
        "/app/hangs has not ended within 0.5 s, for its turn of tests.console.test_operate.Hang has run for" in errors
    )
    assert "await asyncio.Event().wait()" in errors
    assert "`holdfast restart --kill` ends it at once" in errors
    assert (await holdfast("restart", "/app/hangs", "--yes", "--kill"))[0] == DONE


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("protect", "/app/left/a", "pbr", "--off"), "not both"),
        (("repair", "set", "nonsense"), "'nonsense' is none of off, advise, ask, on"),
        (("plan", "small.py"), "a script is for `holdfast apply --dry-run`"),
    ],
    ids=lambda one: one if isinstance(one, str) else one[0],
)
async def test_a_wrong_word_is_told_and_is_status_2(named: hf.ActorSystem, words: tuple[str, ...], said: str) -> None:
    status, _, errors = await holdfast(*words)
    assert (status, said in " ".join(errors.replace("│", " ").split())) == (UNUSABLE, True)


async def test_inspect_shows_of_a_method_what_differs_from_its_defaults(named: hf.ActorSystem) -> None:
    await named.start(hf.child("kept", hf.start(Counter), recovery=hf.hybrid(interval=7.0)))
    assert "spec recovery: hybrid(interval=7.0)\n" in (await holdfast("inspect", "/app/kept"))[1]


async def test_a_restart_that_would_end_the_supervisor_is_refused(named: hf.ActorSystem) -> None:
    await named.start(hf.supervisor("strict", intensity=0, children=[hf.child("x", hf.start(Counter))]))
    status, _, errors = await holdfast("restart", "/app/strict/x", "--yes")
    assert status == FAILED
    assert "/app/strict would give up over its restart (0 of 0 restarts within 5 s are used up)" in errors
    assert (await named.get_status(ref(named, "/app/strict/x"))).life == 1


async def test_a_restart_of_who_would_not_come_back_is_refused(named: hf.ActorSystem) -> None:
    await named.start(hf.child("once", hf.start(Counter), restart="temporary"))
    named.spawn(hf.start(Counter), "alone")
    for path, why in (("/app/once", "stop it, and start it"), ("/app/alone", "no supervisor looks after it")):
        status, _, errors = await holdfast("restart", path, "--yes")
        assert (status, why in errors) == (FAILED, True)


async def test_stop_start_and_remove(named: hf.ActorSystem) -> None:
    status, output, _ = await holdfast("stop", "/app/left/b", "--dry-run")
    assert (status, output.endswith("nothing was done: this was a dry run\n")) == (DONE, True)
    assert (await holdfast("stop", "/app/left/b"))[0] == FAILED
    assert (await holdfast("stop", "/app/left/b", "--yes"))[0] == DONE
    assert "/app/left/b" not in named.tree()
    assert (await holdfast("start", "/app/left/*[state=stopped]"))[0] == DONE
    assert "/app/left/b" in named.tree()
    assert (await holdfast("remove", "/app/pool/f", "--yes"))[0] == DONE
    assert "/app/pool/f" not in named.tree()


async def test_bind_and_unbind(named: hf.ActorSystem) -> None:
    client = ref(named, "/app/right/client")
    assert (await holdfast("bind", "/app/right/client", "peer", "second"))[0] == DONE
    assert (await named.get_status(client)).bindings == {"peer": "/app/left/b"}
    assert (await holdfast("unbind", "/app/right/client", "peer"))[0] == DONE
    assert (await named.get_status(client)).bindings == {}
    status, _, errors = await holdfast("bind", "/app/right/client", "till", "second")
    assert (status, "has no binding 'till'" in errors) == (FAILED, True)


async def test_protect_and_checkpoint(named: hf.ActorSystem) -> None:
    await named.start(hf.child("kept", hf.start(Counter), recovery=hf.hybrid()))
    assert (await holdfast("checkpoint", "/app/kept"))[:2] == (DONE, "1 of 1 saved\n")
    status, _, errors = await holdfast("checkpoint", "/app/left/a")
    assert (status, "keeps no snapshots" in errors) == (FAILED, True)
    assert (await holdfast("checkpoint", "/app/**"))[:2] == (DONE, "1 of 1 saved\n")
    assert (await holdfast("protect", "/app/left/a", "pbr"))[0] == DONE
    (told,) = await as_json("inspect", "/app/left/a")
    assert (told["protection"]["stack"], told["actor"]["place"]) == (["pbr"], "replicas")
    assert (await holdfast("protect", "/app/left/a", "--off"))[0] == DONE
    assert (await named.protection(ref(named, "/app/left/a"))).stack == ()
    assert (await holdfast("protect", "/app/left/a"))[0] == UNUSABLE


async def test_trace_follows_one_actor_and_gives_back_what_it_has_switched_on(named: hf.ActorSystem) -> None:
    one = ref(named, "/app/left/a")
    work = asyncio.create_task(holdfast("trace", "/app/left/a", "--count", 3, "--json"))
    while not work.done():
        await one.ask(Add(1))
        await asyncio.sleep(0)
    status, output, _ = work.result()
    told = [json.loads(line) for line in output.splitlines()]
    assert (status, sorted(line["what"] for line in told)) == (DONE, ["MessageIn", "TurnBegan", "TurnEnded"])
    more = one._cell.more
    async with asyncio.timeout(20):
        while more is not None and more.tap is not None and more.tap.is_on:
            await asyncio.sleep(0.01)


async def test_ctrl_c_ends_a_trace_in_good_order(named: hf.ActorSystem) -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "holdfast.console.cli", "trace", "/app/left/a"),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    line = asyncio.create_task(process.stdout.readline())
    while not line.done():
        await ref(named, "/app/left/a").ask(Add(1))
        await asyncio.sleep(0)
    process.send_signal(signal.SIGINT)
    async with asyncio.timeout(20):
        _, errors = await process.communicate()
    assert (process.returncode, errors) == (DONE, b"")


async def test_a_trace_is_of_one_actor(named: hf.ActorSystem) -> None:
    status, _, errors = await holdfast("trace", "/app/left/*", "--seconds", "0.2")
    assert status == FAILED
    assert "name the one to follow" in errors


@pytest.mark.parametrize("error", ["KeyboardInterrupt", "SystemExit(3)", "GeneratorExit", "Odd"])
async def test_a_module_that_raises_anything_ends_nobody(
    named: hf.ActorSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: str
) -> None:
    """A tree in a file names a class whose module raises what is no Exception when it is imported."""
    module = f"raises_{error.partition('(')[0].lower()}"
    (tmp_path / f"{module}.py").write_text(f"class Odd(BaseException): ...\n\n\nraise {error}\n")
    (tmp_path / "tree.toml").write_text(f'["/app/odd"]\nclass = "{module}:Actor"\n')
    for file in (tmp_path / f"{module}.py", tmp_path / "tree.toml"):
        file.chmod(0o600)
    monkeypatch.syspath_prepend(tmp_path)
    for command in (("plan",), ("apply", "--yes")):
        status, _, errors = await holdfast(*command, tmp_path / "tree.toml")
        assert (status, error.partition("(")[0] in errors) == (FAILED, True), errors
    assert (await holdfast("tree", "--paths"))[0] == DONE


@pytest.mark.parametrize("name", ["e\x1b[31m", "two\nlines", "\u202eback", "c1\x9b"])
async def test_a_name_that_a_terminal_would_obey_is_refused(named: hf.ActorSystem, name: str) -> None:
    """Else a child could pass for another in a script, or make a terminal do something."""
    one = ref(named, "/app/left/a")
    with pytest.raises(hf.SpecError, match="without '/' and control characters"):
        hf.child(name, hf.start(Counter))
    with pytest.raises(hf.SpecError, match="without '/' and control characters"):
        named.spawn(hf.start(Counter), name)
    with pytest.raises(hf.SpecError, match="without '/' and control characters"):
        hf.ActorSystem(name)
    with pytest.raises(hf.SpecError, match="without control characters"):
        hf.child("one", hf.start(Counter), register=name)
    with pytest.raises(hf.SpecError, match="without control characters"):
        named.register(name, one)
    with pytest.raises(hf.errors.TransactionRefused, match="without control characters"):
        async with named.transaction() as change:
            change.register(name, one)
    assert not [path for path in named.tree() if name in path]


async def test_who_suspends_the_root_or_a_supervisor_of_many_is_asked(named: hf.ActorSystem) -> None:
    status, _, errors = await holdfast("suspend", "/app")
    assert status == FAILED
    assert "while /app is suspended it starts, stops and restarts none of its" in errors
    assert errors.endswith("holdfast suspend: this needs a yes: say --yes\n")
    await named.start(hf.supervisor("many", children=[hf.child(f"n{n}", hf.start(Counter)) for n in range(10)]))
    many = ref(named, "/app/many")
    assert (await holdfast("suspend", "/app/many"))[0] == FAILED
    assert (await named.get_status(many)).state == "running"
    assert (await holdfast("suspend", "/app/many", "--yes"))[0] == DONE
    status, _, errors = await holdfast("restart", "/app/many/n1", "--yes")
    assert (status, "/app/many is suspended, and starts nobody: resume it first" in errors) == (FAILED, True)
    assert "/app/many/n1" in named.tree()
    assert (await holdfast("resume", "/app/many"))[0] == DONE
    assert (await holdfast("suspend", "/app/left"))[0] == DONE  # It has a few.


async def test_top_needs_a_terminal(named: hf.ActorSystem) -> None:
    status, output, errors = await holdfast("top")
    assert (status, output) == (UNUSABLE, "")
    assert "it needs a terminal" in errors
