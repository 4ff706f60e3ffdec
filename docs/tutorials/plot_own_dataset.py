"""
Your own dataset
================

A recording rarely looks as a library expects it. Here a robot has tidied tables, and
its log has the *x* of all things before their *y*, a clock, the place of one thing
relative to another, and flags where episodes *begin*. We bring it into TorchRL's
format, describe the entities, check the data, look at what would be swapped, and clone
the demonstrator, with and without counterfactuals.

To use your own recording, replace the first section.
"""

import html
import tempfile

import matplotlib.pyplot as plt
import numpy as np
import torch
from torchrl.objectives import BCLoss

from torchrl_caiac import CAIACTransform, EntityLayout, check_dataset
from torchrl_caiac.data import from_arrays, offline_buffer
from torchrl_caiac.influence import MotionInfluence, score_buffer, suggest_thresholds
from torchrl_caiac.inspection import inspect_dataset
from torchrl_caiac.modules import GoalConditionedActor, GoalFeatures
from torchrl_caiac.report import write_report
from torchrl_caiac.scored import write_scored

torch.manual_seed(0)
torch.set_num_threads(1)
folder = tempfile.TemporaryDirectory()

# %%
# The recording
# -------------
# A suction gripper brings a mug, and then a box, to goals that differ from table to
# table. It picks up the next thing within 8 cm, and lets go of it at its goal. An
# action moves it by up to 6 cm along each axis. Places are in metres.

RANDOM = np.random.default_rng(0)


