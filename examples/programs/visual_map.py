"""A map from photos that closes loops, as RTAB-Map makes it: it knows a place again, and bends the way.

Data: 84 photos of two laps through corridors (rtabmap_samples.zip). They have no odometry: the steps are those of two
laps of a circle, with a drift to one side.
Correct: all photos are in the map, most of what was seen twice is known again, and the way is where it was.
Command: python examples/programs/visual_map.py [--limit N] [--method fresh] [--kill-at 60s]
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import DATA, DamagedData, Feed, Program, Timed, Verdict, find_file, main, reading
from numpy.typing import NDArray
from scans import Floats

import holdfast as hf

FILE = "rtabmap_samples.zip"
LAP = 39.5  # photos, as can be seen in them
DRIFT = 0.1  # steps to the north in each step
SAME_PLACE = 4  # photos apart, of two that show the same
KNOWN_AGAIN = 0.7  # of the places seen twice, at least
GOOD = 3.0  # steps that a photo may be off; by odometry alone the last is more than 8 off

FEATURES = 400
WORD_RADIUS = 40  # bits of 256 in which two descriptors of one thing may differ
YOUNGEST = 10  # photos before this one: what is nearer is no loop
CANDIDATES = 3
LEAST_INLIERS = 45  # features that agree on how the camera has moved
LOOP_WEIGHT = 5.0  # against one step of the odometry

cv2.setNumThreads(1)  # The same bits in every run.

Words = NDArray[np.uint8]  # ORB descriptors, shape (n, 32)


class Photo(hf.Message[int]):
    """A photo (JPEG), and the step since the one before. The reply: the photo of the same place, or -1."""

    jpeg: bytes
    east: float
    north: float


class VisualMap(hf.Actor):
    """Holds the dictionary of words, what each photo shows, the links between photos, and where each was taken."""

    def __init__(self) -> None:
        self.words: Words = np.zeros((0, 32), np.uint8)
        self.descriptors: list[Words] = []
        self.corners: list[NDArray[np.float32]] = []  # where in the photo; shape (n, 2), pixels
        self.contents: list[NDArray[np.int64]] = []  # words in each photo, each once, rising
        self.steps: list[tuple[float, float]] = []
        self.loops: list[tuple[int, int]] = []  # later and earlier photo of one place
        self.positions: Floats = np.zeros((0, 2))

    @hf.on(Photo)
    def add(self, photo: Photo) -> int:
        corners, descriptors = _features(photo.jpeg)
        content = self._learn(descriptors)
        number, loop = len(self.steps), self._find_loop(corners, descriptors, content)
        self.corners.append(corners)
        self.descriptors.append(descriptors)
        self.contents.append(content)
        self.steps.append((photo.east, photo.north))
        if loop >= 0:
            self.loops.append((number, loop))
        self.positions = solve(self.steps, self.loops)
        return loop

    def _learn(self, descriptors: Words) -> NDArray[np.int64]:
        """The words of these descriptors; those that are like none become words themselves."""
        matches = _matcher().match(descriptors, self.words) if len(self.words) and len(descriptors) else ()
        content = np.full(len(descriptors), -1)
        for match in matches:
            if match.distance <= WORD_RADIUS:
                content[match.queryIdx] = match.trainIdx
        new = np.flatnonzero(content < 0)
        content[new] = len(self.words) + np.arange(len(new))
        self.words = np.concatenate([self.words, descriptors[new]])
        return np.unique(content)

    def _find_loop(self, corners: NDArray[np.float32], descriptors: Words, content: NDArray[np.int64]) -> int:
        """The older photo that shows the same place; -1 if there is none."""
        inliers = {
            old: _inliers(corners, descriptors, self.corners[old], self.descriptors[old])
            for old in self._candidates(content)
        }
        best = max(inliers, key=lambda old: inliers[old], default=-1)
        return best if best >= 0 and inliers[best] >= LEAST_INLIERS else -1

    def _candidates(self, content: NDArray[np.int64]) -> list[int]:
        """The older photos that share most with this one, rare words counting more (tf-idf)."""
        frequency = np.zeros(len(self.words))
        for known in self.contents:
            frequency[known] += 1
        worth = np.log((len(self.contents) + 1) / (frequency + 1))
        worth[np.setdiff1d(np.arange(len(worth)), content, assume_unique=True)] = 0
        scores = [float(worth[known].sum()) for known in self.contents[:-YOUNGEST]]
        return sorted(range(len(scores)), key=lambda old: -scores[old])[:CANDIDATES]


def _matcher(*, mutual: bool = False) -> cv2.BFMatcher:
    return cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=mutual)


def _features(jpeg: bytes) -> tuple[NDArray[np.float32], Words]:
    """Corners and their descriptors; a blank wall has none."""
    grey = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    found, descriptors = cv2.ORB.create(FEATURES).detectAndCompute(np.asarray(grey), np.zeros(0))
    corners = np.array([corner.pt for corner in found], np.float32).reshape(-1, 2)
    return corners, np.array([] if descriptors is None else descriptors, np.uint8).reshape(-1, 32)


def _inliers(corners: NDArray[np.float32], words: Words, old_corners: NDArray[np.float32], old_words: Words) -> int:
    """How many features of two photos agree on one movement of the camera (a fundamental matrix)."""
    if not len(words) or not len(old_words):
        return 0
    pairs = [(m.queryIdx, m.trainIdx) for m in _matcher(mutual=True).match(words, old_words) if m.distance < 50]
    if len(pairs) < LEAST_INLIERS:
        return 0
    here, there = np.array(pairs).T
    _, agree = cv2.findFundamentalMat(corners[here], old_corners[there], cv2.FM_RANSAC, 3.0, 0.99)
    return 0 if agree is None else int(agree.sum())


def solve(steps: list[tuple[float, float]], loops: list[tuple[int, int]]) -> Floats:
    """Where the photos were taken, shape (n, 2): steps as measured and loops closed, in the sense of least squares.

    >>> np.round(solve([(0, 0), (1, 0), (-1, 0.3)], []) + 1, 3).tolist()
    [[1.0, 1.0], [2.0, 1.0], [1.0, 1.3]]
    >>> np.round(solve([(0, 0), (1, 0), (-1, 0.3)], [(2, 0)]) + 1, 3).tolist()
    [[1.0, 1.0], [2.0, 0.853], [1.0, 1.006]]
    """
    size = len(steps)
    rows = np.eye(size) - np.eye(size, k=-1)  # Each position less the one before; the first less nothing.
    closing = np.zeros((len(loops), size))
    for row, (later, earlier) in zip(closing, loops, strict=True):
        row[later], row[earlier] = LOOP_WEIGHT, -LOOP_WEIGHT
    wanted = np.concatenate([np.array(steps, float).reshape(-1, 2), np.zeros((len(loops), 2))])
    found: Floats = np.linalg.lstsq(np.concatenate([rows, closing]), wanted)[0]
    return found


class VisualMapping(Program):
    name = "visual_map"

    def __init__(self, data: Path = DATA, limit: int | None = None) -> None:
        self.photos = _read_photos(find_file(data, FILE))[:limit]
        angles = np.arange(len(self.photos)) * (2 * np.pi / LAP)
        self.truth = LAP / (2 * np.pi) * np.column_stack([np.sin(angles), 1 - np.cos(angles)])

    def start(self) -> hf.Start[Any]:
        return hf.start(VisualMap)

    def feed(self) -> Feed:
        steps = np.diff(self.truth, axis=0, prepend=self.truth[:1])
        steps[1:, 1] += DRIFT
        for number, (photo, (east, north)) in enumerate(zip(self.photos, steps.tolist(), strict=True)):
            yield Timed(float(number), Photo(photo, east, north))

    def judge(self, state: dict[str, Any]) -> Verdict:
        positions, loops, size = state["positions"], state["loops"], len(self.photos)
        away = [abs((later - earlier + LAP / 2) % LAP - LAP / 2) for later, earlier in loops]
        false = sum(distance > SAME_PLACE for distance in away)
        twice = max(0, size - round(LAP))
        error = float(np.hypot.reduce(positions - self.truth[: len(positions)], axis=1).max())
        figures = (
            f"{len(positions)} of {size} photos, {len(loops) - false} of {twice} places known again, {false} wrongly, "
            f"at most {error:.1f} steps off"
        )
        complete = len(positions) == size and len(loops) - false >= KNOWN_AGAIN * twice
        return Verdict(complete and not false and error < GOOD, figures)


def _read_photos(path: Path) -> list[bytes]:
    with reading(path), zipfile.ZipFile(path) as archive:
        photos = [archive.read(name) for name in sorted(archive.namelist())]
    if not photos:
        raise DamagedData(f"{path}: no photo in it")
    for number, photo in enumerate(photos, start=1):
        if cv2.imdecode(np.frombuffer(photo, np.uint8), cv2.IMREAD_GRAYSCALE) is None:
            raise DamagedData(f"{path}: photo {number} cannot be decoded")
    return photos


if __name__ == "__main__":
    main(VisualMapping)
