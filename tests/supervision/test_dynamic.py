"""Dynamic supervisors (otp.md 1.14 DynamicSupervisor; 1.1 to 1.9 simple_one_for_one)."""

import asyncio
import dataclasses
import enum
import re
from typing import Any

import msgspec
import pytest

import holdfast as hf
from holdfast.actors.kernel.codec import Packed
from holdfast.actors.process.wire import start_codec
from holdfast.actors.values import encode_value
from tests.supervision.family import Boom, Family, Leave, Life, Plan, kid, refused

virtual = pytest.mark.asyncio(loop_factories=["virtual"])
SLOW = hf.Backoff(initial=60.0, maximum=60.0, jitter=0.0)


class Sum(hf.Message[int]): ...


class Adder(hf.Actor):
    def __init__(self, *numbers: int, factor: int = 1, stop_seconds: float = 0.0) -> None:
        self.numbers, self.factor, self.stop_seconds = numbers, factor, stop_seconds

    async def on_stop(self, reason: hf.ExitReason) -> None:
        await asyncio.sleep(self.stop_seconds)

    @hf.on(Sum)
    def sum(self, message: Sum) -> int:
        return sum(self.numbers) * self.factor

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")


async def begin(
    system: hf.ActorSystem, *, intensity: int = 9, **options: Any
) -> hf.ActorRef[hf.supervision.DynamicSupervisor]:
    return await system.start(hf.dynamic("top", intensity=intensity, **options))


def id_of(ref: hf.ActorRef[Any] | None) -> str:
    assert ref is not None
    return ref.path.rpartition("/")[2]


async def test_it_starts_empty_and_takes_specs_and_bare_starts() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        assert await top.ask(hf.WhichChildren()) == []
        given = await top.ask(hf.StartChild(hf.child("given", hf.start(Adder, 1))))
        made_up = await top.ask(hf.StartChild(hf.start(Adder, 2)))
        nameless = await top.ask(hf.StartChild(hf.child(None, hf.start(Adder, 3), restart="temporary")))
        by_id = await top.ask(hf.StartChild(hf.start(Adder, 4), id="four"))
        refs = (given, made_up, nameless, by_id)
        assert (given.path, by_id.path) == ("/app/top/given", "/app/top/four")
        first, second = (re.fullmatch(r"/app/top/(adder-\w+-)(\d+)", ref.path) for ref in (made_up, nameless))
        assert first is not None
        assert second is not None
        assert (first[1], int(first[2]) + 1) == (second[1], int(second[2]))
        assert [await ref.ask(Sum()) for ref in refs] == [1, 2, 3, 4]
        assert await top.ask(hf.supervision.CountChildren()) == hf.supervision.ChildCounts(4, 4, 0, 4)


async def test_an_id_that_lives_is_refused_with_its_ref_and_free_again_when_it_has_ended() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        family = Family(system, plan)
        ref = await top.ask(hf.StartChild(kid(plan, "a", restart="transient")))
        assert await refused(top.ask(hf.StartChild(kid(plan, "a")))) == hf.errors.AlreadyStarted("a", ref)
        await family.after("a", Leave())
        assert await top.ask(hf.StartChild(kid(plan, "a"))) == ref


async def test_a_child_that_is_not_restarted_is_forgotten() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        family = Family(system, plan)
        for restart in ("permanent", "transient", "temporary"):
            await top.ask(hf.StartChild(kid(plan, restart, restart=restart)))
        for name in ("permanent", "transient", "temporary"):
            await family.after(name, Leave())
        assert await family.states() == {"permanent": "running"}
        assert await family.ref("permanent").ask(Life()) == 2


async def test_those_that_have_ended_are_listed_until_they_are_started_again_or_deleted() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        options: dict[str, Any] = {"restart": "temporary", "recovery": hf.hybrid()}
        specs = {name: hf.child(name, hf.start(Adder), **options) for name in ("a", "b", "c")}

        async def ended() -> list[tuple[str, str, bool]]:
            told = await top.ask(hf.supervision.EndedChildren())
            assert [one.path for one in told] == [f"{top.path}/{one.id}" for one in told]
            return [(one.id, one.reason, one.is_recorded) for one in told]

        refs = {name: await top.ask(hf.StartChild(spec)) for name, spec in specs.items()}
        assert await ended() == []
        await top.ask(hf.TerminateChild("b"))
        with pytest.raises(hf.RemoteCrash):
            await refs["a"].ask(Boom())
        while len(await ended()) < 2:
            pass
        refs["c"].kill()
        while len(await ended()) < 3:
            pass
        crash = "ValueError: boom"
        assert await ended() == [("b", "shutdown", True), ("a", crash, True), ("c", "killed", True)]
        await top.ask(hf.StartChild(specs["b"]))
        await top.ask(hf.DeleteChild("a"))
        assert await ended() == [("c", "killed", True)]