def is_done(places: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Returns which things are within 5 cm of their goals, ``[B, 2]``."""
    return np.linalg.norm(places[:, 1:] - goals, axis=-1) < 0.05


def step(places: np.ndarray, goals: np.ndarray, action: np.ndarray) -> np.ndarray:
    """Moves the places ``[B, 3, 2]`` of hand, mug and box by actions ``[B, 2]``."""
    hand, things = places[:, :1], places[:, 1:]
    done = is_done(places, goals)
    held = (np.linalg.norm(things - hand, axis=-1) < 0.08) & ~done
    held[:, 1] &= done[:, 0]  # the mug first
    hand = hand + 0.06 * action[:, None].clip(-1, 1)
    return np.concatenate([hand, np.where(held[..., None], hand, things)], 1)


def demonstrator(places: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Returns the actions ``[B, 2]`` that tidy up, with some noise."""
    rows = np.arange(len(places))
    thing = is_done(places, goals)[:, 0].astype(int)
    hand, place, goal = places[:, 0], places[rows, 1 + thing], goals[rows, thing]
    is_held = (place == hand).all(1, keepdims=True)
    action = (np.where(is_held, goal, place) - hand) / 0.06
    return (action + RANDOM.normal(0, 0.2, action.shape)).clip(-1, 1)


# %%
# The log of 100 demonstrations, each until both things are in place: flat arrays, in
# which the episodes follow each other. The sensors have a noise of 0.2 mm.

goals, places = RANDOM.uniform(0, 1, (100, 2, 2)), RANDOM.uniform(0, 1, (100, 3, 2))
frames, actions, done = [], [], []
for _ in range(100):
    frames.append(places)
    done.append(is_done(places, goals).all(1))
    actions.append(demonstrator(places, goals))
    places = step(places, goals, actions[-1])
time = np.tile(np.arange(100), (100, 1))  # [episode, step], as all below
kept = np.stack(done, 1).cumsum(1) <= 1
xy = np.stack(frames, 1)[kept]
xy += RANDOM.normal(0, 2e-4, xy.shape)

clock, relative = 0.1 * time[kept], xy[:, 1] - xy[:, 0]
sensors = np.column_stack([clock, xy[..., 0], xy[..., 1], relative])
command, first = np.stack(actions, 1)[kept], time[kept] == 0
targets = np.repeat(goals[:, None], 100, 1)[kept].reshape(-1, 4)
print("sensors", sensors.shape, "command", command.shape, "targets", targets.shape)

# %%
# Transitions
# -----------
# :func:`~torchrl_caiac.data.from_arrays` wants to know where episodes *end*: one row
# before the next one begins. The log has no state after the last action of an episode,
# so that this transition is left out.

ends = {"timeouts": np.roll(first, -1), "action_bounds": ([-1] * 2, [1] * 2)}
data = from_arrays(sensors, command, f"{folder.name}/all", **ends, progress=False)
print(f"{len(sensors)} rows of the log, {len(data)} transitions")

# %%
# :func:`~torchrl_caiac.inspection.inspect_dataset` finds columns that move together,
# and when in an episode they do. Which of these groups is the mug, you have to know.

print(inspect_dataset(data))

# %%
# Errors that raise no exception
# ------------------------------
# The last two columns describe the mug and the hand at once: after a swap they would
# still be about the mug before. :func:`~torchrl_caiac.check_dataset` finds such
# columns.

names = {"robot": [1, 4], "mug": [2, 5], "box": [3, 6]}
print(check_dataset(data, EntityLayout(names, fixed=["robot"])))

# %%
# So we leave them out, and the clock. A policy can compute differences itself, from
# what it gets after the swap. The layout also says which columns of the goals belong to
# which thing: goals then follow every swap.

data = from_arrays(
    sensors[:, 1:7],
    command,
    f"{folder.name}/scored/data",
    achieved_goals=sensors[:, [2, 5, 3, 6]],
    desired_goals=targets,
    **ends,
    progress=False,
)
places_of = {"robot": [0, 3], "mug": [1, 4], "box": [2, 5]}
layout = EntityLayout(
    places_of,
    positions=places_of,
    goal={"mug": [0, 1], "box": [2, 3]},
    achieved={"mug": [1, 4], "box": [2, 5]},
    fixed=["robot"],
)
print(check_dataset(data, layout))

# %%
# Behaviour cloning needs no rewards, so the missing rewards do not matter.
#
# Scores
# ------
# The things rest unless the robot moves them: what moves is influenced, and
# :class:`~torchrl_caiac.influence.MotionInfluence` needs no model. ``fit`` finds out
# how large a change is noise.

rb = offline_buffer(data, batch_size=256)
score_buffer(rb, MotionInfluence(layout).fit(rb), lookahead=0, progress=False)
found = suggest_thresholds(rb, layout)
print(found)

# %%
# Look before you train
# ---------------------
# :func:`~torchrl_caiac.report.write_report` writes one page about what would be
# swapped. Do the coloured steps agree with what you know about the recording? Are the
# examples possible? :doc:`/report` explains each part.

scored = write_scored(
    f"{folder.name}/scored", layout, found, estimator="motion", settings={}
)
report = write_report(scored, f"{folder.name}/report.html", title="Tidying tables")


class Frame:
    """Shows the report within this page."""

    def _repr_html_(self) -> str:
        page = html.escape(report.read_text(encoding="utf-8"))
        return f'<iframe srcdoc="{page}" title="Report" class="report"></iframe>'


Frame()

# %%
# Training
# --------
# A usual loop. Cloning repeats what it has seen, so the thing that the demonstrator
# goes to next has to stay: ``lookahead="next"``.


def clone(augmentation: CAIACTransform | None) -> GoalConditionedActor:
    """Returns a policy that was trained with a transform, or without."""
    torch.manual_seed(0)
    rb = offline_buffer(data, batch_size=256)
    if augmentation is not None:
        rb.append_transform(augmentation)
    features = GoalFeatures(layout, reference="robot")
    features.fit_statistics(rb.sample())
    actor = GoalConditionedActor(features, 2)
    loss_module = BCLoss(actor, loss_function="l2")
    optimizer = torch.optim.AdamW(loss_module.parameters(), lr=1e-3, weight_decay=0.1)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 2500)
    for _ in range(2500):
        loss = loss_module(rb.sample())["loss_bc"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        scheduler.step()
    return actor


swap = CAIACTransform(
    layout, found.thresholds, counterfactual_ratio=0.8, lookahead="next"
)
policies = {"as recorded": clone(None), "with counterfactuals": clone(swap)}

# %%
# Both policies tidy the same 200 new tables.

goals, tables = RANDOM.uniform(0, 1, (200, 2, 2)), RANDOM.uniform(0, 1, (200, 3, 2))
desired = torch.tensor(goals.reshape(200, 4), dtype=torch.float32)
figure, axes = plt.subplots(1, 2, figsize=(8, 3.2), sharey=True)
for ax, (name, policy) in zip(axes, policies.items(), strict=True):
    places, done = tables, []
    for _ in range(60):
        seen = torch.tensor(places.swapaxes(1, 2).reshape(200, 6)).float()
        with torch.no_grad():
            action = policy(observation=seen, desired_goal=desired).numpy()
        places = step(places, goals, action)
        done.append(is_done(places, goals))
    share = np.stack(done)
    ax.plot(share.mean(1), label=["mug", "box"])
    ax.plot(share.all(2).mean(1), "k", label="both")
    ax.set(title=name, xlabel="step", ylim=(0, 1))
    print(f"{name}: both in place on {share[-1].all(1).mean():.0%} of the tables")
axes[0].set_ylabel("share of tables")
axes[0].legend()
figure.tight_layout()
folder.cleanup()
