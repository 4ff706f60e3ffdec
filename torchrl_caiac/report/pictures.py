"""Pictures of recorded and counterfactual states, where the simulator is known."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.layouts import layout_names, ready_layout

__all__ = ["RenderFn", "as_pictures", "known_renderer"]

#: States ``[S]`` to RGB frames ``[S, height, width, 3]``, uint8.
RenderFn = Callable[[TensorDictBase], Any]
_SIZE = (480, 360)
_DIFFERENT = 24  # of 255, the change of a pixel that counts
_QUALITY = 82


def known_renderer(layout: EntityLayout) -> RenderFn | None:
    """Returns a function that renders the states of a layout.

    Known are the layouts of :class:`~torchrl_caiac.envs.KitchenEnv` and Franka-Kitchen,
    of :class:`~torchrl_caiac.envs.FetchPushCubes` and of OGBench's manipulation
    environments.

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
    if not layout.is_flat:
        return None
    names = [
        name for name in layout_names() if ready_layout(name).columns == layout.columns
    ]
    if "kitchen/positions" in names:
        return lambda states: _kitchen(_observations(states, layout))
    if "kitchen/franka" in names:  # with velocities
        places = [*range(9), *range(18, 39)]
        return lambda states: _kitchen(_observations(states, layout)[:, places])
    cubes = sum(name.startswith("cube") for name in layout.names)
    for name in names:
        if name.startswith("fetch_push_cubes/"):
            return lambda states: _fetch_push(_observations(states, layout), cubes)
        family, _, task = name.partition("/")
        if family == "ogbench":
            return lambda states: _ogbench(_observations(states, layout), layout, task)
    return None


def _observations(states: TensorDictBase, layout: EntityLayout) -> NDArray[np.float64]:
    return states[layout.in_keys[0]].double().numpy()


def _kitchen(states: NDArray[np.float64]) -> NDArray[np.uint8]:
    from torchrl_caiac.envs import KitchenEnv

    env = KitchenEnv(render_mode="rgb_array", render_size=_SIZE)
    try:
        return env.render_states(states)
    finally:
        env.close()


def _fetch_push(states: NDArray[np.float64], cubes: int) -> NDArray[np.uint8]:
    from torchrl_caiac.envs import FetchPushCubes
    from torchrl_caiac.envs.fetch_push.simulator import FetchPushSimulator

    # isort: split
    from gymnasium_robotics.utils.rotations import euler2quat

    simulator = FetchPushSimulator(cubes)
    snapshots = []
    for state in states:
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


# How OGBench's observations scale positions, and where their origin is, in metres.
_SCALES = {"cube": 10.0, "button": 120.0, "drawer": 18.0, "window": 15.0}
_CENTRE = (0.425, 0.0, 0.0)
# The joints of the fingers, as multiples of the angle that drives them.
_FINGERS = {"driver": 1.0, "coupler": 0.0, "spring_link": 1.0, "follower": -1.0}


def _ogbench(
    states: NDArray[np.float64], layout: EntityLayout, task: str
) -> NDArray[np.uint8]:
    import mujoco

    from torchrl_caiac.envs.ogbench import OGBenchSimulator
    from torchrl_caiac.envs.rendering import OffscreenRenderer

    simulator = OGBenchSimulator(task)
    model = simulator.model
    camera = {
        "type": mujoco.mjtCamera.mjCAMERA_FIXED.value,
        "fixedcamid": model.camera("front").id,
    }
    renderer = None
    try:
        renderer = OffscreenRenderer(model, *_SIZE, camera=camera)
        frames = []
        for state in states:
            simulator.restore(_ogbench_state(simulator, state, layout))
            frames.append(renderer.frame(simulator.data))
        return np.stack(frames)
    finally:
        if renderer is not None:
            renderer.close()
        simulator.close()


def _ogbench_state(
    simulator: Any, state: NDArray[np.float64], layout: EntityLayout
) -> NDArray[np.float64]:
    """The simulator's state at rest that has the places of an observation."""
    model = simulator.model
    qpos, buttons = np.zeros(model.nq), []
    robot = state[list(layout.columns["robot"])]
    qpos[:6] = robot[:6]
    for side in ("right", "left"):
        for part, factor in _FINGERS.items():
            joint = model.joint(f"ur5e/robotiq/{side}_{part}_joint")
            qpos[joint.qposadr[0]] = factor * 0.8 * robot[17] / 3
    for entity, place in simulator.places.items():
        values = state[list(layout.columns[entity])]
        kind = entity.rstrip("0123456789")
        if kind == "cube":
            position = values[:3] / _SCALES[kind] + _CENTRE
            qpos[place] = np.concatenate([position, values[3:7]])
        elif kind == "button":
            qpos[place] = values[2] / _SCALES[kind]
            buttons.append(float(values[1] > values[0]))
        else:
            qpos[place] = values[0] / _SCALES[kind]
    return np.concatenate([qpos, np.zeros(model.nv), buttons])


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
