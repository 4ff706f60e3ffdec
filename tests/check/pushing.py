"""A world of two objects and a robot that pushes them, to plant errors in."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_caiac import EntityLayout

# The robot has its position and the last move, an object its position and its colour.
ENTITIES = {"robot": range(0, 4), "left": range(4, 7), "right": range(7, 10)}
GOAL = {"left": [0, 1], "right": [2, 3]}
MIRRORED = [4, 5, 7, 8]
LAYOUT = EntityLayout(
    ENTITIES,
    goal=GOAL,
    achieved={"left": [4, 5], "right": [7, 8]},
    fixed=["robot"],
)
REACH, STEP = 0.15, 0.08  # metres


def simulate(
    episodes: int = 40, length: int = 30, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """States ``[episodes, length + 1, 10]`` and actions ``[episodes, length, 2]``."""
    rng = np.random.default_rng(seed)
    robot = rng.uniform(-0.5, 0.5, (episodes, 2))
    move = np.zeros((episodes, 2))
    objects = rng.uniform(-0.5, 0.5, (episodes, 2, 2))
    color = rng.uniform(0, 1, (episodes, 2, 1))
    aim = rng.integers(2, size=episodes)
    states, actions = [], []
    for t in range(length + 1):
        parts = [robot, move, *np.concatenate([objects, color], -1).swapaxes(0, 1)]
        states.append(np.concatenate(parts, -1))
        if t == length:
            break
        towards = objects[np.arange(episodes), aim] - robot
        action = np.clip(towards / STEP + rng.normal(0, 0.5, (episodes, 2)), -1, 1)
        move = STEP * action
        robot = robot + move
        offset = objects - robot[:, None]
        distance = np.linalg.norm(offset, axis=-1, keepdims=True)
        pushed = robot[:, None] + offset / distance * REACH
        objects = np.where(distance < REACH, pushed, objects)
        actions.append(action)
    return np.stack(states, 1), np.stack(actions, 1)


def clean(dtype: Any = torch.float32, **kwargs: Any) -> TensorDict:
    """Transitions ``[T]`` without any error."""
    states, actions = (torch.from_numpy(x) for x in simulate(**kwargs))
    episodes, length = actions.shape[:2]
    states = states.to(dtype)
    done = torch.zeros(episodes, length, 1, dtype=torch.bool)
    done[:, -1] = True
    goal = torch.randn(episodes, 1, 4, generator=torch.Generator().manual_seed(1))
    goal = goal.expand(-1, length, -1)

    def of(x: torch.Tensor) -> dict[str, torch.Tensor]:
        return {
            "observation": x.clone(),
            "achieved_goal": x[..., MIRRORED].clone(),
            "desired_goal": goal.clone(),
        }

    return TensorDict(
        {
            **of(states[:, :-1]),
            "action": actions.float(),
            "episode": torch.arange(episodes)[:, None].expand(-1, length).clone(),
            "next": {
                **of(states[:, 1:]),
                "reward": torch.zeros(episodes, length, 1),
                "done": done,
                "truncated": done.clone(),
                "terminated": torch.zeros_like(done),
            },
        },
        [episodes, length],
    ).reshape(-1)


def nested(data: TensorDict) -> tuple[TensorDict, EntityLayout]:
    """The same transitions with one entry for each entity."""

    def tree(x: torch.Tensor) -> dict[str, Any]:
        return {
            "robot": {"position": x[:, :2].clone(), "move": x[:, 2:4].clone()},
            "left": x[:, 4:7].clone(),
            "right": x[:, 7:10].clone(),
        }

    rest = data.exclude(
        "observation",
        "achieved_goal",
        "desired_goal",
        ("next", "observation"),
        ("next", "achieved_goal"),
        ("next", "desired_goal"),
    ).clone()
    rest["state"] = TensorDict(tree(data["observation"]), [len(data)])
    rest["next", "state"] = TensorDict(tree(data["next", "observation"]), [len(data)])
    layout = EntityLayout.from_keys(
        {name: ("state", name) for name in ENTITIES}, fixed=["robot"]
    )
    return rest, layout


def reorder(data: TensorDict, rows: Any) -> TensorDict:
    """Transitions in another order."""
    return data[torch.as_tensor(rows)].clone()
