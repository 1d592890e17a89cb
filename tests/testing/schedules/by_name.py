"""An actor whose module has the world by names of its own."""

from __future__ import annotations

import random
from os import urandom
from time import monotonic, strftime, time_ns
from time import time as what_time_it_is

import numpy

import holdfast as hf

__all__ = ["NEW", "OLD", "OWN", "Look", "Looker", "monotonic", "urandom", "what_time_it_is"]

OWN = random.Random()
NEW = numpy.random.default_rng()
OLD = numpy.random.RandomState()


class Look(hf.Message[list[str]]):
    """Answered with what the names give."""


class Looker(hf.Actor):
    """Looks by name."""

    @hf.on(Look)
    def look(self, message: Look) -> list[str]:
        found = [what_time_it_is(), monotonic(), time_ns(), strftime("%c"), urandom(4)]
        return [*map(repr, found), *(repr(one) for one in (OWN.random(), NEW.random(), OLD.random_sample()))]
