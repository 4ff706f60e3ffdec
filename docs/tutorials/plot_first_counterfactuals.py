"""
Your first counterfactuals
==========================

A point robot shares a table with two pucks. It moves by its action; a puck moves only
while the robot touches it. From logged transitions we learn which puck the robot
influences in which state. Then we swap the other puck for that of another sample. The
result is a transition that was never recorded, but could have been.
"""

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, LazyTensorStorage, ReplayBuffer

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.influence import CAI, roc_auc, score_buffer
from torchrl_caiac.modules import GaussianWorldModel

torch.manual_seed(0)
torch.set_num_threads(1)

# %%
# A table with two pucks
# ----------------------
# A state has six numbers: the positions of the robot and of both pucks, in metres. A
# step moves the robot by up to 8 cm along each axis. A puck that it then overlaps is
# pushed away.

REACH, STEP = 0.15, 0.08  # metres: distance of contact, largest move along an axis


def step(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Returns next states ``[*B, 6]`` of states ``[*B, 6]``, actions ``[*B, 2]``."""
    robot = state[..., 0:2] + STEP * action
    positions = [robot]
    for puck in (state[..., 2:4], state[..., 4:6]):
        offset = puck - robot
        distance = offset.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        touched = distance < REACH
        positions.append(torch.where(touched, robot + offset / distance * REACH, puck))
    return torch.cat(positions, -1)


# %%
# The logged behaviour moves at random, and in half of the steps towards one of the
# pucks. Transitions have TorchRL's format, with next states under ``"next"``. The key
# ``"episode"`` has the number of each row's trajectory.

EPISODES, LENGTH = 300, 50
state = torch.rand(EPISODES, 6) * 1.6 - 0.8
aim = 2 + 2 * torch.randint(2, (EPISODES,))
columns = torch.stack([aim, aim + 1], -1)
states, actions = [state], []
for _ in range(LENGTH):
    towards = (state.gather(-1, columns) - state[:, 0:2]) / STEP
    action = torch.where(
        torch.rand(EPISODES, 1) < 0.5, towards, 2 * torch.rand(EPISODES, 2) - 1
    )
    action = (action + 0.3 * torch.randn(EPISODES, 2)).clamp(-1, 1)
    state = step(state, action)
    states.append(state)
    actions.append(action)

walk = torch.stack(states, 1)  # [episodes, length + 1, 6]
done = torch.zeros(EPISODES, LENGTH, 1, dtype=torch.bool)
done[:, -1] = True
data = TensorDict(
    {
        "observation": walk[:, :-1],
        "action": torch.stack(actions, 1),
        "episode": torch.arange(EPISODES)[:, None].expand(-1, LENGTH),
        "next": {
            "observation": walk[:, 1:],
            "reward": torch.zeros(EPISODES, LENGTH, 1),
            "done": done,
            "truncated": done,
            "terminated": torch.zeros_like(done),
        },
    },
    [EPISODES, LENGTH],
).reshape(-1)
data

# %%
# Entities
# --------
# The layout says which columns describe which entity. The robot is ``fixed``: it is
# never swapped.

layout = EntityLayout(
    {"robot": [0, 1], "puck A": [2, 3], "puck B": [4, 5]}, fixed=["robot"]
)
layout

# %%
# World model and influence
# -------------------------
# The model predicts a Gaussian for the change of every entity. ``variance_floor`` is
# its smallest standard deviation, in metres. Changes well below it count as noise.
# ``action_spec`` says which actions are possible: influence compares them.

model = GaussianWorldModel(
    layout, action_dim=2, hidden_sizes=(128, 128), variance_floor=5e-3
)
history = fit_world_model(
    model,
    data,
    action_spec=Bounded(-1.0, 1.0, (2,)),
    steps=2000,
    batch_size=500,
    eval_every=500,
    progress=False,
)
print("steps:", history["step"].tolist())
print("validation NLL:", [round(x, 2) for x in history["validation_nll"].tolist()])

# %%
# Causal action influence measures how much the next state of an entity depends on the
# action. :func:`~torchrl_caiac.influence.score_buffer` computes it once for every row
# and stores the scores in the buffer.

rb = ReplayBuffer(
    storage=LazyTensorStorage(len(data)),
    batch_size=256,
    generator=torch.Generator().manual_seed(0),
)
rb.extend(data)
score_buffer(rb, CAI(model), lookahead=0, progress=False)
score = rb.storage[:]["caiac", "score"]
print(score.shape)

# %%
# Here we know the dynamics, so we can compute the ground truth: try 32 actions in every
# state, and check whether a puck's next position varies by more than a millimetre.

tried = 2 * torch.rand(32, 2) - 1
outcome = step(data["observation"][:, None], tried[None])  # [T, 32, 6]
spread = (outcome.amax(1) - outcome.amin(1)).reshape(-1, 3, 2).amax(-1)
influenced = spread > 1e-3

THRESHOLD = 0.1
for i in (1, 2):
    auc = roc_auc(score[:, i], influenced[:, i])
    agree = ((score[:, i] > THRESHOLD) == influenced[:, i]).float().mean()
    print(
        f"{layout.names[i]}: ROC-AUC {auc:.3f}, agreement at {THRESHOLD}: {agree:.3f}"
    )

# %%
# Along one trajectory, the lines are scores, and the bars below them the ground truth.

contacts = influenced[:, 1:].reshape(EPISODES, LENGTH, 2).sum(1)
episode = int(contacts.amin(-1).argmax())  # one with contacts of both pucks
rows = slice(episode * LENGTH, (episode + 1) * LENGTH)
fig, ax = plt.subplots(figsize=(7, 3))
for i, color in ((1, "tab:orange"), (2, "tab:blue")):
    ax.plot(score[rows, i], color=color, label=layout.names[i])
    for t in influenced[rows, i].nonzero()[:, 0].tolist():
        ax.axvspan(
            t - 0.5,
            t + 0.5,
            0.06 - 0.03 * i + 0.03,
            0.09 - 0.03 * i + 0.03,
            color=color,
            lw=0,
        )
ax.axhline(THRESHOLD, color="gray", lw=1, ls="--", label="threshold")
ax.set(xlabel="step", ylabel="influence", ylim=(-0.2, None))
ax.legend(loc="upper right")
fig.tight_layout()

# %%
# Counterfactual batches
# ----------------------
# Append the transform to the buffer, and half of each batch is counterfactual.
# The training loop does not change. In this half, uninfluenced pucks come from other
# rows in which they are uninfluenced too, with their next states. What the robot
# influences stays, and so do the actions.

rb.append_transform(
    CAIACTransform(
        layout, threshold=THRESHOLD, generator=torch.Generator().manual_seed(0)
    )
)
batch = rb.sample()
swapped = batch["caiac", "swapped"]
print("counterfactual rows:", int(batch["caiac", "counterfactual"].sum()))
for i, name in enumerate(layout.names):
    print(f"{name}: swapped in {int(swapped[:, i].sum())} rows")

# %%
# Are these transitions feasible? We check with the dynamics: does the recorded action
# lead from the counterfactual state to the counterfactual next state?

made = batch[swapped.any(-1)]
error = (step(made["observation"], made["action"]) - made["next", "observation"]).abs()
feasible = (error.amax(-1) < 1e-3).float().mean()
print(f"feasible counterfactual transitions: {feasible:.1%}")

# %%
# A transition is infeasible if the swap puts a puck within reach of the robot: the
# method assumes that contacts are rare. The figure shows four steps, with the pucks as
# recorded and as swapped.

original = data["observation"]
fig, axes = plt.subplots(1, 4, figsize=(10, 2.8), sharex=True, sharey=True)
# The robot is never swapped: its position identifies the recorded row.
for ax, row in zip(
    axes, made[swapped[swapped.any(-1)].sum(-1).argsort()][:4], strict=True
):
    source = (original[:, :2] - row["observation"][:2]).abs().sum(-1).argmin()
    for i, color in ((1, "tab:orange"), (2, "tab:blue")):
        before = original[source, 2 * i : 2 * i + 2]
        after = row["observation"][2 * i : 2 * i + 2]
        ax.add_patch(plt.Circle(before.tolist(), 0.09, fill=False, color=color))
        ax.add_patch(plt.Circle(after.tolist(), 0.09, color=color))
    x, y = row["observation"][:2].tolist()
    ax.add_patch(plt.Circle((x, y), 0.06, color="black"))
    dx, dy = (STEP * row["action"]).tolist()
    ax.arrow(x, y, 3 * dx, 3 * dy, head_width=0.06, color="black")
    ax.set(xlim=(-1.5, 1.5), ylim=(-1.5, 1.5), aspect="equal", xticks=[], yticks=[])
fig.suptitle(
    "outlines: as recorded; filled: as sampled; black: the robot and its action"
)
fig.tight_layout()
