"""What a replica knows and decides, without a replica: rewind points and parts in hand, against naive models."""

from __future__ import annotations

from collections import deque

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from holdfast.checkpoint.protocol import FAILED, MESSAGE, OK, START, Answer, Feed, TurnEnd
from holdfast.ftm.bricks.brick_messages import Request, ServerState, StateDelta
from holdfast.ftm.bricks.state_images import Image, Misfit, image_from
from holdfast.ftm.replica.replica_life import ABANDONED, ENDED
from holdfast.ftm.replica.replica_state import (
    GIVE_UP,
    GO_ON,
    MOST_AT_ONCE,
    PART,
    REWIND,
    STOP,
    Attempts,
    BatchPart,
    ReplicaState,
    after_end,
    next_requests,
    size_after,
)
from holdfast.ftm.replica.rewind_points import (
    RewindPoints,
    before_turn,
    change_since,
    led_to,
    needs_point,
    stands_at,
    takes_delta,
)


def request(number: int, name: str = "Add", kind: str = MESSAGE) -> Request:
    return Request("", 0, Feed(number, -1, kind, name, b"", 0.0))


def end(number: int, turn: int, status: str = OK) -> TurnEnd:
    return TurnEnd(turn, number, status, [], Answer())


def value_of(state: ServerState) -> list[int]:
    """What a state stands for: the numbers in its data, and in its deltas."""
    return [*state.data.whole(), *(number for delta in state.deltas for number in delta)]


class Replicating(RuleBasedStateMachine):
    """A leader takes points, goes back, and says what has changed; a follower has to come to the very same values."""

    @initialize()
    def begin(self) -> None:
        self.points, self.value, self.turn = RewindPoints(), list[int](), -1
        self.follower: ServerState | None = None
        self.past: list[
            tuple[ServerState, list[int]]
        ] = []  # the model: every point of this life, with what it stands for
        self.number = 0
        self.compact()

    def _made(self, data: Image, deltas: list[bytes]) -> ServerState:
        return ServerState(self.turn, data, deltas, [], [], True)

    def _point(self, made: ServerState) -> None:
        self.points.go_on_to(made)
        self.past.append((made, list(self.value)))
        assert stands_at(self.points, self.turn, live=True)
        assert value_of(made) == self.value

    @rule()
    def compact(self) -> None:
        self.turn += 1
        self.value.append(self.number % 256)
        self.number += 1
        self._point(self._made(image_from(bytes(self.value)), []))

    @rule()
    def handle(self) -> None:
        before = self.points.point
        assert before is not None
        self.turn += 1
        new = self.number % 256
        self.number += 1
        self.value.append(new)
        one = request(self.number)
        self.points.keep_tail([one], [end(self.number, self.turn)])
        assert not stands_at(self.points, self.turn, live=True)
        assert takes_delta(self.points)
        self._point(self._made(before.data, [*before.deltas, bytes([new])]))
        self.points.previous = before, [one]
        assert self.points.delta_bytes == sum(map(len, self.points.point.deltas if self.points.point else ()))

    @precondition(lambda self: len(self.past) > 1)
    @rule(data=st.data())
    def go_back(self, data: st.DataObject) -> None:
        point, value = data.draw(st.sampled_from(self.past[-3:]), label="point")
        self.points.go_back_to(point)
        self.turn, self.value = point.turn, list(value)
        self.past = [one for one in self.past if one[0].turn <= point.turn]
        self.follower = None  # Whoever counted on what is undone is brought to the state anew.

    @rule(turns=st.integers(1, 3))
    def skip(self, turns: int) -> None:
        self.turn += turns
        self.points.skip_to(self.turn)
        assert self.points.point is not None
        self.past.append((self.points.point, list(self.value)))

    @rule()
    def tell(self) -> None:
        """The leader says what leads on from the turn that the follower has; all of it, if that is not known."""
        point = self.points.point
        assert point is not None
        said = None if self.follower is None else change_since(self.points, self.follower.turn)
        self.points.given = point
        self.follower = led_to(self.follower, said or point)
        assert self.follower.turn == self.turn
        assert value_of(self.follower) == self.value


TestReplicating = Replicating.TestCase


def test_a_point_that_is_gone_back_to_leads_on_without_what_was_undone() -> None:
    """Whatever was done in between, what the other replica is told has all that it lacks."""
    points = RewindPoints()
    data = image_from(b"\x01")
    first = ServerState(1, data, [b"a"], [], [], True)
    points.install(first)
    points.go_on_to(ServerState(2, data, [b"a", b"b"], [], [], True))
    points.go_back_to(first)
    points.go_on_to(ServerState(2, data, [b"a", b"c"], [], [], True))
    change = change_since(points, 1)
    assert change is not None
    assert change.deltas == [b"c"]


@given(base=st.integers(-1, 3), here=st.integers(-1, 3))
def test_a_change_is_put_upon_the_state_that_it_belongs_to(base: int, here: int) -> None:
    point = ServerState(here, image_from(b"\x01"), [], [], [], True) if here >= 0 else None
    change = StateDelta(9, base, None, [], 0, [], [], True)
    if point is not None and base == here:
        assert led_to(point, change).turn == 9
        with pytest.raises(Misfit):
            led_to(point, msgspec.structs.replace(change, deltas=[b"x"]))
    else:
        with pytest.raises(Misfit):
            led_to(point, change)


