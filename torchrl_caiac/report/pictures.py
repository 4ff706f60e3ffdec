"""Pictures of recorded and counterfactual states, where the simulator is known."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from torchrl_caiac.entities import EntityLayout

__all__ = ["RenderFn", "as_pictures", "known_renderer"]

#: States ``[S]`` to RGB frames ``[S, height, width, 3]``, uint8.
RenderFn = Callable[[TensorDictBase], Any]
_SIZE = (480, 360)
_DIFFERENT = 24  # of 255, the change of a pixel that counts
_MOST_CUBES = 8
_QUALITY = 82


def known_renderer(layout: EntityLayout) -> RenderFn | None:
    """Returns a function that renders the states of a layout.

    Known are the layouts of :class:`~torchrl_caiac.envs.KitchenEnv` and
    :class:`~torchrl_caiac.envs.FetchPushCubes`.

    Args:
        layout (EntityLayout): the entities.

    Returns:
        callable, optional: from states ``[S]`` to RGB frames, uint8
        ``[S, height, width, 3]``; ``None`` for other layouts.

    Raises:
        ImportError: the layout is that of a simulator that is not installed.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.report.pictures import known_renderer
        >>> known_renderer(EntityLayout({"arm": [0], "cup": [1]})) is None
        True
    """
    columns = dict(layout.columns)
    if not columns:
        return None
    if set(columns) == set(_KITCHEN):
        from torchrl_caiac.envs import KitchenEnv

        if columns == KitchenEnv.layout.columns:
            return lambda states: _kitchen(states[_key(layout)])
    cubes = len(columns) - 1
    if "gripper" in columns and 1 <= cubes <= _MOST_CUBES and "cube0" in columns:
        from torchrl_caiac.envs import fetch_push_layout

        if columns == fetch_push_layout(cubes).columns:
            return lambda states: _fetch_push(states[_key(layout)], cubes)
    return None


# Compared before the simulator is imported.
_KITCHEN = (
    "robot",
    "bottom_right_burner",
    "bottom_burner",
    "top_right_burner",
    "top_burner",
    "light_switch",
    "slide_cabinet",
    "hinge_cabinet",
    "microwave",
    "kettle",
)


def _key(layout: EntityLayout) -> Any:
    return layout.in_keys[0]


def _kitchen(states: torch.Tensor) -> NDArray[np.uint8]:
    from torchrl_caiac.envs import KitchenEnv

    env = KitchenEnv(render_mode="rgb_array", render_size=_SIZE)
    try:
        return env.render_states(states.double().numpy())
    finally:
        env.close()


def _fetch_push(states: torch.Tensor, cubes: int) -> NDArray[np.uint8]:
    from gymnasium_robotics.utils.rotations import euler2quat

    from torchrl_caiac.envs import FetchPushCubes
    from torchrl_caiac.envs.fetch_push.simulator import FetchPushSimulator

    simulator = FetchPushSimulator(cubes)
    snapshots = []
    for state in states.double().numpy():
        poses = state[10:].reshape(cubes, -1)
        simulator.start(poses[:, :3], state[:3])
        joints = simulator.data.qpos[-7 * cubes :].reshape(cubes, 7)
        joints[:, 3:] = euler2quat(poses[:, 3:6])
        snapshots.append(simulator.state())
    env = FetchPushCubes(cubes, render_mode="rgb_array", render_size=_SIZE)
    try:
        # Goals are no part of the state: their marks are moved out of sight.
        return env.render_states(np.stack(snapshots), np.tile([0, 0, -9.0], cubes))
    finally:
        env.close()


def as_pictures(recorded: Any, made: Any) -> tuple[str, str]:
    """Returns two frames as addresses for ``<img>``, with their difference outlined.

    Args:
        recorded (array): an RGB frame ``[H, W, 3]``, uint8.
        made (array): another one of this shape.

    Returns:
        pair of str: JPEG images as ``data:`` addresses.

    Raises:
        ValueError: the frames are not RGB images of the same shape.

    Examples:
        >>> import numpy as np
        >>> from torchrl_caiac.report.pictures import as_pictures
        >>> frame = np.zeros((48, 64, 3), np.uint8)
        >>> as_pictures(frame, frame)[0][:23]
        'data:image/jpeg;base64,'
    """
    from PIL import Image, ImageFilter

    frames = [np.asarray(frame) for frame in (recorded, made)]
    shapes = [(frame.shape, str(frame.dtype)) for frame in frames]
    shape, dtype = shapes[0]
    if len(shape) != 3 or shape[-1] != 3 or dtype != "uint8" or shapes[1] != shapes[0]:
        raise ValueError(
            f"the rendered frames are {shapes[0]} and {shapes[1]}, expected two of "
            "[height, width, 3], uint8"
        )
    change = np.abs(frames[0].astype(np.int16) - frames[1]).max(-1) > _DIFFERENT
    mask = Image.fromarray(np.where(change, 255, 0).astype(np.uint8))
    mask = mask.filter(ImageFilter.MedianFilter(3))  # without single pixels
    inner = mask.filter(ImageFilter.MaxFilter(7))
    line = np.asarray(inner.filter(ImageFilter.MaxFilter(7))) > np.asarray(inner)
    addresses = []
    for frame in frames:
        drawn = frame.copy()
        drawn[line] = (255, 176, 0)  # visible on light and on dark
        buffer = io.BytesIO()
        Image.fromarray(drawn).save(buffer, "JPEG", quality=_QUALITY)
        text = base64.b64encode(buffer.getvalue()).decode()
        addresses.append(f"data:image/jpeg;base64,{text}")
    return addresses[0], addresses[1]
