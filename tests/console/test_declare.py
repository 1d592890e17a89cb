"""A tree in a file: the plan is the smallest change from what runs, and what stays keeps its state."""

import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.console.declare.tree_file import TreeFile
from holdfast.console.declare.tree_plan import declare
from holdfast.console.endpoint import control_endpoint
from tests.console.commands import holdfast
from tests.system.trees import Add, Boom, Counter, Double, ref

DONE, FAILED, UNUSABLE = 0, 1, 2
SHOP = """
["/app"]
supervisor = "one_for_one"
intensity = 1000

["/app/left"]
supervisor = "rest_for_one"
intensity = 9

["/app/left/a"]
class = "tests.system.trees:Counter"
args = [5]
names = ["first"]

["/app/left/b"]
class = "tests.system.trees:Client"
bindings = { peer = "/app/left/a" }

["/app/pool"]
supervisor = "dynamic"
intensity = 9
"""


@pytest.fixture
async def app() -> AsyncIterator[hf.ActorSystem]:
    """A system in which nothing runs."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


async def steps(system: hf.ActorSystem, text: str, *, dry_run: bool = False) -> list[str]:
    """The steps that a file leads to, in words."""
    change = await declare(system, text, "shop.toml", dry_run=dry_run)
    return [] if change is None else [step.text for step in change.steps]


def without(text: str, table: str) -> str:
    """The file without one table."""
    before, _, rest = text.partition(f'["{table}"]')
    _, mark, after = rest.partition("\n[")
    return before + (f"[{after}" if mark else "")


async def test_a_tree_is_planted_and_a_second_time_nothing_is_to_be_done(app: hf.ActorSystem) -> None:
    planned = await steps(app, SHOP, dry_run=True)
    assert app.tree() == ["/app"]
    assert await steps(app, SHOP) == planned == ["add /app/left", "add /app/pool"]
    assert await ref(app, "/app/left/a").ask(Add(1)) == 6
    assert app.whereis("first").path == "/app/left/a"
    assert (await app.get_status(ref(app, "/app/left/b"))).bindings == {"peer": "/app/left/a"}
    assert await steps(app, SHOP) == []


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('"rest_for_one"', '"one_for_all"', "set strategy='one_for_all' of /app/left"),
        ('"rest_for_one"\nintensity = 9', '"rest_for_one"', "set intensity=1, period=5.0 of /app/left"),
        ("args = [5]", "args = [7]", "replace code of /app/left/a by tests.system.trees.Counter"),
        ("trees:Counter", "trees:Double", "replace code of /app/left/a by tests.system.trees.Double"),
        ("args = [5]", 'args = [5]\nisolation = "process"', "have /app/left/a live in a process"),
        ("args = [5]", 'args = [5]\nrestart = "transient"', "set restart='transient' of /app/left/a"),
        ("args = [5]", "args = [5]\nbackoff = { initial = 0.5 }", "set backoff=Backoff(initial=0.5"),
        ("args = [5]", 'args = [5]\nmechanism = "pbr"', "protect /app/left/a"),
        ('bindings = { peer = "/app/left/a" }\n', "", "unbind peer of /app/left/b"),
        ('names = ["first"]', 'names = ["first", "till"]', "register /app/left/a as 'till'"),
        ('bindings = { peer = "/app/left/a" }\n', "running = false", "stop /app/left/b"),
    ],
)
async def test_each_difference_is_one_step_and_state_is_kept(
    app: hf.ActorSystem, old: str, new: str, expected: str
) -> None:
    await steps(app, SHOP)
    one = ref(app, "/app/left/a")
    await one.ask(Add(10))
    changed = SHOP.replace(old, new)
    assert changed != SHOP
    found = await steps(app, changed)
    assert any(step.startswith(expected) for step in found), found
    assert len(found) == 1
    assert await steps(app, changed) == []
    assert await one.ask(Add(1)) == (17 if "Double" in new else 16)
    assert (await app.get_status(one)).life == 1
    await steps(app, SHOP)
    assert await steps(app, SHOP) == []


FLEET = """
["/app"]
supervisor = "one_for_one"
intensity = 1000

