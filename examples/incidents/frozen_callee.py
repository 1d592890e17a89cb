"""A frozen callee: a bank waits for a payment provider that never answers, and the tills wait for the bank."""

import asyncio

import holdfast as hf


class Pay(hf.Message[str]):
    cents: int


class Book(hf.Message[str]):
    cents: int


class Bank(hf.Actor):
    def __init__(self, port: int) -> None:
        self.port = port

    @hf.on(Book)
    async def book(self, message: Book) -> str:
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        writer.write(f"charge {message.cents}\n".encode())
        receipt = await reader.readline()
        writer.close()
        return receipt.decode()


class Till(hf.Actor):
    bank: hf.Binding[Bank]

    @hf.on(Pay)
    async def pay(self, message: Pay) -> str:
        try:
            return await self.bank.ask(Book(message.cents), timeout=60.0)
        except hf.HoldfastError:
            return "try again later"


async def says_nothing(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Stands for a provider that takes a connection and never answers."""
    await reader.read()
    writer.close()


async def main(system: hf.ActorSystem) -> None:
    provider = await asyncio.start_server(says_nothing, "127.0.0.1", 0)
    bank = hf.child("bank", hf.start(Bank, provider.sockets[0].getsockname()[1]), shutdown=0.5)
    till = hf.child("till", hf.start(Till), bindings={"bank": "/shop/bank"}, shutdown=0.5)
    await system.start(bank)
    paying = await system.start(till)
    await asyncio.gather(*(paying.ask(Pay(cents), timeout=60.0) for cents in (250, 399, 1000)), return_exceptions=True)
    await asyncio.Event().wait()
