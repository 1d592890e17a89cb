"""A web service whose state lives in an actor. FastAPI runs `def` endpoints in threads, `async def` ones on the loop.

`pip install 'holdfast[web]'`, then `python examples/fastapi_service.py`, and in another terminal
`curl -X POST localhost:8000/tickets/opera` and `curl localhost:8000/tickets/opera`.
"""

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import TypedDict

import uvicorn
from fastapi import FastAPI, HTTPException, Request

import holdfast as hf


class Sell(hf.Message[int]):
    show: str


class CountLeft(hf.Message[int]):
    show: str


class SoldOut(hf.Refusal):
    show: str


class BoxOffice(hf.Actor):
    def __init__(self, seats: int) -> None:
        self.seats = seats
        self.sold: dict[str, int] = {}

    @hf.on(Sell)
    def sell(self, message: Sell) -> int:
        number = self.sold.get(message.show, 0) + 1
        if number > self.seats:
            raise SoldOut(message.show)
        self.sold[message.show] = number
        return number

    @hf.on(CountLeft, readonly=True)
    def count_left(self, message: CountLeft) -> int:
        return self.seats - self.sold.get(message.show, 0)


class State(TypedDict):
    """What each request finds in `request.state`."""

    office: hf.ActorRef[BoxOffice]
    threads: hf.system.ThreadPortal


@asynccontextmanager
async def lifespan(app: FastAPI) -> AsyncGenerator[State, None]:
    """The system starts and stops with the server, and lives on the server's event loop."""
    async with hf.ActorSystem("theatre") as system:
        office: hf.ActorRef[BoxOffice] = await system.start(
            hf.child("office", hf.start(BoxOffice, seats=50), recovery=hf.hybrid())
        )
        yield {"office": office, "threads": system.from_thread()}


app = FastAPI(lifespan=lifespan)


@app.post("/tickets/{show}")
def sell(show: str, request: Request) -> dict[str, int]:
    """A plain `def` runs in a thread, where a ref must not be used: the portal brings the message to the loop."""
    try:
        return {"ticket": request.state.threads.ask(request.state.office, Sell(show))}
    except SoldOut as no:
        raise HTTPException(409, f"{no.show} is sold out") from no


@app.get("/tickets/{show}")
async def count_left(show: str, request: Request) -> dict[str, int]:
    """An `async def` runs on the loop of the system, and uses the ref itself."""
    return {"left": await request.state.office.ask(CountLeft(show))}


if __name__ == "__main__":
    uvicorn.run(app, host="127.0.0.1", port=8000)
