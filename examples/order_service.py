"""An order service that finds out what is wrong with it, and puts that right: the cause, not the symptom.

A gateway takes orders, a matcher matches them at the prices of a feed, a ledger books them through a connection to a
database. None of the five knows of diagnosis. What a user adds is in `look_after`: the model is that of the running
system, with one expectation that nobody can see from outside.
"""

import asyncio

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis import (
    DIAGNOSIS,
    OBSERVATIONS,
    REPAIR,
    Diagnosis,
    Expectation,
    Limits,
    Manner,
    Observation,
    Policy,
    Property,
)
from holdfast.diagnosis.model import Expect
from holdfast.diagnosis.observers import Agreement, Check, DiagnosticObserver
from holdfast.diagnosis.repair import ActionBegan, GaveUp, Repaired

# -- the service -----------------------------------------------------------------------------------------------------


class Price(hf.Message):
    cents: int


class Trade(hf.Message):
    cents: int


class Confirmation(hf.Message):
    seconds: float


class Alive(hf.Message): ...


class Tick(hf.Message): ...


class Match(hf.Message[int]): ...


class Book(hf.Message[int]):
    cents: int


class Write(hf.Message[None]):
    cents: int


class Disconnected(hf.Refusal): ...


class Break(hf.Message):
    """Begin to be faulty: freeze, leak, or lose the connection; nobody is told."""


class Feed(hf.Actor):
    def on_start(self, restored: bool) -> None:
        self._timer = self.ctx.every(0.05, Tick())

    @hf.on(Tick)
    async def tick(self, message: Tick) -> None:
        await self.ctx.publish("/prices", Price(100))

    @hf.on(Break)
    def freeze(self, message: Break) -> None:
        self._timer.cancel()


class Database(hf.Actor):
    """The connection: a restart makes a new one."""

    def __init__(self) -> None:
        self._is_connected = True

    def on_start(self, restored: bool) -> None:
        self.ctx.every(0.1, Tick())

    @hf.on(Tick)
    async def ping(self, message: Tick) -> None:
        if self._is_connected:
            await self.ctx.publish("/database", Alive())

    @hf.on(Write)
    def write(self, message: Write) -> None:
        if not self._is_connected:
            raise Disconnected

    @hf.on(Break)
    def lose(self, message: Break) -> None:
        self._is_connected = False


class Ledger(hf.Actor):
    """Lives in a process of its own, and its bookings outlive that."""

    database: hf.Binding[Database]

    def __init__(self) -> None:
        self.booked = 0
        self._leaks, self._leaked = False, list[bytes]()

    @hf.on(Book)
    async def book(self, message: Book) -> int:
        await self.database.ask(Write(message.cents))
        self.booked += 1
        if self._leaks:
            self._leaked.append(b"x" * 5_000_000)
        return self.booked

    @hf.on(Break)
    def leak(self, message: Break) -> None:
        self._leaks = True


class Matcher(hf.Actor):
    """Matches at the last price; when that is stale, it asks the exchange itself, which is slow."""

    deterministic = False
    ledger: hf.Binding[Ledger]

    def __init__(self) -> None:
        self._cents, self._time = 0, 0.0

    @hf.subscribe("/prices")
    @hf.on(Price)
    def see(self, message: Price) -> None:
        self._cents, self._time = message.cents, asyncio.get_running_loop().time()

    @hf.on(Match)
    async def match(self, message: Match) -> int:
        if asyncio.get_running_loop().time() - self._time > 0.2:
            await asyncio.sleep(0.3)
        number = await self.ledger.ask(Book(self._cents))
        await self.ctx.publish("/trades", Trade(self._cents))
        return number


class Gateway(hf.Actor):
    deterministic = False
    matcher: hf.Binding[Matcher]

    def on_start(self, restored: bool) -> None:
        self.ctx.tell_after(0.1, Tick())

    @hf.on(Tick)
    async def order(self, message: Tick) -> None:
        began = asyncio.get_running_loop().time()
        try:
            await self.matcher.ask(Match())
        except hf.HoldfastError:
            pass  # The customer is told to come again.
        else:
            await self.ctx.publish("/confirmations", Confirmation(asyncio.get_running_loop().time() - began))
        self.ctx.tell_after(0.1, Tick())


class Desk(hf.Actor):
    """What people see of it."""

    @hf.subscribe("/trades")
    @hf.subscribe("/confirmations")
    @hf.subscribe("/database")
    @hf.on(Trade)
    @hf.on(Confirmation)
    @hf.on(Alive)
    def show(self, message: Trade | Confirmation | Alive) -> None: ...


shop = hf.supervisor(
    "shop",
    children=[
        hf.child("feed", hf.start(Feed)),
        hf.child("database", hf.start(Database)),
        hf.child(
            "ledger",
            hf.start(Ledger),
            isolation="process",
            recovery=hf.hybrid(),
            bindings={"database": "/app/shop/database"},
        ),
        hf.child("matcher", hf.start(Matcher), bindings={"ledger": "/app/shop/ledger"}),
        hf.child("gateway", hf.start(Gateway), bindings={"matcher": "/app/shop/matcher"}),
        hf.child("desk", hf.start(Desk)),
    ],
)

