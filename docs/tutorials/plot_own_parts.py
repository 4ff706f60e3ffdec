"""
Your own estimator and learner
==============================

An estimator of influence is any function from transitions to scores, and a learner is
whatever reads the batches. This tutorial writes both. Parts ride on a conveyor belt, so
that motion alone does not say what the robot does: but we know the speed of the belt.
The learner is a mixture of Gaussians.
"""

import tempfile
import warnings

import matplotlib.pyplot as plt
import numpy as np
import torch
from tensordict import TensorDictBase
from torch.distributions import (
    Categorical,
    Independent,
    MixtureSameFamily,
    Normal,
)
from torch.nn.functional import softplus
from torchrl.modules import MLP

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.data import from_arrays, offline_buffer
from torchrl_caiac.influence import MotionInfluence, score_buffer

torch.manual_seed(0)
torch.set_num_threads(1)
warnings.filterwarnings("ignore", "entities are free")  # says the same as below
folder = tempfile.TemporaryDirectory()

# %%
# Parts on a belt
# ---------------
# A suction gripper takes part A, and then part B, from the belt to their goals beside
# it. The belt moves what lies on it by 1 cm in each step. The gripper picks up the next
# part within 8 cm, and lets go of it at its goal. Places are in metres.

RANDOM = np.random.default_rng(0)
BELT, SPEED, STEP = 0.4, np.array([0.01, 0.0]), 0.06  # the belt is where y < 0.4


