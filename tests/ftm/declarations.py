"""Declarations of eight mechanisms, as their files have them; bricks are not needed to select."""

from holdfast.ftm.model.mechanism_declaration import Cost, MechanismDeclaration


class PBR(MechanismDeclaration):
    name = "pbr"
    replicas = units = 2
    tolerates = frozenset({"crash"})
    needs = frozenset({"state_access"})
    bandwidth = "high"
    cost = Cost(states=1, requests=1, recovery=0.02)


class LFR(MechanismDeclaration):
    name = "lfr"
    replicas = units = 2
    tolerates = frozenset({"crash"})
    needs = frozenset({"determinism"})
    bandwidth = "low"
    cpu = "high"
    cost = Cost(total=2, requests=1, recovery=0.01)


class TR(MechanismDeclaration):
    name = "tr"
    tolerates = frozenset({"transient_value"})
    needs = frozenset({"determinism", "state_access"})
    cpu = "high"


class AD(MechanismDeclaration):
    name = "a&d"
    replicas = units = 2
    tolerates = frozenset({"transient_value", "permanent_value"})
    needs = frozenset({"assertions"})
    over = frozenset({"replication"})


class SEC(MechanismDeclaration):
    name = "sec"
    tolerates = frozenset({"eavesdropping", "forgery", "replay"})
    needs = frozenset({"certificates"})


class RB(MechanismDeclaration):
    name = "rb"
    layer = "repetition"
    tolerates = frozenset({"development", "transient_value"})
    needs = frozenset({"versions", "assertions", "state_access"})


class NVP(MechanismDeclaration):
    name = "nvp"
    layer = "repetition"
    units = 3
    tolerates = frozenset({"development", "transient_value", "permanent_value"})
    needs = frozenset({"versions", "determinism"})
    cpu = "high"
    cost = Cost(runs=1, latency=1, total=3, requests=2)


class TMR(MechanismDeclaration):
    name = "tmr"
    replicas = units = 3
    tolerates = frozenset({"crash", "transient_value", "permanent_value"})
    needs = frozenset({"determinism"})
    bandwidth = "low"
    cpu = "high"


EIGHT = (PBR, LFR, TR, AD, SEC, RB, NVP, TMR)
