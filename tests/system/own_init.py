"""A supervisor in a process of its own that names its children in its own `init`, and binds one of them there."""

from __future__ import annotations

from typing import Any

import holdfast as hf

TOP = "/app/top"
WHO = f"{TOP}/who"


class Where(hf.Message[str]):
    """The address that the port leads to."""


class Die(hf.Message): ...


class Kill(hf.Message[str]):
    """Kill whoever the port leads to; the reply is the error, if there is one."""


class Other(hf.Actor):
    @hf.on(Where)
    def where(self, message: Where) -> str:
        return self.ctx.path


class Owner(hf.Actor):
    port: hf.Binding[Other]

    @hf.on(Where, readonly=True)
    def where(self, message: Where) -> str:
        try:
            return self.port.path
        except hf.HoldfastError:
            return ""

    @hf.on(Die)
    def die(self, message: Die) -> None:
        raise RuntimeError("as told")

    @hf.on(Kill)
    def kill(self, message: Kill) -> str:
        try:
            self.port.kill()
        except hf.errors.NotGranted as error:
            return str(error)
        return ""


class Top(hf.Supervisor):
    """Its own `init` names the children: `kind` says how the one with the binding lives."""

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def init(self) -> hf.Plan:
        near = hf.child("near", hf.start(Other))
        who = hf.child("who", hf.start(Owner), bindings={"port": "/app/first"}, **options(self.kind))
        return hf.Plan([near, who], intensity=1000)


class Nest(hf.Supervisor):
    """The one with the binding is a grandchild, whose supervisor is an ordinary one."""

    def init(self) -> hf.Plan:
        who = hf.child("who", hf.start(Owner), bindings={"port": "/app/first"})
        return hf.Plan([hf.supervisor("inner", children=[who], intensity=1000)], intensity=1000)


def options(kind: str) -> dict[str, Any]:
    """How the child with the binding lives."""
    known: dict[str, dict[str, Any]] = {
        "plain": {},
        "recorded": {"recovery": hf.hybrid(interval=3600.0)},
        "protected": {"mechanism": hf.ftm.PBR()},
    }
    return known[kind]