def start(episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns places ``[B, 3, 2]`` of hand and parts, and goals ``[B, 2, 2]``."""
    places = RANDOM.uniform((0, 0), (1, 1), (episodes, 3, 2))
    places[:, 1:] *= (0.5, BELT)
    return places, RANDOM.uniform((0, BELT + 0.1), (1, 1), (episodes, 2, 2))


def step(
    places: np.ndarray, goals: np.ndarray, action: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the next places, and which parts are held ``[B, 2]``."""
    hand, parts = places[:, :1], places[:, 1:]
    done = np.linalg.norm(parts - goals, axis=-1) < 0.05
    held = (np.linalg.norm(parts - hand, axis=-1) < 0.08) & ~done
    held[:, 1] &= done[:, 0]  # part A first
    hand = hand + STEP * action[:, None].clip(-1, 1)
    parts = parts + SPEED * (parts[..., 1:] < BELT)
    return np.concatenate([hand, np.where(held[..., None], hand, parts)], 1), held


def expert(places: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Returns the actions ``[B, 2]`` of the demonstrator, with some noise."""
    rows = np.arange(len(places))
    part = (np.linalg.norm(places[:, 1] - goals[:, 0], axis=-1) < 0.05).astype(int)
    hand, place, goal = places[:, 0], places[rows, 1 + part], goals[rows, part]
    held = (place == hand).all(1, keepdims=True)
    action = (np.where(held, goal, place) - hand) / STEP
    return (action + RANDOM.normal(0, 0.2, action.shape)).clip(-1, 1)


# %%
# 50 demonstrations, each until both parts are at their goals.

places, goals = start(50)
seen, actions, held = [places], [], []
for _ in range(60):
    actions.append(expert(places, goals))
    places, holds = step(places, goals, actions[-1])
    seen.append(places)
    held.append(holds)
seen = np.stack(seen, 1)
done = (np.linalg.norm(seen[:, :, 1:] - goals[:, None], axis=-1) < 0.05).all(2)
lengths = np.where(done.any(1), done.argmax(1), 60)
actions, held = np.stack(actions, 1), np.stack(held, 1)
data = from_arrays(
    [seen[i, : n + 1].reshape(n + 1, 6) for i, n in enumerate(lengths)],
    [actions[i, :n] for i, n in enumerate(lengths)],
    f"{folder.name}/belt",
    desired_goals=[
        np.tile(goals[i].ravel(), (n + 1, 1)) for i, n in enumerate(lengths)
    ],
    progress=False,
)
held = torch.tensor(np.concatenate([held[i, :n] for i, n in enumerate(lengths)]))

layout = EntityLayout(
    {"hand": [0, 1], "part A": [2, 3], "part B": [4, 5]},
    goal={"part A": [0, 1], "part B": [2, 3]},
    achieved={"part A": [2, 3], "part B": [4, 5]},
    fixed=["hand"],
)

# %%
# An estimator
# ------------
# It has a ``layout``, and maps transitions ``[*B]`` to scores ``[*B, N]``, one for each
# entity in the order of the layout. ``in_keys`` says what it reads: the state alone, or
# more. Its ``repr`` goes into the record of the scores, so that scores of other
# settings are not taken for these.


class BeltInfluence:
    """Whether an entity moves otherwise than the belt moves it."""

    in_keys = ("observation", ("next", "observation"))

    def __init__(self, layout: EntityLayout, tolerance: float = 1e-3) -> None:
        self.layout, self.tolerance = layout, tolerance

    def __repr__(self) -> str:
        return f"BeltInfluence({self.tolerance})"

    def __call__(self, tensordict: TensorDictBase) -> torch.Tensor:
        place, after = (tensordict[key].unflatten(-1, (3, 2)) for key in self.in_keys)
        rides = (place[..., 1:] < BELT) & torch.tensor([[False], [True], [True]])
        unexplained = after - place - rides * torch.tensor(SPEED, dtype=place.dtype)
        return (unexplained.abs() > self.tolerance).any(-1).float()


# %%
# Scores of 0 and 1 need no threshold. We know what the gripper held, so we can see how
# often each estimator says "influenced". Motion takes the belt for the robot, and the
# package warns of what follows.

estimators = {"motion": MotionInfluence(layout, 1e-3), "belt": BeltInfluence(layout)}
rb = offline_buffer(data)
for name, estimator in estimators.items():
    with warnings.catch_warnings(record=True) as caught:
        score_buffer(rb, estimator, lookahead=0, key=("caiac", name), progress=False)
    influenced = rb.storage[:]["caiac", name][:, 1:] > 0.05
    print(
        f"{name}: influenced in {influenced[held].float().mean():.0%} of the rows in "
        f"which a part is held, and in {influenced[~held].float().mean():.0%} of others"
    )
    for warning in caught:
        print("warning:", warning.message)

# %%
# The same along one demonstration. Grey is what the gripper held.

row = data["episode"] == 0
figure, axes = plt.subplots(2, 1, figsize=(8, 2.6), sharex=True)
for i, (ax, part) in enumerate(zip(axes, layout.names[1:], strict=True)):
    ax.fill_between(range(int(row.sum())), held[row, i], step="mid", color="0.85")
    for (name, _), height in zip(estimators.items(), (0.8, 0.6), strict=True):
        score = rb.storage[:]["caiac", name][row, 1 + i]
        steps = score.nonzero()[:, 0]
        ax.plot(steps, torch.full(steps.shape, height), "s", ms=3, label=name)
    ax.set(yticks=[], ylim=(0, 1), ylabel=part)
axes[0].legend(loc="upper right")
axes[1].set_xlabel("step")
figure.tight_layout()

# %%
# A learner
# ---------
# Ours is a mixture of three Gaussians over actions, which learns by maximum likelihood
# and carries out the most likely mean. It knows nothing of counterfactuals. What any
# learner has to do: read goals from the batch, so that they follow the swap, and
# compute differences of places itself, since stored ones would be those from before the
# swap.


class Mixture(torch.nn.Module):
    """Maps states ``[B, 6]`` and goals ``[B, 4]`` to distributions of actions."""

    def __init__(self) -> None:
        super().__init__()
        self.network = MLP(18, 15, num_cells=[256] * 3, activation_class=torch.nn.ReLU)

    def forward(self, state: torch.Tensor, goal: torch.Tensor) -> MixtureSameFamily:
        hand, parts = state[:, :2].repeat(1, 2), state[:, 2:]
        x = 4 * torch.cat([state - 0.5, goal - 0.5, parts - hand, goal - parts], -1)
        weight, mean, spread = self.network(x).split([3, 6, 6], -1)
        mean, spread = mean.unflatten(-1, (3, 2)), spread.unflatten(-1, (3, 2))
        part = Independent(Normal(mean, 0.05 + softplus(spread)), 1)
        return MixtureSameFamily(Categorical(logits=weight), part)


def train(score: str | None) -> Mixture:
    """Trains with the counterfactuals of some scores, or without any."""
    torch.manual_seed(0)
    rb = offline_buffer(data, batch_size=256)
    if score is not None:
        rb.append_transform(
            CAIACTransform(
                layout,
                counterfactual_ratio=0.8,
                lookahead="next",
                score_key=("caiac", score),
            )
        )
    policy = Mixture()
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-3, weight_decay=0.1)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 2500)
    for _ in range(2500):
        batch = rb.sample()
        actions = policy(batch["observation"], batch["desired_goal"])
        loss = -actions.log_prob(batch["action"]).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        scheduler.step()
    if score is not None:
        share = batch["caiac", "swapped"].float().mean(0)
        print(f"{score}: part A swapped in {share[1]:.0%}, part B in {share[2]:.0%}")
    return policy


policies = {
    "as recorded": train(None),
    "counterfactuals, motion": train("motion"),
    "counterfactuals, belt": train("belt"),
}

# %%
# All three policies play the same 200 new episodes. With motion, part B is never
# swapped: it rides on the belt while part A is brought to its goal.

tables, goals = start(200)
desired = torch.tensor(goals.reshape(200, 4)).float()
for name, policy in policies.items():
    places = tables
    for _ in range(60):
        with torch.no_grad():
            actions = policy(torch.tensor(places.reshape(200, 6)).float(), desired)
        best = actions.mixture_distribution.logits.argmax(-1)
        means = actions.component_distribution.mean
        places, _ = step(places, goals, means[torch.arange(200), best].numpy())
    done = np.linalg.norm(places[:, 1:] - goals, axis=-1) < 0.05
    print(f"{name}: both at their goals in {done.all(1).mean():.0%} of 200 episodes")
folder.cleanup()

# %%
# Before you trust an estimator of your own, look at its scores along trajectories
# (:func:`~torchrl_caiac.plotting.plot_influence`, or a :doc:`/report`). With a
# simulator, :func:`~torchrl_caiac.evaluation.compare_influence` compares it with the
# ground truth. :doc:`/how_to/train` has the settings for other learners.
