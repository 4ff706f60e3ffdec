"""
Pushing cubes, learned from demonstrations
==========================================

A policy learns to push two cubes to their goals from 300 demonstrations of a scripted
expert, by behaviour cloning: once from the demonstrations alone, and once with
counterfactuals, in which cubes that the robot does not influence are swapped with those
of other demonstrations. Nothing else differs. At the end the policies play from the
same new starts.

The script runs in about two minutes on one processor core. It needs no world model:
what the robot influences is read from the motion in the recording. ``make fetch-push``
does the same with more seeds and starts, and also with causal action influence, see
:doc:`/results`.
"""

import tempfile
import warnings

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDictBase
from torchrl.data import SamplerWithoutReplacement
from torchrl.objectives import BCLoss

from torchrl_caiac import CAIACTransform
from torchrl_caiac.data import load_minari, offline_buffer, select_successful
from torchrl_caiac.envs import (
    FetchPushCubes,
    FetchPushExpert,
    RenderingUnavailable,
    create_fetch_push_expert,
    fetch_push_layout,
    make_fetch_push_env,
)
from torchrl_caiac.influence import MotionInfluence, score_buffer
from torchrl_caiac.modules import GoalConditionedActor, GoalFeatures
from torchrl_caiac.plotting import plot_frames

torch.manual_seed(0)
torch.set_num_threads(1)
warnings.filterwarnings("ignore", "The name target_actor_network_params")  # BCLoss

# %%
# Environment and expert
# ----------------------
# ``FetchPushCubes`` is a Gymnasium environment with goals. The layout says which of the
# 34 observation columns describe which entity, and which goal columns belong to which
# cube. The gripper is fixed: it is never swapped.

layout = fetch_push_layout(2)
layout

# %%
# The expert's action depends on the observation only, so a policy can learn it. The
# reward is -1 until both cubes are within 5 cm of their goals.

env = FetchPushCubes(2, render_mode="rgb_array")
expert = FetchPushExpert(2)
observation, info = env.reset(seed=3)
states, rewards = [env.simulator_state()], []
for _ in range(100):
    observation, reward, _, _, info = env.step(expert(observation))
    states.append(env.simulator_state())
    rewards.append(reward)
first = rewards.index(0.0) + 1
print("steps until both cubes were at their goals:", first)

# %%
# Frames of this episode, if OpenGL is available. Each goal is a ball of its cube's
# colour.

