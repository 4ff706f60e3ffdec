"""A small world for tests: a hand on a line pushes two cups, which else rest."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_caiac import EntityLayout

#: hand: position and velocity; cups: position and a copy of it in other units.
LAYOUT = EntityLayout(
    {"hand": [0, 1], "cup": [2, 3], "box": [4, 5]},
    fixed=["hand"],
    positions={"hand": [0], "cup": [2], "box": [4]},
    variance_floor=1e-3,
)
REACH = 0.05  # m: how far from the hand a cup is pushed


def push_episode(
    rng: np.random.Generator, steps: int, still: bool = False
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns the observations ``[steps + 1, 6]`` and actions ``[steps, 1]``.

    With ``still``, the hand stays away from the box.
    """
    state = np.array(
        [rng.uniform(0.3, 0.5), rng.uniform(0.6, 0.7), rng.uniform(0, 0.1)]
    )
    goals = np.array([0.55, 0.75]) if still else np.array([0.0, 0.75])
    seen, actions = [], []
    before = state[0]
    for step in range(steps + 1):
        hand, cup, box = state
        seen.append([hand, hand - before, cup, 10 * cup, box, 10 * box])
        goal = goals[step * len(goals) // (steps + 1)]
        action = np.clip((goal - hand) / 0.05 + rng.normal(0, 0.3), -1, 1)
        actions.append([action])
        before = hand
        move = 0.05 * action
        for place in (1, 2):
            if abs(state[place] - hand) < REACH:
                state[place] += move
        state[0] = hand + move
    return np.float32(seen), np.float32(actions[:-1])


def push_arrays(
    lengths: tuple[int, ...] = (40, 30, 50, 40, 35, 45), seed: int = 0
) -> dict[str, NDArray[np.generic]]:
    """Returns episodes one after another, as the arrays of transitions."""
    rng = np.random.default_rng(seed)
    episodes = [
        push_episode(rng, length, still=number % 2 == 1)
        for number, length in enumerate(lengths)
    ]
    ends = np.zeros(sum(lengths), dtype=bool)
    ends[np.cumsum(lengths) - 1] = True
    return {
        "observations": np.concatenate([states[:-1] for states, _ in episodes]),
        "next_observations": np.concatenate([states[1:] for states, _ in episodes]),
        "actions": np.concatenate([actions for _, actions in episodes]),
        "timeouts": ends,
    }


def push_transitions(
    lengths: tuple[int, ...] = (40, 30, 50, 40, 35, 45), seed: int = 0
) -> TensorDict:
    """Returns the same as TorchRL transitions, with an entry that no swap follows."""
    arrays = push_arrays(lengths, seed)
    done = torch.from_numpy(arrays["timeouts"]).unsqueeze(-1)
    ids = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    return TensorDict(
        {
            "observation": torch.from_numpy(arrays["observations"]),
            "action": torch.from_numpy(arrays["actions"]),
            "episode": ids,
            "info": {"step": torch.arange(len(ids))},
            "next": {
                "observation": torch.from_numpy(arrays["next_observations"]),
                "done": done,
                "terminated": torch.zeros_like(done),
                "truncated": done,
            },
        },
        [len(ids)],
    )
