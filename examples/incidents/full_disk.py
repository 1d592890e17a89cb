"""A full disk: an order book records its orders in a store, and something else has taken the room beside it."""

import asyncio

import holdfast as hf


class Order(hf.Message[int]):
    text: str


class OrderBook(hf.Actor):
    def __init__(self) -> None:
        self.orders = 0

    @hf.on(Order)
    def order(self, message: Order) -> int:
        self.orders += 1
        return self.orders


async def main(system: hf.ActorSystem) -> None:
    orders = await system.start(hf.child("orders", hf.start(OrderBook), recovery=hf.hybrid()))
    while True:
        try:
            await orders.ask(Order("x" * 1_000), timeout=1.0)
        except hf.HoldfastError as error:
            print(f"an order was not taken: {error}", flush=True)
        await asyncio.sleep(0.02)
