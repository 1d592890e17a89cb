"""Chapter 6 of the tutorial: a part that falls silent without crashing is found and repaired."""

from chapter_1 import Account, Balance

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis import OBSERVATIONS, REPAIR, GeneralObserver, Manner, Observation, Policy, System
from holdfast.diagnosis.repair import Repaired


class Rate(hf.Message):
    dollars: float


class Quote(hf.Message):
    price: float


class Tick(hf.Message): ...


class Freeze(hf.Message):
    """Stop publishing, and tell nobody."""


class Market(hf.Actor):
    def on_start(self, restored: bool) -> None:
        self._timer = self.ctx.every(0.05, Tick())

    @hf.on(Tick)
    async def tick(self, message: Tick) -> None:
        await self.ctx.publish("/rates", Rate(1.25))

    @hf.on(Freeze)
    def freeze(self, message: Freeze) -> None:
        self._timer.cancel()


class Exchange(hf.Actor):
    @hf.subscribe("/rates")
    @hf.on(Rate)
    async def quote(self, message: Rate) -> None:
        await self.ctx.publish("/quotes", Quote(message.dollars * 1.01))


class Board(hf.Actor):
    """Shows the quotes in the hall."""

    @hf.subscribe("/quotes")
    @hf.on(Quote)
    def show(self, message: Quote) -> None: ...


branch = hf.supervisor(
    "branch",
    children=[
        hf.child("alice", hf.start(Account, 100)),
        hf.child("market", hf.start(Market)),
        hf.child("exchange", hf.start(Exchange)),
        hf.child("board", hf.start(Board)),
    ],
)


class Report(hf.Message):
    symptoms: list[str]
    actions: list[str]


class NextReport(hf.Message[Report]):
    """Answered when the next repair is over."""


class Operator(hf.Actor):
    """Reads along what is observed and what is done about it."""

    def __init__(self) -> None:
        self.symptoms = set[str]()
        self.asker: hf.ReplyHandle[Report] | None = None

    @hf.on(NextReport)
    def promise(self, message: NextReport) -> hf.ReplyHandle[Report]:
        self.asker = self.ctx.reply_handle()
        return self.asker

    @hf.subscribe(OBSERVATIONS)
    @hf.on(Observation)
    def observe(self, message: Observation) -> None:
        if str(message.literal).startswith("not "):
            self.symptoms.add(str(message.literal))

    @hf.subscribe(REPAIR)
    @hf.on(Repaired)
    def report(self, message: Repaired) -> None:
        if self.asker is not None:
            self.asker.reply(Report(sorted(self.symptoms), [str(action) for action in message.actions]))
            self.asker = None


async def look_after(system: hf.ActorSystem) -> diagnosis.Watch:
    model = System()
    model.node("market", out=["/rates"])
    model.node("exchange", out={"/quotes": ["/rates"]})  # it makes quotes from rates

    manner = Manner(every=0.05, time_to_live=1.0)
    observers = [  # about 20 messages in a second; silence is what we want to hear of
        diagnosis.observer(name, hf.start(GeneralObserver, f"/{name}", 20.0, 19.0, window=1.0, manner=manner))
        for name in ("rates", "quotes")
    ]
    addresses = {"market": "/bank/branch/market", "exchange": "/bank/branch/exchange"}
    return await diagnosis.watch(
        system, model, observers, addresses=addresses, repair="on", policy=Policy(settle=0.5), manner=manner
    )


async def main() -> None:
    async with hf.ActorSystem("bank", log=False) as system:
        await system.start(branch)
        watching = await look_after(system)
        operator = await system.start(hf.child("operator", hf.start(Operator)))

        report = operator.ask(NextReport(), timeout=20.0)
        system.ref("/bank/branch/market", Market).tell(Freeze())
        found = await report
        print(found.symptoms)  # ['not ok(/quotes)', 'not ok(/rates)']
        print(found.actions)  # ['restart_child(market)']

        print((await watching.diagnosis()).state.name)  # HEALTHY
        print(await system.ref("/bank/branch/alice", Account).ask(Balance()))  # 100


if __name__ == "__main__":
    hf.run(main())
