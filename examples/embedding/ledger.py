"""The actor that all programs of this folder embed: it keeps numbers, and loses none that it has confirmed."""

import os
from typing import Literal

import holdfast as hf


class Note(hf.Message[int]):
    """Keep a number; the answer is how many there are."""

    number: int


class Notes(hf.Message[list[int]]):
    """Say which numbers there are."""


class Ledger(hf.Actor):
    """Keeps numbers. A client that has got no answer may send its number again."""

    def __init__(self) -> None:
        self.numbers: dict[int, None] = {}

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.numbers[message.number] = None
        return len(self.numbers)

    @hf.on(Notes, readonly=True)
    def notes(self, message: Notes) -> list[int]:
        return list(self.numbers)


def ledger(isolation: Literal["task", "process"] = "task") -> hf.ChildSpec[Ledger]:
    """Say how the ledger lives: it is recorded, so that it goes on where it was, in whatever program comes next."""
    return hf.child("ledger", hf.start(Ledger), recovery=hf.hybrid(), isolation=isolation)


def make_system(number: int = 0) -> hf.ActorSystem:
    """Make the system of worker `number`, with a store of its own in the folder that `NOTES_FOLDER` names."""
    return hf.ActorSystem("notes", store=f"sqlite:{os.environ.get('NOTES_FOLDER', '.')}/notes-{number}.db")