shown = [0, first // 3, 2 * first // 3, first]
try:
    frames = env.render_states([states[i] for i in shown])
    figure = plot_frames(frames, [f"step {i}" for i in shown])
except RenderingUnavailable as error:
    figure = None
    print("no frames:", error)
env.close()
figure

# %%
# Demonstrations
# --------------
# Episodes are stored as a Minari dataset, which other programs can read too.
# :func:`~torchrl_caiac.data.load_minari` converts them to memory-mapped TorchRL
# transitions. ``workers=1`` collects in this process; more workers need a script with
# ``if __name__ == "__main__":``.

folder = tempfile.TemporaryDirectory()
dataset = create_fetch_push_expert(
    episodes=310,
    simulator_states=False,
    root=folder.name,
    workers=1,
    progress=False,
)
episodes = load_minari(dataset, f"{folder.name}/episodes", progress=False)
print(dataset.storage.metadata["description"])

# %%
# A cloned policy repeats whatever its data show. So we leave out the episodes that
# fail, and what the expert does after its first success.
# :func:`~torchrl_caiac.data.select_successful` does both.

data = select_successful(
    episodes,
    ("next", "reward"),
    above=-0.5,  # the reward is 0 at the goal, else -1
    trajectories=300,
)
print(f"{len(episodes)} rows of 310 episodes, {len(data)} rows of 300 demonstrations")

# %%
# What moves is influenced
# ------------------------
# The cubes rest unless the robot pushes them. So a cube that moves by more than a
# millimetre in a recorded step is influenced by the action of this step.
# :class:`~torchrl_caiac.influence.MotionInfluence` says so, without a model. The scores
# are computed once and stored with the data.

score_buffer(
    offline_buffer(data), MotionInfluence(layout, 1e-3), lookahead=0, progress=False
)
moves = data["caiac", "score"][:, 1:] > 0  # cube0, cube1
for name, share in zip(layout.names[1:], moves.float().mean(0), strict=True):
    print(f"{name} moves in {share:.0%} of the rows")

# %%
# Lookahead
# ---------
# While the gripper flies to a cube, nothing moves yet. If this cube were swapped, the
# action would go to a place where no cube is any more, and so would a policy that
# clones it. With ``lookahead="next"`` the transform also keeps the cube that is
# influenced *next* in the trajectory. The other one may be swapped.
#
# To show the difference, we make all rows counterfactual, and sample each row once.

data["row"] = torch.arange(len(data))
swapped = {}
for lookahead in (None, "next"):
    all_rows = offline_buffer(
        data, batch_size=len(data), sampler=SamplerWithoutReplacement()
    )
    all_rows.append_transform(
        CAIACTransform(layout, counterfactual_ratio=1.0, lookahead=lookahead)
    )
    batch = all_rows.sample()
    swapped[lookahead] = torch.zeros_like(moves)
    swapped[lookahead][batch["row"]] = batch["caiac", "swapped"][:, 1:]
    count = swapped[lookahead].sum(1)
    one, both = ((count == n).float().mean() for n in (1, 2))
    print(f"lookahead={lookahead!r}: one cube swapped in {one:.0%}, both in {both:.0%}")

# %%
# One demonstration, in which the cubes never move at the same time. The third panel has
# what the policy below learns from: a cube is not swapped from when the gripper sets
# out for it until it rests.

pushed = torch.zeros(int(data["episode"].max()) + 1, 2)
pushed.index_add_(0, data["episode"], moves.float())
at_once = torch.zeros(len(pushed)).index_add_(0, data["episode"], moves.all(1).float())
shown = data["episode"] == pushed.amin(1).where(at_once == 0, -1).argmax()
panels = {
    "moves": moves,
    "swapped, lookahead=None": swapped[None],
    'swapped, lookahead="next"': swapped["next"],
}
fig, axes = plt.subplots(3, 1, figsize=(8, 3.6), sharex=True)
for ax, (title, flags) in zip(axes, panels.items(), strict=True):
    ax.imshow(flags[shown].T, aspect="auto", cmap="Blues", vmin=0, vmax=1.5)
    ax.set_title(title, fontsize="medium", loc="left")
    ax.set_yticks([0, 1], layout.names[1:])
axes[-1].set_xlabel("step")
fig.tight_layout()

# %%
# Some counterfactual rows from above. Outlines are cubes as recorded, filled squares as
# sampled, stars are goals, the dot is the gripper, and the arrow is the recorded
# action. The goal of a cube is swapped with it: the desired goal still says where each
# cube belongs.

count = batch["caiac", "swapped"][:, 1:].sum(-1)
examples = batch[count == 1][:4]
fig, axes = plt.subplots(1, 4, figsize=(10, 2.9), sharex=True, sharey=True)
for ax, row in zip(axes, examples, strict=True):
    recorded = data["observation"][row["row"]]
    state, goal = row["observation"], row["desired_goal"]
    for i, color in ((0, "tab:red"), (1, "tab:blue")):
        column = layout.columns[f"cube{i}"][0]
        for position, fill in ((recorded, False), (state, True)):
            x, y = position[column : column + 2].tolist()
            corner = (x - 0.025, y - 0.025)
            ax.add_patch(plt.Rectangle(corner, 0.05, 0.05, fill=fill, color=color))
        ax.plot(*goal[3 * i : 3 * i + 2].tolist(), "*", color=color, ms=9, mec="black")
    x, y = state[:2].tolist()
    dx, dy = (0.033 * row["action"][:2]).tolist()
    ax.plot(x, y, "o", color="black", ms=4)
    ax.arrow(x, y, 2 * dx, 2 * dy, head_width=0.015, color="black")
    ax.set(xlim=(1.1, 1.6), ylim=(0.5, 1.0), aspect="equal", xticks=[], yticks=[])
fig.suptitle("one cube is swapped, with its goal")
fig.tight_layout()

# %%
# Behaviour cloning
# -----------------
# The policy reads the state, the goal, and the positions of the cubes relative to the
# gripper and to the goals. ``GoalFeatures`` computes these within the network, since
# stored ones would describe the cube before the swap. The loss is TorchRL's ``BCLoss``.
#
# The recipe is that of the study: AdamW with a weight decay of 0.1, and a learning rate
# that falls to 0 along a cosine. With counterfactuals, 80 % of each batch are
# counterfactual.

STEPS = 6000


def clone(augmentation: CAIACTransform | None) -> GoalConditionedActor:
    """Returns a policy that was trained with a transform, or without."""
    torch.manual_seed(0)
    rb = offline_buffer(data)
    if augmentation is not None:
        rb.append_transform(augmentation)
    features = GoalFeatures(layout, reference="gripper")
    features.fit_statistics(rb.sample(10_000))
    actor = GoalConditionedActor(features, 4)
    loss_module = BCLoss(actor, loss_function="l2")
    optimizer = torch.optim.AdamW(
        loss_module.parameters(), lr=1e-3, weight_decay=0.1, fused=True
    )
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for step in range(1, STEPS + 1):
        loss = loss_module(rb.sample(256))["loss_bc"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        scheduler.step()
        if step % 2000 == 0:
            print(f"step {step}: loss {loss.item():.4f}")
    return actor


policies = {}
for name, augmentation in {
    "no counterfactuals": None,
    "lookahead=None": CAIACTransform(layout, counterfactual_ratio=0.8),
    'lookahead="next"': CAIACTransform(
        layout, counterfactual_ratio=0.8, lookahead="next"
    ),
}.items():
    print(name)
    policies[name] = clone(augmentation)

# %%
# The loss is lowest without counterfactuals: the 300 demonstrations are easier to fit
# than all their combinations. What matters is what the policies do from new starts.
#
# Evaluation
# ----------
# Each policy plays 30 episodes, from the same new starts. An episode ends when both
# cubes are at their goals, or after 100 steps.

EPISODES = 30
env = make_fetch_push_env(2, terminate_on_success=True)
played: dict[str, list[TensorDictBase]] = {}
for name, policy in policies.items():
    played[name] = []
    for number in range(EPISODES):
        env.set_seed(1000 + number)
        with torch.no_grad():
            played[name].append(env.rollout(100, policy))
env.close()

success = {}
for name, rollouts in played.items():
    after = [rollout["next"] for rollout in rollouts]
    reached = torch.stack([td["cube_success"].any(0) for td in after])
    success[name] = torch.stack([td["success"].any() for td in after])
    both, (first, second) = int(success[name].sum()), reached.sum(0).tolist()
    print(
        f"{name}: both cubes at their goals in {both} of {EPISODES} episodes, "
        f"cube0 in {first}, cube1 in {second}"
    )

# %%
# Counterfactuals help only if the cube that an action is for stays where it is.
#
# The first eight starts from above. Lines show where the cubes were pushed, squares are
# the cubes at the end, stars their goals, and the grey line is the gripper.

fig, axes = plt.subplots(3, 8, figsize=(12, 5.2), sharex=True, sharey=True)
for line, (name, rollouts) in zip(axes, played.items(), strict=True):
    for ax, rollout, solved in zip(line, rollouts, success[name], strict=False):
        place = rollout["next", "observation"]
        ax.plot(place[:, 0], place[:, 1], color="0.75", lw=1)
        for i, color in ((0, "tab:red"), (1, "tab:blue")):
            x, y = rollout["next", "achieved_goal"].unflatten(-1, (2, 3))[:, i, :2].T
            ax.plot(x, y, color=color, lw=1.5)
            corner = (x[-1] - 0.025, y[-1] - 0.025)
            ax.add_patch(plt.Rectangle(corner, 0.05, 0.05, color=color, alpha=0.7))
            goal = rollout["desired_goal"][0, 3 * i : 3 * i + 2].tolist()
            ax.plot(*goal, "*", color=color, ms=9, mec="black")
        ax.set(xlim=(1.05, 1.6), ylim=(0.45, 1.05), aspect="equal")
        ax.set(xticks=[], yticks=[])
        ax.set_title("success" if solved else "failure", fontsize="small")
    line[0].set_ylabel(name)
fig.tight_layout()
folder.cleanup()

# %%
# Thirty starts and one seed are few: with other seeds the numbers differ. The study has
# several seeds, 100 starts, up to 1,200 demonstrations, other estimators of influence,
# and policies that are chosen on starts of their own, see :doc:`/results`.
#
# To change the learner, replace the loss. The transform stays the same.
# :doc:`/how_to/train` says which settings suit which learner.
