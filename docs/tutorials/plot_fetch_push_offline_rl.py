"""
Offline RL on Fetch-Push
========================

A robot is to push two cubes to their goals, and may only learn from logged episodes:
some of a scripted expert, most of them of random actions. A goal is about both cubes;
an action moves one of them, or mostly none. This page goes the whole way from the
environment to a policy, with TD3, hindsight goals and counterfactuals (sections 4.3,
A.3.1 and A.5.2 of the paper).

It does so on too little data and with far too few gradient steps, so that it runs in a
minute or two, and shows how the pieces fit together. What counterfactuals are worth is
another question: ``make fetch-push`` measures that, and :doc:`/results` reports it.
"""

import tempfile

import matplotlib.pyplot as plt
import torch
from torchrl.objectives import SoftUpdate

from torchrl_caiac import CAIACTransform
from torchrl_caiac.data import (
    load_minari,
    mix_trajectories,
    offline_buffer,
)
from torchrl_caiac.envs import (
    FetchPushCubes,
    FetchPushExpert,
    FetchPushTruth,
    RenderingUnavailable,
    create_fetch_push_expert,
    create_fetch_push_random,
    fetch_push_layout,
    fetch_push_reward,
    make_fetch_push_env,
)
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.influence import (
    CAI,
    influence_report,
    score_buffer,
    true_influence,
)
from torchrl_caiac.modules import (
    GaussianWorldModel,
    GoalConditionedActor,
    GoalConditionedCritic,
    GoalFeatures,
)
from torchrl_caiac.objectives import GoalConditionedTD3Loss
from torchrl_caiac.plotting import plot_frames, plot_influence
from torchrl_caiac.transforms import HindsightGoal

torch.manual_seed(0)
torch.set_num_threads(1)

# %%
# The environment and its expert
# ------------------------------
# ``FetchPushCubes`` is a Gymnasium environment with goals. The layout says which of
# the 34 columns of the observation are whose, and which cube each goal is about. The
# gripper is fixed: it is never swapped.

layout = fetch_push_layout(2)
layout

# %%
# The expert's action depends on what it sees alone, so that a policy can learn it. The
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
print("there at the end:", bool(info["success"]))

# %%
# Frames of this episode, where there is OpenGL. Goals are balls of their cube's colour.

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
# Two datasets, and a mixture
# ---------------------------
# Episodes are kept as Minari datasets, to be read by any other program too. The
# simulator's states go with them: we shall ask it for the truth. ``workers=1`` collects
# in this process; a script with ``if __name__ == "__main__":`` can have more.

folder = tempfile.TemporaryDirectory()
options = {"root": folder.name, "workers": 1, "progress": False}
datasets = {
    "expert": create_fetch_push_expert(episodes=30, **options),
    "random": create_fetch_push_random(episodes=70, **options),
    "held-out": create_fetch_push_expert(
        "fetch-push-2/held-out-v0", episodes=4, seed=1, **options
    ),
}
for dataset in datasets.values():
    print(f"{dataset.id}: {dataset.storage.metadata['description']}")

# %%
# :func:`~torchrl_caiac.data.load_minari` writes them as rows of TorchRL transitions,
# memory-mapped, and :func:`~torchrl_caiac.data.mix_trajectories` draws whole episodes
# of several datasets. Smaller fractions are the beginnings of larger ones, so that
# results with less data can be compared.

rows = {
    name: load_minari(
        dataset, f"{folder.name}/{name}", infos=["simulator"], progress=False
    )
    for name, dataset in datasets.items()
}
data = mix_trajectories([rows["expert"], rows["random"]])
tenth = mix_trajectories([rows["expert"], rows["random"]], fraction=0.1)
for name, part in (("all", data), ("a tenth", tenth)):
    episodes = part["episode"].unique()
    share = (part["source"] == 0).float().mean()
    print(f"{name}: {len(part)} rows, {len(episodes)} episodes, expert's {share:.0%}")

# %%
# What the action influences
# --------------------------
# The world model predicts by how much positions change, and everything below 1 mm is
# left to chance (``variance_floor``). With a floor far below that, scores of resting
# cubes are mostly noise.

