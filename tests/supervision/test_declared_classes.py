"""A value of a subclass of what a field declares would arrive as its base, without what is its own: it is refused.

It is, wherever a message, reply or refusal is coded: on its way to or from a process, and into a journal.
"""

import asyncio
import enum
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple, TypedDict

import msgspec
import numpy as np
import pytest

import holdfast as hf
from holdfast.errors import BadMessage, BadReply, RemoteCrash


class Shape(msgspec.Struct):
    name: str


class Circle(Shape):
    radius: float


@dataclass
class Row:
    key: str
    below: "list[Row]"


@dataclass
class Marked(Row):
    mark: int


class Point(NamedTuple):
    x: int
    y: int


class Named(Point):
    @property
    def name(self) -> str:
        return f"{self.x}/{self.y}"


class Options(TypedDict, total=False):
    width: int
    corner: Point


class Size(TypedDict, total=False):
    width: int


class Mixed(enum.Enum):
    NUMBER = 1
    TEXT = "one"


class Square(msgspec.Struct, tag=True):
    side: float


class Dot(msgspec.Struct, tag=True):
    at: tuple[float, float]


class Ping(hf.Message):
    pass


class Draw(hf.Message[str]):
    shape: Shape | None = None
    shapes: list[Shape] = msgspec.field(default_factory=list)
    named: dict[str, tuple[int, Shape]] = msgspec.field(default_factory=dict)
    row: Row | None = None
    message: hf.Message[Any] | None = None
    reason: hf.ExitReason | None = None
    union: Square | Dot | None = None
    point: Point | None = None
    options: Options | None = None
    size: Size | None = None
    pixels: np.ndarray[Any, Any] | None = None


class Choose(hf.Message[None]):
    one: Mixed


class Unknown(hf.Message["Nobody"]):  # type: ignore[name-defined]  # that is the point
    """Its reply has a type that its module does not know, as one that is imported for type checkers only."""


class Reply(hf.Message[Shape | list[Row] | None]):
    what: str


class Later(hf.Message[Shape | list[Row] | None]):
    """As Reply, answered by Give."""


class Give(hf.Message[None]):
    what: str


class Crash(hf.Message[None]): ...


class TooMany(hf.Refusal):
    shape: Shape


class Pass(hf.Message[str]):
    """Has whoever gets it hand a circle on, by this verb."""

    verb: str
    to: str


class Board(hf.Actor):
    def __init__(self) -> None:
        self.owed: hf.ReplyHandle[Any] | None = None

    @hf.on(Draw)
    async def draw(self, message: Draw) -> str:
        return repr(message)

    @hf.on(Unknown)
    async def unknown(self, message: Unknown) -> Any:
        return 1

    @hf.on(Choose)
    async def choose(self, message: Choose) -> None: ...

    @hf.on(Reply)
    async def reply(self, message: Reply) -> Shape | list[Row] | None:
        if message.what == "refusal":
            raise TooMany(Circle("a", 2.5))
        return REPLIES[message.what]

    @hf.on(Later)
    async def later(self, message: Later) -> Any:
        self.owed = self.ctx.reply_handle()
        return self.owed

    @hf.on(Give)
    async def give(self, message: Give) -> None:
        assert self.owed is not None
        if message.what == "refusal":
            self.owed.fail(TooMany(Circle("a", 2.5)))
        else:
            self.owed.reply(REPLIES[message.what])

    @hf.on(Crash)
    async def crash(self, message: Crash) -> None:
        raise RuntimeError("on purpose")

    @hf.on(Pass)
    async def pass_on(self, message: Pass) -> str:
        circle, other = Draw(shape=Circle("a", 2.5)), self.ctx.find(message.to, Board)
        try:
            match message.verb:
                case "tell":
                    other.tell(circle)
                case "send":
                    await other.send(circle)
                case "ask":
                    await other.ask(circle)
                case "publish":
                    await self.ctx.publish("/drawn", circle)
        except BadMessage as error:
            return error.problem
        return "handed on"


REPLIES: dict[str, Any] = {
    "circle": Circle("a", 2.5),
    "rows": [Row("a", [Marked("b", [], 3)])],
    "shape": Shape("a"),
}
MORE: Any = {"width": 1, "height": 2}
LOST = {
    "a field": (Draw(shape=Circle("a", 2.5)), "field 'shape': a "),
    "an item": (Draw(shapes=[Shape("a"), Circle("b", 2.5)]), "field 'shapes[1]': a "),
    "a value": (Draw(named={"x": (1, Circle("b", 2.5))}), "field \"named['x'][1]\": a "),
    "a part of a part": (Draw(row=Row("a", [Row("b", [Marked("c", [], 3)])])), "field 'row.below[0].below[0]': a "),
    "another message": (Draw(message=Ping()), "field 'message': a "),
    "an exit reason": (Draw(reason=hf.Shutdown("late")), "str(reason)"),
    "a named tuple": (Draw(point=Named(1, 2)), "field 'point': a "),
    "a key": (Draw(size=MORE), "field 'size': the key 'height' is none of"),
    "a value of a key": (Draw(options={"corner": Named(1, 2)}), "field \"options['corner']\": a "),
    "a mask": (Draw(pixels=np.ma.masked_array([1, 2], [True, False])), "send its data and its mask"),
    "a class of arrays": (Draw(pixels=np.zeros(2).view(np.recarray)), "send numpy.asarray(...) of it"),
    "a large array's class": (Draw(pixels=np.zeros((1, 100_000)).view(np.recarray)), "send numpy.asarray(...) of it"),
}
KEPT = (
    Draw(shape=Shape("a")),
    Draw(row=Row("a", [Row("b", [])]), shapes=[Shape("a")]),
    Draw(union=Square(2.0)),
    Draw(union=Dot((1.0, 2.0))),
    Draw(point=Point(1, 2), options={"width": 1, "corner": Point(1, 2)}),
    Draw(pixels=np.arange(6).reshape(2, 3).T),
)
TOLD = "would (arrive|get lost)"
CODED = pytest.mark.parametrize(
    ("isolation", "recovery"),
    [("process", None), ("task", hf.hybrid()), ("process", hf.hybrid())],
    ids=["process", "recorded", "recorded process"],
)


