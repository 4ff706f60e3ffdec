"""
Skills in the kitchen
=====================

The slide cabinet is open in all microwave demonstrations and closed in all kettle
demonstrations. An agent learns goal-conditioned skills from them, and is evaluated on
both tasks with the cabinet closed. In the data a closed cabinet means that the robot
pushes the kettle. Counterfactuals remove this correlation.

This tutorial is a small version of the paper's motivating experiment (section 4.1):
demonstrations, influence, counterfactual windows, latent motor plans, and episodes of
both tasks with and without counterfactuals. It runs in a minute or two. ``make demo``
has more demonstrations, seeds and episodes, see :doc:`/results`.
"""

import tempfile
from dataclasses import replace

import torch
from minari import MinariDataset
from tensordict import TensorDict
from torchrl.data import Bounded, SliceSampler, TensorDictReplayBuffer

from torchrl_caiac import CAIACTransform
from torchrl_caiac.data import offline_buffer
from torchrl_caiac.envs import RenderingUnavailable
from torchrl_caiac.envs.kitchen import (
    KITCHEN_TASKS,
    MICROWAVE_KETTLE,
    KitchenEnv,
    create_kitchen_demonstrations,
    create_kitchen_random,
    kitchen_transitions,
    make_kitchen_env,
)
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.influence import CAI, roc_auc, score_buffer, true_influence
from torchrl_caiac.modules import GaussianWorldModel, LMPActor, LMPModel
from torchrl_caiac.objectives import LMPLoss
from torchrl_caiac.plotting import plot_frames, plot_influence
from torchrl_caiac.transforms import WindowGoal

torch.manual_seed(0)
torch.set_num_threads(1)

# %%
# Demonstrations
# --------------
# The scripted expert acts in gymnasium-robotics' Franka-Kitchen, with noise on its
# waypoints and its actions. ``MICROWAVE_KETTLE`` has the tasks and their starts. We
# collect 30 demonstrations of each task, and two held-out ones to check the scores.
# They are stored as Minari datasets and read as TorchRL transitions. ``workers=1``
# collects in this process; more workers need a script with ``if __name__ ==
# "__main__":``.

folder = tempfile.TemporaryDirectory()
options = {"root": folder.name, "workers": 1, "progress": False}


def demonstrations(
    dataset_id: str, episodes: int, seed: int
) -> tuple[MinariDataset, TensorDict]:
    """Collects both tasks; returns a Minari dataset and TorchRL transitions."""
    groups = [replace(group, episodes=episodes) for group in MICROWAVE_KETTLE]
    dataset, _ = create_kitchen_demonstrations(
        dataset_id, demonstrations=groups, seed=seed, **options
    )
    return dataset, kitchen_transitions(dataset, progress=False)


dataset, data = demonstrations("kitchen/few-v0", episodes=30, seed=0)
_, held_out = demonstrations("kitchen/held-out-v0", episodes=2, seed=1)

layout = KitchenEnv.layout
MICROWAVE, KETTLE = KITCHEN_TASKS.index("microwave"), KITCHEN_TASKS.index("kettle")
cabinet = data["observation"][:, layout.columns["slide_cabinet"][0]]
for name, task in (("microwave", MICROWAVE), ("kettle", KETTLE)):
    mine = data["task"] == task
    print(
        f"{name}: {len(data['episode'][mine].unique())} demonstrations, "
        f"{int(mine.sum())} rows, cabinet open in "
        f"{(cabinet[mine] > 0.2).float().mean():.0%}"
    )

# %%
# The 30 columns of the state describe ten entities. A goal has a value for every column
# of every object: it says where *everything* has to be in the end.

layout

# %%
# World model and influence
# -------------------------
# Influence depends on what other actions would have done. Demonstrations hardly show
# that. We therefore add as many random actions, taken in states of the demonstrations.

random = kitchen_transitions(
    create_kitchen_random(dataset, "kitchen/random-v0", **options), progress=False
)
model = GaussianWorldModel(layout, action_dim=9, variance_floor=2e-3)
history = fit_world_model(
    model,
    [data, random],
    action_spec=Bounded(-1.0, 1.0, (9,)),
    steps=1500,
    eval_every=500,
    progress=False,
)
print("rows:", len(data), "of demonstrations,", len(random), "random")
print("validation NLL:", [round(x, 2) for x in history["validation_nll"].tolist()])

