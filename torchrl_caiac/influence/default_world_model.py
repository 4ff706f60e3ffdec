"""The world model and its fit that suit most data, for CAI."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict.utils import NestedKey

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel

__all__ = ["DEFAULT_FIT", "default_world_model"]

#: Settings of :func:`~torchrl_caiac.fit.fit_world_model`: a minute of one processor.
DEFAULT_FIT: dict[str, Any] = {
    "steps": 10_000,
    "batch_size": 500,
    "lr": 8e-4,
    "eval_every": 1_000,
}


def default_world_model(
    layout: EntityLayout,
    action_dim: int,
    *,
    widths: Mapping[str, int] | None = None,
    action_key: NestedKey = "action",
) -> GaussianWorldModel:
    """Creates a world model for :class:`~torchrl_caiac.influence.CAI`, not fitted.

    If ``layout.positions`` names the positions of entities, the model predicts them
    only, and of the ``fixed`` entities it reads them only. Of all other entities it
    reads all columns. On OGBench's cube-double more columns of the robot make the
    scores worse: compare ``python examples/compare_influence.py
    env=ogbench_cube_double method=[caiac]`` with and without
    ``env.robot_inputs=all``.

    The variance floor is that of the layout or, if that has none, comes from the noise
    in the data. Fit the model with :func:`~torchrl_caiac.fit.fit_world_model`. The
    command line takes 10,000 steps with batches of 500, and a learning rate of 8e-4.

    Args:
        layout (EntityLayout): the entities.
        action_dim (int): the size ``A`` of the action.

    Keyword Args:
        widths (Mapping of str to int, optional): the number of features of each entity,
            ``layout.widths(td)``. Required for nested layouts only.
        action_key (NestedKey): the action. Defaults to ``"action"``.

    Returns:
        GaussianWorldModel: the model, with three hidden layers of 256.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence import default_world_model
        >>> layout = EntityLayout(
        ...     {"arm": [0, 1, 2], "cup": [3, 4]},
        ...     fixed=["arm"],
        ...     positions={"arm": [0, 1], "cup": [3]},
        ... )
        >>> model = default_world_model(layout, action_dim=2)
        >>> model.config["inputs"], model.config["predict"]
        ({'arm': [0, 1], 'cup': [3, 4]}, {'arm': [0, 1], 'cup': [3]})
        >>> model.config["variance_floor"]
        'auto'
    """
    positions = layout.positions
    return GaussianWorldModel(
        layout,
        action_dim,
        predict=positions,
        widths=widths,
        action_key=action_key,
        variance_floor=None if layout.variance_floor else "auto",
        inputs={name: positions[name] for name in layout.fixed if name in positions},
    )
