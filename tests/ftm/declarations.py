"""Declarations of eight mechanisms, as their files have them; bricks are not needed to select."""

from typing import ClassVar

from holdfast.ftm.model.declaration import Cost


class Declared:
    """Base of the declarations below."""

    name: ClassVar[str] = ""
    replicas: ClassVar[int] = 1
    units: ClassVar[int] = 1
    tolerates: ClassVar[frozenset[str]] = frozenset()
    needs: ClassVar[frozenset[str]] = frozenset()
    bandwidth: ClassVar[str] = "nil"
    cpu: ClassVar[str] = "low"


class PBR(Declared):
    name = "pbr"
    replicas = units = 2
    tolerates = frozenset({"crash"})
    needs = frozenset({"state_access"})
    bandwidth = "high"
    cost = Cost(states=1, requests=1, recovery=0.02)


class LFR(Declared):
    name = "lfr"
    replicas = units = 2
    tolerates = frozenset({"crash"})
    needs = frozenset({"determinism"})
    bandwidth = "low"
    cpu = "high"
    cost = Cost(total=2, requests=1, recovery=0.01)


class TR(Declared):
    name = "tr"
    tolerates = frozenset({"transient_value"})
    needs = frozenset({"determinism", "state_access"})
    cpu = "high"


class AD(Declared):
    name = "a&d"
    replicas = units = 2
    tolerates = frozenset({"transient_value", "permanent_value"})
    needs = frozenset({"assertions"})
    over = frozenset({"replication"})


class SEC(Declared):
    name = "sec"
    tolerates = frozenset({"eavesdropping", "forgery", "replay"})
    needs = frozenset({"certificates"})


class RB(Declared):
    name = "rb"
    layer = "repetition"
    tolerates = frozenset({"development", "transient_value"})
    needs = frozenset({"versions", "assertions", "state_access"})


class NVP(Declared):
    name = "nvp"
    layer = "repetition"
    units = 3
    tolerates = frozenset({"development", "transient_value", "permanent_value"})
    needs = frozenset({"versions", "determinism"})
    cpu = "high"
    cost = Cost(runs=1, latency=1, total=3, requests=2)


class TMR(Declared):
    name = "tmr"
    replicas = units = 3
    tolerates = frozenset({"crash", "transient_value", "permanent_value"})
    needs = frozenset({"determinism"})
    bandwidth = "low"
    cpu = "high"


EIGHT = (PBR, LFR, TR, AD, SEC, RB, NVP, TMR)