# %%
# The held-out demonstrations check the scores. In each of their states the simulator
# tries 16 actions. An object is influenced if two of them bring it to places more than
# 2 mm (or mrad) apart. This is the ground truth.

score_buffer(offline_buffer(held_out), CAI(model), lookahead=0, progress=False)
states = torch.cat([held_out["sim", "qpos"], held_out["sim", "qvel"]], -1)
truth = true_influence(KitchenEnv, states, num_actions=16, progress=False).influenced

THRESHOLD = 0.3
for name in ("microwave", "kettle"):
    i = layout.names.index(name)
    score = held_out["caiac", "score"][:, i]
    print(
        f"{name}: influenced in {truth[:, i].float().mean():.0%} of the rows, "
        f"score above {THRESHOLD} in {(score > THRESHOLD).float().mean():.0%}; ROC-AUC "
        f"{roc_auc(score, truth[:, i]):.3f}"
    )
rest = [i for i, name in enumerate(layout.names) if not truth[:, i].any()]
print(
    f"highest score of the {len(rest)} other objects:",
    round(held_out["caiac", "score"][:, rest].max().item(), 3),
)

# %%
# Scores along a microwave demonstration: the hand approaches, grasps the handle, and
# opens the microwave.

shown = held_out["episode"] == 0
figure = plot_influence(
    held_out["caiac", "score"][shown].numpy(),
    layout.names,
    ground_truth=truth[shown].numpy(),
    threshold=THRESHOLD,
    exclude=["robot"],
    step_seconds=0.08,
    title="influence along a microwave demonstration",
)
figure

# %%
# Why scores look ahead
# ---------------------
# While the hand approaches, nothing is influenced. By the scores of these rows alone,
# the microwave could be swapped for that of a kettle demonstration, with its goal. Such
# a window teaches the agent to go to the microwave if the microwave has to stay closed.
# But an object that the robot is *about* to move is the reason for its actions. With
# ``lookahead=100`` the score of a row is the highest one of the rest of its
# demonstration, so this object is kept. The cabinet, which the robot never touches, may
# still be swapped. ``CAIACTransform(..., lookahead=100)`` does the same without new
# scores.

WINDOW = 10
objects = ("microwave", "kettle", "slide_cabinet")
for lookahead in (0, 100):
    score_buffer(
        offline_buffer(data),
        CAI(model),
        lookahead=lookahead,
        overwrite=True,
        progress=False,
    )
    print(f"lookahead={lookahead}, share of rows in which an object may be swapped")
    for name, task in (("microwave", MICROWAVE), ("kettle", KETTLE)):
        score = data["caiac", "score"][data["task"] == task]
        share = (score <= THRESHOLD).float().mean(0)
        shares = [f"{o} {share[layout.names.index(o)]:.0%}" for o in objects]
        print(f"  {name} demonstrations:", ", ".join(shares))

# %%
# Counterfactual windows
# ----------------------
# Latent motor plans learn from windows of ten steps. ``WindowGoal`` gives each window a
# later state of its demonstration as goal. ``CAIACTransform`` then makes half of the
# windows counterfactual: objects that are uninfluenced throughout the window are
# swapped for those of other windows, as whole windows and with their goals.


def windows(counterfactual: bool) -> TensorDictReplayBuffer:
    """Returns a replay buffer of windows, with or without counterfactuals."""
    goals = WindowGoal(layout, window=WINDOW)
    rb = offline_buffer(
        data,
        batch_size=64 * WINDOW,
        sampler=SliceSampler(slice_len=WINDOW, traj_key="episode", cache_values=True),
        sample_unit=goals,
    )
    rb.append_transform(goals)
    if counterfactual:
        rb.append_transform(
            CAIACTransform(layout, threshold=THRESHOLD, swap_prob=0.5, window=WINDOW)
        )
    return rb


# %%
# What matters is the cabinet in the microwave's windows:

column = layout.columns["slide_cabinet"][0]
for name, counterfactual in (("as recorded", False), ("with counterfactuals", True)):
    rb = windows(counterfactual)
    batch = torch.cat([rb.sample() for _ in range(10)])
    mine = batch[batch["task"] == MICROWAVE]
    closed = (mine["observation"][:, column] < 0.2).float().mean()
    print(f"{name}: cabinet closed in {closed:.0%} of the microwave's windows")

