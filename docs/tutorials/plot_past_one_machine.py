"""
Past one machine
================

Scoring a large dataset, and collecting while a learner trains, are work for several
processes. This tutorial uses two on this machine, and says what changes with more
machines: the calls stay the same. :doc:`/scaling` has the details, and what was
measured.
"""

import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from torch import multiprocessing
from torchrl.data import LazyMemmapStorage

from torchrl_caiac import CAIACTransform
from torchrl_caiac.caiac_buffer import CAIACReplayBuffer
from torchrl_caiac.data import (
    episode_transitions,
    from_arrays,
    load_transitions,
    offline_buffer,
)
from torchrl_caiac.envs import FetchPushCubes, FetchPushExpert, fetch_push_layout
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.influence import (
    CAI,
    ScoreOnWrite,
    default_world_model,
    score_buffer,
    suggest_thresholds,
)

torch.manual_seed(0)
torch.set_num_threads(1)
folder = tempfile.TemporaryDirectory()
root = Path(folder.name)

# %%
# Data
# ----
# A scripted expert plays Fetch-Push with noise on its actions. The episodes are written
# to a folder, and a world model is fitted to them.

layout = fetch_push_layout(2)
LENGTH = 100


def play(seed: int) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Returns the states and actions of an episode."""
    env, expert = FetchPushCubes(2), FetchPushExpert(2)
    noise = torch.randn(LENGTH, 4, generator=torch.Generator().manual_seed(seed))
    observation, _ = env.reset(seed=seed)
    states, actions = [observation], []
    for t in range(LENGTH):
        actions.append((expert(observation) + 0.5 * noise[t].numpy()).clip(-1, 1))
        observation = env.step(actions[-1])[0]
        states.append(observation)
    env.close()
    stacked = {
        key: torch.tensor([state[key].tolist() for state in states])
        for key in observation
    }
    return stacked, torch.tensor([action.tolist() for action in actions])


episodes = [play(seed) for seed in range(60)]
states = {key: [s[key] for s, _ in episodes] for key in episodes[0][0]}
actions = [a for _, a in episodes]
bounds = ([-1.0] * 4, [1.0] * 4)
for name in ("together", "alone"):
    data = from_arrays(
        states, actions, root / name, action_bounds=bounds, progress=False
    )
model = default_world_model(layout, action_dim=4)
fit_world_model(model, data, steps=2000, progress=False)
torch.save({"config": model.config, "weights": model.state_dict()}, root / "model.pt")
print(len(data), "transitions")

# %%
# Scoring in two processes
# ------------------------
# Each process makes the same call, with its number. It claims parts of the data by
# creating files, so that the folder is all that processes share: on a cluster, it lies
# in a file system that all machines see. The script below could be a task of a job
# array.

(root / "score.py").write_text("""
import sys, torch
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.influence import CAI, score_buffer
from torchrl_caiac.modules import GaussianWorldModel

root, i = sys.argv[1], int(sys.argv[2])
torch.set_num_threads(1)
saved = torch.load(f"{root}/model.pt", weights_only=True)
model = GaussianWorldModel.from_config(saved["config"])
model.load_state_dict(saved["weights"])
rb = offline_buffer(load_transitions(f"{root}/together"))
score_buffer(rb, CAI(model), shard=(i, 2), progress=False)
""")
command = [sys.executable, str(root / "score.py"), folder.name]
processes = [subprocess.Popen([*command, str(i)]) for i in range(2)]
print("exit codes:", [process.wait() for process in processes])

# %%
# The scores are those of one process, to the bit:

rb = offline_buffer(load_transitions(root / "alone"))
score_buffer(rb, CAI(model), progress=False)
alone = rb.storage[:]["caiac", "score"]
together = load_transitions(root / "together")["caiac", "score"]
print("equal:", torch.equal(alone, together))

# %%
# A process that is killed loses nothing but the part that it was at, which another one
# takes over. With Ray, ``score_buffer_ray(folder, estimator, num_workers=8)`` starts
# the processes, and ``caiac score DATA --workers 8`` does without code.
#
# Collecting while a learner trains
# ---------------------------------
# A shared buffer is written by some processes and sampled by others. The estimator is a
# transform of the buffer, so that each transition is scored where it is written. The
# buffer gets functions that make its parts, since it makes them where it lives.

thresholds = suggest_thresholds(rb, layout).thresholds
print({name: round(value, 3) for name, value in thresholds.items()})
shared = CAIACReplayBuffer(
    partial(LazyMemmapStorage, 10_000),
    augmentation=partial(CAIACTransform, layout, thresholds),
    transforms=[partial(ScoreOnWrite, CAI(model))],
    batch_size=256,
    shared=True,
)


def collect(worker: int) -> None:
    """Plays ten episodes and writes them to the buffer."""
    torch.set_num_threads(1)
    for i in range(10):
        number = 1000 * (worker + 1) + i
        rows = episode_transitions(*play(number), where=f"episode {number}")
        shared.extend(rows.set("episode", torch.full((LENGTH,), number)))


collect(0)  # the first rows, which also make the storage
fork = multiprocessing.get_context("fork")
workers = [fork.Process(target=collect, args=(i,)) for i in (1, 2)]
for worker in workers:
    worker.start()
rows, swaps = [], []
while any(worker.is_alive() for worker in workers):
    batch = shared.sample()  # a learner takes its step here
    rows.append(len(shared))
    swaps.append(batch["caiac", "swapped"].sum(0))
for worker in workers:
    worker.join()
print("exit codes:", [worker.exitcode for worker in workers])
print(f"{rows[0]} rows at the first sample, {len(shared)} at the end")
share = torch.stack(swaps).float().mean(0) / 256
print("swapped:", {n: f"{s:.0%}" for n, s in zip(layout.names, share, strict=True)})

# %%
# Each sample is drawn from what has been written so far:

figure, ax = plt.subplots(figsize=(7, 2.6))
ax.plot(rows)
ax.set(xlabel="sample", ylabel="rows in the buffer", ylim=(0, None))
figure.tight_layout()
folder.cleanup()

# %%
# The learner on another machine
# ------------------------------
# With one more argument the same buffer lives in an actor of Ray. Batches are sampled,
# swapped and relabelled there, and ``prefetch=1`` draws the next one while the learner
# takes its step:
#
# .. code-block:: python
#
#     rb = CAIACReplayBuffer(
#         "data/rows",  # a folder with scores
#         augmentation=partial(CAIACTransform, layout, thresholds),
#         batch_size=256,
#         prefetch=1,
#         seed=0,
#         service_backend="ray",
#     )
#
# With the same seed, its batches are those of a buffer in this process, to the bit.
