"""A 3D model from a stereo camera, as ORB_SLAM2 makes it: points of the world, and the camera's way between them.

Data: tracked features of 77 frames of a car (KITTI 00), its calibration, and where it really was.
Correct: the model has the points that were seen well, and the way ends where the car did.
Command: python examples/programs/visual_odometry.py [--limit N] [--method fresh] [--kill-at 3s]
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import DATA, DamagedData, Feed, Program, Timed, Verdict, find_file, main, read_numbers
from numpy.typing import NDArray
from scans import Floats
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import holdfast as hf

TRACKS, CALIBRATION, REFERENCE = (
    "kitti00_stereo_tracks.txt.gz",
    "kitti00_calibration.txt",
    "kitti00_reference_poses.txt",
)
PERIOD = 0.1  # seconds from frame to frame
LEAST_DISPARITY = 4.0  # pixels: what is farther has no depth to speak of
LEAST_POINTS = 10  # known ones, to find the camera by
OUTLIER = 1.0  # pixels: features farther than this from where they should be pull less and less
DRIFT = 0.03  # of the way: how wrong its end may be


@dataclass(frozen=True)
class Camera:
    """A stereo camera. Pixels are (left x, right x, y); a pose is a rotation vector and a position, shape (6,).

    Attributes:
        focal: focal lengths, pixels.
        middle: of the picture, pixels.
        baseline: distance of the two eyes, metres.
    """

    focal: tuple[float, float]
    middle: tuple[float, float]
    baseline: float

    def unproject(self, pixels: Floats, pose: Floats) -> Floats:
        """Where features are in the world, shape (n, 3)."""
        depth = self.focal[0] * self.baseline / (pixels[:, 0] - pixels[:, 1])
        x = (pixels[:, 0] - self.middle[0]) * depth / self.focal[0]
        y = (pixels[:, 2] - self.middle[1]) * depth / self.focal[1]
        turned: Floats = Rotation.from_rotvec(pose[:3]).apply(np.column_stack([x, y, depth]))
        return turned + pose[3:]

    def project(self, points: Floats, pose: Floats) -> Floats:
        """The pixels where points of the world are seen, shape (n, 3)."""
        x, y, depth = Rotation.from_rotvec(pose[:3]).apply(points - pose[3:], inverse=True).T
        depth = np.maximum(depth, 0.1)  # What has come behind the camera is an outlier, not a division by zero.
        left = self.focal[0] * x / depth + self.middle[0]
        right = left - self.focal[0] * self.baseline / depth
        return np.column_stack([left, right, self.focal[1] * y / depth + self.middle[1]])

    def locate(self, points: Floats, pixels: Floats, guess: Floats) -> Floats:
        """The pose near `guess` from which known points are seen at these pixels."""

        def misfit(pose: Floats) -> Floats:
            return (self.project(points, pose) - pixels).ravel()

        found: Floats = least_squares(misfit, guess, loss="cauchy", f_scale=OUTLIER, max_nfev=20).x
        return found


class Frame(hf.Message[int]):
    """Features of a pair of pictures: numbers of their landmarks (int64), (left x, right x, y) in pixels (float64)."""

    landmarks: bytes
    pixels: bytes


class VisualOdometry(hf.Actor):
    """Holds the model: landmarks by rising number, where they are in the world, and how often they were seen."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.pose: Floats = np.zeros(6)  # of the camera in the world: rotation vector, position
        self.step: Floats = np.zeros(6)  # the last one, added to the pose to guess the next
        self.trail: list[Floats] = []
        self.numbers = np.zeros(0, np.int64)
        self.points: Floats = np.zeros((0, 3))
        self.sightings = np.zeros(0, np.int64)

    @hf.on(Frame)
    def add(self, frame: Frame) -> int:
        numbers = np.frombuffer(frame.landmarks, "<i8")
        pixels = np.frombuffer(frame.pixels, "<f8").reshape(-1, 3)
        _, seen, known = np.intersect1d(numbers, self.numbers, return_indices=True)
        if len(known) >= LEAST_POINTS:
            pose = self._camera.locate(self.points[known], pixels[seen], self.pose + self.step)
            self.step, self.pose = pose - self.pose, pose
        self.trail.append(self.pose)
        near = pixels[:, 0] - pixels[:, 1] > LEAST_DISPARITY
        self._learn(numbers[near], self._camera.unproject(pixels[near], self.pose))
        return len(self.numbers)

    def _learn(self, numbers: NDArray[np.int64], points: Floats) -> None:
        """Put in what is new; move what is known towards the mean of its sightings."""
        self.numbers, old, into = _union(self.numbers, numbers)
        merged, sightings = np.zeros((len(self.numbers), 3)), np.zeros(len(self.numbers), np.int64)
        merged[old], sightings[old] = self.points, self.sightings
        sightings[into] += 1
        merged[into] += (points - merged[into]) / sightings[into, None]
        self.points, self.sightings = merged, sightings