positions = {"gripper": 5, "cube0": 3, "cube1": 3}  # the first columns of each
model = GaussianWorldModel(
    layout,
    action_dim=4,
    predict={name: layout.columns[name][:n] for name, n in positions.items()},
    variance_floor=1e-3,
)
history = fit_world_model(model, data, steps=2000, eval_every=1000, progress=False)
print("steps:", history["step"].tolist())
for name in positions:
    error = 1e3 * history["validation_mse", name].sqrt()
    print(f"{name}, error in mm:", [round(x, 2) for x in error.tolist()])

# %%
# Scores are made once for every row, and kept beside the data. As in the paper a score
# is that of the row's own state, the mean over three steps.

rb = offline_buffer(data)
score_buffer(rb, CAI(model), smoothing=3, lookahead=0, progress=False)
below = (data["caiac", "score"] <= 0.05).float().mean(0)
for name, share in zip(layout.names, below, strict=True):
    print(f"{name}: score at most 0.05 in {share:.0%} of the rows")

# %%
# Do they find influence? On the held-out episodes the simulator knows: restore a row's
# state, try 24 actions, and see whether two of them bring a cube to places more than a
# millimetre apart.

held_out = rows["held-out"].clone()
score_buffer(
    offline_buffer(held_out), CAI(model), smoothing=3, lookahead=0, progress=False
)
score = held_out["caiac", "score"]
truth = true_influence(
    FetchPushTruth,
    held_out["info", "simulator"],
    num_actions=24,
    threshold=1e-3,
    progress=False,
).influenced

THRESHOLD = 0.05
report = influence_report(score, truth, layout.names, THRESHOLD)
for name in ("cube0", "cube1"):
    row = report[name]
    print(
        f"{name}: influenced in {row['influenced']:.0%} of the rows; ROC-AUC "
        f"{row['auc']:.3f}; at {THRESHOLD} true positive rate "
        f"{row['true_positive_rate']:.0%}, false positive rate "
        f"{row['false_positive_rate']:.0%}"
    )

# %%
# Along one of these episodes, the one that has most influence on both cubes. With so
# few data a score also rises when the *other* cube is touched.

contacts = torch.stack([t[:, 1:].sum(0) for t in truth.reshape(-1, 100, 3)])
episode = int(contacts.amin(-1).argmax())
shown = slice(100 * episode, 100 * episode + 100)
figure = plot_influence(
    score[shown].numpy(),
    layout.names,
    ground_truth=truth[shown].numpy(),
    threshold=THRESHOLD,
    exclude=["gripper"],
    step_seconds=env.dt,
    title="influence along an expert's episode",
)
figure

# %%
# Counterfactuals and hindsight goals
# -----------------------------------
# Two transforms make the batches. The first one makes the last half counterfactual: a
# cube that the action does not influence is taken from another row, its goal with it.
# The second one relabels (A.5.2): half of the real rows get a goal that was achieved
# later in their episode, half of the counterfactual ones a goal that a counterfactual
# row achieves. All these rewards are made anew, from the *next* achieved goal.
#
# Swap first, then relabel. ``HindsightGoal`` is the buffer's ``sample_unit`` too: that
# is how it sees which rows were sampled, and reads what came after them.

data["row"] = torch.arange(len(data))  # to find recorded rows again, for the figure
goals = HindsightGoal(layout, fetch_push_reward)
rb = offline_buffer(data.exclude("info"), sample_unit=goals)
rb.append_transform(CAIACTransform(layout, threshold=THRESHOLD))
rb.append_transform(goals)

batch = rb.sample(512)
counterfactual = batch["caiac", "counterfactual"].squeeze(-1)
for name, kind in (("real", ~counterfactual), ("counterfactual", counterfactual)):
    part = batch[kind]
    relabeled = part["hindsight", "relabeled"].squeeze(-1)
    reward = part["next", "reward"].squeeze(-1)
    print(
        f"{name}: {len(part)} rows; swapped cube0 "
        f"{part['caiac', 'swapped'][:, 1].float().mean():.0%}, cube1 "
        f"{part['caiac', 'swapped'][:, 2].float().mean():.0%}; relabelled "
        f"{relabeled.float().mean():.0%}; reward 0 in "
        f"{(reward[relabeled] == 0).float().mean():.0%} of these and "
        f"{(reward[~relabeled] == 0).float().mean():.0%} of the others"
    )

