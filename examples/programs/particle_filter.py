"""Where is the robot? A cloud of guesses says it, as in AMCL: moved by odometry, weighed by scans, drawn anew.

Data: the map of the Willow Garage office; the robot in it is simulated, its sensors are noisy. It follows a way by what
the filter says: with a wrong answer it drives into a wall.
Correct: the robot comes to its goal, and the filter knew all the way where it was.
Command: python examples/programs/particle_filter.py [--limit N] [--method fresh] [--kill-at 9s]
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from common import DATA, Feed, Program, Timed, Verdict, main
from map_demo.grid import OccupancyGrid
from planning import Roads
from scans import Estimate, Floats, LikelihoodField, Start, compose
from willow import LASER_RANGE, PERIOD, Robot, bearings_of_beams, read_map, steer

import holdfast as hf

START = (27.0, 4.0, 1.1)
GOAL = (18.0, 37.0)
LOOK_AHEAD = 0.8  # metres
MOST_MESSAGES = 700  # three times what the way takes
GOOD = 0.5  # metres that the answer may be wrong

ODOMETRY_NOISE = np.array([0.02, 0.01, 0.01])  # metres, metres, radians a step
LASER_NOISE = 0.03  # metres

PARTICLES = 1000
SPREAD = np.array([0.3, 0.3, 0.1])  # of the first guess
DIFFUSION = np.array([0.03, 0.02, 0.02])  # what a step may be wrong by
HIT_WIDTH = 0.15  # metres
CAUTION = 0.2  # beams side by side see the same wall, so each counts less than one of its own would
EVERY = 2  # beams


class Moved(hf.Message[Estimate]):
    """The robot went a step (seen from before it), and scans all around; ranges in metres as float32."""

    forward: float
    left: float
    turned: float
    ranges: bytes


class ParticleFilter(hf.Actor):
    """Holds the guesses, and the random numbers that move them. The map is given to every life anew."""

    def __init__(self, grid: OccupancyGrid, seed: int = 1) -> None:
        self._field = LikelihoodField.of(grid)
        self.random = np.random.default_rng(seed)
        self.particles = np.zeros((PARTICLES, 3))  # x, y, heading
        self.log_weights = np.zeros(PARTICLES)

    @hf.on(Start)
    def begin(self, start: Start) -> None:
        around = np.array([start.x, start.y, start.heading])
        self.particles = around + SPREAD * self.random.standard_normal((PARTICLES, 3))
        self.log_weights = np.zeros(PARTICLES)

    @hf.on(Moved)
    def follow(self, moved: Moved) -> Estimate:
        self._move(np.array([moved.forward, moved.left, moved.turned]))
        self._weigh(np.frombuffer(moved.ranges, "<f4").astype(np.float64))
        weights = np.exp(self.log_weights - self.log_weights.max())
        weights /= weights.sum()
        mean = mean_pose(self.particles, weights)
        if 1 / np.sum(weights**2) < PARTICLES / 2:  # Few still count.
            self.particles = self.particles[draw(weights, self.random.random())]
            self.log_weights = np.zeros(PARTICLES)
        return Estimate(*mean)

    def _move(self, step: Floats) -> None:
        steps = step + DIFFUSION * self.random.standard_normal((PARTICLES, 3))
        cosines, sines = np.cos(self.particles[:, 2]), np.sin(self.particles[:, 2])
        self.particles[:, 0] += cosines * steps[:, 0] - sines * steps[:, 1]
        self.particles[:, 1] += sines * steps[:, 0] + cosines * steps[:, 1]
        self.particles[:, 2] += steps[:, 2]

    def _weigh(self, ranges: Floats) -> None:
        """Beams that would end far from any wall speak against a guess."""
        seen = np.flatnonzero(ranges[::EVERY] < LASER_RANGE) * EVERY
        bearings = self.particles[:, 2:] + bearings_of_beams()[seen]
        ends = self.particles[:, None, :2] + ranges[seen, None] * np.stack(
            [np.cos(bearings), np.sin(bearings)], axis=-1
        )
        distances = self._field.at(ends.reshape(-1, 2)).reshape(PARTICLES, -1)
        fits = 0.9 * np.exp(-0.5 * (distances / HIT_WIDTH) ** 2) + 0.1
        self.log_weights += CAUTION * np.log(fits).sum(axis=1)


def mean_pose(particles: Floats, weights: Floats) -> tuple[float, float, float]:
    """The weighted mean of poses; headings are averaged on the circle."""
    x, y = weights @ particles[:, :2]
    heading = np.arctan2(weights @ np.sin(particles[:, 2]), weights @ np.cos(particles[:, 2]))
    return float(x), float(y), float(heading)


def draw(weights: Floats, offset: float) -> np.ndarray:
    """Systematic resampling: as many indices as there are weights, evenly spaced over their sum.

    >>> draw(np.array([0.5, 0.0, 0.25, 0.25]), 0.5).tolist()
    [0, 0, 2, 3]
    """
    ticks = (np.arange(len(weights)) + offset) / len(weights)
    return np.minimum(np.searchsorted(np.cumsum(weights), ticks), len(weights) - 1)


class ParticleLocalisation(Program):
    name = "particle_filter"

    def __init__(self, data: Path = DATA, limit: int | None = None) -> None:
        self.grid, self.limit = read_map(data), limit
        self.robot = Robot(self.grid, START)
        self.way = Roads(self.grid).way(START[:2], GOAL)
        self.errors: list[float] = []  # metres, one for each answer

    def start(self) -> hf.Start[Any]:
        return hf.start(ParticleFilter, self.grid)

    def feed(self) -> Feed:
        yield Timed(0.0, Start(*START))
        random = np.random.default_rng(2)
        believed, way = np.array(START), self.way
        for number in range(1, self.limit or MOST_MESSAGES):
            way = _left_of(way, believed)
            step = self.robot.drive(*steer(believed, (float(way[0, 0]), float(way[0, 1]))))
            step = step + ODOMETRY_NOISE * random.standard_normal(3) * (np.abs(step).sum() > 0)
            ranges = self.robot.scan()
            ranges = np.where(ranges < LASER_RANGE, ranges + LASER_NOISE * random.standard_normal(len(ranges)), ranges)
            forward, left, turned = step.tolist()
            moved = Moved(forward, left, turned, ranges.astype("<f4").tobytes())
            answer: Estimate | None = yield Timed(number * PERIOD, moved)
            # Without an answer the robot goes on by its wheels.
            believed = compose(believed, step) if answer is None else np.array([answer.x, answer.y, answer.heading])
            self.errors.append(float(np.hypot(*(believed - self.robot.pose)[:2])))
            if np.hypot(*(believed[:2] - GOAL)) < LOOK_AHEAD / 2:
                return

    def judge(self, state: dict[str, Any]) -> Verdict:
        hit, there = self.robot.has_hit_wall, self.robot.is_at(GOAL, within=1.0)
        worst = max(self.errors)
        end = "hit a wall" if hit else "at the goal" if there else "not at the goal"
        figures = f"{end} after {self.robot.travelled:.0f} m; error {np.mean(self.errors):.2f} m, at most {worst:.2f} m"
        return Verdict(worst < GOOD and not hit and (there or self.limit is not None), figures)


def _left_of(way: Floats, pose: Floats) -> Floats:
    """What is left of a way for a robot at a pose: not what it has come near to."""
    far = np.hypot(*(way - pose[:2]).T) > LOOK_AHEAD
    return way[int(far.argmax()) if far.any() else -1 :]


if __name__ == "__main__":
    main(ParticleLocalisation)
