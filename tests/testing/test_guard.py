"""What the guard finds, each beside a test that has done no wrong; seen from outside, in suites of a user's."""

import pytest

from holdfast.testing.guard.changes import changes
from holdfast.testing.guard.declared import may_change, wrong_field
from holdfast.testing.guard.leaks import open_files
from tests.testing.suites import HEAD, run_suite

ACTORS = """
class Items(hf.Message[list[int]]): ...

class Keep(hf.Message):
    items: list[int]

class Touch(hf.Message): ...

class Shelf(hf.Actor):
    def __init__(self):
        self.items = [1, 2]

    @hf.on(Items)
    def give(self, message):
        return self.items

    @hf.on(Keep)
    def keep(self, message):
        self.items = message.items

    @hf.on(Touch)
    def touch(self, message):
        self.items.append(99)

class Careful(Shelf):
    @hf.on(Items)
    def give(self, message):
        return list(self.items)

    @hf.on(Keep)
    def keep(self, message):
        self.items = list(message.items)
"""


@pytest.fixture
def suite(pytester: pytest.Pytester):
    def run(tests: str, **options: str) -> pytest.RunResult:
        return run_suite(pytester, HEAD + ACTORS + tests, **options)

    return run


BODIES = {
    "reply changed by the asker": (
        "reply = await shelf.ask(Items()); reply.append(5); await shelf.ask(Items())",
        "*from /app/shelf to the test, for Items(): replied [[]1, 2], changed since, which /app/shelf holds as *",
        "replies",
    ),
    "reply changed by the replier": (
        "reply = await shelf.ask(Items()); shelf.tell(Touch()); await idle(actor_system)",
        "*after the turn of Touch() at /app/shelf it was [[]1, 2, 99]*",
        "replies",
    ),
    "message changed by the receiver in a later turn": (
        "shelf.tell(Keep([1])); await idle(actor_system); shelf.tell(Touch()); await idle(actor_system)",
        "*from the test to /app/shelf: sent Keep(items=[[]1]), changed since (in items), which /app/shelf holds as *",
        "sends",
    ),
    "message changed by the sender after its turn": (
        "items = [1]; shelf.tell(Keep(items)); await idle(actor_system); items.append(7)",
        "*changed since (in items), which /app/shelf holds as `items`: at the end of the test*Keep(items=[[]1, 7])*",
        "sends",
    ),
}


@pytest.mark.parametrize("case", BODIES)
def test_what_two_share_and_one_changes_is_found_and_a_copy_is_not(suite, case: str) -> None:
    body, text, kind = BODIES[case]
    result = suite(f"""
from holdfast.testing import idle

async def run(actor_system, kind):
    shelf = actor_system.spawn(hf.start(kind), "shelf")
    {body}

async def test_shares(actor_system):
    await run(actor_system, Shelf)

async def test_copies(actor_system):
    await run(actor_system, Careful)

async def test_says_so(actor_system):
    actor_system.expect_{kind}()
    await run(actor_system, Shelf)

@pytest.mark.holdfast({kind}=True)
async def test_is_marked(actor_system):
    await run(actor_system, Shelf)
""")
    result.assert_outcomes(passed=4, errors=1)
    result.stdout.fnmatch_lines([text])


def test_what_nobody_else_holds_may_be_changed(suite) -> None:
    suite("""
from holdfast.testing import idle

async def test_reuses(actor_system):
    shelf, items = actor_system.spawn(hf.start(Careful)), []
    for number in range(3):
        items.append(number)
        shelf.tell(Keep(items))
        await idle(actor_system)
    reply = await shelf.ask(Items())
    reply.clear()
    assert await shelf.ask(Items()) == [0, 1, 2]

class Tags(hf.Message):
    tags: set[str]
    value: float

class Reader(hf.Actor):
    @hf.on(Tags)
    def read(self, message):
        self.last = message
        message.tags.discard("none of them")

async def test_sets_and_what_is_no_number(actor_system):
    reader = actor_system.spawn(hf.start(Reader))
    reader.tell(Tags({"a", "b", "c"}, float("nan")))
    await idle(actor_system)
""").assert_outcomes(passed=2)


