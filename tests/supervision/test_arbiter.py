"""One arbiter: an actor is in the hands of its supervisor, of failover, or of repair, never of two (T63)."""

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

import holdfast as hf
from holdfast.supervision.arbiter import Arbiter, Grant, GrantLost, Hand, InOtherHands, arbiter_of, covers, on_errand

REPAIR, FAILOVER, ADAPTATION = Hand.REPAIR, Hand.FAILOVER, Hand.ADAPTATION


class Boom(hf.Message):
    """End with an error."""


class Worker(hf.Actor):
    @hf.on(Boom)
    def _boom(self, message: Boom) -> None:
        raise RuntimeError("boom")


def arbiter(now: list[float] | None = None) -> Arbiter:
    times = now or [0.0]
    return Arbiter(lambda: times[0])


def test_two_do_not_hold_one_actor() -> None:
    judge = arbiter()
    grant = judge.claim("/app/a", REPAIR, "it is slow")
    with pytest.raises(InOtherHands, match=r"/app/a is in the hands of repair: it is slow"):
        judge.claim("/app/a", REPAIR, "me too")
    judge.release(grant)
    assert judge.claim("/app/a", REPAIR, "me too").epoch > grant.epoch


@pytest.mark.parametrize("other", ["/app", "/app/a", "/app/a/b"])
def test_a_grant_covers_what_is_below_and_excludes_what_is_above(other: str) -> None:
    judge = arbiter()
    judge.claim("/app/a", REPAIR, "")
    with pytest.raises(InOtherHands):
        judge.claim(other, REPAIR, "")
    judge.claim("/app/ab", REPAIR, "a neighbour")


def test_failover_goes_before_repair() -> None:
    judge, heard = arbiter(), list[str]()
    mended = judge.claim("/app/a", REPAIR, "slow", lost=heard.append)
    moved = judge.claim("/app/a", FAILOVER, "its node is gone")
    assert heard == ["failover has it now: its node is gone"]
    with pytest.raises(GrantLost):
        judge.check(mended)
    judge.check(moved)
    judge.release(mended)  # nothing is left to give back
    assert judge.holder("/app/a") == moved
    with pytest.raises(InOtherHands, match="failover"):
        judge.claim("/app/a", REPAIR, "slow")


@pytest.mark.parametrize(("first", "second"), [(REPAIR, ADAPTATION), (ADAPTATION, REPAIR), (ADAPTATION, ADAPTATION)])
def test_of_repair_and_adaptation_the_first_one_has_the_actor(first: Hand, second: Hand) -> None:
    judge, heard = arbiter(), list[str]()
    grant = judge.claim("/app/a", first, "it is slow", lost=heard.append)
    busy = judge.in_the_way("/app/a", second)
    assert str(busy) == f"/app/a is in the hands of {first.name.lower()}: it is slow"
    with pytest.raises(InOtherHands):
        judge.claim("/app/a", second, "me too")
    judge.check(grant)
    judge.release(grant)
    assert judge.in_the_way("/app/a", second) is None
    judge.claim("/app/a", second, "me too")
    assert heard == []


def test_an_adaptation_rests_while_a_failover_is_at_it_and_repair_does_not_come_between() -> None:
    judge, heard = arbiter(), list[str]()
    changed = judge.claim("/app/a", ADAPTATION, "another mechanism", lost=heard.append)
    moved = judge.claim("/app/a", FAILOVER, "its primary is gone")
    judge.check(changed)
    judge.release(moved)
    with pytest.raises(InOtherHands, match="adaptation"):
        judge.claim("/app/a", REPAIR, "slow")
    moved = judge.claim("/app/a", FAILOVER, "again")
    judge.release(changed)
    with pytest.raises(InOtherHands, match="failover"):
        judge.claim("/app/a", REPAIR, "slow")
    assert judge.claim("/app/a", ADAPTATION, "a third one").epoch > moved.epoch
    assert heard == []


def test_what_is_done_on_one_errand_does_not_exclude_itself() -> None:
    """A repair step has a mechanism changed: failover takes both from it."""
    judge, heard, step = arbiter(), list[str](), object()
    judge.claim("/app/a", REPAIR, "its values are wrong", lost=heard.append, errand=step)
    token = on_errand.set(step)
    try:
        changed = judge.claim("/app/a", ADAPTATION, "another mechanism")
    finally:
        on_errand.reset(token)
    with pytest.raises(InOtherHands, match="repair"):
        judge.claim("/app/a", ADAPTATION, "another one's", errand=object())
    with pytest.raises(InOtherHands):
        judge.claim("/app/a", REPAIR, "nobody's")
    judge.claim("/app/a", FAILOVER, "its primary is gone")
    assert heard == ["failover has it now: its primary is gone"]
    judge.check(changed)  # It rests; who has begun it is told.


