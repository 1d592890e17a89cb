"""What the root knows of a group, and decides, without a group: data and pure functions, against naive models."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

import holdfast as hf
from holdfast.actors.errors import AskTimeout, NoSuchActor
from holdfast.checkpoint.protocol import (
    DROPPED,
    MESSAGE,
    OK,
    Answer,
    Came,
    Feed,
    Go,
    Outcome,
    PipeDone,
    SnapshotNow,
    TurnEnd,
)
from holdfast.ftm.bricks.behind import Behind
from holdfast.ftm.bricks.brick_messages import MOST_REQUESTS, Request, Strayed, Work
from holdfast.ftm.bricks.replica_orders import Stand
from holdfast.ftm.group.delivery import Delivery
from holdfast.ftm.group.hung import STUCK_AFTER
from holdfast.ftm.group.membership import (
    FIRST_PAUSE,
    LONGEST_PAUSE,
    MOST_STRAYED,
    STEADY,
    FailoverStep,
    Membership,
    Strays,
    Suspicion,
    next_step,
)
from holdfast.ftm.group.probation import LONGEST_PAUSE as LONGEST_RETRY
from holdfast.ftm.group.probation import MOST_SECONDS, SECONDS, TURNS, Conduct, pauses
from holdfast.ftm.group.reconfiguration import (
    MOST_BROKEN_OFF,
    Adaptation,
    CannotAdapt,
    Preparation,
    Reconfiguration,
    Stage,
    names_for,
    still_silent,
    what_is_wrong,
)

NAMES: tuple[str, ...] = ("r1", "r2", "r3")
HOPELESS = 10.0
replicas = st.sampled_from(NAMES)
roles = st.sampled_from((*NAMES, "primary", "leading", "joining"))


class FailingOver(RuleBasedStateMachine):
    """Replicas die, fall silent, start and join at any moment; one leads, and never two.

    The model knows what really happened: which lives have been told to lead, and which hold all that was acknowledged.
    """

    @initialize(keeps_members=st.booleans())
    def begin(self, keeps_members: bool) -> None:
        self.lives: dict[str, int] = dict.fromkeys(NAMES, 1)
        self.known = Membership(NAMES, 1, "r1", keeps_members=keeps_members, is_begun=True)
        self.known.members, self.known.up = {"r1": 1, "r2": 1}, dict(self.lives)
        self.now = 0.0
        self.led = [(1, "r1", 1)]  # the model: epoch, name and life of all that were ever told to lead
        self.holders = {("r1", 1), ("r2", 1)}  # and who has all that was acknowledged

    # -- what happens to them -----------------------------------------------------------------------------------------

    def _name_of(self, role: str) -> str:
        joining = next(iter(self.known.joining), None)
        return {"primary": self.known.primary, "leading": self.known.leading, "joining": joining}.get(
            role, role
        ) or "r1"

    @rule(role=roles)
    def die(self, role: str) -> None:
        self.lives[self._name_of(role)] = 0

    @rule(name=replicas, life=st.integers(2, 9))
    def start(self, name: str, life: int) -> None:
        known = [life for _, one, life in self.led if one == name] + [life for one, life in self.holders if one == name]
        if not self.lives[name]:
            self.lives[name] = max([*known, self.known.up.get(name, 0), 1]) + life

    @rule(name=replicas)
    def beat(self, name: str) -> None:
        life, before = self.lives[name], self.known.suspected.get(name)
        if life:
            heard = self.known.hear(name, life)
            is_suspect = before is not None and before.life == life
            assert (heard == "cleared") == (is_suspect and before is not None and before.is_silence)
            assert self.known.is_suspect(name, life) == (heard == "known")

    @rule(role=roles, is_silence=st.booleans())
    def suspect(self, role: str, is_silence: bool) -> None:
        name = self._name_of(role)
        if (name, self.lives[name]) in self.known.watched(self.lives):
            self.known.suspect(name, Suspicion(self.lives[name], "it is", self.now, is_silence), self.now)
            assert not self.known.is_well(name, self.lives)

    @rule(seconds=st.sampled_from([1.0, HOPELESS]))
    def pass_time(self, seconds: float) -> None:
        self.now += seconds

    @rule(name=replicas)
    def ask_to_join(self, name: str) -> None:
        known = self.known
        if known.is_led(self.lives) and known.may_join(name, self.lives):
            known.joining[name], known.is_joining = self.lives[name], True

    @precondition(lambda self: self.known.joining)
    @rule()
    def join(self) -> None:
        known, (name, life) = self.known, self.known.joining.popitem()
        known.is_joining = False
        if known.primary is None:
            return
        if self.lives[name] != life:
            known.dropped.add(name)
        else:
            known.members[name] = life
            self.holders.add((name, life))

    @rule(name=replicas)
    def stray(self, name: str) -> None:
        """A backup has diverged again and again."""
        life = self.known.members.get(name, 0)
        if life and name != self.known.primary and self.known.primary is not None:
            self.known.condemned[name] = life
            self._lose(name)

    @precondition(lambda self: self.known.primary is not None)
    @rule()
    def renew(self) -> None:
        self.known.renewing = self.known.primary

    # -- what failover does -------------------------------------------------------------------------------------------

    def _lose(self, name: str) -> None:
        self.known.members.pop(name, None)

    def _bury(self, name: str, life: int) -> None:
        if self.lives[name] == life:
            self.lives[name] = 0

    def _apply(self, step: FailoverStep) -> None:
        """Do what the failover manager does, and check that it may be done."""
        known, name = self.known, step.name
        match step.kind:
            case "wait":
                life = self.lives[name]
                assert known.suspected[name].life == life == known.members[name]
                assert known.leading is None or known.suspected[name].is_silence
                assert not any(known.is_well(one, self.lives) for one in NAMES)
            case "depose" | "condemn":
                assert not known.is_well(name, self.lives)
                assert name == (known.primary if step.kind == "depose" else known.leading)
                self._check_that_nobody_would_wait(name, silent=step.kind == "condemn")
                known.condemn(name)
                self._lose(name)
            case "renew" | "elect":
                assert known.is_well(name, self.lives)
                before = known.epoch
                known.elect(name)
                assert (known.epoch, known.leading, known.primary) == (before + 1, name, None)
            case "fall":
                assert not any(known.is_well(one, self.lives) for one in NAMES)
                self.begin(known.keeps_members)  # The home begins another group.
            case "bury":
                self._bury(name, known.condemned.pop(name))
            case "lead":
                self._lead(name)
            case "forget":
                assert known.joining.pop(name) != self.lives[name]
                known.dropped.add(name)
            case "drop":
                assert name != known.primary
                life = known.members.get(name, 0) or known.up[name]
                self._lose(name)
                known.dropped.add(name)
                self._bury(name, life)
            case "tell":
                assert known.dropped
                known.dropped.clear()
            case "rest":
                assert known.primary is not None
                assert all(known.is_well(one, self.lives) for one in known.members)
                assert not known.dropped
                assert not known.condemned
                assert all(self.lives[one] == life for one, life in known.joining.items())
                suspects = {one for one in NAMES if self.lives[one] and known.is_suspect(one, self.lives[one])}
                assert not [one for one in suspects if known.up.get(one) == self.lives[one]]

    def _check_that_nobody_would_wait(self, name: str, *, silent: bool) -> None:
        """What only this one has may not be given up, as long as it may yet be heard of."""
        suspicion = self.known.suspected.get(name)
        is_alive = self.lives[name] > 0 and self.known.members.get(name) == self.lives[name]
        if is_alive and not any(self.known.is_well(one, self.lives) for one in NAMES):
            assert suspicion is not None
            assert self.now - suspicion.since >= HOPELESS or (silent and not suspicion.is_silence)

    def _lead(self, name: str) -> None:
        known, life = self.known, self.lives[name]
        for epoch, one, past in self.led:
            assert (one, past) == (name, life) or self.lives[one] != past, "who has led before lives"
            assert epoch < known.epoch
        assert (name, life) in self.holders
        self.led.append((known.epoch, name, life))
        lost = known.bind(name)
        if not known.keeps_members:
            self.holders = {(name, life)}
        for one in lost:
            self._lose(one)
        assert known.keeps_members or set(known.members) == {name}

    def _next(self) -> FailoverStep:
        return next_step(self.known, self.lives, self.now, HOPELESS)

    @rule()
    def step(self) -> None:
        self._apply(self._next())

    @rule()
    def settle(self) -> None:
        self._settle()

    def _settle(self) -> str:
        """If nothing else happens it comes to rest, or waits, or gives up."""
        for _ in range(30):
            step = self._next()
            self._apply(step)
            if step.kind in ("rest", "wait", "fall"):
                return step.kind
        raise AssertionError(f"it does not come to rest: {self.known}")

    @rule()
    def have_quiet_time(self) -> None:
        """All that is not there starts, is heard of, and joins."""
        if self.known.joining:
            self.join()
        while self._settle() == "wait":
            self.pass_time(HOPELESS)
        for name in NAMES:
            self.start(name, 2)
            self.beat(name)
            self.ask_to_join(name)
            if self.known.joining:
                self.join()
        assert self._settle() == "rest"
        assert self.known.is_whole(self.lives)

    @invariant()
    def one_leads(self) -> None:
        known = self.known
        assert known.primary is None or known.leading is None
        assert known.primary is None or known.primary in known.members
        assert {(one, life) for one, life in known.members.items()} <= self.holders
        peer = known.peer_of("r1", self.lives)
        assert peer is None or (known.keeps_members and known.is_well(peer, self.lives) and peer != "r1")
        for name in NAMES:
            state, life = known.state_of(name, self.lives[name]), self.lives[name]
            assert (state in ("leads", "follows")) == known.is_well(name, self.lives)
            assert (state == "down") == (not life)


TestFailingOver = FailingOver.TestCase
TestFailingOver.settings = settings(max_examples=200, stateful_step_count=50, deadline=None)


def test_who_has_died_while_it_joined_is_forgotten_before_its_next_life_joins() -> None:
    known = Membership(NAMES, 1, "r1", members={"r1": 1}, joining={"r2": 1}, up={"r2": 1})
    lives = {"r1": 1, "r2": 2}
    assert next_step(known, lives, 0.0, HOPELESS) == ("forget", "r2")
    del known.joining["r2"]
    known.dropped.add("r2")
    assert known.hear("r2", 2) == "new"
    assert not known.may_join("r2", lives)
    assert next_step(known, lives, 0.0, HOPELESS).kind == "tell"
    known.dropped.clear()
    assert known.may_join("r2", lives)
    assert next_step(known, lives, 0.0, HOPELESS).kind == "rest"


def feed(number: int, turn: int = -1) -> Feed:
    return Feed(number, turn, MESSAGE, "Add", b"", 0.0)


def work(delivery: Delivery, batch: list[Feed], go: Go | None) -> Work:
    return Work(1, 1, delivery.number, [Request("", 0, one) for one in batch], go)


class Delivering(RuleBasedStateMachine):
    """A home feeds inputs, replicas end them and die; each leader gets each open input once, in order.

    The model is a list of all inputs, and for each what has been done with it.
    """

    @initialize()
    def begin(self) -> None:
        self.delivery, self.open, self.count = Delivery(is_live=True), dict[int, None](), 0
        self.order: list[int] = []  # the model: what the present leader is to get, in this order
        self.had: set[int] = set()  # and what an earlier one has got, not ended since
        self.begun = -1

    @rule(count=st.integers(1, 5))
    def feed(self, count: int) -> None:
        for _ in range(count):
            self.open[self.count] = None
            assert self.delivery.put(feed(self.count))
            self.order.append(self.count)
            self.count += 1

    @precondition(lambda self: self.open)
    @rule(data=st.data())
    def drop(self, data: st.DataObject) -> None:
        """The home gives one up that nobody has begun."""
        sent = [] if self.delivery.out is None else [one.feed.id for one in self.delivery.out.requests]
        number = data.draw(st.sampled_from(sorted(self.open)), label="dropped")
        if number not in sent:
            del self.open[number]
            self.had.discard(number)

    @rule(kind=st.sampled_from(["is_suspended", "is_stopping", "is_resting"]), value=st.booleans())
    def hold(self, kind: str, value: bool) -> None:
        setattr(self.delivery, kind, value)

    @rule()
    def send(self) -> None:
        delivery, was_again = self.delivery, self.delivery.is_again
        taken = delivery.next_batch(self.open)
        if delivery.out is not None:
            assert taken is None
            return
        batch = [] if taken is None else [one.id for one in taken[0]]
        expected = [one for one in self.order if one in self.open]
        if not delivery.takes_new:
            count = next((index for index, one in enumerate(expected) if one not in self.had), len(expected))
            expected = expected[:count]
        assert batch == expected[: len(batch)]
        careful = delivery.careful.intersection(expected)
        assert len(batch) == 1 or not careful.intersection(batch)
        assert batch or not expected
        assert (taken is None) == (not batch and not was_again)
        if careful.isdisjoint(expected):
            assert len(batch) == min(len(expected), MOST_REQUESTS)
        gone = set(self.order) - self.open.keys()
        self.order = [one for one in self.order if one not in batch and one not in gone]
        if taken is not None:
            delivery.out = work(delivery, *taken)

    @precondition(lambda self: self.delivery.out is not None)
    @rule(data=st.data())
    def end_some(self, data: st.DataObject) -> None:
        """Turns of the batch that is out end, and perhaps all of it."""
        delivery, out = self.delivery, self.delivery.out
        assert out is not None
        left = [one.feed.id for one in out.requests if one.feed.id in self.open]
        for number in left[: data.draw(st.integers(0, len(left)), label="ended")]:
            del self.open[number]
            del delivery.fed[number]
        assert delivery.end_batch(out.number - 1) is None
        if not any(one.feed.id in self.open for one in out.requests):
            assert delivery.end_batch(out.number) is out
            self.had -= {one.feed.id for one in out.requests}
            assert delivery.careful.isdisjoint(one.feed.id for one in out.requests)
            assert delivery.out is None

    @rule(careful=st.booleans(), data=st.data())
    def another_leads(self, careful: bool, data: st.DataObject) -> None:
        delivery, out = self.delivery, self.delivery.out
        sent = [] if out is None else [one.feed.id for one in out.requests if one.feed.id in self.open]
        suspect = delivery.only_suspect_input()
        assert suspect == (sent[0] if out is not None and len(out.requests) == 1 and sent else -1)
        begun = data.draw(st.sampled_from([-1, *sent]), label="begun")
        delivery.send_again(self.open, begun, careful=careful)
        self.had |= set(sent)
        self.had &= self.open.keys()
        self.order = sorted(self.open, key=lambda one: (one != begun, one))
        assert delivery.out is None
        if careful and out is not None:
            assert delivery.careful == set(sent)
        if begun >= 0:
            assert delivery.fed[begun].deadline == 0.0

    @rule()
    def bring_inward(self) -> None:
        """A snapshot waits until the home knows all that a replica does; an outcome does not."""
        delivery = self.delivery
        for record in (Outcome(1, 1, Came()), SnapshotNow()):
            assert delivery.put(record)
        kinds = [type(one) for one in delivery.next_inward()]
        assert Outcome in kinds
        assert (SnapshotNow in kinds) == (not delivery.inside)

    @invariant()
    def what_is_inside_is_known(self) -> None:
        delivery = self.delivery
        assert delivery.inside & self.open.keys() == self.had & self.open.keys()
        sent = set[int]() if delivery.out is None else {one.feed.id for one in delivery.out.requests}
        waiting = {one.id for one in delivery.waiting if isinstance(one, Feed)}
        assert delivery.inside <= self.open.keys() | sent | waiting
        assert delivery.is_idle == (delivery.out is None and not delivery.waiting)
        assert self.open.keys() <= delivery.fed.keys()


TestDelivering = Delivering.TestCase
TestDelivering.settings = settings(max_examples=100, stateful_step_count=50, deadline=None)


def test_a_life_that_has_been_told_to_go_on_gets_nothing_while_nobody_could_take_over() -> None:
    delivery = Delivery(is_held=True)
    for record in (feed(0), Go(recovered=False, turn=0), feed(1)):
        delivery.put(record)
    taken = delivery.next_batch(())
    assert taken is not None
    assert ([one.id for one in taken[0]], type(taken[1])) == ([0], Go)
    delivery.out = work(delivery, *taken)
    del delivery.fed[0]
    assert delivery.end_batch(delivery.number) is not None
    assert delivery.next_batch(()) is None
    delivery.is_held = False
    later = delivery.next_batch(())
    assert later is not None
    assert [one.id for one in later[0]] == [1]


def test_each_input_in_whose_company_a_replica_has_died_goes_alone() -> None:
    """One that is new goes with its like before and behind them."""
    delivery, numbers = Delivery(is_live=True), dict.fromkeys(range(7))
    for number in range(3):
        delivery.put(feed(number))
    delivery.out = work(delivery, *sent(delivery, numbers))
    delivery.send_again(numbers, -1, careful=True)
    delivery.out = None
    for number in range(3, 5):
        delivery.put(feed(number))
    delivery.waiting.rotate(1)  # One that is not careful is ahead of them.
    batches = []
    while delivery.waiting:
        batches.append([one.id for one in sent(delivery, numbers)[0]])
    assert batches == [[4], [0], [1], [2], [3]]


@pytest.mark.parametrize("ended", range(5))
def test_what_is_replayed_for_two_turns_is_in_no_batch_twice_and_comes_again_in_the_order_of_turns(ended: int) -> None:
    """It was put aside in one turn and handled in another; who leads may die at each of them."""
    delivery, history = Delivery(), [(0, 1), (1, 2), (2, 3), (0, 4), (1, 5)]
    for number, turn in history:
        delivery.put(feed(number, turn))
    left, done = list(history), 0
    while left:
        batch = sent(delivery, {})[0]
        assert [(one.id, one.turn) for one in batch] == left[: len(batch)]
        assert len({one.id for one in batch}) == len(batch)
        delivery.out = work(delivery, batch, None)
        for one in batch:
            done += 1
            left.pop(0)
            if (one.id, one.turn) not in history[:2]:  # These were put aside.
                delivery.fed.pop(one.id, None)
            if done == ended:
                delivery.send_again((), -1)
                left = [(number, turn) for number, turn in history if number in delivery.fed]
                break
        else:
            assert delivery.end_batch(delivery.number) is not None


def sent(delivery: Delivery, open_inputs: dict[int, None]) -> tuple[list[Feed], Go | None]:
    taken = delivery.next_batch(open_inputs)
    assert taken is not None
    return taken


def test_who_leads_next_is_told_again_that_it_goes_on() -> None:
    delivery = Delivery()
    for record in (feed(0), Go(recovered=False, turn=0)):
        delivery.put(record)
    taken = delivery.next_batch(())
    assert taken is not None
    delivery.out = work(delivery, *taken)
    delivery.send_again((), -1)
    again = delivery.next_batch(())
    assert again is not None
    assert ([one.id for one in again[0]], again[1]) == ([0], taken[1])


@given(
    st.booleans(), st.integers(-1, 5), st.booleans(), st.booleans(), st.sampled_from([OK, DROPPED]), st.integers(0, 4)
)
def test_an_end_counts_once(is_live: bool, turn: int, is_open: bool, is_known: bool, status: str, last: int) -> None:
    judged = Delivery(is_live=is_live).judge(
        TurnEnd(turn, 7, status, [], Answer()), last, is_open=is_open, is_known=lambda *one: is_known
    )
    if turn < 0 and status == DROPPED:
        expected = "dropped"
    elif not is_live:
        expected = "new"  # A replay: the home compares it.
    elif is_open and turn > last:
        expected = "new"
    elif is_open and not is_known:
        expected = "behind"
    else:
        expected = "double"
    assert judged == expected


looks = st.lists(
    st.tuples(
        st.sampled_from([0.5, 1.0, 2.0, 30.0]),
        st.sampled_from([0, 1, 60]),
        st.sampled_from([1, 1, 1, 2]),
        st.booleans(),
    ),
    max_size=30,
)


@given(looks)
def test_a_stack_is_trusted_when_it_has_worked_for_long_enough(steps: list[tuple[float, int, int, bool]]) -> None:
    now, turn, life = 100.0, 5, 1
    conduct = Conduct(now, turn, {"r1": 1}, turn, now, {})
    history = [(now, turn, life, True)]  # the model: all that was seen; it forgets nothing
    for seconds, turns, change, is_idle in steps:
        now, turn, life = now + seconds, turn + turns, life + (change == 2)
        verdict = conduct.look(now, turn, {"r1": life}, {}, is_idle=is_idle)
        history.append((now, turn, life, is_idle or turns > 0))
        moved = max(when for when, _, _, has_moved in history if has_moved)
        same = [(when, past) for when, past, one, _ in history if one == life]
        since, first = same[0]
        is_long = now - since >= MOST_SECONDS or (now - since >= SECONDS and turn - first >= TURNS)
        if now - moved >= STUCK_AFTER:
            assert verdict == "ask"
        else:
            assert verdict == ("judge" if is_long and history[-1][3] else "wait")


def test_pauses_get_longer_and_not_too_long() -> None:
    retries: Iterator[float] = pauses()
    seen = [next(retries) for _ in range(9)]
    assert seen == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, LONGEST_RETRY, LONGEST_RETRY, LONGEST_RETRY]


@given(st.lists(st.tuples(st.sampled_from(["r1", "r2"]), st.integers(1, 2), st.integers(0, 2 * STEADY)), max_size=12))
def test_who_strays_again_and_again_is_faulty(strayed: list[tuple[str, int, int]]) -> None:
    strays, turn, now = Strays(), 0, 0.0
    in_row: dict[str, tuple[int, int]] = {}  # the model: life, and times in a row
    joined: dict[str, int] = {}
    for name, life, turns in strayed:
        strays.joined(name, life, turn)
        if in_row.get(name, (0, 0))[0] != life:
            in_row[name] = life, 0
        joined[name], turn, now = turn, turn + turns, now + 1.0
        times = 1 if turns > STEADY else in_row[name][1] + 1
        in_row[name] = life, times
        assert strays.count_again(name, life, turn, now) == (times, times >= MOST_STRAYED)
        pause = strays.pause(name, life, turn, now)
        assert pause == pytest.approx(min(FIRST_PAUSE * 2 ** (times - 1), LONGEST_PAUSE))
    assert strays.count == len(strayed)


# -- a change of mechanisms -------------------------------------------------------------------------------------------


def change(loop: Any, told: list[str] | None = None, **more: Any) -> Reconfiguration:
    said = told if told is not None else []
    return Reconfiguration("/app/a", 2, (hf.ftm.PBR(),), ("r1", "r2"), loop, lambda: said.append("look"), **more)


@given(
    st.lists(st.sampled_from(["r1", "r2", "r3", "r5"]), unique=True, min_size=1),
    st.sampled_from(["r1", "r2", "r3", "r5", None]),
    st.sets(st.sampled_from(["r1", "r2", "r3", "r5"])),
    st.sampled_from([(hf.ftm.TR(),), (hf.ftm.PBR(),), (hf.ftm.TMR(),)]),
)
def test_replicas_are_kept_as_far_as_they_are_needed(
    names: list[str], primary: str | None, members: set[str], layers: tuple[Any, ...]
) -> None:
    wanted = max(layer.replicas for layer in layers)
    known = Membership(tuple(names), 1, primary, members=dict.fromkeys(members, 1))
    kept = names_for(known, layers)
    assert len(kept) == len(set(kept)) == wanted
    assert len(set(kept) & set(names)) == min(wanted, len(names))
    if primary in names:
        assert kept[0] == primary
    left = [name for name in names if name not in kept]
    assert (
        not left
        or not any(name not in members and name != primary for name in kept if name in names)
        or (not any(name in members for name in left))
    )


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 2)), min_size=1, max_size=3))
def test_replicas_change_only_if_one_leads_and_all_have_the_same_stack(stands: list[tuple[bool, int]]) -> None:
    told = {f"r{index}": Stand(1, config, 5, leads) for index, (leads, config) in enumerate(stands, 1)}
    is_right = [leads for leads, _ in stands] == [True] + [False] * (len(stands) - 1) and {
        config for _, config in stands
    } == {1}
    assert (what_is_wrong(told, "r1", 1) == "") == is_right


async def test_a_change_can_be_given_up_until_it_commits() -> None:
    loop, told = asyncio.get_running_loop(), list[str]()
    stages: tuple[Stage, ...] = ("preparing", "resting", "committing", "tidying")
    for stage in stages:
        one = change(loop, told, stage=stage)
        one.give_up("it is not wanted")
        one.give_up("nor for this reason")
        is_early = stage in ("preparing", "resting")
        assert one.why == ("it is not wanted" if is_early else "")
        assert one.given_up.done() == is_early
        assert one.next_stage() == ("undoing" if is_early else stage)
        one.close("its life has ended")
        error = one.outcome.exception()
        assert (error is None) == (stage == "tidying")
        assert error is None or isinstance(error, CannotAdapt)
    assert told == ["look"] * 4


@given(st.dictionaries(replicas, st.sampled_from(["done", "behind", "silent", "refused", "dead"]), min_size=1))
def test_as_soon_as_one_has_changed_there_is_no_way_back(fates: dict[str, str]) -> None:
    loop = asyncio.new_event_loop()
    try:
        one = change(loop)
    finally:
        loop.close()
    one.turn, one.preparation.lives = 7, dict.fromkeys(fates, 1)
    turns = {name: 7 if fate == "done" else 6 for name, fate in fates.items() if fate in ("done", "behind")}
    errors: dict[str, BaseException] = {
        name: NoSuchActor(name) if fate == "refused" else AskTimeout(name, 5.0)
        for name, fate in fates.items()
        if name not in turns
    }
    lives = {name: int(fate != "dead") for name, fate in fates.items()}
    assert one.judge_commit(turns, errors, lives) == {name for name, fate in fates.items() if fate == "behind"}
    assert (one.next_stage() == "undoing") == (not turns)
    failed = {name for name, fate in fates.items() if fate == "silent" or (fate == "refused" and turns)}
    assert one.failed == dict.fromkeys(failed, 1)


def test_what_was_prepared_holds_while_the_same_ones_count_in_the_same_epoch() -> None:
    known, lives = Membership(NAMES, 3, "r1", members={"r1": 1, "r2": 4}), {"r1": 1, "r2": 4}
    preparation = Preparation(lives=dict(lives), epoch=3)
    assert preparation.still_holds(known, lives)
    assert not preparation.still_holds(known, lives | {"r2": 5})
    known.suspect("r2", Suspicion(4, "it is silent", 0.0), 0.0)
    assert not preparation.still_holds(known, lives)
    assert known.noticed == 0.0  # It does not lead.
    known.suspected.clear()
    known.epoch = 4
    assert not preparation.still_holds(known, lives)
    whys = [preparation.break_off("r2") for _ in range(MOST_BROKEN_OFF)]
    assert [bool(why) for why in whys] == [False] * (MOST_BROKEN_OFF - 1) + [True]


def test_who_had_no_time_to_hear_an_order_is_told_again() -> None:
    errors: dict[str, BaseException] = {
        "r1": AskTimeout("r1", 5.0),
        "r2": AskTimeout("r2", 5.0),
        "r3": NoSuchActor("r3"),
    }
    assert still_silent(errors, 6.0, {"r1": 2.0, "r2": 0.5, "r3": 6.0}, 5.0) == ["r1"]


async def test_what_a_failover_has_left_to_tidy_up_comes_behind_the_change_under_way() -> None:
    loop = asyncio.get_running_loop()
    first, back = change(loop), change(loop, is_back=True)
    adaptation = Adaptation(1, first, back)
    assert adaptation.next_change() is first
    adaptation.end(first)
    assert adaptation.next_change() is back
    assert adaptation.gone_back is None
    adaptation.end(back)
    assert adaptation.next_change() is None


def test_what_stands_behind_a_turn_waits_for_it() -> None:
    behind, done = Behind(), [PipeDone(turn, 1, "tests:Done", b"") for turn in (3, 5)]
    for record in done:
        behind.put(record.turn, [record])
    assert [list(behind.due(turn)) for turn in (2, 4, 4)] == [[], done[:1], []]
    behind.put(7, [Strayed("/app/alice/ftm/r2")])  # It is about no turn.
    assert [type(one) for one in behind.due(4)] == [Strayed]
    assert list(behind.due(None)) == done[1:]