def test_a_message_to_a_process_that_is_changed_before_its_turn_is_over_is_found(suite) -> None:
    result = suite("""
import tests.testing.players as players

class Lot(hf.Message):
    items: list[int]

async def test_changes(actor_system):
    far = await actor_system.start(hf.child("far", hf.start(players.Shelf), isolation="process"))
    message = players.Put([1])
    far.tell(message)
    message.items.append(2)
    assert await far.ask(players.Count()) == 1
""")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*to /app/far: sent Put(items=[[]1]), after its turn it was Put(items=[[]1, 2])*"])


LEAKS = {
    "descriptors": ("kept.append(open(__file__))", "a descriptor was left open: /*/test_*.py*"),
    "threads": (
        "thread = threading.Thread(target=gate.wait, name='mine', daemon=True); thread.start()",
        "a thread was left running: mine, started at *test_*.py:*",
    ),
    "timers": ("asyncio.get_running_loop().call_later(100, print)", "a timer was left: builtins.print, due in *"),
    "tasks": ("kept.append(asyncio.ensure_future(asyncio.sleep(3600)))", "a task was left running: *sleep*"),
    "signals": (
        "signal.signal(signal.SIGUSR1, lambda *_: None)",
        "a handler of a signal was left: SIGUSR1 calls <function *",
    ),
}