async def started(system: hf.ActorSystem, isolation: Any, recovery: hf.Method | None) -> hf.ActorRef[Board]:
    """An actor whose messages are coded, and one beside it at /app/top/far."""
    far = hf.child("far", hf.start(Board), isolation="process")
    board = hf.child("board", hf.start(Board), isolation=isolation, recovery=recovery)
    await system.start(hf.supervisor("top", children=[far, board], intensity=100))
    return system.ref("/app/top/board", Board)


@CODED
@pytest.mark.parametrize("what", LOST)
async def test_a_message_is_refused_that_would_lose_a_class(
    system: hf.ActorSystem, isolation: str, recovery: hf.Method | None, what: str
) -> None:
    board = await started(system, isolation, recovery)
    message, told = LOST[what]
    for _ in range(3):  # Of a type that was sent before, too: from the third message on its name is a number.
        with pytest.raises(BadMessage, match=TOLD) as of_tell:
            board.tell(message)
        with pytest.raises(BadMessage) as of_send:
            await board.send(message)
        with pytest.raises(BadMessage) as of_ask:
            await board.ask(message)
        assert told in of_tell.value.problem
        assert of_tell.value.problem == of_send.value.problem == of_ask.value.problem
        assert await board.ask(KEPT[0]) == repr(KEPT[0])


@CODED
async def test_what_is_of_the_declared_class_arrives(
    system: hf.ActorSystem, isolation: str, recovery: hf.Method | None
) -> None:
    board = await started(system, isolation, recovery)
    for message in KEPT:
        assert await board.ask(message) == repr(message)


async def test_a_plain_task_gets_the_object_itself(system: hf.ActorSystem) -> None:
    board = await started(system, "task", None)
    for message, _ in LOST.values():
        assert await board.ask(message) == repr(message)


@CODED
@pytest.mark.parametrize("what", ["circle", "rows", "refusal"])
async def test_a_reply_is_refused_that_would_lose_a_class(
    system: hf.ActorSystem, isolation: str, recovery: hf.Method | None, what: str
) -> None:
    board = await started(system, isolation, recovery)
    with pytest.raises(BadReply, match="would arrive as that"):
        await board.ask(Reply(what))
    assert await board.ask(Reply("shape")) == Shape("a")


@CODED
@pytest.mark.parametrize("what", ["circle", "rows", "refusal"])
async def test_a_reply_by_a_handle_is_refused_that_would_lose_a_class(
    system: hf.ActorSystem, isolation: str, recovery: hf.Method | None, what: str
) -> None:
    board = await started(system, isolation, recovery)
    for asked, outcome in ((what, pytest.raises(BadReply, match="would arrive as that")), ("shape", nullcontext())):
        owed = asyncio.ensure_future(board.ask(Later()))
        await board.ask(KEPT[0])
        if recovery is not None:  # The handle is one that a restart has brought back.
            with pytest.raises(RemoteCrash):
                await board.ask(Crash())
        await board.ask(Give(asked))
        with outcome:
            assert await owed == Shape("a")


@CODED
@pytest.mark.parametrize("verb", ["tell", "send", "ask", "publish"])
async def test_an_actor_that_hands_one_on_is_told(
    system: hf.ActorSystem, isolation: str, recovery: hf.Method | None, verb: str
) -> None:
    board = await started(system, isolation, recovery)
    assert "would arrive as that" in await board.ask(Pass(verb, "/app/top/far"))
    assert await board.ask(KEPT[0]) == repr(KEPT[0])


@CODED
async def test_what_nothing_can_be_decoded_as_crashes_nobody(
    system: hf.ActorSystem, isolation: str, recovery: hf.Method | None
) -> None:
    board = await started(system, isolation, recovery)
    with pytest.raises(BadMessage, match="all str or all int"):
        await board.ask(Choose(Mixed.TEXT))
    with pytest.raises(BadReply, match="reply type 'Nobody'"):
        await board.ask(Unknown())
    assert await board.ask(KEPT[0]) == repr(KEPT[0])
    assert board._cell.life == 1


async def test_a_class_that_was_made_later_is_seen(system: hf.ActorSystem) -> None:
    class Late(Square):
        colour: str

    board = await started(system, "process", None)
    assert await board.ask(Draw(union=Square(2.0))) == repr(Draw(union=Square(2.0)))
    with pytest.raises(BadMessage, match="Late is given where"):
        await board.ask(Draw(union=Late(2.0, "red")))
