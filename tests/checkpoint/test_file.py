"""The recovery file: methods and key variables without a change to the program, and what is wrong in one (R17-R19)."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.recovery_file import RecoveryFile
from tests.checkpoint.players import Doer, Note, Seen, start
from tests.checkpoint.strikes import strike

HERE = "tests.checkpoint.test_file"


class Pose:
    """A plain object, which no snapshot can hold as it is."""

    def __init__(self, x: float) -> None:
        self.x, self.lock = x, asyncio.Lock


class Motor:
    def __init__(self) -> None:
        self.pose = Pose(0.0)
        self.open = open

    @property
    def speed(self) -> float:
        return 1.0


class Drive(hf.Message[float]):
    by: float


class Where(hf.Message[tuple[float, int]]): ...


class Robot(hf.Actor):
    """Written with no thought of recovery."""

    def __init__(self) -> None:
        self.motor = Motor()
        self.moves = 0
        self.lock = asyncio.Lock()

    @hf.on(Drive)
    def drive(self, message: Drive) -> float:
        self.motor.pose.x += message.by
        self.moves += 1
        return self.motor.pose.x

    @hf.on(Where)
    def where(self, message: Where) -> tuple[float, int]:
        return self.motor.pose.x, self.moves


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "recovery.toml"
    path.write_text(text)
    return path


async def drive(system: hf.ActorSystem, isolation: str) -> tuple[float, int]:
    ref = await start(system, isolation, "robot", hf.start(Robot))
    await ref.ask(Drive(1.5))
    await ref.ask(Drive(2.0))
    life = ref._cell.life
    strike(system, ref)
    reply: tuple[float, int] = await ref.ask(Where(), timeout=30.0)
    assert ref._cell.life == life + 1 or isolation == "subtree"
    return reply


async def test_a_program_is_recovered_as_the_file_says(tmp_path: Path, isolation: str, store: str | None) -> None:
    """Variables inside plain objects, of a class that knows nothing of recovery and has what cannot be saved."""
    path = written(tmp_path, f'["{HERE}:Robot"]\nkey_variables = ["motor.pose.x", "moves"]\ninterval = 0.01\n')
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store, recovery=path) as system:
        assert await drive(system, isolation) == (3.5, 2)


async def test_what_is_not_named_is_not_saved(tmp_path: Path) -> None:
    """The opposite, to see that it is the snapshot that brings it back."""
    text = f'["{HERE}:Robot"]\nmethod = "checkpoint_only"\ninterval = 0.01\nkey_variables = ["moves"]'
    async with hf.ActorSystem("app", log=False, intensity=1000, recovery=written(tmp_path, text)) as system:
        ref = await start(system, "task", "robot", hf.start(Robot))
        with system.events() as stream:
            await ref.ask(Drive(1.5))
            async for one in stream:
                if isinstance(one, hf.events.SnapshotTaken) and one.turn >= 1:
                    break
        ref.kill()
        assert await ref.ask(Where()) == (0.0, 1)


@pytest.mark.parametrize("isolation", ["task", "process"], indirect=True)
async def test_without_the_file_nothing_comes_back(tmp_path: Path, isolation: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        assert await drive(system, isolation) == (0.0, 0)


def test_tables_for_addresses_come_before_those_for_classes() -> None:
    file = RecoveryFile(
        f"""
        ["{HERE}:Robot"]
        method = "hybrid"
        interval = 1
        key_variables = ["moves"]
        ["/app/bank/*"]
        interval = 2
        ["/app/bank/alice"]
        method = "replay_only"
        ["/app/*/bob"]
        interval = 4
        ["/app/carol"]
        key_variables = ["motor.pose.x"]
        """,
        "recovery.toml",
    )

    def method(address: str, given: Any = None) -> hf.Method:
        found = file.method_for(address, Robot, given)
        assert found is not None
        return found

    assert method("/app/dave").interval == 1.0
    assert method("/app/bank/alice").name == "replay_only"
    assert method("/app/bank/bob").interval == 2.0, "the first that fits"
    assert method("/app/x/bob").interval == 4.0
    assert method("/app/x/bob").key_variables == ("moves",), "the class's, if the address says nothing of them"
    assert method("/app/carol").key_variables == ("motor.pose.x",)
    assert method("/app/carol").interval == 1.0
    given = method("/app/dave", hf.hybrid(9.0))
    assert (given.interval, given.key_variables) == (9.0, ("moves",)), "a child spec that says how has its way"
    assert method("/app/dave", hf.fresh()) == hf.fresh()
    assert file.method_for("/app/dave", Doer) is None


def test_every_setting_of_a_method_can_stand_in_the_file() -> None:
    text = """
    ["/all"]
    method = "hybrid"
    interval = 0.5
    pacing = 2.5
    max_deliveries = 3
    journal_limit = 1000
    keep = 1
    on_escalate = "fresh"
    skip = false
    check_readonly = true
    safe_state = ["/app/wheels", "/app/arm"]
    safe_state_timeout = 4
    held = { capacity = 10, overflow = "latest" }
    ["/topics"]
    pacing = "original"
    ["/topics".safe_state]
    to = "/app/wheels"
    enter = { message = "tests.checkpoint.players:Note", text = "stop" }
    leave = { message = "tests.checkpoint.players:Note", text = "go" }
    ["/topics".held]
    "/scan" = { capacity = 1, overflow = "latest" }
    "*" = { capacity = 100 }
    """
    file = RecoveryFile(text, "x")
    assert file.method_for("/all", Doer) == hf.hybrid(
        0.5,
        pacing=2.5,
        max_deliveries=3,
        journal_limit=1000,
        keep=1,
        on_escalate="fresh",
        skip=False,
        check_readonly=True,
        safe_state=["/app/wheels", "/app/arm"],
        safe_state_timeout=4,
        held=hf.checkpoint.held(10, overflow="latest"),
    )
    assert file.method_for("/topics", Doer) == hf.hybrid(
        pacing="original",
        safe_state=hf.checkpoint.safe_state("/app/wheels", enter=Note("stop"), leave=Note("go")),
        held={"/scan": hf.checkpoint.held(1, overflow="latest"), "*": hf.checkpoint.held(100)},
    )


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[x\n", r"recovery.toml.*line 1"),
        ("x = 1", r"recovery.toml, \[x\]: must be a table named for a class"),
        ("[nowhere]\n", r"line 1, \[nowhere\]: must be a table named for a class"),
        ('\n["/a"]\nintervall = 1', r"line 3, \[/a\]: hybrid has no setting 'intervall'"),
        ('["/a"]\nhooks = {}', r"line 2, \[/a\]: hybrid has no setting 'hooks' in a file"),
        ('["/a"]\nmethod = "reply_only"', r"line 2, \[/a\]: method must be one of .*'replay_only'.* not 'reply_only'"),
        ('["/a"]\nmethod = "replay_only"\ninterval = 1', r"line 3, \[/a\]: replay_only has no setting 'interval'"),
        ('["/a"]\n\ninterval = "1"', r"line 3, \[/a\]: interval: Expected `float`, got `str`"),
        ('["/a"]\ninterval = true', r"line 2, \[/a\]: interval: Expected `float`, got `bool`"),
        ('["/a"]\ninterval = -1', r"line 2, \[/a\]: .*interval must be a finite number of seconds > 0, not -1"),
        ('["/a"]\npacing = "slow"', r"line 2, \[/a\]: .*pacing must be 'fast', 'original' or a factor"),
        ('["/a"]\ndurability = "disk"', r"line 2, \[/a\]: .*durability must be one of 'memory', 'os', 'fsync'"),
        ('["/a"]\nkeep = 0', r"line 2, \[/a\]: .*keep must be a whole number from 1 to 100"),
        ('["/b"]\nkeep = 2\n["/a"]\n# keep\nkeep = 2.5', r"line 5, \[/a\]: keep: Expected `int`, got `float`"),
        ('["/a"]\nheld = 3', r"line 2, \[/a\]: held: Expected `object`, got `int`"),
        ('["/a"]\nheld = { capacity = 0 }', r"line 2, \[/a\]: held: capacity must be"),
        ('["/a".held]\n"/x" = 1', r"line 1, \[/a\]: held: '/x' must be a table"),
        ('["/a"]\nsafe_state = { too = "/b" }', r"line 2, \[/a\]: safe_state: has to, enter and leave; not 'too'"),
        (
            '["/a"]\nsafe_state = { to = "/b", enter = { message = "tests.checkpoint.players:Note", text = 1 } }',
            r"line 2, \[/a\]: safe_state: message tests.checkpoint.players:Note: Expected `str`, got `int`",
        ),
        ('["/a"]\nkey_variables = "x"', r"line 2, \[/a\]: key_variables: Expected `array`, got `str`"),
        ('["/a"]\nkey_variables = [\n "x",\n "y z"]', r"line 4, \[/a\]: key_variables: 'y z' names no variable"),
        ('["/a"]\nkey_variables = ["x", "x"]', r"line 2, .*'x' stands there twice"),
        ('["/a"]\nkey_variables = ["x", "x.y"]', r"line 2, .*'x.y' is inside 'x'"),
    ],
)
def test_what_is_wrong_in_a_file_is_refused_by_line_and_setting(tmp_path: Path, text: str, problem: str) -> None:
    with pytest.raises(hf.SpecError, match=problem):
        hf.checkpoint.load_recovery(written(tmp_path, text))


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        (f"{HERE}:Robbot", "is not there"),
        ("no.such.module:Robot", "No module named 'no'"),
        (f"{HERE}:Pose", "is no actor class"),
    ],
)
async def test_unknown_classes_are_refused_when_the_system_starts(tmp_path: Path, name: str, problem: str) -> None:
    path = written(tmp_path, f'\n["{name}"]\ninterval = 1.0')
    with pytest.raises(hf.SpecError, match=rf"recovery.toml, line 2, \[{name}\].*{problem}"):
        async with hf.ActorSystem("app", log=False, recovery=path):
            pass


@pytest.mark.parametrize("name", ["/ap/*", "/ap/robot", "/app", "/application/*", "/b*"])
async def test_addresses_of_another_system_are_refused_when_the_system_starts(tmp_path: Path, name: str) -> None:
    path = written(tmp_path, f'["/app/*"]\nkeep = 1\n["/*/robot"]\nkeep = 1\n["{name}"]\nkeep = 1')
    with pytest.raises(hf.SpecError, match=r"recovery.toml, line 5, .*begin with '/app/'"):
        async with hf.ActorSystem("app", log=False, recovery=path):
            pass


@pytest.mark.parametrize(
    ("variable", "problem"),
    [
        ("goal", r"Robot has no key variable 'goal'"),
        ("motor.pose.z", r"no key variable 'motor.pose.z': a .*Pose has no attribute 'z'"),
        ("motor.pose", r"key variable 'motor.pose': .*Robot.motor.pose: a value of type .*Pose cannot be saved"),
        ("lock", r"key variable 'lock': .*Robot.lock: a value of type asyncio.locks.Lock cannot be saved"),
        ("motor.speed", r"Robot.motor.speed cannot be set"),
    ],
)
async def test_wrong_variables_are_refused_before_the_first_message(
    tmp_path: Path, isolation: str, variable: str, problem: str
) -> None:
    path = written(tmp_path, f'["{HERE}:Robot"]\nkey_variables = ["moves", "{variable}"]')
    async with hf.ActorSystem("app", log=False, recovery=path) as system:
        with pytest.raises(hf.StartFailed, match=rf"recovery.toml, line 2, \[{HERE}:Robot\]: .*{problem}"):
            await start(system, isolation, "robot", hf.start(Robot))


class Gambler(hf.Actor):
    deterministic = False


async def test_a_method_that_does_not_go_with_the_class_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, '["/app/*"]\nmethod = "hybrid"')
    async with hf.ActorSystem("app", log=False, recovery=path) as system:
        with pytest.raises(hf.HoldfastError, match="Gambler is not deterministic, so hybrid cannot replay"):
            await system.start(hf.child("x", hf.start(Gambler)))


async def test_a_fresh_start_and_a_change_of_specs_see_the_file_too(tmp_path: Path) -> None:
    store, path = f"sqlite:{tmp_path / 'app.db'}", written(tmp_path, '["/app/top/*"]\nmethod = "hybrid"')
    spec = hf.child("x", hf.start(Doer))
    async with hf.ActorSystem("app", log=False, store=store, recovery=path) as system:
        top = await system.start(hf.supervisor("top", children=[spec]))
        ref = system.ref("/app/top/x", Doer)
        await ref.ask(Note("one"))
        await top.ask(hf.supervision.ChangeSupervisor(children=(spec, hf.child("y", hf.start(Doer)))))
        await top.ask(hf.TerminateChild("x"))
        await top.ask(hf.RestartChild("x"))
        assert await system.ref("/app/top/x", Doer).ask(Seen()) == ["one"]
    for fresh in (False, True):
        async with hf.ActorSystem("app", log=False, store=store, recovery=hf.checkpoint.load_recovery(path)) as system:
            await system.start(hf.supervisor("top", children=[spec]), fresh=fresh)
            assert await system.ref("/app/top/x", Doer).ask(Seen()) == ([] if fresh else ["one"])


async def test_a_table_that_is_for_nobody_is_told_of(tmp_path: Path, isolation: str) -> None:
    """Nothing in the file is passed over in silence: a name may be misspelt."""
    path = tmp_path / "recovery.toml"
    tables = ["/app/of-*/doer", "/app/doer", "/app/doter", "tests.checkpoint.players:Hooks"]
    path.write_text("".join(f'["{table}"]\n' for table in tables))
    async with hf.ActorSystem("app", log=False, recovery=str(path)) as system:
        await start(system, isolation, "doer", hf.start(Doer))
        stream = system.events()
    told = [(one.table, one.where) for one in stream.take() if isinstance(one, hf.events.RecoveryTableUnused)]
    other = ("/app/doer", 2) if isolation == "subtree" else ("/app/of-*/doer", 1)
    names = [other, ("/app/doter", 3), ("tests.checkpoint.players:Hooks", 4)]
    assert sorted(told) == sorted((name, f"{path}, line {line}, [{name}]") for name, line in names)


def test_a_topic_without_a_message_is_refused() -> None:
    with pytest.raises(TypeError, match="@subscribe without @on"):

        class Deaf(hf.Actor):
            @hf.subscribe("/scan")
            def scan(self, message: Note) -> int:
                return 0