@pytest.mark.parametrize("loops", ["asyncio", "uvloop"])
@pytest.mark.parametrize("kind", LEAKS)
def test_each_leak_is_found_and_can_be_allowed(suite, kind: str, loops: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holdfast.testing.guard.thread_leaks.GRACE", 0.3)
    leak, text = LEAKS[kind]
    allowed = ("timers", "tasks") if kind == "tasks" else (kind,)
    result = suite(
        f"""
import signal, threading
kept, gate = [], threading.Event()

async def test_leaks(actor_system):
    {leak}

@pytest.mark.holdfast(leaks={allowed!r})
async def test_may(actor_system):
    {leak}

async def test_cleans_up(actor_system):
    task = asyncio.ensure_future(asyncio.sleep(0))
    thread = threading.Thread(target=gate.wait, args=(0.001,))
    thread.start()
    asyncio.get_running_loop().call_later(100, print).cancel()
    await asyncio.to_thread(int)
    open("/dev/null").close()
    before = signal.signal(signal.SIGUSR2, print)
    signal.signal(signal.SIGUSR2, before)
    await task

def test_end():
    gate.set()
    signal.signal(signal.SIGUSR1, signal.SIG_DFL)
    for one in kept:
        if hasattr(one, "close"): one.close()
""",
        holdfast_loops=loops,
    )
    result.assert_outcomes(passed=4, errors=1)
    result.stdout.fnmatch_lines([f"*{text}*"])


def test_a_pool_that_the_test_has_made_is_told_if_it_is_at_work(suite, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holdfast.testing.guard.thread_leaks.GRACE", 0.2)
    result = suite("""
import threading
from concurrent.futures import ThreadPoolExecutor
gate, pools = threading.Event(), []

async def test_leaves_it_at_work(actor_system):
    pools.append(ThreadPoolExecutor(1, "mine"))
    pools[-1].submit(gate.wait)

async def test_leaves_it_idle(actor_system):
    pools.append(ThreadPoolExecutor(1))
    assert await asyncio.wrap_future(pools[-1].submit(int)) == 0

async def test_leaves_it_with_what_ends(actor_system):
    pools.append(ThreadPoolExecutor(1))
    pools[-1].submit(gate.wait, 0.05)

async def test_has_the_loop_wait_for_it(actor_system):
    task = asyncio.ensure_future(asyncio.to_thread(gate.wait))
    await asyncio.sleep(0)
    gate.set()
    await task

def test_end():
    for pool in pools:
        pool.shutdown()
""")
    result.assert_outcomes(passed=5, errors=1)
    result.stdout.fnmatch_lines(["*a thread was left running: mine_0, started at *test_*.py:*"])


def test_an_exception_that_ends_a_thread_is_told(suite) -> None:
    result = suite("""
import threading
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")

def fails():
    raise LookupError("in a thread")

def run(target):
    thread = threading.Thread(target=target, name="mine")
    thread.start()
    thread.join()

async def test_fails(actor_system):
    run(fails)

async def test_says_so(actor_system):
    actor_system.expect_exceptions()
    run(fails)

@pytest.mark.holdfast(exceptions=True)
async def test_is_marked(actor_system):
    run(fails)

async def test_exits(actor_system):
    run(exit)
""")
    result.assert_outcomes(passed=4, errors=1)
    result.stdout.fnmatch_lines(["*an exception has ended a thread: LookupError: in a thread, in mine; *"])


def test_an_async_generator_that_is_left_open_is_told(suite) -> None:
    result = suite(
        """
kept = []

async def numbers():
    try:
        yield 1
        yield 2
    finally:
        await asyncio.sleep(0)

@pytest.fixture
async def number():
    yield 1

async def test_leaves(actor_system):
    kept.append(numbers())
    assert await anext(kept[-1]) == 1

@pytest.mark.holdfast(leaks="generators")
async def test_may(actor_system):
    kept.append(numbers())
    await anext(kept[-1])

async def test_closes(actor_system, number):
    kept.append(numbers())
    await anext(kept[-1])
    await kept[-1].aclose()

async def test_drops(number, actor_system):
    async for _ in numbers():
        break

async def test_ends(actor_system):
    kept.append(numbers())
    assert [one async for one in kept[-1]] == [1, 2]
""",
        holdfast_loops="asyncio",
    )
    result.assert_outcomes(passed=5, errors=1)
    result.stdout.fnmatch_lines(["*an async generator was left open: numbers at *test_*.py; close it (aclose)"])


def test_a_kind_of_leak_that_there_is_not_is_refused(suite) -> None:
    result = suite("""
@pytest.mark.holdfast(leaks="sockets")
async def test_leaks(actor_system): ...
""")
    result.stdout.fnmatch_lines(
        ["*'sockets' is none of descriptors, generators, processes, signals, tasks, threads, timers*"]
    )


EXCEPTIONS = {
    "task": ("kept.append(asyncio.ensure_future(fail())); await asyncio.sleep(0)", "nobody has awaited *Task*"),
    "task that is gone": ("asyncio.ensure_future(fail()); await asyncio.sleep(0)", "never retrieved"),
    "task in a cycle": (
        "cycle = [asyncio.ensure_future(fail())]; cycle.append(cycle); del cycle; await asyncio.sleep(0)",
        "RuntimeError: boom",
    ),
    "callback": ("asyncio.get_running_loop().call_soon(boom); await asyncio.sleep(0)", "Exception in callback boom()*"),
    "ask": (
        "kept.append(actor_system.spawn(hf.start(Counter), 'counter').ask(No())); await idle(actor_system)",
        "nobody has awaited the ask of No() to /app/counter",
    ),
}


@pytest.mark.parametrize("case", EXCEPTIONS)
def test_an_exception_that_nobody_sees_is_found(suite, case: str) -> None:
    body, text = EXCEPTIONS[case]
    result = suite(f"""
from holdfast.testing import idle

class No(hf.Message[int]): ...

class Never(hf.Refusal): ...

class Counter(hf.Actor):
    @hf.on(No)
    def no(self, message):
        raise Never

kept = []

def boom():
    raise RuntimeError("boom")

async def fail():
    boom()

async def test_loses(actor_system):
    {body}

@pytest.mark.holdfast(exceptions=True)
async def test_may(actor_system):
    {body}

async def test_says_so(actor_system):
    actor_system.expect_exceptions()
    {body}

async def test_sees(actor_system):
    with pytest.raises(RuntimeError):
        await asyncio.ensure_future(fail())
    with pytest.raises(Never):
        await actor_system.spawn(hf.start(Counter), "counter").ask(No())
""")
    assert result.parseoutcomes()["errors"] == 1
    assert result.parseoutcomes()["passed"] == 4
    result.stdout.fnmatch_lines([f"*an exception was never seen: *{text}*"])


def test_types_are_looked_at_within_containers(suite) -> None:
    result = suite("""
class Rows(hf.Message):
    rows: dict[str, list[int]]

class Odd:
    pass

class Local(hf.Message):
    odd: Odd
    items: list[int]

class Reader(hf.Actor):
    @hf.on(Rows)
    def rows(self, message): ...

    @hf.on(Local)
    def local(self, message): ...

async def test_wrong(actor_system):
    reader = actor_system.spawn(hf.start(Reader), "reader")
    with pytest.raises(hf.errors.BadMessage, match=r"Expected `list`, got `tuple` - at `rows\\['a'\\]`"):
        reader.tell(Rows({"a": (1, 2)}))
    with pytest.raises(hf.errors.BadMessage, match=r"Expected `int`, got `str` - at `items\\[1\\]`"):
        reader.tell(Local(Odd(), [1, "2"]))

async def test_right(actor_system):
    reader = actor_system.spawn(hf.start(Reader), "reader")
    reader.tell(Rows({"a": [1, 2]}))
    reader.tell(Local(Odd(), [1, 2]))

@pytest.mark.holdfast(types=True)
async def test_may(actor_system):
    actor_system.spawn(hf.start(Reader), "reader").tell(Rows({"a": (1, 2)}))
""")
    result.assert_outcomes(passed=3)


def test_declared_types() -> None:
    import dataclasses
    import enum
    from collections.abc import Mapping, Sequence
    from typing import Any, Literal

    import numpy as np

    import holdfast as hf

    class Colour(enum.Enum):
        RED = 1

    @dataclasses.dataclass
    class Point:
        x: float
        y: float = 0.0

    good: list[tuple[Any, Any]] = [
        (list[int], [1, 2]), (tuple[int, ...], (1, 2)), (tuple[int, str], (1, "a")), (Sequence[int], (1, 2)),
        (Mapping[str, int], {"a": 1}), (float, 1), (int, np.int64(1)), (np.ndarray, np.zeros(2)), (int | None, None),
        (list[int | str], [1, "a"]), (Literal["a", "b"], "a"), (Colour, Colour.RED), (list[Point], [Point(1.0)]),
        (set[str], {"a"}), (Any, object()), (bytes, bytearray(b"a")), (dict[str, Any], {"a": object()}),
        (object, 1), (list, ["a", 1]),
    ]  # fmt: skip
    bad: list[tuple[Any, Any, str]] = [
        (list[int], (1, 2), "Expected `list`, got `tuple` - at `value`"),
        (tuple[int, ...], [1], "Expected `tuple`, got `list` - at `value`"),
        (tuple[int, str], (1,), "Expected `tuple` of length 2, got 1 - at `value`"),
        (list[list[int]], [[1], [2, "a"]], "Expected `int`, got `str` - at `value[1][1]`"),
        (dict[str, int], {1: 1}, "Expected `str`, got `int` - at `value[key 1]`"),
        (int, True, "Expected `int`, got `bool` - at `value`"),
        (Colour, 1, "Expected `Colour`, got `int` - at `value`"),
        (list[Point], [Point("a")], "Expected `float`, got `str` - at `value[0].x`"),  # type: ignore[arg-type]
        (int | None, "a", "Expected `int | None`, got `str` - at `value`"),
        (list[int] | None, ["a"], "Expected `int`, got `str` - at `value[0]`"),
        (Literal["a"], "b", "Expected one of 'a', got 'b' - at `value`"),
        (frozenset[int], {1}, "Expected `frozenset`, got `set` - at `value`"),
    ]

    def message(declared: Any, value: Any) -> Any:
        kind: Any = type("Given", (hf.Message,), {"__annotations__": {"value": declared}})
        return kind(value)

    for declared, value in good:
        assert wrong_field(message(declared, value)) is None, (declared, value)
    for declared, value, problem in bad:
        assert wrong_field(message(declared, value)) == problem


def test_what_can_change_and_what_has() -> None:
    import msgspec

    from tests.testing.players import Add, Put

    assert not may_change(Add(1))
    assert may_change(Put([1]))
    value = {"a": [[1], [2]], "b": {"c": [3]}}
    was = msgspec.msgpack.encode(value)
    value["a"][1].append(4)  # type: ignore[index]
    assert changes(value, was, msgspec.msgpack.encode(value)) == {"['a'][1]": [2, 4]}


def test_descriptors_are_told_by_number_and_target() -> None:
    before = open_files()
    with open("/dev/null") as opened:
        now = open_files()
        assert now.keys() - before.keys() == {opened.fileno()}
        assert now[opened.fileno()] == "/dev/null"


def test_a_number_that_has_become_another_file_is_told(suite) -> None:
    """As many descriptors are open as before."""
    result = suite("""
import os

@pytest.fixture(scope="module")
def number():
    opened = os.open("/dev/null", os.O_RDONLY)
    yield opened
    os.close(opened)

async def test_exchanges(number, actor_system):
    os.close(number)
    assert os.open(__file__, os.O_RDONLY) == number

async def test_does_nothing(number, actor_system): ...
""")
    result.assert_outcomes(passed=2, errors=1)
    result.stdout.fnmatch_lines(["*a descriptor was left open: /*/test_*.py*"])


def test_what_is_no_message_is_refused_as_it_is_without_the_guard(suite) -> None:
    """The class of a message, too, whose class is no struct."""
    result = suite("""
async def refusals(counter, what):
    told = []
    for way in ("tell", "ask", "send"):
        with pytest.raises(hf.errors.HoldfastError) as error:
            await getattr(counter, way)(what)
        told.append(repr(error.value))
    return told

@pytest.mark.parametrize("what", [Add, 5, None, [Add(1)], Add(1).__class__.__class__])
async def test_sends(actor_system, what):
    async with hf.ActorSystem(log=False) as plain:
        both = [system.spawn(hf.start(Counter), "counter") for system in (actor_system, plain)]
        guarded, unguarded = [await refusals(counter, what) for counter in both]
    assert guarded == unguarded
""")
    result.assert_outcomes(passed=5)


def test_a_simulated_test_is_guarded_alike(suite) -> None:
    result = suite("""
from holdfast.testing import simulate

async def fail():
    raise RuntimeError("boom")

@simulate(seeds=1)
async def test_timer(system):
    asyncio.get_running_loop().call_later(100, print)

@simulate(seeds=1)
async def test_exception(system):
    kept.append(asyncio.ensure_future(fail()))
    await asyncio.sleep(1)

@pytest.mark.holdfast(exceptions=True, leaks="timers")
@simulate(seeds=1)
async def test_both(system):
    asyncio.get_running_loop().call_later(100, print)
    kept.append(asyncio.ensure_future(fail()))
    await asyncio.sleep(1)

@simulate(seeds=1)
async def test_reply(system):
    shelf = system.spawn(hf.start(Shelf), "shelf")
    (await shelf.ask(Items())).append(5)

kept = []
""")
    result.assert_outcomes(passed=1, failed=3)
    result.stdout.fnmatch_lines_random([
        "*a timer was left: builtins.print*",
        "*an exception was never seen: RuntimeError: boom*",
        "*from /app/shelf to the test, for Items()*",
    ])  # fmt: skip
