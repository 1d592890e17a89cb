"""Actor classes: what `@on` checks, which handler gets a message, what a life has (DESIGN 3)."""

import functools
import types
from typing import Any, cast

import pytest

import holdfast as hf


class Add(hf.Message[int]):
    n: int


class AddTwice(Add): ...


class AddThrice(AddTwice): ...


class Read(hf.Message[int]): ...


class Stranger(hf.Message[None]): ...


class Refused(hf.Refusal):
    why: str


class Counter(hf.Actor):
    def __init__(self, value: int = 0) -> None:
        self.value = value
        self.seen: list[str] = []

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        self.seen.append(type(message).__name__)
        self.value += message.n
        return self.value

    @hf.on(Read, readonly=True)
    def read(self, message: Read) -> int:
        return self.value


class Doubling(Counter):
    @hf.on(AddTwice)
    def add_twice(self, message: AddTwice) -> int:
        self.value += 2 * message.n
        return self.value


class Overriding(Counter):
    @hf.on(Add)
    async def add(self, message: Add) -> int:
        return -1


async def test_sync_and_async_handlers_answer(system: hf.ActorSystem) -> None:
    counter = system.spawn(hf.start(Counter, 3))
    assert await counter.ask(Add(4)) == 7
    assert await counter.ask(Read()) == 7


async def test_a_derived_message_goes_to_the_handler_of_the_nearest_base(system: hf.ActorSystem) -> None:
    plain, doubling = system.spawn(hf.start(Counter)), system.spawn(hf.start(Doubling))
    assert await plain.ask(AddThrice(1)) == 1
    assert await doubling.ask(AddThrice(1)) == 2
    assert await doubling.ask(Add(1)) == 3


async def test_a_derived_actor_inherits_and_overrides_handlers(system: hf.ActorSystem) -> None:
    overriding = system.spawn(hf.start(Overriding, 5))
    assert await overriding.ask(Add(1)) == -1
    assert await overriding.ask(Read()) == 5


@pytest.mark.parametrize("base", [Counter, type("Mixin", (), {"add": Counter.add})], ids=["an actor", "a mixin"])
def test_what_stands_in_the_place_of_a_handler_is_one_or_says_that_there_is_none(base: type) -> None:
    bases = (base,) if issubclass(base, hf.Actor) else (base, hf.Actor)

    def add(self: object, message: Add) -> int:
        return -1

    with pytest.raises(TypeError, match=r"Silent.add stands in the place of a handler.*write @on\(Add\) above it, too"):
        type("Silent", bases, {"add": add})
    with pytest.raises(TypeError, match=r"Silent\.add stands in the place of a handler"):
        type("Silent", (type("Above", (), {"add": add}), *bases), {})
    without: Any = type("Without", bases, {"add": None})
    assert Add not in without._table


async def test_a_message_without_handler_is_refused_at_the_call_every_time(system: hf.ActorSystem) -> None:
    counter = system.spawn(hf.start(Counter))
    for _ in range(2):
        with pytest.raises(hf.UnknownMessage, match=r"@on\(Stranger\)"):
            counter.tell(Stranger())
        with pytest.raises(hf.UnknownMessage):
            counter.ask(Stranger())
        with pytest.raises(hf.UnknownMessage):
            await counter.send(Stranger())
    assert system.dead_letters == 0


@pytest.mark.pairs
@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("send", ["tell", "ask", "send"])
async def test_what_is_no_message_is_refused_with_advice(send: str, isolation: Any) -> None:
    class Any_(hf.Message[int]): ...

    async with hf.ActorSystem(log=False) as system:
        ref: Any = await system.start(hf.child("counter", hf.start(hf.Actor), isolation=isolation))
        for no_message, advice in (
            ("hello", "class MyMessage(hf.Message[...])"),
            (Any_, "send an instance, Any_(...)"),
        ):
            with pytest.raises(hf.errors.BadMessage) as caught:
                await getattr(ref, send)(no_message)  # A tell would return None, were it not refused.
            assert advice in str(caught.value)
            assert "@on(str)" not in str(caught.value)