def _union(*sets: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.intp], NDArray[np.intp]]:
    """The sorted union of two sets, and where the members of each are in it."""
    union = np.union1d(*sets)
    return union, np.searchsorted(union, sets[0]), np.searchsorted(union, sets[1])


class Odometry(Program):
    name = "visual_odometry"

    def __init__(self, data: Path = DATA, limit: int | None = None) -> None:
        self.camera = _read_camera(find_file(data, CALIBRATION))
        self.truth = np.array(list(read_numbers(find_file(data, REFERENCE), columns=17)))[:, [4, 8, 12]]
        self.frames = _read_frames(find_file(data, TRACKS))[:limit]
        if len(self.truth) < len(self.frames):
            raise DamagedData(f"{data / REFERENCE}: {len(self.truth)} poses for {len(self.frames)} frames")

    def start(self) -> hf.Start[Any]:
        return hf.start(VisualOdometry, self.camera)

    def feed(self) -> Feed:
        for number, frame in enumerate(self.frames):
            landmarks, pixels = frame[:, 1].astype("<i8"), frame[:, 2:5].astype("<f8")
            yield Timed(number * PERIOD, Frame(landmarks.tobytes(), pixels.tobytes()))

    def judge(self, state: dict[str, Any]) -> Verdict:
        seen = np.concatenate([frame[frame[:, 2] - frame[:, 3] > LEAST_DISPARITY, 1] for frame in self.frames])
        share = len(state["numbers"]) / len(np.unique(seen))
        truth = self.truth[: len(self.frames)]
        way = float(np.hypot.reduce(np.diff(truth, axis=0), axis=1).sum())
        error = float(np.hypot.reduce(state["pose"][3:] - truth[-1]))
        figures = f"{100 * share:.1f} % of the points, {error:.2f} m off after {way:.1f} m"
        return Verdict(share == 1.0 and error <= DRIFT * max(way, 1.0), figures)


def _read_camera(path: Path) -> Camera:
    rows = list(read_numbers(path, columns=6))
    if len(rows) != 1:
        raise DamagedData(f"{path}: {len(rows)} lines, expected one")
    focal_x, focal_y, _, middle_x, middle_y, baseline = rows[0]
    return Camera((focal_x, focal_y), (middle_x, middle_y), baseline)


def _read_frames(path: Path) -> list[Floats]:
    """The features of each frame: rows of frame, landmark, left x, right x, y, and three that are not used."""
    rows = np.array(list(read_numbers(path, columns=8))).reshape(-1, 8)
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    numbers = np.unique(rows[:, 0])
    if not np.array_equal(numbers, np.arange(len(numbers))) or not len(numbers):
        raise DamagedData(f"{path}: its frames are not numbered from 0 on")
    return np.split(rows, np.searchsorted(rows[:, 0], numbers[1:]))


if __name__ == "__main__":
    main(Odometry)
