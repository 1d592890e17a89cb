"""Trees from mappings and TOML files."""

import copy
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.supervision.family import Boom


class Ask(hf.Message[int]): ...


class Counter(hf.Actor):
    def __init__(self, start: int = 0, *, step: int = 1) -> None:
        self.total, self.step = start, step

    @hf.on(Ask)
    def ask(self, message: Ask) -> int:
        self.total += self.step
        return self.total

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")


COUNTER = f"{__name__}:Counter"
TOML = f"""
name = "top"
strategy = "rest_for_one"
intensity = 3
auto_shutdown = "any_significant"

[[children]]
id = "alice"
start = "{COUNTER}"
args = [100]
kwargs = {{ step = 5 }}
restart = "transient"
significant = true
shutdown = 2.5
backoff = {{ initial = 0.0, maximum = 1.0 }}
mailbox = {{ capacity = 10, overflow = "drop_oldest" }}
rules = [{{ reason = "KeyError", action = "stop" }}]

[[children]]
id = "safe"
start = "{COUNTER}"
recovery = {{ use = "holdfast:hybrid", interval = 9.0 }}

[[children]]
name = "inner"
intensity = 7

[[children.children]]
id = "deep"
start = "{COUNTER}"

[[children]]
name = "pool"
kind = "dynamic"
max_children = 1
template = {{ start = "{COUNTER}", restart = "temporary" }}

[[children]]
name = "shards"
kind = "partitions"
count = 3
copy = {{ start = "{COUNTER}", args = [1000] }}
"""


async def test_a_tree_from_a_file_is_the_tree_from_code(tmp_path: Path) -> None:
    path = tmp_path / "tree.toml"
    path.write_text(TOML)
    start = hf.start(Counter)
    alice = hf.child(
        "alice",
        hf.start(Counter, 100, step=5),
        restart="transient",
        significant=True,
        shutdown=2.5,
        backoff=hf.Backoff(initial=0.0, maximum=1.0),
        mailbox=hf.bounded(10, overflow="drop_oldest"),
        rules=[hf.rule(KeyError, "stop")],
    )
    assert hf.load_tree(path) == hf.supervisor(
        "top",
        strategy="rest_for_one",
        intensity=3,
        auto_shutdown="any_significant",
        children=[
            alice,
            hf.child("safe", start, recovery=hf.hybrid(interval=9.0)),
            hf.supervisor("inner", intensity=7, children=[hf.child("deep", start)]),
            hf.dynamic("pool", max_children=1, template=hf.child(None, start, restart="temporary")),
            hf.supervision.partitions("shards", hf.start(Counter, 1000), 3),
        ],
    )
    async with hf.ActorSystem(log=False) as system:
        await system.start(hf.load_tree(path))
        assert await system.ref("/app/top/alice", Counter).ask(Ask()) == 105
        assert await system.ref("/app/top/inner/deep", Counter).ask(Ask()) == 1
        assert await system.ref("/app/top/shards/2", Counter).ask(Ask()) == 1001
        pool = system.ref("/app/top/pool", hf.supervision.DynamicSupervisor)
        assert await (await pool.ask(hf.StartChild(args=(7,)))).ask(Ask()) == 8


GOOD: dict[str, Any] = {
    "name": "top",
    "children": [
        {"id": "a", "start": COUNTER, "backoff": {"initial": 1.0}},
        {"name": "b", "children": [{"id": "c", "start": COUNTER}]},
    ],
}