class Babble(hf.Message[list[str]]):
    """Answered with how each way to send what is no message was refused."""


class Babbler(hf.Actor):
    to: hf.Binding[hf.Actor]

    @hf.on(Babble)
    async def babble(self, message: Babble) -> list[str]:
        to, ctx = cast("Any", self.to), cast("Any", self.ctx)
        refused: list[str] = []
        for send in (to.tell, to.send, to.ask, functools.partial(ctx.publish, "/babble")):
            for no_message in ("hello", Add):
                try:
                    sending = send(no_message)
                    if sending is not None:
                        await sending
                except hf.errors.BadMessage as error:
                    refused.append(str(error))
        return refused


@pytest.mark.pairs
@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("to", ["task", "process"])
async def test_what_an_actor_sends_that_is_no_message_is_refused_alike(to: Any, isolation: Any, recovery: Any) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("to", hf.start(Counter), isolation=to))
        spec = hf.child("from", hf.start(Babbler), isolation=isolation, recovery=recovery, bindings={"to": "/app/to"})
        refused = await (await system.start(spec)).ask(Babble(), 60)
        assert len(refused) == 8
        for error, where in zip(refused, ["/app/to"] * 6 + ["/babble"] * 2, strict=True):
            assert f"to {where}: " in error
            assert "class MyMessage(hf.Message[...])" in error or "send an instance, Add(...)" in error
        with pytest.raises(hf.errors.BadMessage, match=r"to /babble: messages are instances of a class of their own"):
            await system.publish("/babble", cast("Any", "hello"))


async def test_a_refusal_ends_the_turn_well(system: hf.ActorSystem) -> None:
    class Strict(hf.Actor):
        @hf.on(Add)
        def add(self, message: Add) -> int:
            raise Refused(why="no")

        @hf.on(Read)
        async def read(self, message: Read) -> int:
            raise Refused(why=f"life {self.ctx.life}")

    strict = system.spawn(hf.start(Strict))
    strict.tell(Add(1))  # nobody waits for the answer
    with pytest.raises(Refused, match="no"):
        await strict.ask(Add(1))
    with pytest.raises(Refused, match="life 1"):
        await strict.ask(Read())


def test_two_handlers_for_one_message_are_refused_when_the_class_is_made() -> None:
    with pytest.raises(TypeError, match="two handlers"):

        class Bad(hf.Actor):
            @hf.on(Add)
            def one(self, message: Add) -> int:
                return 1

            @hf.on(Add)
            def two(self, message: Add) -> int:
                return 2


def test_an_async_init_is_refused_when_the_class_is_made() -> None:
    with pytest.raises(TypeError, match=r"__init__ cannot be async: what has to be awaited goes into on_start"):

        class Waits(hf.Actor):
            async def __init__(self) -> None: ...  # type: ignore[misc]


def test_a_handler_whose_annotation_contradicts_is_refused_when_the_class_is_made() -> None:
    with pytest.raises(TypeError, match=r"@on\(Add\) but takes a Read"):

        class Bad(hf.Actor):
            @hf.on(Add)
            def add(self, message: Read) -> int:
                return 1


def test_a_handler_annotated_with_a_base_of_the_message_is_fine() -> None:
    class Good(hf.Actor):
        @hf.on(AddTwice)
        def add(self, message: Add) -> int:
            return 1

    assert AddTwice in Good._table


def too_few(self: Any) -> int:
    return 1


def too_many(self: Any, message: Add, more: int) -> int:
    return 1


@pytest.mark.parametrize("handler", [too_few, too_many])
def test_a_handler_takes_self_and_the_message_and_nothing_else(handler: Any) -> None:
    with pytest.raises(TypeError, match="self and the message"):
        type("Bad", (hf.Actor,), {"add": hf.on(Add)(handler)})


