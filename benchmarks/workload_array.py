"""An actor that mirrors numpy arrays: apart from the others, so that they do not import numpy."""

from __future__ import annotations

import numpy as np

import holdfast as hf


class Picture(hf.Message[np.ndarray]):
    """Asked; the reply is the same pixels."""

    pixels: np.ndarray


class Mirror(hf.Actor):
    """Lives in a process of its own."""

    @hf.on(Picture)
    def reflect(self, message: Picture) -> np.ndarray:
        return message.pixels
