"""The stacks of mechanisms that the campaign strikes, for each workload, with the assertions and versions they need."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import holdfast as hf
from holdfast.ftm.model.mechanism import load
from holdfast.ftm.sec.authority import CertificationAuthority
from tests.ftm.accounts import Add, Bank, Put, Transfer
from tests.ftm.store import Cas, Look, Store, Write
from tests.ftm.versions import OtherCounter, SameCounter

CA = "/app/ca"
HUGE = 10**9
"""No value that a client writes is as large."""
OWN = Path(__file__).with_name("retrying.py")


# -- versions ---------------------------------------------------------------------------------------------------------


class SameBank(Bank):
    """Another one, as far as anybody sees."""


class OtherBank(Bank):
    """Moves money in another way."""

    @hf.on(Transfer)
    async def transfer(self, message: Transfer) -> int:
        for account, amount in ((self.one, -message.amount), (self.other, message.amount)):
            await account.ask(Put(amount))
        self.done = [*self.done, message.tag]
        return len(self.done)


class SameStore(Store):
    """Another one, as far as anybody sees."""


class OtherStore(Store):
    """Keeps its values in another way."""

    @hf.on(Write)
    def write(self, message: Write) -> None:
        self.values = {**self.values, message.key: message.value}

    @hf.on(Cas)
    def cas(self, message: Cas) -> bool:
        is_old = self.values.get(message.key) == message.old
        if is_old:
            self.values = {**self.values, message.key: message.new}
        return is_old


VERSIONS: dict[str, tuple[type[hf.Actor], type[hf.Actor]]] = {
    "counter": (SameCounter, OtherCounter),
    "bank": (SameBank, OtherBank),
    "store": (SameStore, OtherStore),
}


# -- assertions -------------------------------------------------------------------------------------------------------


def counts_right(reply: Any, message: Any, state: Any) -> bool:
    return state.total == len(state.tags) and (not isinstance(message, Add) or reply == state.total)


def banks_right(reply: Any, message: Any, state: Any) -> bool:
    return not isinstance(message, Transfer) or (reply == len(state.done) and state.done[-1] == message.tag)


def stores_right(reply: Any, message: Any, state: Any) -> bool:
    is_read = not isinstance(message, Look) or reply == state.values.get(message.key)
    return is_read and all(value < HUGE for value in state.values.values())


RIGHT: dict[str, Any] = {"counter": counts_right, "bank": banks_right, "store": stores_right}


# -- stacks -----------------------------------------------------------------------------------------------------------

Make = Callable[[str], tuple[Any, ...]]
"""The layers of a stack for a workload, outermost first."""

STACKS: dict[str, Make] = {
    "PBR": lambda load: (hf.ftm.PBR(),),
    "LFR": lambda load: (hf.ftm.LFR(),),
    "TR": lambda load: (hf.ftm.TR(),),
    "AD+PBR": lambda load: (hf.ftm.AD((RIGHT[load],)), hf.ftm.PBR()),
    "AD+LFR": lambda load: (hf.ftm.AD((RIGHT[load],)), hf.ftm.LFR()),
    "RB": lambda load: (hf.ftm.RB(alternates=VERSIONS[load][1], test=RIGHT[load]),),
    "NVP": lambda load: (hf.ftm.NVP(VERSIONS[load]),),
    "TMR": lambda load: (hf.ftm.TMR(),),
    "SEC": lambda load: (hf.ftm.SEC(CA),),
    "SEC+PBR": lambda load: (hf.ftm.SEC(CA), hf.ftm.PBR()),
    "PBR+TR": lambda load: (hf.ftm.PBR(), hf.ftm.TR()),
    "LFR+TR": lambda load: (hf.ftm.LFR(), hf.ftm.TR()),
    "SEC+PBR+TR": lambda load: (hf.ftm.SEC(CA), hf.ftm.PBR(), hf.ftm.TR()),
    "PBR+own": lambda load: (hf.ftm.PBR(), own(load)),
}


def own(workload: str) -> Any:
    """The mechanism that the library has never seen."""
    made: Any = load(OWN)
    return made(checks=(RIGHT[workload],))


async def enrolling(system: hf.ActorSystem, layers: tuple[Any, ...]) -> None:
    """Start the authority, if a layer needs certificates."""
    if any(one.name == "sec" for one in layers):
        await system.start(hf.child("ca", hf.start(CertificationAuthority)))