# -- what a user adds ------------------------------------------------------------------------------------------------


async def look_after(system: hf.ActorSystem) -> None:
    """Diagnosis and repair of what runs in the system: who publishes, subscribes and is bound to whom is found out."""
    # Steady rather than quick: most of the last looks have to agree, and what comes within a second is one finding.
    manner = Manner(every=0.1, time_to_live=2.0, agreement=Agreement(3, 4))
    fast = Check("ok(latency)", "seconds", Limits(high=0.2))
    await diagnosis.watch(
        system,
        observers=[
            diagnosis.observer("latency", hf.start(DiagnosticObserver, "/confirmations", [fast], manner=manner))
        ],
        limits={"shop/ledger": {Property.MEMORY: Limits(high=150e6)}},
        repair="on",
        policy=Policy(settle=1.0),
        manner=manner,
        seconds=1.0,
        window=1.0,
        quiet=1.0,
    )
    # What nobody can see from outside: orders are quick while all who are asked work and prices are fresh.
    given = ("ok(/prices)", "ok(shop/ledger:replies)")
    expected = Expectation("ok(latency)", of=("shop/gateway", "shop/matcher"), given=given)
    await system.ref("/app/diagnosis/model", diagnosis.ModelServer).ask(diagnosis.ChangeModel((Expect(expected),)))


# -- who watches all of it -------------------------------------------------------------------------------------------


class WhenSeen(hf.Message[None]):
    """Answered when these literals have been observed."""

    literals: tuple[str, ...]


class Case(hf.Message):
    """What a case of repair came to."""

    suspects: tuple[str, ...]
    actions: tuple[str, ...]
    symptoms: tuple[str, ...]
    is_repaired: bool


class NextCase(hf.Message[Case]):
    """Answered when the next case of repair is over."""


class Operator(hf.Actor):
    deterministic = False

    def __init__(self) -> None:
        self._seen = set[str]()
        self._suspects, self._actions = set[str](), list[str]()
        self._wanted: tuple[hf.ReplyHandle[None], set[str]] | None = None
        self._asker: hf.ReplyHandle[Case] | None = None

    @hf.subscribe(OBSERVATIONS)
    @hf.on(Observation)
    def _observed(self, message: Observation) -> None:
        self._seen.add(str(message.literal))
        if self._wanted is not None and self._wanted[1] <= self._seen:
            self._wanted[0].reply(None)
            self._wanted = None

    @hf.subscribe(DIAGNOSIS)
    @hf.on(Diagnosis)
    def _diagnosed(self, message: Diagnosis) -> None:
        self._suspects.update(message.suspects)

    @hf.subscribe(REPAIR)
    @hf.on(ActionBegan)
    @hf.on(Repaired)
    @hf.on(GaveUp)
    def _repairs(self, message: ActionBegan | Repaired | GaveUp) -> None:
        if isinstance(message, ActionBegan):
            self._actions.append(str(message.step))
        elif self._asker is not None:
            bad = sorted(literal for literal in self._seen if literal.startswith("not "))
            case = Case(tuple(sorted(self._suspects)), tuple(self._actions), tuple(bad), isinstance(message, Repaired))
            self._asker.reply(case)

    @hf.on(WhenSeen)
    def _when_seen(self, message: WhenSeen) -> hf.ReplyHandle[None]:
        handle = self.ctx.reply_handle()
        self._wanted = handle, set(message.literals)
        return handle

    @hf.on(NextCase)
    def _next_case(self, message: NextCase) -> hf.ReplyHandle[Case]:
        self._seen, self._suspects, self._actions = set(), set(), []
        self._asker = self.ctx.reply_handle()
        return self._asker


async def main() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(shop)
        operator = system.spawn(hf.start(Operator), name="operator")
        names = ("/prices", "/trades", "/confirmations", "/database", "latency", "shop/ledger.memory")
        known = operator.ask(WhenSeen(tuple(f"ok({name})" for name in names)), timeout=50.0)
        await look_after(system)
        await known
        await asyncio.sleep(2.0)  # How often prices come is learned from the first twenty of them.

        async def broken(name: str, kind: type[hf.Actor]) -> Case:
            case = operator.ask(NextCase(), timeout=50.0)
            system.ref(f"/app/shop/{name}", kind).tell(Break())
            return await case

        case = await broken("feed", Feed)
        print(*case.suspects, *case.actions)  # shop/feed restart_child(shop/feed)
        print("not ok(latency)" in case.symptoms)  # True: the matcher was slow, and nobody blamed it

        ledger = system.ref("/app/shop/ledger", Ledger)
        before = await ledger.ask(Book(100))
        case = await broken("ledger", Ledger)
        print(*case.suspects, *case.actions)  # shop/ledger restart_child(shop/ledger)
        print(await ledger.ask(Book(100)) > before)  # True: the memory is free again, the bookings are kept

        case = await broken("database", Database)
        print(*case.suspects, *case.actions)  # shop/database restart_child(shop/database)
        print(case.is_repaired)  # True


if __name__ == "__main__":
    hf.run(main())