# %%
# Most real rows that were relabelled are successes: in the few steps to their goal
# little moved.
#
# Some of the counterfactual rows, seen from above. Outlines are the cubes as recorded,
# filled squares as sampled, stars the goals; the dot is the gripper, and the arrow the
# recorded action. Nothing keeps a cube from being swapped to where the gripper is: the
# method takes it that objects rarely touch.

swapped = batch["caiac", "swapped"][:, 1:].sum(-1)
examples = torch.cat([batch[swapped == 1][:2], batch[swapped == 2][:2]])
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
fig.suptitle("left: one cube swapped, one above the threshold; right: both swapped")
fig.tight_layout()

# %%
# TD3 with goals
# --------------
# Actor and critics see the positions of the cubes relative to the gripper and to the
# goals, besides state and goal. ``GoalFeatures`` computes them within the networks:
# stored ones would describe the cube that was swapped out. The loss bounds its targets
# by what a return can be, -1 / (1 - 0.97) to 0.

features = GoalFeatures(layout, reference="gripper")
features.fit_statistics(rb.sample(10_000))
actor = GoalConditionedActor(features, 4)
critics = [GoalConditionedCritic(features, 4) for _ in range(2)]
loss = GoalConditionedTD3Loss(actor, critics)
loss.make_value_estimator(gamma=0.97)
updater = SoftUpdate(loss, tau=0.005)
actor_optimizer, critic_optimizer = (
    torch.optim.Adam(params.flatten_keys().values(), lr=1e-3)
    for params in (loss.actor_network_params, loss.qvalue_network_params)
)


def descend(value: torch.Tensor, optimizer: torch.optim.Optimizer) -> None:
    """One gradient step."""
    optimizer.zero_grad()
    value.backward()
    optimizer.step()


STEPS = 1000
torch.set_flush_denormal(True)  # denormal numbers are slow on a CPU
for step in range(1, STEPS + 1):
    batch = rb.sample(256)
    value_loss, info = loss.value_loss(batch)
    descend(value_loss, critic_optimizer)
    if step % 2 == 0:  # the policy every other step
        descend(loss.actor_loss(batch)[0], actor_optimizer)
        updater.step()
    if step % 250 == 0:
        print(
            f"step {step}: critics' loss {value_loss.item():.3f}, mean value "
            f"{info['pred_value'].mean():.2f}, mean target "
            f"{info['target_value'].mean():.2f}"
        )

# %%
# What the critics have learnt so far: their value of the expert's actions along the
# held-out episodes, which should rise towards 0 as the cubes come to their goals.

torch.set_flush_denormal(False)
with torch.no_grad():
    value = loss.value_loss(held_out)[1]["pred_value"].mean(0).reshape(-1, 100)
reached = (held_out["next", "reward"] == 0).reshape(-1, 100)
fig, ax = plt.subplots(figsize=(7, 3))
for color, line, success in zip(plt.cm.tab10.colors, value, reached, strict=False):
    ax.plot(line, color=color, lw=1)
    if success.any():
        ax.axvline(int(success.int().argmax()), color=color, lw=1, ls=":")
ax.set(xlabel="step", ylabel="value", title="dotted: the first success of an episode")
fig.tight_layout()

# %%
# The policy plays
# ----------------
# Ten episodes from new starts. As in the paper a cube counts as brought to its goal if
# it is there at some step; none starts there.

env = make_fetch_push_env(2)
env.set_seed(1000)
with torch.no_grad():
    played = torch.stack([env.rollout(100, actor) for _ in range(10)])
env.close()
after = played["next"]
for i in (0, 1):
    count = int(after["cube_success"][..., i].any(1).sum())
    print(f"episodes with cube{i} at its goal: {count} of 10")
print("with both there at once:", int(after["success"].any(1).sum()), "of 10")
start, end = played["achieved_goal"][:, 0], after["achieved_goal"][:, -1]
moved = (end - start).unflatten(-1, (2, 3)).norm(dim=-1)
print("cubes moved by more than 1 cm:", int((moved > 0.01).sum()), "of 20")
folder.cleanup()

# %%
# These numbers say nothing about the method, for or against it: 100 episodes and 1,000
# gradient steps are far from enough for that. The study has 2,000 episodes, tens of
# thousands of steps, several seeds, and arms that tell the swap from the relabelling
# that comes with it (``examples/fetch_push``, ``make fetch-push``).