async def test_so_many_that_have_ended_are_listed_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holdfast.supervision.supervisor.ENDED", 2)
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        for name in "abc":
            await top.ask(hf.StartChild(hf.child(name, hf.start(Adder))))
            await top.ask(hf.TerminateChild(name))
        assert [one.id for one in await top.ask(hf.supervision.EndedChildren())] == ["b", "c"]


async def test_a_crash_restarts_that_child_only_with_its_arguments() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        one, other = [await top.ask(hf.StartChild(hf.start(Adder, number))) for number in (1, 2)]
        one.tell(Boom())
        assert (await one.ask(Sum()), await other.ask(Sum())) == (1, 2)
        assert (one._cell.life, other._cell.life) == (2, 1)


async def test_one_intensity_for_all_children() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, intensity=2, restart="temporary")
        family = Family(system, plan)
        for name in "abc":
            await top.ask(hf.StartChild(kid(plan, name)))
        for name in "abc":
            await family.after(name, Boom())
        assert not family.is_alive


# -- max_children ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("most", [0, 1, 2])
async def test_no_more_than_max_children(most: int) -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, max_children=most)
        refs = [await top.ask(hf.StartChild(hf.start(Adder))) for _ in range(most)]
        assert await refused(top.ask(hf.StartChild(hf.start(Adder)))) == hf.errors.MaxChildren(most)
        if refs:
            await top.ask(hf.TerminateChild(id_of(refs[0])))
            await top.ask(hf.StartChild(hf.start(Adder)))


@virtual
async def test_children_that_are_being_restarted_count() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, max_children=1)
        family = Family(system, plan)
        await top.ask(hf.StartChild(kid(plan, "a", backoff=SLOW)))
        await family.after("a", Boom())
        assert await family.states() == {"a": "restarting"}
        assert await refused(top.ask(hf.StartChild(hf.start(Adder)))) == hf.errors.MaxChildren(1)
        assert isinstance(await refused(top.ask(hf.StartChild(kid(plan, "a")))), hf.errors.AlreadyStarted)
        await top.ask(hf.TerminateChild("a"))  # Which cancels the restart.
        await top.ask(hf.StartChild(hf.start(Adder), id="b"))
        await asyncio.sleep(1000.0)
        assert await family.states() == {"b": "running"}


async def test_a_changed_max_children_holds_and_those_who_live_stay() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        for _ in range(3):
            await top.ask(hf.StartChild(hf.start(Adder)))
        await top.ask(hf.supervision.ChangeSupervisor(hf.supervision.Flags(max_children=1)))
        assert await refused(top.ask(hf.StartChild(hf.start(Adder)))) == hf.errors.MaxChildren(1)
        assert len(await top.ask(hf.WhichChildren())) == 3


async def test_a_failed_start_leaves_nothing_behind() -> None:
    plan = Plan()
    plan.todo["a"] = ["fail"]
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, max_children=1, intensity=0)
        assert isinstance(await refused(top.ask(hf.StartChild(kid(plan, "a")))), hf.StartFailed)
        assert await top.ask(hf.WhichChildren()) == []
        assert system.tree() == ["/app", "/app/top"]
        await top.ask(hf.StartChild(kid(plan, "a")))


# -- admin calls ----------------------------------------------------------------------------------------------------


async def test_terminate_forgets_and_a_second_time_there_is_nobody() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        ref = await top.ask(hf.StartChild(hf.start(Adder)))
        name = id_of(ref)
        calls: list[hf.Message[Any]] = [hf.RestartChild(name), hf.DeleteChild(name)]
        for call in calls:
            assert isinstance(await refused(top.ask(call)), hf.errors.NotSupported)
        await top.ask(hf.TerminateChild(name))
        for call in [hf.TerminateChild(name), *calls]:
            assert await refused(top.ask(call)) == hf.errors.NoSuchChild(name)
        with pytest.raises(hf.ActorStopped):
            await ref.ask(Sum())


async def test_the_system_stops_a_dynamic_child_like_any_other() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        await system.stop(await top.ask(hf.StartChild(hf.start(Adder))))
        assert await top.ask(hf.WhichChildren()) == []


