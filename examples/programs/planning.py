"""Ways to goals, as move_base plans them: a goal comes, then where the robot is, again and again; the reply drives it.

Data: the map of the Willow Garage office; the robot in it is simulated.
Correct: the robot comes to all goals and hits no wall.
Command: python examples/programs/planning.py [--limit N] [--method fresh] [--kill-at 9s]
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from common import DATA, Feed, Program, Timed, Verdict, main
from map_demo.grid import OccupancyGrid
from numpy.typing import NDArray
from scans import Floats
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from willow import PERIOD, Robot, read_map, room_of, steer

import holdfast as hf

Place = tuple[float, float]

START = (27.0, 4.0, 1.1)
GOALS: tuple[Place, ...] = (
    (31.0, 13.0),
    (37.0, 17.0),
    (24.0, 18.5),
    (16.0, 15.0),
    (18.0, 37.0),
    (30.0, 53.0),
    (50.0, 44.0),
)
ARRIVED = 0.2  # metres from the goal
PATIENCE = 25  # messages: the robot gives up when it has stood still for so long

SPACING = 2  # cells between the places that a way may lead over
ROBOT_RADIUS = 0.35  # metres
COMFORT = 0.3  # metres: a way so much farther from a wall costs a third of what it adds
REPLAN = 2  # positions between one plan and the next
LOOK_AHEAD = 0.6  # metres


class Goal(hf.Message[bool]):
    """Go there. The reply: whether there is a way at all."""

    x: float
    y: float


class Drive(hf.Message):
    """What the robot is to do until it hears more: speed in m/s, rate of turning in rad/s."""

    speed: float
    turn: float
    arrived: bool = False


class Position(hf.Message[Drive]):
    """Where the robot is."""

    x: float
    y: float
    heading: float


class Planner(hf.Actor):
    """Holds the goal and the way there, and where the robot has been. The map is given to every life anew."""

    def __init__(self, grid: OccupancyGrid) -> None:
        self._roads = Roads(grid)
        self.goal: Place | None = None
        self.way: Floats = np.zeros((0, 2))  # what is left of it; shape (n, 2)
        self.heard = 0
        self.trail: list[Place] = []

    @hf.on(Goal)
    def take_goal(self, goal: Goal) -> bool:
        self.goal = goal.x, goal.y
        self.heard = 0
        return self._roads.knows(self.goal)

    @hf.on(Position)
    def drive(self, here: Position) -> Drive:
        self.trail.append((here.x, here.y))
        if self.goal is None:
            return Drive(0.0, 0.0)
        if np.hypot(here.x - self.goal[0], here.y - self.goal[1]) < ARRIVED:
            self.goal = None
            return Drive(0.0, 0.0, arrived=True)
        if self.heard % REPLAN == 0:
            self.way = self._roads.way((here.x, here.y), self.goal)
        self.heard += 1
        return Drive(*steer(np.array([here.x, here.y, here.heading]), self._next_point(here)))

    def _next_point(self, here: Position) -> Place:
        """The first point of the way that is not quite near; what lies before it is left behind."""
        far = np.hypot(*(self.way - (here.x, here.y)).T) > LOOK_AHEAD
        self.way = self.way[int(far.argmax()) if far.any() else -1 :]
        return float(self.way[0, 0]), float(self.way[0, 1])


class Roads:
    """All places where the robot may stand, every one joined to its eight neighbours; the costs grow near walls."""

    def __init__(self, grid: OccupancyGrid) -> None:
        room = room_of(grid).distances[::SPACING, ::SPACING]
        self._pitch = SPACING * grid.geometry.resolution
        self._free = room > ROBOT_RADIUS
        self._number = np.where(self._free, np.cumsum(self._free).reshape(room.shape) - 1, -1)
        self._places = np.argwhere(self._free)
        costs = 1.0 + 3.0 * np.exp((ROBOT_RADIUS - room) / COMFORT)
        self._graph = _join(self._number, costs)

    def knows(self, place: Place) -> bool:
        """Whether the robot may stand there."""
        return bool(self._number[self._cell(place)] >= 0)

    def way(self, start: Place, goal: Place) -> Floats:
        """The cheapest way as points, shape (n, 2); the last is the goal, and the only one if there is no way."""
        _, towards = dijkstra(self._graph, indices=self._nearest(goal), return_predecessors=True)
        at, way = self._nearest(start), list[Floats]()
        while (at := int(towards[at])) >= 0:
            way.append((self._places[at, ::-1] + 0.5 / SPACING) * self._pitch)
        return np.array([*way[:-1], goal])

    def _cell(self, place: Place) -> tuple[int, int]:
        return int(place[1] / self._pitch), int(place[0] / self._pitch)

    def _nearest(self, place: Place) -> int:
        return int(np.abs(self._places - self._cell(place)).max(axis=1).argmin())


def _join(number: NDArray[np.int64], costs: Floats) -> csr_array:
    """The graph of neighbours: to go from one to the other costs the distance times the mean of their costs."""
    rows, columns, weights = list[NDArray[np.int64]](), list[NDArray[np.int64]](), list[Floats]()
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = np.s_[: number.shape[0] - down, max(0, -right) : number.shape[1] - max(0, right)]
        there = np.s_[down:, max(0, right) : number.shape[1] + min(0, right)]
        joined = (number[here] >= 0) & (number[there] >= 0)
        rows.append(number[here][joined])
        columns.append(number[there][joined])
        weights.append((costs[here] + costs[there])[joined] * np.hypot(down, right) / 2)
    size = int(number.max()) + 1
    half = csr_array((np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), (size, size))
    return half + half.T


class Planning(Program):
    name = "planning"

    def __init__(self, data: Path = DATA, limit: int | None = None) -> None:
        self.grid, self.limit = read_map(data), limit
        self.robot = Robot(self.grid, START)
        self.given, self.reached = list[Place](), list[Place]()
        self.stood = 0

    def start(self) -> hf.Start[Any]:
        return hf.start(Planner, self.grid)

    def feed(self) -> Feed:
        sent = 0
        for goal in GOALS:
            self.given.append(goal)
            yield Timed(sent * PERIOD, Goal(*goal))
            sent, arrived = sent + 1, False
            while not arrived:
                if sent == self.limit or self.stood == PATIENCE:
                    return
                x, y, heading = self.robot.pose
                drive: Drive | None = yield Timed(sent * PERIOD, Position(float(x), float(y), float(heading)))
                arrived = self._obey(drive or Drive(0.0, 0.0))
                sent += 1

    def _obey(self, drive: Drive) -> bool:
        self.robot.drive(drive.speed, drive.turn)
        self.stood = 0 if drive.arrived or drive.speed or drive.turn else self.stood + 1
        if drive.arrived and self.robot.is_at(self.given[-1]):
            self.reached.append(self.given[-1])
        return drive.arrived

    def judge(self, state: dict[str, Any]) -> Verdict:
        # A run that is cut short ends on the way to a goal.
        under_way = self.limit is not None and state["goal"] == self.given[-1] and not self.stood
        hit = self.robot.has_hit_wall
        figures = f"{len(self.reached)} of {len(self.given)} goals reached in {self.robot.travelled:.0f} m"
        correct = len(self.reached) + under_way == len(self.given) and not hit
        return Verdict(correct, figures + (", hit a wall" if hit else ", the next under way" if under_way else ""))


if __name__ == "__main__":
    main(Planning)
