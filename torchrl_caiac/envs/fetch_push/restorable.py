"""Fetch-Push, put into recorded simulator states."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchrl_caiac.envs.fetch_push.env import FetchPushCubes

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["RestorableFetchPush"]


class RestorableFetchPush:
    """Fetch-Push for :func:`~torchrl_caiac.envs.random_transitions`.

    A state is what ``FetchPushCubes.simulator_state`` returns. Goals, and so rewards,
    belong to no task: a file of states has one goal.

    Args:
        num_cubes (int): the number of cubes. Defaults to 2.

    Examples:
        >>> from torchrl_caiac.envs import random_transitions
        >>> from torchrl_caiac.envs.fetch_push import RestorableFetchPush
        >>> states = RestorableFetchPush().env.simulator_state()[None]
        >>> rows = random_transitions(
        ...     RestorableFetchPush, states, 3, num_workers=1, progress=False
        ... )
        >>> rows["next", "achieved_goal"].shape, rows["info", "simulator"].shape
        (torch.Size([3, 6]), torch.Size([3, 83]))
    """

    def __init__(self, num_cubes: int = 2) -> None:
        #: The environment.
        self.env = FetchPushCubes(num_cubes)
        self.env.reset(seed=0)
        #: The box of the actions.
        self.action_space = self.env.action_space

    def seed(self, seed: int) -> None:
        """Draws another goal.

        Args:
            seed (int): equal seeds give equal goals.
        """
        self.env.reset(seed=seed)

    def restore(self, state: ArrayLike) -> dict[str, NDArray[Any]]:
        """Puts the simulator into a state.

        Args:
            state (array_like): ``[S]``.

        Returns:
            dict: the observation.
        """
        return self.env.set_simulator_state(state)

    def step(self, action: NDArray[Any]) -> tuple[Any, Any, Any, bool, Any]:
        """Simulates an action; the episode has no limit of steps.

        Args:
            action (numpy.ndarray): ``[4]``.

        Returns:
            tuple: what Gymnasium's ``step`` returns.
        """
        observation, reward, terminated, _, info = self.env.step(action)
        return observation, reward, terminated, False, info

    def record(self) -> dict[str, NDArray[Any]]:
        """Returns the simulator's state.

        Returns:
            dict: ``"simulator"`` ``[S]``, float64.
        """
        return {"simulator": self.env.simulator_state()}

    def close(self) -> None:
        """Closes the environment."""
        self.env.close()
