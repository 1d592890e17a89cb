"""Actors that are killed, crash and wait, for the tests of what is told of them."""

import holdfast as hf


class Add(hf.Message[int]):
    n: int = 1


class Boom(hf.Message[int]): ...


class No(hf.Refusal):
    """Not today."""


class Deny(hf.Message[int]): ...


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
