"""Names and addresses: who is found where (DESIGN 2; otp.md 1.13 "names", W16)."""

from typing import Any

import pytest

import holdfast as hf


class Do(hf.Message[Any]):
    work: Any


class One(hf.Actor):
    @hf.on(Do)
    def do(self, message: Do) -> Any:
        return message.work(self)


class Special(One): ...


class Other(hf.Actor): ...


async def test_a_registered_name_finds_its_actor(system: hf.ActorSystem) -> None:
    one = system.spawn(hf.start(One))
    system.register("leader", one)
    assert system.whereis("leader") == one


async def test_a_name_has_one_holder(system: hf.ActorSystem) -> None:
    one, other = system.spawn(hf.start(One)), system.spawn(hf.start(One))
    system.register("leader", one)
    with pytest.raises(hf.errors.NameTaken, match="leader"):
        system.register("leader", other)
    system.register("leader", one)  # again, by its holder: fine
    assert system.whereis("leader") == one


async def test_an_actor_may_have_several_names(system: hf.ActorSystem) -> None:
    one = system.spawn(hf.start(One))
    for name in ("a", "b"):
        system.register(name, one)
    system.unregister("a")
    with pytest.raises(hf.errors.NoSuchActor):
        system.whereis("a")
    assert system.whereis("b") == one


async def test_names_end_with_the_life(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(One)))
    system.register("leader", one)
    with pytest.raises(hf.RemoteCrash):
        await one.ask(Do(lambda _: 1 / 0))
    assert await one.ask(Do(lambda actor: actor.ctx.life)) == 2
    with pytest.raises(hf.errors.NoSuchActor, match=r"^no actor has the name 'leader'$"):
        system.whereis("leader")


async def test_the_end_of_a_former_holder_is_nothing_to_the_present_one(system: hf.ActorSystem) -> None:
    former, present = system.spawn(hf.start(One)), system.spawn(hf.start(One))
    for _ in range(2):
        system.register("leader", former)
    system.unregister("leader")
    system.register("leader", present)
    await system.stop(former)
    assert system.whereis("leader") == present


async def test_the_dead_cannot_be_registered(system: hf.ActorSystem) -> None:
    one = system.spawn(hf.start(One))
    await system.stop(one)
    with pytest.raises(hf.ActorStopped):
        system.register("leader", one)
    system.unregister("leader")  # unknown: fine


async def test_a_ref_is_found_by_address_and_class(system: hf.ActorSystem) -> None:
    special = system.spawn(hf.start(Special), "special")
    assert system.ref("/t/special", Special) == system.ref("/t/special", One) == special
    with pytest.raises(hf.errors.WrongActor) as wrong:
        system.ref("/t/special", Other)
    assert (wrong.value.actor, wrong.value.expected.rpartition(".")[2]) == ("/t/special", "Other")


@pytest.mark.parametrize("path", ["/t/nobody", "/t/one/below", "/else", "/tt/one", "one", "", "/t/one/"])
async def test_nobody_lives_at_other_addresses(system: hf.ActorSystem, path: str) -> None:
    system.spawn(hf.start(One), "one")
    with pytest.raises(hf.errors.NoSuchActor):
        system.ref(path, One)


async def test_an_address_is_unique_among_the_living_and_free_after_an_end(system: hf.ActorSystem) -> None:
    one = system.spawn(hf.start(One), "one")
    with pytest.raises(hf.errors.NameTaken, match="/t/one"):
        system.spawn(hf.start(One), "one")
    one.kill()
    await system._node.settled()
    again = system.spawn(hf.start(One), "one")
    assert again == one  # refs compare by address
    assert await one.ask(Do(lambda actor: actor.ctx.path)) == "/t/one"


async def test_actors_without_a_name_get_one_each(system: hf.ActorSystem) -> None:
    paths = {system.spawn(hf.start(One)).path for _ in range(10)}
    assert len(paths) == 10


@pytest.mark.parametrize("name", ["a/b", "/", ""])
async def test_a_name_is_text_without_a_slash(system: hf.ActorSystem, name: str) -> None:
    with pytest.raises(hf.SpecError, match="without '/'"):
        system.spawn(hf.start(One), name)
    with pytest.raises(hf.SpecError):
        hf.ActorSystem(name)


async def test_children_live_below_their_parent(system: hf.ActorSystem) -> None:
    one = system.spawn(hf.start(One), "one")
    child: hf.ActorRef[One] = await one.ask(Do(lambda actor: actor.ctx.spawn(hf.start(One), "child")))
    assert child.path == "/t/one/child"
    assert system.tree() == ["/t", "/t/one", "/t/one/child"]
    with pytest.raises(hf.RemoteCrash, match="exists already"):
        await one.ask(Do(lambda actor: actor.ctx.spawn(hf.start(One), "child")))
