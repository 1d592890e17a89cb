"""Who may enrol and revoke: the root, and whom it has granted the authority's address."""

from __future__ import annotations

import pytest

import holdfast as hf
from holdfast.ftm.sec.authority import CertificationAuthority, Enrol, GetCertificate, GetRoot, Revoke
from holdfast.ftm.sec.certificates import make_request
from holdfast.ftm.sec.keys import SigningKey

CA = "/app/ca"


class Seize(hf.Message[list[str]]):
    """Become `name` in the eyes of the authority."""

    name: str


class Mallory(hf.Actor):
    """Lives in a process of its own, and has neither key nor certificate."""

    @hf.on(Seize)
    async def seize(self, message: Seize) -> list[str]:
        authority = self.ctx.find(CA, CertificationAuthority)
        said = list[str]()
        request = make_request(SigningKey.per_start(), message.name)
        for order in (Revoke(message.name), Enrol(request)):
            try:
                said.append(repr(await authority.ask(order)))
            except hf.HoldfastError as error:
                said.append(type(error).__name__)
        return [*said, "root" if await authority.ask(GetRoot()) else ""]


class Registrar(Mallory):
    """Was granted the authority's address."""

    authority: hf.Binding[CertificationAuthority]


async def test_an_actor_without_keys_becomes_nobody_else() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        authority = await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        mine = await authority.ask(Enrol(make_request(SigningKey.per_start(), "bob")))
        mallory = await system.start(hf.child("mallory", hf.start(Mallory), isolation="process"))
        assert await mallory.ask(Seize("bob"), timeout=20.0) == ["NotGranted", "NotGranted", "root"]
        assert await authority.ask(GetCertificate("bob")) == mine
        assert await mallory.ask(Seize("somebody new"), timeout=20.0) == ["NotGranted", "NotGranted", "root"]
        with pytest.raises(hf.HoldfastError, match="no valid certificate"):
            await authority.ask(GetCertificate("somebody new"))


async def test_whom_the_root_has_granted_the_authority_may_enrol() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        authority = await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        spec = hf.child("registrar", hf.start(Registrar), isolation="process", bindings={"authority": CA})
        registrar = await system.start(spec)
        revoked, enrolled, _ = await registrar.ask(Seize("bob"), timeout=20.0)
        assert revoked == "0"
        assert enrolled == repr(await authority.ask(GetCertificate("bob")))
