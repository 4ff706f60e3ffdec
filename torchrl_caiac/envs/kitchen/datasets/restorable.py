"""The Franka-Kitchen, put into recorded simulator states."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_caiac.envs.kitchen.datasets.collection import (
    DEFAULT_TASKS,
    KitchenSource,
)
from torchrl_caiac.envs.kitchen.starts import set_kitchen_start
from torchrl_caiac.envs.kitchen.tasks import STATE_COLUMNS

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["RestorableFrankaKitchen", "RestorableKitchen"]

_POSITIONS = 30
_COLUMNS = list(STATE_COLUMNS)


class RestorableFrankaKitchen(KitchenSource):
    """``FrankaKitchen-v1`` with its own observations, put into recorded states."""

    def __init__(self) -> None:
        super().__init__(DEFAULT_TASKS)
        #: The box of the actions.
        self.action_space = self.env.action_space

    def seed(self, seed: int) -> None:
        """Seeds the noise of the observations.

        Args:
            seed (int): equal seeds give equal noise.
        """
        self.env.reset(seed=seed)

    def restore(self, state: ArrayLike) -> Any:
        """Puts the simulator into a state.

        Args:
            state (array_like): positions and velocities, ``[59]``.

        Returns:
            dict: the observation.
        """
        vector = np.asarray(state)
        return set_kitchen_start(
            self.env, qpos=vector[:_POSITIONS], qvel=vector[_POSITIONS:]
        )

    def step(self, action: NDArray[Any]) -> tuple[Any, Any, Any, Any, Any]:
        """Simulates an action.

        Args:
            action (numpy.ndarray): ``[9]``.

        Returns:
            tuple: what Gymnasium's ``step`` returns.
        """
        # The environment without its wrappers: they count steps over episodes.
        result: tuple[Any, Any, Any, Any, Any] = self.env.unwrapped.step(action)
        return result

    def record(self) -> dict[str, NDArray[np.float64]]:
        """Returns the simulator's state.

        Returns:
            dict: ``"qpos"`` ``[30]`` and ``"qvel"`` ``[29]``, float64.
        """
        return self.simulator_state()


class RestorableKitchen(RestorableFrankaKitchen):
    """The kitchen for :func:`~torchrl_caiac.envs.random_transitions`.

    A state has the positions and velocities of the simulator. Observations have the 30
    columns of :func:`~torchrl_caiac.envs.kitchen_transitions`, to which
    ``info_key="sim"`` belongs.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.envs import KitchenEnv, random_transitions
        >>> from torchrl_caiac.envs.kitchen import RestorableKitchen
        >>> state = np.concatenate([KitchenEnv.default_state(), np.zeros(29)])
        >>> rows = random_transitions(
        ...     RestorableKitchen, state[None], steps=4, info_key="sim", num_workers=1,
        ...     progress=False,
        ... )
        >>> rows["observation"].shape, rows["sim", "qvel"].shape
        (torch.Size([4, 30]), torch.Size([4, 29]))
    """

    def restore(self, state: ArrayLike) -> NDArray[np.float64]:
        """Puts the simulator into a state.

        Args:
            state (array_like): positions and velocities, ``[59]``.

        Returns:
            numpy.ndarray: the observation ``[30]``.
        """
        return self._state(super().restore(state))

    def step(self, action: NDArray[Any]) -> tuple[Any, Any, Any, Any, Any]:
        """Simulates an action.

        Args:
            action (numpy.ndarray): ``[9]``.

        Returns:
            tuple: what Gymnasium's ``step`` returns.
        """
        observation, *others = super().step(action)
        reward, terminated, truncated, info = others
        return self._state(observation), reward, terminated, truncated, info

    @staticmethod
    def _state(observation: Any) -> NDArray[np.float64]:
        return np.asarray(observation["observation"][_COLUMNS])