@pytest.mark.parametrize(
    ("place", "value", "error"),
    [
        (("strategy",), "one_for_some", r"tree: supervisor 'top': strategy must be one of one_for_one"),
        (("stratgy",), "one_for_one", r"tree: .*unexpected keyword argument 'stratgy'"),
        (("kind",), "static", r"tree\.kind: must be one of supervisor, dynamic, partitions, not 'static'"),
        (("children",), "abc", r"tree\.children: must be a list, not 'abc'"),
        (("children",), [7], r"tree\.children\[0\]: must be a table, not 7"),
        (("children", 0, "start"), "Counter", r"tree\.children\[0\]\.start: must be a name such as"),
        (("children", 0, "start"), "holdfast:nobody", r"tree\.children\[0\]\.start: 'holdfast:nobody'"),
        (("children", 0, "start"), "pathlib:Path", r"tree\.children\[0\]\.start: 'pathlib:Path' is no Actor class"),
        (("children", 0, "args"), [1, 2, 3], r"tree\.children\[0\]: child 'a': start\(.*too many positional"),
        (("children", 0, "args"), 7, r"tree\.children\[0\]\.args: must be a list"),
        (("children", 0, "kwargs"), [], r"tree\.children\[0\]\.kwargs: must be a table"),
        (("children", 0, "restart"), "never", r"tree\.children\[0\]: child 'a': restart must be one of"),
        (("children", 0, "backoff", "factor"), 0, r"tree\.children\[0\]\.backoff: Backoff: factor must be"),
        (("children", 0, "backoff", "speed"), 0, r"tree\.children\[0\]\.backoff: .*'speed'"),
        (("children", 0, "mailbox"), {"capacity": 0}, r"tree\.children\[0\]\.mailbox: "),
        (("children", 0, "rules"), [{"reason": "X"}], r"tree\.children\[0\]\.rules\[0\]: .*'action'"),
        (("children", 0, "recovery"), {"interval": 1.0}, r"tree\.children\[0\]\.recovery\.use: must be a name"),
        (("children", 0, "mechanism"), {"window": 3}, r"tree\.children\[0\]\.mechanism\.use: must be a name"),
        (("children", 0, "mechanism"), [{"use": "holdfast:hybrid"}], r"tree\.children\[0\]: .*mechanism must be one"),
        (("children", 0, "mechanism"), [{"use": "holdfast.ftm:PBR", "windw": 3}], r"mechanism\[0\]: .*'windw'"),
        (("children", 0, "mechanism"), "pbr", r"tree\.children\[0\]\.mechanism: must be a list"),
        (("children", 0, "significant"), True, r"tree\.children\[0\]: child 'a': a permanent child cannot be"),
        (("children", 1, "name"), None, r"tree\.children\[1\]: "),
        (("children", 1, "children", 0, "id"), "x/y", r"tree\.children\[1\]\.children\[0\]: child 'x/y': the id"),
        (("children", 1, "children", 0, 5), "x", r"tree\.children\[1\]\.children\[0\]: keys must be text"),
    ],
)
def test_errors_say_where(place: tuple[Any, ...], value: Any, error: str) -> None:
    mapping = copy.deepcopy(GOOD)
    assert hf.supervision.tree_from(mapping).id == "top"
    at: Any = mapping
    for step in place[:-1]:
        at = at[step]
    at[place[-1]] = value
    with pytest.raises(hf.SpecError, match=error):
        hf.supervision.tree_from(mapping)


def test_mechanisms_are_tables_too() -> None:
    one = {"id": "one", "start": COUNTER, "mechanism": {"use": "holdfast.ftm:PBR", "window": 3}}
    two = {"id": "two", "start": COUNTER, "mechanism": [{"use": "holdfast.ftm:LFR"}, {"use": "holdfast.ftm:TR"}]}
    children = [
        hf.child("one", hf.start(Counter), mechanism=hf.ftm.PBR(window=3)),
        hf.child("two", hf.start(Counter), mechanism=(hf.ftm.LFR(), hf.ftm.TR())),
    ]
    assert hf.supervision.tree_from({"name": "top", "children": [one, two]}) == hf.supervisor("top", children=children)


def test_the_top_is_a_supervisor_and_what_is_given_stays_as_it_is() -> None:
    with pytest.raises(hf.SpecError, match="the top must be a supervisor"):
        hf.supervision.tree_from({"id": "a", "start": COUNTER})
    with pytest.raises(hf.SpecError, match="a supervisor name and children"):
        hf.supervision.tree_from({"children": []})
    mapping = {"name": "top", "kind": "dynamic", "template": {"start": COUNTER}}
    before = copy.deepcopy(mapping)
    hf.supervision.tree_from(mapping)
    assert mapping == before


def test_a_file_that_is_no_toml_is_named(tmp_path: Path) -> None:
    path = tmp_path / "tree.toml"
    path.write_text("name = ")
    with pytest.raises(hf.SpecError, match=r"tree\.toml: "):
        hf.load_tree(path)
    path.write_text("['/app/top']\nsupervisor = 'one_for_one'\n")
    with pytest.raises(hf.SpecError, match="a whole tree for `holdfast run`"):
        hf.load_tree(path)
    path.write_text("name = 'top'\n[[children]]\nid = 'a'\nstart = 'nowhere:X'\n")
    with pytest.raises(hf.SpecError, match=r"tree\.toml: tree\.children\[0\]\.start: 'nowhere:X'"):
        hf.load_tree(path)
