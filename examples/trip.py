"""A trip is booked at three companies, and taken back where one of them says no: a saga, as ordinary code.

Each booking is an effect: its outcome is journaled, so a crash at any point neither books anything twice nor forgets
what has to be taken back. The process of the booking actor is killed once in the middle to show that.
"""

import asyncio
import os
import signal
import tempfile
from pathlib import Path

import holdfast as hf

COMPANIES = Path(os.environ.setdefault("COMPANIES", tempfile.mkdtemp()))  # The outside world: a file for each company.


class Sold(hf.Refusal, text="the {company} has none left"):
    """The company has none left."""

    company: str


class Trip(hf.Message[str]):
    to: str


def book(company: str, to: str, key: str) -> str:
    """Book at a company, which knows a booking that comes again by its key."""
    if company == "hotel" and to == "Atlantis":
        raise Sold(company)
    file = COMPANIES / company
    bookings = file.read_text().splitlines() if file.exists() else []
    if key not in bookings:
        file.write_text("\n".join([*bookings, key]))
    return f"{company} to {to}"


def cancel(company: str, key: str) -> None:
    """Take a booking back; one that is not there is no error, for this may come twice."""
    file = COMPANIES / company
    file.write_text("\n".join(one for one in file.read_text().splitlines() if one != key))


class Agency(hf.Actor):
    def __init__(self) -> None:
        self.sold = 0

    @hf.on(Trip)
    async def trip(self, message: Trip) -> str:
        key, booked = self.ctx.message_id, dict[str, str]()
        try:
            for company in ("train", "ferry", "hotel"):
                booked[company] = await self.ctx.effect(book, company, message.to, key, key=f"book {company}")
                if company == "ferry" and self.ctx.life == 1:
                    os.kill(os.getpid(), signal.SIGKILL)  # Where it hurts most.
        except (Sold, hf.errors.EffectFailed) as problem:
            for company in reversed(booked):
                await self.ctx.effect(cancel, company, key, key=f"cancel {company}", retry=hf.Retry(attempts=100))
            return f"all is taken back, for {problem}"
        self.sold += 1
        return ", ".join(booked.values())


def bookings() -> list[int]:
    """How many bookings each company has."""
    return [len(file.read_text().split()) for file in sorted(COMPANIES.iterdir())]


async def main() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        agency = await system.start(hf.child("agency", hf.start(Agency), recovery=hf.hybrid(), isolation="process"))
        print(await agency.ask(Trip("Sylt")))  # train to Sylt, ferry to Sylt, hotel to Sylt
        print(bookings())  # [1, 1, 1]
        print(await agency.ask(Trip("Atlantis")))  # all is taken back, for the hotel has none left
        print(bookings())  # [1, 1, 1]


if __name__ == "__main__":
    asyncio.run(main())
