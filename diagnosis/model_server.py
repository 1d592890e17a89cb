"""The model server: the actor that holds the model while the system runs (D29, D31).

A change that leads to a model that cannot be used is refused, with all that is wrong with it, and changes nothing.
"""

from __future__ import annotations

from typing import Final

from ..actors.kernel.actor import Actor, on
from ..actors.kernel.message import Message, Refusal, RuntimeCall
from .messages import MODEL, ModelChanged
from .model import (
    Change,
    Declaration,
    Finding,
    History,
    Model,
    ModelError,
    NoSuchVersion,
    Replace,
    System,
    Version,
    lint,
    read,
)
from .model.model_history import apply

LOADED: Final = "loaded"


class GetModel(Message[Version]):
    """Asks for the version of the model that is in force."""


class GetVersions(Message[tuple[Version, ...]]):
    """All versions that are kept, oldest first."""


class ChangeModel(RuntimeCall[int]):
    """Make all of the changes, or none; answered with the new version. Refused with `ModelRefused`."""

    changes: tuple[Change, ...]
    reason: str = ""


class LoadModel(RuntimeCall[int]):
    """Replace the model by that of a file's text (YAML); answered with the new version. Refused with `ModelRefused`."""

    text: str
    where: str = "model.yaml"
    """How errors name the file."""


class RollBackModel(RuntimeCall[int]):
    """Make an earlier version count again, the one before unless it is named; answered with the new version's number.

    Refused with `ModelRefused`: it is not kept.
    """

    version: int | None = None
    reason: str = ""


class ValidateModel(RuntimeCall[tuple[Finding, ...]]):
    """Ask what changes of the model would lead to; nothing is changed.

    Answered with what lint finds; refused with `ModelRefused`.
    """

    changes: tuple[Change, ...] = ()


class ModelRefused(Refusal, text="the model stays as it is: {problems:; }"):
    """The model stays as it is; `problems` says why, one line each."""

    problems: tuple[str, ...]


class ModelServer(Actor):
    """Holds the model, checks what is changed, and tells of it on `/model`.

    Args:
        model: to begin with. A `History` outlives this actor's lives: after a restart the model is what it was.
    """

    deterministic = False

    def __init__(self, model: History | Declaration | System) -> None:
        self._history = model if isinstance(model, History) else History(model)

    async def on_start(self, restored: bool) -> None:
        """In a later life, say what counts: the last life may have ended before it did."""
        if len(self._history.versions) > 1:
            await self._tell()

    @on(GetModel, readonly=True)
    def _current(self, message: GetModel) -> Version:
        return self._history.versions[-1]

    @on(GetVersions, readonly=True)
    def _versions(self, message: GetVersions) -> tuple[Version, ...]:
        return self._history.versions

    @on(ChangeModel)
    async def _change(self, message: ChangeModel) -> int:
        return await self._changed(message.changes, message.reason)

    @on(LoadModel)
    async def _load(self, message: LoadModel) -> int:
        try:
            declaration = read(message.text, message.where)
        except ModelError as error:
            raise ModelRefused(error.problems) from error
        return await self._changed((Replace(declaration),), f"{LOADED} from {message.where}")

    @on(RollBackModel)
    async def _roll_back(self, message: RollBackModel) -> int:
        try:
            self._history.roll_back(message.version, message.reason, self.ctx.now())
        except NoSuchVersion as error:
            raise ModelRefused((str(error),)) from error
        return await self._tell()

    @on(ValidateModel, readonly=True)
    def _validate(self, message: ValidateModel) -> tuple[Finding, ...]:
        declaration = self._history.model.declaration
        try:
            for change in message.changes:
                declaration = apply(change, declaration)
            return tuple(lint(Model(declaration)))
        except ModelError as error:
            raise ModelRefused(error.problems) from error

    async def _changed(self, changes: tuple[Change, ...], reason: str) -> int:
        try:
            self._history.change(changes, reason, self.ctx.now())
        except ModelError as error:
            raise ModelRefused(error.problems) from error
        return await self._tell()

    async def _tell(self) -> int:
        version = self._history.versions[-1]
        await self.ctx.publish(MODEL, ModelChanged(version.number, version.declaration, version.reason))
        return version.number
