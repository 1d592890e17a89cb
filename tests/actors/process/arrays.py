"""An actor that takes arrays: apart from the others, whose processes need no numpy."""

from __future__ import annotations

import numpy as np

import holdfast as hf


class Array(hf.Message[np.ndarray]):
    values: np.ndarray
    factor: float


class Multiplier(hf.Actor):
    """Returns an array times a number."""

    @hf.on(Array)
    def array(self, message: Array) -> np.ndarray:
        message.values.flags.writeable = message.values.flags.writeable or True
        return message.values * message.factor