["/app/a"]
class = "tests.system.trees:Counter"
args = [5]
names = ["first"]
"""


async def test_a_file_says_which_names_an_actor_has_and_not_who_finds_it(app: hf.ActorSystem) -> None:
    """A name of the next lives, too: the program has given it by the spec, with a scope that the file does not know."""
    one = await app.start(hf.child("a", hf.start(Counter, 5), register="first", scope="fleet"))

    async def lives_again() -> list[str]:
        """The names of its next life."""
        with pytest.raises(hf.RemoteCrash):
            await one.ask(Boom())
        assert await one.ask(Add(1)) == 6
        return list(app._node.names)

    assert await steps(app, FLEET) == []
    assert await lives_again() == ["first"]
    assert app._node.shown("first") is one._cell
    for file, names in ((FLEET.replace("first", "till"), ["till"]), (FLEET.replace('"first"', ""), [])):
        assert await steps(app, file)
        assert await steps(app, file) == []
        assert list(app._node.names) == await lives_again() == names
    await steps(app, FLEET)
    assert await lives_again() == ["first"]
    with pytest.raises(hf.errors.NoSuchActor):
        app._node.shown("first")  # It was taken away, with who has found it.


async def test_a_new_actor_of_a_file_is_found_in_its_system(app: hf.ActorSystem) -> None:
    assert await steps(app, FLEET) == ["add /app/a"]
    assert app.whereis("first").path == "/app/a"
    with pytest.raises(hf.errors.NoSuchActor):
        app._node.shown("first")


async def test_what_is_not_in_the_file_is_removed_and_children_of_dynamic_supervisors_stay(
    app: hf.ActorSystem,
) -> None:
    await steps(app, SHOP)
    await ref(app, "/app/pool").ask(hf.StartChild(hf.child("guest", hf.start(Double))))
    app.spawn(hf.start(Double), "visitor")
    assert await steps(app, without(SHOP, "/app/left/b")) == ["remove /app/left/b"]
    assert {"/app/pool/guest", "/app/visitor", "/app/left/a"} <= set(app.tree())
    assert "/app/left/b" not in app.tree()


async def test_an_actor_that_is_elsewhere_in_the_file_is_moved_with_its_state(app: hf.ActorSystem) -> None:
    await steps(app, SHOP)
    await ref(app, "/app/left/a").ask(Add(10))
    await steps(app, SHOP + '\n["/app/right"]\nsupervisor = "one_for_one"\n')
    moved = SHOP.replace('["/app/left/b"]', '["/app/right"]\nsupervisor = "one_for_one"\n\n["/app/right/b"]')
    assert await steps(app, moved) == [
        "move /app/left/b to /app/right",
        "reorder the children of /app: left, right, pool",
    ]
    assert await steps(app, moved) == []


async def test_the_order_of_the_file_is_the_order_of_starts(app: hf.ActorSystem) -> None:
    await steps(app, SHOP)
    one = SHOP.index('["/app/left/a"]')
    other, end = SHOP.index('["/app/left/b"]'), SHOP.index('["/app/pool"]')
    turned = (
        SHOP[:one] + SHOP[other:end].replace('bindings = { peer = "/app/left/a" }\n', "") + SHOP[one:other] + SHOP[end:]
    )
    assert await steps(app, turned) == ["unbind peer of /app/left/b", "reorder the children of /app/left: b, a"]


async def test_what_is_kept_stays_whatever_it_is(app: hf.ActorSystem) -> None:
    pool = hf.supervisor("odd", children=[hf.child("x", hf.start(Double))])
    await app.start(pool)
    text = '["/app/odd"]\nkeep = true\n'
    assert await steps(app, text) == []
    with pytest.raises(hf.SpecError, match=r"shop.toml, line 2, /app/even, keep: nobody is there who could be kept"):
        await steps(app, '["/app/even"]\nkeep = true\n')


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a = = 1", r"shop.toml: Invalid value \(at line 1, column 5\)"),
        ("", "it names no actor"),
        ('["/app/a"]\nclass = "nowhere:Actor"', r"line 2, /app/a.*nowhere:Actor"),
        ('["/app/a"]\nclas = "x:Y"', r"shop.toml, line 1, /app/a: it needs one of supervisor"),
        (
            '["/app/a"]\nclass = "tests.system.trees:Counter"\ncolour = "red"',
            r"shop.toml, line 3, /app/a, colour: there is no key 'colour' here; there are class, args",
        ),
        (
            '["/app/a"]\nclass = "tests.system.trees:Counter"\nrestart = "often"',
            r"line 3, /app/a, restart: restart must be one of permanent, transient, temporary, not 'often'",
        ),
        (
            '["/app/a"]\nclass = "tests.system.trees:Counter"\nargs = [1, 2]',
            r"line 1, /app/a: start\(tests.system.trees.Counter, ...\): too many positional arguments",
        ),
        (
            '["/app/a"]\nclass = "tests.system.trees:Client"\nbindings = { peer = "/app/b" }',
            r"line 3, /app/a, bindings: peer leads to /app/b, which is not in this file",
        ),
        (
            '["/app/a"]\nclass = "tests.system.trees:Counter"\nrecovery = { method = "hybrid", intervall = 1 }',
            r"line 3, /app/a, recovery: recovery: .*intervall",
        ),
        ('["/app/a/b"]\nclass = "tests.system.trees:Counter"', r"its supervisor /app/a has no table in this file"),
        ('["/app/a"]\nclass = "tests.system.trees:Add"', r"line 2, /app/a, class: tests.system.trees:Add is no actor"),
        ('["/app/a"]\nclass = "no_such:Class"', r"/app/a, class: class no_such:Class is not there .*'\)$"),
        (
            '["/app/a/"]\nclass = "tests.system.trees:Counter"',
            r"line 1, /app/a/: there are .* tables named for an address",
        ),
        (
            'below = 5\n["/app/a"]\nclass = "tests.system.trees:Counter"',
            r"line 1, below: it must be an address .*, not 5$",
        ),
        (
            '["/app/a"]\nclass = "tests.system.trees:Counter"\nnames = ["x", "x"]',
            r"line 3, /app/a, names: names must have each text once, not \['x', 'x'\]",
        ),
        (
            '["/app/a"]\nclass = "tests.system.trees:Counter"\nnames = [""]',
            r"line 3, /app/a, names: names must be text without control characters",
        ),
        (
            '["/app/a"]\nclass = "tests.system.trees:Counter"\nrunning = "no"',
            r"line 3, /app/a, running: running must be True or False, not 'no'",
        ),
        ('name = "top"\nchildren = []', r"line 1, name: this is one supervisor as hf.load_tree reads it"),
    ],
)
def test_an_error_names_line_and_key(text: str, problem: str) -> None:
    with pytest.raises(hf.SpecError, match=problem):
        TreeFile(text, "shop.toml")


async def test_what_cannot_be_another_is_refused_with_its_line(app: hf.ActorSystem) -> None:
    await steps(app, SHOP)
    for new, problem in (
        ('recovery = "hybrid"', r"line 13, /app/left/a, recovery: it is None now, and cannot be another while it runs"),
        ("mailbox = { capacity = 3 }", r"/app/left/a, mailbox: it is None now, and cannot"),
    ):
        with pytest.raises(hf.SpecError, match=problem):
            await steps(app, SHOP.replace("args = [5]", f"args = [5]\n{new}"))
    assert await steps(app, SHOP) == []


async def test_a_child_that_cannot_start_leaves_all_as_it_was(app: hf.ActorSystem) -> None:
    await steps(app, SHOP)
    broken = SHOP.replace('"rest_for_one"', '"one_for_all"') + '\n["/app/x"]\nclass = "tests.system.trees:Broken"\n'
    with pytest.raises(hf.TransactionFailed, match="no such device"):
        await steps(app, broken)
    assert await steps(app, SHOP) == []


async def test_what_was_declared_is_there_after_a_restart_of_the_root(tmp_path: Path) -> None:
    spec = hf.supervisor("left", children=[])
    store = f"sqlite:{tmp_path}/app.db"
    tree = SHOP.replace("args = [5]", 'args = [5]\nrestart = "transient"')
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as first:
        await first.start(spec)
        await steps(first, tree)
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as second:
        await second.start(spec)
        assert await steps(second, tree) == []


# -- from the command line --------------------------------------------------------------------------------------------


@pytest.fixture
async def path(app: hf.ActorSystem, tmp_path: Path) -> AsyncIterator[Path]:
    """Where its control endpoint is."""
    async with control_endpoint(app, tmp_path / "app.sock") as where:
        yield where


async def test_plan_shows_and_apply_does(app: hf.ActorSystem, path: Path, tmp_path: Path) -> None:
    file = tmp_path / "shop.toml"
    file.write_text(SHOP)
    file.chmod(0o600)
    status, output, errors = await holdfast("plan", file, "--socket", path)
    assert (status, errors) == (DONE, "")
    assert output.startswith("1. add /app/left\n2. add /app/pool\n+ /app/left: Supervisor")
    assert output.endswith("nothing was done: this was a dry run\n")
    assert app.tree() == ["/app"]
    assert (await holdfast("apply", file, "--socket", path))[0] == DONE
    assert "/app/left/b" in app.tree()
    status, output, _ = await holdfast("plan", file, "--socket", path, "--json")
    told: Any = json.loads(output)
    assert (status, told) == (DONE, {"dry_run": True, "steps": [], "difference": [], "lost": []})


async def test_apply_asks_before_something_is_lost(app: hf.ActorSystem, path: Path, tmp_path: Path) -> None:
    await steps(app, SHOP)
    file = tmp_path / "shop.toml"
    file.write_text(without(SHOP, "/app/left/b"))
    file.chmod(0o600)
    status, _, errors = await holdfast("apply", file, "--socket", path)
    assert (status, errors.splitlines()[0]) == (FAILED, "without recovery, the state is lost of /app/left/b")
    assert "/app/left/b" in app.tree()
    assert (await holdfast("apply", file, "--socket", path, "--yes"))[0] == DONE
    assert "/app/left/b" not in app.tree()


async def test_what_is_recorded_of_one_that_moves_and_is_another_is_told_as_lost(
    app: hf.ActorSystem, path: Path, tmp_path: Path
) -> None:
    recorded = SHOP.replace("args = [5]", 'args = [5]\nrecovery = "hybrid"')
    await steps(app, without(recorded, "/app/left/b"))
    await ref(app, "/app/left/a").ask(Add(1))
    other = without(without(recorded, "/app/left/b"), "/app/left/a")
    file = tmp_path / "shop.toml"
    file.write_text(f'{other}\n["/app/a"]\nclass = "tests.system.trees:Double"\nrecovery = "hybrid"\n')
    file.chmod(0o600)
    lost = "/app/a begins anew as Double, and what is recorded of /app/left/a (Counter) is left behind"
    status, output, _ = await holdfast("plan", file, "--socket", path)
    assert (status, f"! {lost}" in output) == (DONE, True)
    _, output, _ = await holdfast("plan", file, "--socket", path, "--json")
    assert json.loads(output)["lost"][0].startswith(lost)
    status, _, errors = await holdfast("apply", file, "--socket", path)
    assert (status, errors.startswith(lost), "say --yes" in errors) == (FAILED, True, True)
    assert "/app/left/a" in app.tree()
    assert (await holdfast("apply", file, "--socket", path, "--yes"))[0] == DONE
    assert "/app/a" in app.tree()


async def test_a_file_that_others_may_write_or_that_is_not_there_is_not_used(path: Path, tmp_path: Path) -> None:
    file = tmp_path / "shop.toml"
    file.write_text(SHOP)
    file.chmod(0o666)
    status, _, errors = await holdfast("plan", file, "--socket", path)
    assert (status, "others may write it" in errors) == (UNUSABLE, True)
    assert (await holdfast("plan", tmp_path / "gone.toml", "--socket", path))[0] == UNUSABLE


async def test_a_module_that_others_may_write_is_not_imported_for_a_tree(
    app: hf.ActorSystem, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = tmp_path / "library"
    library.mkdir()
    module = library / "shady_tree.py"
    module.write_text("import holdfast as hf\nclass Shady(hf.Actor): ...\n")
    module.chmod(0o666)
    monkeypatch.syspath_prepend(str(library))
    file = tmp_path / "shop.toml"
    file.write_text('["/app/x"]\nclass = "shady_tree:Shady"\n')
    file.chmod(0o600)
    status, _, errors = await holdfast("apply", file, "--socket", path)
    assert (status, "others may write it (mode 0666)" in errors) == (FAILED, True)
    assert app.tree() == ["/app"]
