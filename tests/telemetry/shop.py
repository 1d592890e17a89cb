"""Actors that are killed, crash and wait, for the tests of what is told of them."""

import holdfast as hf


class Add(hf.Message[int]):
    n: int = 1


class Boom(hf.Message[int]): ...


class No(hf.Refusal):
    """Not today."""


class Deny(hf.Message[int]): ...


class Waste(hf.Message):
    count: int


class Hire(hf.Message): ...


class Careless(hf.Actor):
    """Has a helper that has ended, and tells it something all the same; refuses what it tells itself."""

    def __init__(self) -> None:
        self.helper: hf.ActorRef[Account] | None = None
        self.asked: hf.ReplyHandle[None] | None = None

    @hf.on(Hire)
    def hire(self, message: Hire) -> hf.ReplyHandle[None]:
        self.helper, self.asked = self.ctx.spawn(hf.start(Account)), self.ctx.reply_handle()
        self.ctx.monitor(self.helper)
        self.helper.stop()
        return self.asked

    def on_down(self, source: hf.ActorRef, reason: hf.ExitReason, recovering: bool) -> None:
        assert self.asked is not None
        self.asked.reply(None)

    @hf.on(Waste)
    def waste(self, message: Waste) -> None:
        assert self.helper is not None
        for _ in range(message.count):
            self.helper.tell(Add())
            self.ctx.ref.tell(Deny())

    @hf.on(Deny)
    def deny(self, message: Deny) -> int:
        raise No


class Account(hf.Actor):
    def __init__(self) -> None:
        self.euros = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.euros += message.n
        return self.euros

    @hf.on(Boom)
    def boom(self, message: Boom) -> int:
        raise ValueError("boom")

    @hf.on(Deny)
    def deny(self, message: Deny) -> int:
        raise No