def test_a_lease_ends_by_itself() -> None:
    now, heard = [0.0], list[str]()
    judge = arbiter(now)
    grant = judge.claim("/app/a", REPAIR, "", seconds=5.0, lost=heard.append)
    now[0] = 5.0
    judge.check(grant)
    now[0] = 5.1
    with pytest.raises(GrantLost, match="its time is up"):
        judge.check(grant)
    judge.claim("/app/a", REPAIR, "the next one")
    assert heard == ["its time is up"]


def test_a_block_gives_it_back_even_if_it_raises() -> None:
    judge = arbiter()
    with pytest.raises(ZeroDivisionError), judge.held("/app/a", REPAIR, ""):
        raise ZeroDivisionError
    assert judge.holder("/app/a") is None


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["/a", "/a/b", "/a/b/c", "/a/d", "/e"]), st.sampled_from([REPAIR, FAILOVER]), st.booleans()
        )
    )
)
def test_whatever_is_asked_no_two_grants_that_count_overlap(asks: list[tuple[str, Hand, bool]]) -> None:
    judge, made = arbiter(), list[Grant]()
    for address, hand, gives_back in asks:
        try:
            made.append(judge.claim(address, hand, ""))
        except InOtherHands:
            if gives_back and made:
                judge.release(made.pop(0))
        valid = [grant for grant in made if _counts(judge, grant)]
        for one in valid:
            for other in valid:
                assert one is other or not (covers(one.address, other.address) or covers(other.address, one.address))
    assert [one.epoch for one in made] == sorted({one.epoch for one in made})


def _counts(judge: Arbiter, grant: Grant) -> bool:
    try:
        judge.check(grant)
    except GrantLost:
        return False
    return True


async def test_a_system_has_one_arbiter() -> None:
    async with hf.ActorSystem("t", log=False) as system:
        assert arbiter_of(system._node) is arbiter_of(system._node)


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_supervisor_that_restarts_a_child_has_it() -> None:
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        backoff = hf.Backoff(initial=10.0, maximum=10.0, jitter=0.0)
        spec = hf.supervisor("s", children=[hf.child("w", hf.start(Worker), backoff=backoff)])
        await system.start(spec)
        judge = arbiter_of(system._node)
        system.ref("/t/s/w", Worker).tell(Boom())
        await asyncio.sleep(1.0)
        for address in ("/t/s/w", "/t/s", "/t"):
            with pytest.raises(InOtherHands, match="its supervisor"):
                judge.claim(address, REPAIR, "slow")
        judge.release(judge.claim("/t/s/w", FAILOVER, "goes first"))
        await asyncio.sleep(15.0)
        judge.claim("/t/s/w", REPAIR, "it is back, and slow")


async def test_repair_loses_an_actor_that_crashes_in_its_hands() -> None:
    async with hf.ActorSystem("t", log=False) as system:
        await system.start(hf.supervisor("s", intensity=3, children=[hf.child("w", hf.start(Worker))]))
        judge = arbiter_of(system._node)
        lost = asyncio.get_running_loop().create_future()
        grant = judge.claim("/t/s/w", REPAIR, "slow", lost=lost.set_result)
        system.ref("/t/s/w", Worker).tell(Boom())
        async with asyncio.timeout(20):
            assert "its supervisor restarts /t/s/w" in await lost
        with pytest.raises(GrantLost):
            judge.check(grant)


async def test_what_repair_has_a_supervisor_do_does_not_take_it_away() -> None:
    async with hf.ActorSystem("t", log=False) as system:
        await system.start(hf.supervisor("s", children=[hf.child("w", hf.start(Worker))]))
        judge, keeper = arbiter_of(system._node), system.ref("/t/s", hf.Supervisor)
        grant = judge.claim("/t/s/w", REPAIR, "slow")
        await keeper.ask(hf.TerminateChild("w"))
        await keeper.ask(hf.RestartChild("w"))
        judge.check(grant)