@pytest.mark.parametrize("spec", ["x", None, 7])
async def test_something_else_is_refused_and_the_supervisor_lives(spec: Any) -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        assert isinstance(await refused(top.ask(hf.StartChild(spec))), hf.SpecError)
        assert await top.ask(hf.WhichChildren()) == []


async def test_what_does_not_go_with_dynamic_children_is_refused() -> None:
    significant = hf.child("a", hf.start(Adder), restart="transient", significant=True)
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        for call in (
            hf.StartChild(significant),
            hf.StartChild(args=(1,)),
            hf.supervision.ChangeSupervisor(hf.supervision.Flags(auto_shutdown="any_significant")),
            hf.supervision.ChangeSupervisor(hf.supervision.Flags(strategy="one_for_all")),
            hf.supervision.ChangeSupervisor(children=[hf.child("a", hf.start(Adder)), hf.child("b", hf.start(Adder))]),
        ):
            assert isinstance(await refused(top.ask(call)), hf.SpecError)
        assert await top.ask(hf.StartChild(hf.start(Adder))) is not None
    for most in (-1, 1.5, True, "many"):
        with pytest.raises(hf.SpecError, match="dynamic 'top': max_children must be a whole number"):
            hf.dynamic("top", max_children=most)  # type: ignore[arg-type]
    with pytest.raises(hf.SpecError, match="only children of a dynamic supervisor can go without an id"):
        hf.supervisor("top", children=[hf.child(None, hf.start(Adder))])


# -- shutdown -------------------------------------------------------------------------------------------------------


@virtual
async def test_all_children_are_stopped_at_once() -> None:
    """otp.md 1.7: in parallel, each with its own time; a killed one is reported."""
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        for seconds, shutdown in ((4.0, 5.0), (3.0, "infinity"), (100.0, 2.0), (100.0, 4.5), (100.0, "brutal_kill")):
            spec = hf.child(None, hf.start(Adder, stop_seconds=seconds), shutdown=shutdown)  # type: ignore[arg-type]
            await top.ask(hf.StartChild(spec))
        with system.events() as events:
            await system.stop(top)
            errors = [event for event in events.take() if isinstance(event, hf.events.ShutdownError)]
        assert asyncio.get_running_loop().time() == 4.5
        assert [(error.address[-1], str(error.reason)) for error in errors] == [("3", "killed"), ("4", "killed")]
        assert system.tree() == ["/app"]


async def test_dynamic_children_are_lost_when_their_supervisor_is_restarted() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, intensity=0)
        family = Family(system, plan)
        await top.ask(hf.StartChild(kid(plan, "a")))
        await family.after("a", Boom())
        assert await family.states() == {}


# -- templates ------------------------------------------------------------------------------------------------------


async def test_a_template_takes_the_rest_of_the_arguments() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, template=hf.child(None, hf.start(Adder, 100), restart="transient"), max_children=3)
        refs = [
            await top.ask(hf.StartChild(args=(1, 2))),
            await top.ask(hf.StartChild(kwargs={"factor": 2})),
            await top.ask(hf.StartChild(args=(5,), id="five")),
        ]
        assert [id_of(ref).partition("-")[0] for ref in refs] == ["adder", "adder", "five"]
        assert [await ref.ask(Sum()) for ref in refs] == [103, 200, 105]
        refs[0].tell(Boom())
        assert await refs[0].ask(Sum()) == 103, "restarted with the arguments it was started with"
        assert (await top.ask(hf.supervision.GetChildSpec("five"))).restart == "transient"
        assert await refused(top.ask(hf.StartChild())) == hf.errors.MaxChildren(3)


async def test_a_template_with_an_id_names_its_children_by_it() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, template=hf.child("worker", hf.start(Adder)))
        assert id_of(await top.ask(hf.StartChild())).startswith("worker-")


async def test_what_does_not_fit_a_template_is_refused() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, template=hf.child(None, hf.start(Adder)))
        for call in (hf.StartChild(hf.start(Adder)), hf.StartChild(kwargs={"colour": "red"})):
            assert isinstance(await refused(top.ask(call)), hf.SpecError)
        assert await top.ask(hf.WhichChildren()) == []


async def test_a_changed_template_is_for_those_to_come() -> None:
    """otp.md 1.10."""
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, template=hf.child(None, hf.start(Adder, 1)))
        old = await top.ask(hf.StartChild())
        await top.ask(hf.supervision.ChangeSupervisor(children=[hf.child(None, hf.start(Adder, 2))]))
        new = await top.ask(hf.StartChild())
        old.tell(Boom())
        assert (await old.ask(Sum()), await new.ask(Sum())) == (1, 2)