# %%
# A counterfactual window next to its recording, if OpenGL is available:

batch = windows(counterfactual=True).sample()
rows = batch[(batch["task"] == MICROWAVE) & batch["caiac", "swapped"].any(-1)]
rows = rows[rows["observation"][:, column] < 0.2]
made = rows["observation"][0]
# The robot is never swapped: its joints identify the recorded row.
recorded = data["observation"]
recorded = recorded[(recorded[:, :9] - made[:9]).abs().sum(-1).argmin()]
kitchen = KitchenEnv(render_mode="rgb_array")
try:
    frames = kitchen.render_states(torch.stack([recorded, made]).numpy())
    figure = plot_frames(frames, ["recorded", "counterfactual"])
except RenderingUnavailable as error:
    figure = None
    print("no frames:", error)
kitchen.close()
figure

# %%
# Latent motor plans
# ------------------
# An encoder compresses a window into a plan, a decoder maps a plan to actions, and a
# prior learns which plan leads from a state towards a goal. The policy draws a plan
# from the prior every ten steps.

STEPS = 1000


def train(counterfactual: bool) -> LMPModel:
    """Trains latent motor plans for a short time."""
    torch.manual_seed(0)
    model = LMPModel(observation_dim=30, goal_dim=21, action_dim=9, window=WINDOW)
    model.fit_statistics(data, goals=layout.achieved_goal(data, next=True))
    loss_module = LMPLoss(model, kl_weight=0.1, reconstruction_weight=2.0)
    optimizer = torch.optim.Adam(model.parameters(), lr=2e-3)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    rb = windows(counterfactual)
    torch.set_flush_denormal(True)  # denormal numbers are slow on a CPU
    for step in range(1, STEPS + 1):
        losses = loss_module(rb.sample().reshape(-1, WINDOW))
        loss = losses["loss_reconstruction"] + losses["loss_kl"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        scheduler.step()
        if step % 250 == 0:
            print(f"  step {step}: loss {loss.item():.3f}")
    torch.set_flush_denormal(False)
    return model.eval()


models = {}
for name, counterfactual in (("without", False), ("with", True)):
    print(name, "counterfactuals")
    models[name] = train(counterfactual)

# %%
# Evaluation
# ----------
# All episodes start with everything closed and differ in the noise of the simulator. An
# episode ends with success when *all* objects are where the goal requires, and
# without success after 280 steps.

EPISODES = 5
strips, titles = [], []
for name, lmp in models.items():
    actor = LMPActor(lmp)
    for task in ("kettle", "microwave"):
        env = make_kitchen_env(task)
        env.append_transform(actor.make_tensordict_primer())
        env.set_seed(0)
        torch.manual_seed(0)
        with torch.no_grad():
            played = [env.rollout(280, actor)["next"] for _ in range(EPISODES)]
        env.close()
        last = torch.stack([episode[-1] for episode in played])
        wrong = {
            t: int(count)
            for t, count in zip(KITCHEN_TASKS, last["wrong_tasks"].sum(0), strict=True)
            if count
        }
        print(
            f"{name} counterfactuals, {task}: success in {int(last['success'].sum())} "
            f"of {EPISODES} episodes; other tasks done: {wrong or 'none'}"
        )
        if task == "microwave":
            steps = [0, 15, 30, 45]
            steps = [min(step, len(played[0]) - 1) for step in steps]
            strips.append(played[0]["observation"][steps])
            titles += [f"{name}, step {step + 1}" for step in steps]
folder.cleanup()

# %%
# The first microwave episode, without and with counterfactuals:

kitchen = KitchenEnv(render_mode="rgb_array")
try:
    frames = kitchen.render_states(torch.cat(strips).numpy())
    figure = plot_frames(frames, titles, columns=4)
except RenderingUnavailable as error:
    figure = None
    print("no frames:", error)
kitchen.close()
figure

# %%
# A few episodes of one short training are an illustration, not a measurement: with
# another seed a task may fail. ``make demo`` has more demonstrations, twice the
# gradient steps with twice the windows, two seeds, and 20 episodes per task.