@given(st.booleans(), st.booleans(), st.integers(0, 300), st.booleans())
def test_where_nobody_looks_at_the_state_points_are_far_apart(lazy: bool, has: bool, tail: int, live: bool) -> None:
    points = RewindPoints(ServerState(0, image_from(b"x"), [], [], [], True) if has else None)
    points.keep_tail([request(n) for n in range(tail)], [])
    assert needs_point(points, is_lazy=lazy, live=live) == (not (lazy and has and live) or tail >= 256)


def test_what_has_happened_since_an_earlier_turn() -> None:
    first, second = (ServerState(turn, image_from(b"x"), [], [], [], True) for turn in (0, 2))
    points = RewindPoints(second, previous=(first, [request(1), request(2)]))
    points.keep_tail([request(3)], [end(3, 3, FAILED)])
    assert before_turn(points, 3, 3) == (second, [request(3)])
    assert before_turn(points, 1, 1) == (first, [request(1)])
    assert before_turn(points, 2, 2) == (first, [request(1), request(2)])
    assert before_turn(points, 9, 9) is None


@given(
    names=st.lists(st.sampled_from(["Add", "Ask", "Wait"]), min_size=1, max_size=12),
    size=st.integers(1, 5),
    singles=st.integers(0, 3),
    leads=st.booleans(),
    is_again=st.booleans(),
    has_work=st.booleans(),
    confirmed=st.integers(0, 2),
)
def test_a_batch_is_run_whole_and_in_order(
    names: list[str], size: int, singles: int, leads: bool, is_again: bool, has_work: bool, confirmed: int
) -> None:
    """Whoever may ask in its turn is first in a part, and alone; nobody is left out, and nobody overtakes.

    While background work is out, that is everybody who may wait for something.
    """
    state = ReplicaState(
        is_again=is_again, handed=2, confirmed=confirmed, alone={(MESSAGE, "Ask")}, waiting=frozenset({"Wait"})
    )
    alone = {"Ask", "Wait"} if has_work else {"Ask"}
    attempts, done = Attempts(size, singles), list[Request]()
    requests = [request(number, name) for number, name in enumerate(names)]
    part = BatchPart(deque(requests))
    for _ in range(4 * len(requests)):
        if not part.pending:
            break
        chunk = next_requests(state, part, attempts, leads=leads, has_work=has_work)
        if not chunk:
            assert part.begun or (leads and state.confirmed < state.handed)
            state.confirmed = state.handed  # Home has what came before,
            part = BatchPart(part.pending)  # and the next part begins.
            continue
        assert len(chunk) <= size
        if not is_again and alone.intersection(one.feed.name for one in chunk):
            assert len(chunk) == 1
            assert not part.begun
            assert not leads or state.confirmed == state.handed
        part.begun += chunk
        done += chunk
    assert done == requests


@given(st.lists(st.integers(1, 20), unique=True, max_size=8), st.data())
def test_what_is_taken_back_is_pending_again_in_its_order(numbers: list[int], data: st.DataObject) -> None:
    given_to = data.draw(st.integers(0, len(numbers)))
    ended = data.draw(st.integers(0, given_to))
    requests = [request(number) for number in numbers]
    part = BatchPart(deque(requests[given_to:]), requests[:given_to], [end(one.feed.id, 0) for one in requests[:ended]])
    handed, ends = part.hand_out()
    assert handed == requests[:ended]
    assert [one.id for one in ends] == numbers[:ended]
    part.take_back()
    assert list(part.pending) == requests[ended:]
    assert not part.begun
    assert not part.ends


@given(st.integers(1, MOST_AT_ONCE), st.floats(0, 1))
def test_as_many_at_once_as_are_done_soon(size: int, seconds: float) -> None:
    after = size_after(size, size, seconds)
    assert 1 <= after <= MOST_AT_ONCE
    assert (after < size) == (seconds > PART and size > 1)
    assert after <= size_after(size, size, seconds / 2)


@given(
    st.booleans(), st.booleans(), st.booleans(), st.booleans(), st.sampled_from([None, 1, 2]),
    st.sampled_from([ENDED, ABANDONED]),
)  # fmt: skip
def test_what_follows_when_a_life_has_ended(
    is_over: bool, is_stopping: bool, has_access: bool, has_point: bool, failed: int | None, why: str
) -> None:
    state = ReplicaState(is_over=is_over, is_stopping=is_stopping, has_access=has_access)
    part = BatchPart(deque(), [request(1, "", START), request(2)])
    then = after_end(state, part, failed, why, has_point=has_point)
    if why is ABANDONED:
        assert then is GIVE_UP
    elif is_over or is_stopping or failed == 1:  # An `on_start` that has raised is not tried again.
        assert then is STOP
    else:
        assert then is (REWIND if has_access and (has_point or failed is None) else GO_ON)