@pytest.mark.parametrize("whose", ["its own", "its supervisor's"])
async def test_a_changed_template_lasts_when_the_supervisor_is_restarted(whose: str) -> None:
    async with hf.ActorSystem(log=False) as system:
        inner = hf.dynamic("inner", template=hf.child(None, hf.start(Adder, 1)))
        top = await system.start(hf.supervisor("top", children=[inner], intensity=9))
        ref = system.ref(f"{top.path}/inner", hf.supervision.DynamicSupervisor)
        flags = hf.supervision.Flags(max_children=2)
        await ref.ask(hf.supervision.ChangeSupervisor(flags, [hf.child(None, hf.start(Adder, 2))]))
        for _ in range(2):
            with system.events() as events:
                (ref if whose == "its own" else top).kill()
                while (await events.until(hf.events.ActorStarted)).address != ref.path:
                    pass
            one = await ref.ask(hf.StartChild())
            assert await one.ask(Sum()) == 2
            await ref.ask(hf.StartChild())
            assert isinstance(await refused(ref.ask(hf.StartChild())), hf.errors.MaxChildren)


class Pool(hf.supervision.DynamicSupervisor):
    """A dynamic supervisor as a class."""

    def __init__(self, most: int) -> None:
        self.most = most

    def init(self) -> hf.Plan:
        return hf.Plan([hf.child(None, hf.start(Adder, 7))], max_children=self.most)


async def test_a_derived_class_says_it_in_init() -> None:
    async with hf.ActorSystem(log=False) as system:
        pool = await system.start(hf.child("pool", hf.start(Pool, 1)))
        assert await (await pool.ask(hf.StartChild())).ask(Sum()) == 7
        assert await refused(pool.ask(hf.StartChild())) == hf.errors.MaxChildren(1)


# -- processes ------------------------------------------------------------------------------------------------------


async def test_children_in_processes_and_a_whole_pool_in_a_process() -> None:
    async with hf.ActorSystem(log=False, intensity=9) as system:
        top = await begin(system, template=hf.child(None, hf.start(Adder, 1), isolation="process"))
        ref = await top.ask(hf.StartChild(args=(2,)))
        assert await ref.ask(Sum()) == 3
        assert system.pid_of(ref) != system.pid_of(top)
        remote = await system.start(hf.dynamic("far", isolation="process", max_children=2))
        first = await remote.ask(hf.StartChild(hf.child("first", hf.start(Adder, 4))))
        second = await remote.ask(hf.StartChild(hf.start(Adder, 5)))
        assert (await first.ask(Sum()), await second.ask(Sum())) == (4, 5)
        assert system.pid_of(first) == system.pid_of(remote)
        assert await refused(remote.ask(hf.StartChild(hf.start(Adder)))) == hf.errors.MaxChildren(2)
        far = hf.supervisor("far", children=[], isolation="process")
        error = await refused(remote.ask(hf.StartChild(far)))
        assert "cannot hold another supervisor" in str(error)
        again = await refused(remote.ask(hf.StartChild(hf.child("first", hf.start(Adder)))))
        assert again == hf.errors.AlreadyStarted("first", first)


class Hire(hf.Message[str]):
    at: hf.ActorRef[hf.Actor]
    how: str


class Boss(hf.Actor):
    """Lives in a process, and asks supervisors elsewhere, which it is bound to, for workers."""

    plain: hf.Binding[hf.Supervisor]
    pool: hf.Binding[hf.Supervisor]

    @hf.on(Hire)
    async def hire(self, message: Hire) -> str:
        if message.how == "spec":
            ask = hf.StartChild(hf.child("w", hf.start(Adder, 1)))
        else:
            ask = hf.StartChild(args=(1, 2), id="w")
        try:
            ref = await message.at.ask(ask)
        except hf.SpecError as error:
            return str(error)
        return f"{ref.path} {await ref.ask(Sum())}"


async def test_an_actor_in_a_process_starts_from_a_template_but_sends_no_code() -> None:
    """Nothing that comes from a process is imported or made in the root, so its specs are not opened there."""
    async with hf.ActorSystem(log=False) as system:
        plain = await begin(system)
        boss = await system.start(hf.child("boss", hf.start(Boss), isolation="process", bindings={"plain": plain.path}))
        assert "from an actor process is not taken here" in await boss.ask(Hire(plain, "spec"))
        assert await plain.ask(hf.WhichChildren()) == []
        pool = await system.start(hf.dynamic("pool", template=hf.child(None, hf.start(Adder))))
        system.bind(boss, "pool", pool)
        assert await boss.ask(Hire(pool, "args")) == "/app/pool/w 3"