@pytest.mark.parametrize("kind", [int, hf.Actor, Add(1), None, "Add"])
def test_on_takes_a_message_class(kind: Any) -> None:
    with pytest.raises(TypeError, match="Message class"):
        hf.on(kind)


def test_readonly_handlers_are_known_by_message() -> None:
    for kind in (Counter, Doubling):
        assert {one for one, declared in kind._declared.items() if declared.readonly} == {Read}


def test_a_recipe_takes_an_actor_class() -> None:
    with pytest.raises(TypeError, match="Actor class"):
        hf.start(int)  # type: ignore[type-var]


async def test_ctx_is_there_before_init(system: hf.ActorSystem) -> None:
    class Early(hf.Actor):
        def __init__(self) -> None:
            self.value = len(self.ctx.path)

        @hf.on(Read)
        def read(self, message: Read) -> int:
            return self.value

    assert await system.spawn(hf.start(Early), "four").ask(Read()) == len("/t/four")


async def test_random_and_uuid_follow_from_the_system_s_seed() -> None:
    class Dice(hf.Actor):
        @hf.on(Read)
        def read(self, message: Read) -> int:
            return self.ctx.random.randrange(10**9) + self.ctx.uuid().int

    async def draw(seed: int) -> list[int]:
        async with hf.ActorSystem("t", log=False, seed=seed) as system:
            return [await system.spawn(hf.start(Dice)).ask(Read()) for _ in range(2)]

    first, again, other = await draw(1), await draw(1), await draw(2)
    assert first == again != other
    assert first[0] != first[1]


class Asker(hf.Actor):
    counter: hf.Binding[Counter]

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        return await self.counter.ask(message)

    @hf.on(Read)
    def read(self, message: Read) -> int:
        setattr(self, "counter", None)  # noqa: B010 - the checkers refuse the plain form
        return 0


async def test_a_binding_gives_a_ref_and_can_be_pointed_elsewhere(system: hf.ActorSystem) -> None:
    one, two = system.spawn(hf.start(Counter, 10)), system.spawn(hf.start(Counter, 20))
    asker = system.spawn(hf.start(Asker))
    system.bind(asker, "counter", one)
    assert await asker.ask(Add(1)) == 11
    system.bind(asker, "counter", two)
    assert await asker.ask(Add(1)) == 21


async def test_an_unbound_port_is_named(system: hf.ActorSystem) -> None:
    asker = system.spawn(hf.start(Asker))
    with pytest.raises(hf.RemoteCrash, match=r"counter is not bound") as crash:
        await asker.ask(Add(1))
    assert crash.value.type_name.endswith("Unbound")


async def test_only_the_runtime_sets_a_binding(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.RemoteCrash, match="set by the runtime"):
        await system.spawn(hf.start(Asker)).ask(Read())


async def test_binding_an_unknown_port_says_which_there_are(system: hf.ActorSystem) -> None:
    asker = system.spawn(hf.start(Asker))
    with pytest.raises(hf.SpecError, match="counter"):
        system.bind(asker, "meter", asker)


async def test_a_derived_class_inherits_its_bindings(system: hf.ActorSystem) -> None:
    class More(Asker): ...

    more = system.spawn(hf.start(More))
    system.bind(more, "counter", system.spawn(hf.start(Counter, 1)))
    assert await more.ask(Add(1)) == 2


async def test_a_message_whose_class_was_defined_anew_is_told_apart(system: hf.ActorSystem) -> None:
    """As in a notebook, whose cell runs again: the actor knows the class of before."""
    counter = system.spawn(hf.start(Counter))
    names = {"__module__": Add.__module__, "__qualname__": Add.__qualname__}
    anew = types.new_class("Add", (hf.Message[int],), {}, lambda body: body.update(names))
    with pytest.raises(hf.UnknownMessage, match=r"Add of before: .*Add was defined anew") as unknown:
        counter.tell(anew())
    assert unknown.value.is_anew
