"""The start positions of the cubes, and their goals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from torchrl_caiac.envs.fetch_push.model import CUBE_HALF, TABLE_HIGH, TABLE_LOW
from torchrl_caiac.envs.fetch_push.simulator import START, cube_height

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

__all__ = ["Region", "check_positions"]

# The gripper reaches these distances from the axis of the shoulder while it is tilted
# by less than 15 degrees.
_SHOULDER = np.array([0.7245, 0.7441])
_REACH = (0.40, 0.87)
# Horizontal distance between the centres of drawn cubes, of drawn goals, and of a
# drawn cube and the gripper; and between cubes that touch at their corners.
_SEPARATION = 0.1
_DIAGONAL = 2 * np.sqrt(2) * CUBE_HALF
_MAX_DRAWS = 200
# The minimum distance of positions from the edges of the table.
_MARGIN = 0.05


class Region:
    """A square around the centre of the table, from which positions are drawn.

    Args:
        name (str): what is drawn, ``"cubes"`` or ``"goals"``.
        num_cubes (int): the number of cubes ``n``.
        half (float): half the side of the square, in metres.
        distance_threshold (float): a cube is farther than this from its own goal, in
            metres.

    Raises:
        ValueError: the arm cannot reach the whole square.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.envs.fetch_push.starts import Region
        >>> region = Region("cubes", 2, half=0.15, distance_threshold=0.05)
        >>> region.draw(np.random.default_rng(0)).shape
        (2, 3)
    """

    def __init__(
        self, name: str, num_cubes: int, *, half: float, distance_threshold: float
    ) -> None:
        self.name = name
        self.num_cubes = num_cubes
        self.half = half
        self.distance_threshold = distance_threshold
        corners = START[:2] + half * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
        nearest = START[:2] - [half, 0.0]
        if not half >= 0 or not all(map(_in_reach, (*corners, nearest))):
            raise ValueError(
                f"{self._argument} is {half}, expected at least 0, and a square that "
                "the arm can reach (up to about 0.2)"
            )

    @property
    def _argument(self) -> str:
        return f"{self.name[:-1]}_range"

    def draw(
        self,
        rng: np.random.Generator,
        *,
        away_from: Sequence[NDArray[np.float64]] = (),
        own: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Draws positions that are at least 10 cm apart.

        Args:
            rng (np.random.Generator): the source of random numbers.

        Keyword Args:
            away_from (sequence of NDArray, optional): positions ``[2]`` that are at
                least 10 cm from all drawn ones, such as that of the gripper.
            own (NDArray, optional): positions ``[n, 3]``: a drawn cube is farther than
                ``distance_threshold`` from its own goal, and a drawn goal from its
                cube.

        Returns:
            NDArray: positions ``[n, 3]``, at the height of a resting cube.

        Raises:
            ValueError: the positions do not fit into the square.
        """
        for _ in range(_MAX_DRAWS):
            chosen: list[NDArray[np.float64]] = []
            for i in range(self.num_cubes):
                offsets = rng.uniform(-self.half, self.half, (_MAX_DRAWS, 2))
                candidates = START[:2] + offsets
                free = np.ones(_MAX_DRAWS, dtype=np.bool_)
                for other in (*chosen, *away_from):
                    gap = np.linalg.norm(candidates - other, axis=-1)
                    free &= gap >= _SEPARATION
                if own is not None:
                    gap = np.linalg.norm(candidates - own[i, :2], axis=-1)
                    free &= gap > self.distance_threshold
                if not free.any():
                    break
                chosen.append(candidates[free.argmax()])
            else:
                height = np.full((self.num_cubes, 1), cube_height())
                return np.concatenate((np.array(chosen), height), 1)
        raise ValueError(
            f"{self.num_cubes} {self.name} do not fit into the square of +-{self.half} "
            f"m with {_SEPARATION} m between them and more than "
            f"{self.distance_threshold} m between a cube and its goal: use fewer "
            f"cubes, a larger {self._argument} or a smaller distance_threshold"
        )


def check_positions(
    name: str, positions: ArrayLike, num_cubes: int, *, height_tolerance: float
) -> NDArray[np.float64]:
    """Checks given positions.

    Args:
        name (str): what they are, ``"cubes"`` or ``"goals"``.
        positions (array): ``[n, 2]`` or ``[n, 3]``.
        num_cubes (int): the number of cubes ``n``.

    Keyword Args:
        height_tolerance (float): heights may differ by less than this from that of a
            resting cube, in metres.

    Returns:
        NDArray: the positions ``[n, 3]``.

    Raises:
        ValueError: a position is off the table, out of reach or overlaps another.

    Examples:
        >>> from torchrl_caiac.envs.fetch_push.starts import check_positions
        >>> check_positions("cubes", [[1.3, 0.7]], 1, height_tolerance=1e-3).round(2)
        array([[1.3 , 0.7 , 0.42]])
    """
    given = np.asarray(positions, dtype=np.float64)
    n = num_cubes
    if given.shape not in ((n, 2), (n, 3)) or not np.isfinite(given).all():
        raise ValueError(
            f"{name} have shape {given.shape}, expected ({n}, 2) or ({n}, 3) and "
            "finite values"
        )
    height = cube_height()
    checked = np.full((n, 3), height)
    checked[:, : given.shape[1]] = given
    low, high = TABLE_LOW + _MARGIN, TABLE_HIGH - _MARGIN
    for i, position in enumerate(checked):
        what = f"{name}[{i}] = {position.tolist()}"
        place = position[:2]
        if (place < low).any() or (place > high).any():
            raise ValueError(
                f"{what} is off the table, expected x and y between {low.tolist()} and "
                f"{high.tolist()}"
            )
        if not _in_reach(place):
            raise ValueError(
                f"{what} is out of reach, expected {_REACH[0]} to {_REACH[1]} m from "
                f"the shoulder at {_SHOULDER.tolist()}"
            )
        if abs(position[2] - height) >= height_tolerance:
            raise ValueError(
                f"{what} is not on the table, expected a height of {height:.4f}: omit "
                "the height"
            )
    first, second = np.triu_indices(n, 1)
    gaps = np.linalg.norm(checked[first, :2] - checked[second, :2], axis=-1)
    if gaps.min(initial=np.inf) < _DIAGONAL:
        raise ValueError(
            f"{name} overlap: two are {gaps.min():.3f} m apart, expected at least "
            f"{_DIAGONAL:.3f}"
        )
    return checked


def _in_reach(place: NDArray[np.float64]) -> bool:
    return bool(_REACH[0] <= np.linalg.norm(place - _SHOULDER) <= _REACH[1])