@dataclasses.dataclass(frozen=True)
class Place:
    row: int


class Seat(msgspec.Struct, frozen=True):
    number: int
    place: Place


class Colour(enum.Enum):
    RED = "r"


class Tell(hf.Message[str]): ...


class Given(hf.Actor):
    """Says what it was given."""

    def __init__(self, *given: Any, **named: Any) -> None:
        self.given, self.named = given, named

    @hf.on(Tell)
    def tell(self, message: Tell) -> str:
        return repr((self.given, self.named))


class Bring(hf.Message[str]):
    to: hf.ActorRef[hf.Actor]
    what: str


ARGUMENTS: dict[str, Any] = {
    "struct": Seat(1, Place(2)),
    "dataclass": Place(3),
    "enum": Colour.RED,
    "tuple": (1, ("a", b"b")),
    "set": {4},
    "list": [Place(5)],
    "dict": {(1, 2): 3.0},
}


class Bringer(hf.Actor):
    pool: hf.Binding[hf.Supervisor]

    @hf.on(Bring)
    async def bring(self, message: Bring) -> str:
        value = ARGUMENTS[message.what]
        ref = await message.to.ask(hf.StartChild(args=(value,), kwargs={"it": value}))
        return await ref.ask(Tell())


@pytest.mark.parametrize("whose", ["task", "process"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_the_arguments_of_a_start_arrive_as_what_they_are(isolation: Any, whose: Any) -> None:
    template = hf.child(None, hf.start(Given))
    async with hf.ActorSystem(log=False) as system:
        pool = await system.start(hf.dynamic("pool", template=template, isolation=isolation))
        bringer = hf.child("bringer", hf.start(Bringer), isolation=whose, bindings={"pool": pool.path})
        brings = await system.start(bringer)
        for name, value in ARGUMENTS.items():
            wanted = repr(((value,), {"it": value}))
            assert await (await pool.ask(hf.StartChild(args=(value,), kwargs={"it": value}))).ask(Tell()) == wanted
            assert await brings.ask(Bring(pool, name)) == wanted
        of_refs = await pool.ask(hf.StartChild(args=((brings, [pool]),)))
        assert await of_refs.ask(Tell()) == repr((((brings, [pool]),), {}))


async def test_arguments_of_a_start_that_cannot_be_sent_are_refused_where_they_are_sent() -> None:
    async with hf.ActorSystem(log=False) as system:
        pool = await system.start(hf.dynamic("pool", template=hf.child(None, hf.start(Given)), isolation="process"))
        with pytest.raises(
            hf.errors.BadMessage, match=r"field 'args': argument\[1\]: a value of type object cannot be saved"
        ):
            await pool.ask(hf.StartChild(args=([1, object()],)))
        assert await pool.ask(hf.WhichChildren()) == []


@pytest.mark.parametrize(
    "given",
    [
        start_codec._Packed(5, (), {}),  # type: ignore[arg-type]  # as a process may say that is not ours any more
        start_codec._PackedSuccessor(5, ()),  # type: ignore[arg-type]
        start_codec._Packed(f"{__name__}:Nobody", (), {}),
        start_codec._PackedData("subprocess:Popen", {"args": "ls"}),
    ],
    ids=["no class", "no start", "nobody", "a class of its choice"],
)
async def test_arguments_from_a_process_that_lies_are_refused_and_end_nobody(given: object) -> None:
    async with hf.ActorSystem(log=False) as system:
        pool = await system.start(hf.dynamic("pool", template=hf.child(None, hf.start(Given))))
        error = await refused(pool.ask(hf.StartChild(args=(Packed(encode_value(given)),))))
        assert isinstance(error, hf.SpecError)
        assert "an argument cannot be read here" in str(error)
        assert (await system.get_status(pool)).life == 1


BEGUN: list[int] = []


class Numbered(hf.Actor):
    def __init__(self, number: int = 0) -> None:
        BEGUN.append(number)


async def test_of_hundreds_that_start_at_once_each_is_answered_when_it_is_up() -> None:
    BEGUN.clear()
    count, begun_before = 300, list[int]()
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, template=hf.child(None, hf.start(Numbered), recovery=hf.hybrid()))

        async def start(number: int) -> None:
            await top.ask(hf.StartChild(args=(number,), id=f"n{number}"), timeout=60.0)
            begun_before.append(len(BEGUN))

        await asyncio.gather(*map(start, range(count)))
    assert begun_before[0] < count / 2, f"the first was answered when {begun_before[0]} of {count} had begun"
    assert begun_before[count // 2] < count
