"""
A threshold without a simulator
===============================

Causal action influence is a number, and a threshold says from which number on an entity
counts as influenced. With a simulator we could compute the ground truth, and choose the
threshold that agrees best with it. Most data come without one. This tutorial chooses
thresholds from the recording alone, reads the reasons, and looks at what happens where
no threshold is right. At the end we use the simulator after all, to see how good the
choice was.
"""

import warnings

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.data import offline_buffer
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.influence import (
    CAI,
    best_threshold,
    score_buffer,
    suggest_thresholds,
)
from torchrl_caiac.modules import GaussianWorldModel
from torchrl_caiac.noise import resting_noise

torch.manual_seed(0)
torch.set_num_threads(1)
warnings.filterwarnings("ignore", "with the default threshold")  # we choose others

# %%
# A table seen by a camera
# ------------------------
# A robot pushes a puck that rests. A second one is glued to the table. A third one
# rides on a conveyor belt, out of reach, and never rests. The camera that sees all this
# has a noise of 1 mm. Places are in metres.

REACH, STEP = 0.15, 0.08  # distance of contact, largest move along an axis
BELT, NOISE = torch.tensor([0.03, 0.0]), 1e-3


def step(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Returns next states ``[*B, 8]`` of states ``[*B, 8]``, actions ``[*B, 2]``."""
    robot, puck, glued, riding = state.unflatten(-1, (4, 2)).unbind(-2)
    robot = robot + STEP * action
    offset = puck - robot
    distance = offset.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    puck = torch.where(distance < REACH, robot + offset / distance * REACH, puck)
    return torch.cat(
        [robot, puck, glued.expand_as(puck), (riding + BELT).expand_as(puck)], -1
    )


# %%
# Every ten steps the robot chooses where to go: to the puck, or to any other place.

EPISODES, LENGTH = 300, 50
state = torch.rand(EPISODES, 8) * 1.6 - 0.8
state[:, 4:6] += 4.0  # out of reach
states, actions = [state], []
for t in range(LENGTH):
    if t % 10 == 0:
        place = torch.rand(EPISODES, 2) * 1.6 - 0.8
        to_puck = torch.rand(EPISODES, 1) < 0.3
    towards = torch.where(to_puck, state[:, 2:4], place) - state[:, 0:2]
    action = (towards / STEP + 0.3 * torch.randn(EPISODES, 2)).clamp(-1, 1)
    state = step(state, action)
    states.append(state)
    actions.append(action)
true = torch.stack(states, 1)
seen = true + NOISE * torch.randn(true.shape)
done = torch.zeros(EPISODES, LENGTH, 1, dtype=torch.bool)
done[:, -1] = True
data = TensorDict(
    {
        "observation": seen[:, :-1],
        "action": torch.stack(actions, 1),
        "episode": torch.arange(EPISODES)[:, None].expand(-1, LENGTH),
        "next": {"observation": seen[:, 1:], "done": done},
    },
    [EPISODES, LENGTH],
).reshape(-1)

places = {"robot": [0, 1], "puck": [2, 3], "glued": [4, 5], "riding": [6, 7]}
layout = EntityLayout(places, positions=places, fixed=["robot"], variance_floor=8e-3)
layout

# %%
# What is noise
# -------------
# ``variance_floor`` is the largest change that does not matter, in metres. The camera's
# noise has to stay below it. :func:`~torchrl_caiac.noise.resting_noise` measures how
# much each entity changes while it rests, if it both rests and moves, as the puck does.

print(resting_noise(data, layout)["puck"].reason)
change = (data["next", "observation"] - data["observation"]).abs()
print(f"largest change of the glued puck: {change[:, 4:6].max():.4f} m")

# %%
# Scores
# ------
# Two world models are fitted to the same data, one with this floor, and one with a
# floor that is far too small. The second one shows what goes wrong,
# and ``check=False`` leaves out the warnings that would say so.

rb = offline_buffer(data, batch_size=256)
for key, floor in (("good", 8e-3), ("small floor", 1e-4)):
    torch.manual_seed(0)
    model = GaussianWorldModel(
        layout, action_dim=2, hidden_sizes=(128, 128), variance_floor=floor
    )
    fit_world_model(
        model,
        data,
        action_spec=Bounded(-1.0, 1.0, (2,)),
        steps=2000,
        batch_size=500,
        check=False,
        progress=False,
    )
    score_buffer(
        rb, CAI(model), lookahead=0, key=("caiac", key), check=False, progress=False
    )

# %%
# A threshold for each entity
# ---------------------------
# :func:`~torchrl_caiac.influence.suggest_thresholds` splits the scores of an entity in
# two. Then it compares the split with the rows in which the entity moves: these must
# score above those in which it rests.

found = suggest_thresholds(rb, layout, score_key=("caiac", "good"))
print(found)

# %%
found.figure()

# %%
# - The *puck* has two modes, with the threshold between them.
# - The *glued* puck never moves, and its scores have one mode: it may always be
#   swapped.
# - The *riding* puck always moves. Where nothing rests, the recording cannot say
#   whether the robot or something else moves it. So it is never swapped.
#
# What the recording cannot say, you may know. The robot does not reach the belt, and
# the scores agree: all of them are below the threshold of the puck. So we set this
# threshold.

score = rb.storage[:]["caiac", "good"]
print(f"highest score of the riding puck: {score[:, 3].max():.4f}")
thresholds = {**found.thresholds, "riding": found.thresholds["puck"]}
rb.append_transform(CAIACTransform(layout, thresholds, score_key=("caiac", "good")))
swapped = rb.sample()["caiac", "swapped"].sum(0)
print("swapped in 128 rows:", dict(zip(layout.names, swapped.tolist(), strict=True)))

# %%
# Where no threshold is right
# ---------------------------
# The scores of the other model do not separate rows in which the puck moves from those
# in which it rests. The threshold is *unclear*, and nothing is swapped: a warning in
# the log of ``CAIACTransform(threshold="auto")`` would say so.

small = suggest_thresholds(rb, layout, score_key=("caiac", "small floor"))
print(small.confidence["puck"], "-", small.reasons["puck"])

# %%
# Then another number does not help. Look at the floor, at whether the data have
# different actions in similar states, and at the number of steps of the fit.
#
# How good is the choice?
# -----------------------
# Here we have the simulator. In each state we try 32 actions: the puck is influenced if
# two of them bring it to places more than 1 mm apart.

tried = 2 * torch.rand(32, 2) - 1
states = true[:, :-1].reshape(-1, 8)
outcome = step(states[:, None], tried)[..., 2:4]
influenced = (outcome.amax(1) - outcome.amin(1)).amax(-1) > 1e-3
best, accuracy = best_threshold(score[:, 1], influenced)
above = score[:, 1] > found.thresholds["puck"]
ours = (above[influenced].float().mean() + (~above)[~influenced].float().mean()) / 2
print(f"suggested {found.thresholds['puck']:.3f}, balanced accuracy {ours:.3f}")
print(f"best      {best:.3f}, balanced accuracy {accuracy:.3f}")

# %%
# The same as a map: each dot is a state, at the place of the puck relative to the
# robot. Dots are dark where the score is above the suggested threshold, or, without a
# clear one, above the best split. The robot can touch the puck within the circle.

figure, axes = plt.subplots(1, 2, figsize=(8, 4), sharex=True, sharey=True)
splits = {"good": found.splits["puck"], "small floor": small.splits["puck"]}
offset = states[:, 2:4] - states[:, 0:2]
for ax, (key, split) in zip(axes, splits.items(), strict=True):
    above = rb.storage[:]["caiac", key][:, 1] > split
    ax.scatter(*offset.T, c=above, s=3, cmap="Blues", vmin=-0.4, vmax=1)
    ax.add_patch(plt.Circle((0, 0), REACH + STEP, fill=False, color="tab:red"))
    ax.set(title=key, xlim=(-0.8, 0.8), ylim=(-0.8, 0.8), aspect="equal")
figure.tight_layout()

# %%
# :doc:`/how_to/score` has the rules in short, and :doc:`/report` shows the same figures
# for a dataset of your own.
