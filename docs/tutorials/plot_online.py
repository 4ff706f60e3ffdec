"""
Collecting while training
=========================

A robot that goes on collecting can learn from its own episodes, and swap what it did
not influence in them. Here, a policy is cloned from 30 demonstrations. Then it plays,
and what succeeds goes into the replay buffer, which scores each transition as it is
written.
"""

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import (
    Binary,
    Bounded,
    Composite,
    LazyTensorStorage,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import EnvBase
from torchrl.modules import AdditiveGaussianModule

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.data import select_successful
from torchrl_caiac.influence import MotionInfluence, ScoreOnWrite
from torchrl_caiac.modules import GoalConditionedActor, GoalFeatures
from torchrl_caiac.transforms import TransformKeys

torch.set_num_threads(1)

# %%
# The environment
# ---------------
# A suction gripper brings a mug, and then a box, to their goals. It picks up the next
# thing within 8 cm, and lets go of it within 5 cm of its goal. An action moves it by up
# to 6 cm along each axis. Many tables are played at once.


class Tables(EnvBase):
    """Tables with a hand, a mug and a box."""

    def __init__(self, tables: int) -> None:
        super().__init__(batch_size=[tables])
        self.observation_spec = Composite(
            observation=Unbounded((tables, 6)),
            desired_goal=Unbounded((tables, 4)),
            shape=(tables,),
        )
        self.action_spec = Bounded(-1.0, 1.0, (tables, 2))
        self.reward_spec = Unbounded((tables, 1))
        flag = Binary(1, (tables, 1), dtype=torch.bool)
        self.done_spec = Composite(
            done=flag, terminated=flag, truncated=flag, shape=(tables,)
        )

    def _reset(self, tensordict: TensorDictBase | None) -> TensorDict:
        new = {
            key: torch.rand(*self.batch_size, width)
            for key, width in (("observation", 6), ("desired_goal", 4))
        }
        return TensorDict(new, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        hand, things = tensordict["observation"].split([2, 4], -1)
        things, goals = things.unflatten(-1, (2, 2)), tensordict["desired_goal"]
        goals = goals.unflatten(-1, (2, 2))
        done = (things - goals).norm(dim=-1) < 0.05
        held = ((things - hand.unsqueeze(-2)).norm(dim=-1) < 0.08) & ~done
        held[:, 1] &= done[:, 0]  # the mug first
        hand = hand + 0.06 * tensordict["action"].clamp(-1, 1)
        things = torch.where(held.unsqueeze(-1), hand.unsqueeze(-2), things)
        done = ((things - goals).norm(dim=-1) < 0.05).all(-1, keepdim=True)
        after = {
            "observation": torch.cat([hand, things.flatten(-2)], -1),
            "desired_goal": tensordict["desired_goal"],
            "reward": done.float(),
            "done": done,
            "terminated": done,
            "truncated": torch.zeros_like(done),
        }
        return TensorDict(after, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed)


def demonstrate(state: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """Returns the actions of the demonstrator."""
    things, goals = state[..., 2:].unflatten(-1, (2, 2)), goal.unflatten(-1, (2, 2))
    thing = ((things - goals).norm(dim=-1) < 0.05)[..., :1].long().unsqueeze(-1)
    thing = thing.expand(*thing.shape[:-1], 2)
    place, goal = (
        things.gather(-2, thing)[..., 0, :],
        goals.gather(-2, thing)[..., 0, :],
    )
    held = (place == state[..., :2]).all(-1, keepdim=True)
    return ((torch.where(held, goal, place) - state[..., :2]) / 0.06).clamp(-1, 1)


demonstrator = TensorDictModule(
    demonstrate, in_keys=["observation", "desired_goal"], out_keys=["action"]
)

# %%
# Collecting
# ----------
# TorchRL's collector plays with some noise, and numbers the trajectories. Those that
# succeed are kept, up to their success.

KEYS = TransformKeys(trajectory=("collector", "traj_ids"))


def collect(policy: TensorDictModuleBase, tables: int) -> tuple[TensorDictBase, float]:
    """Returns the trajectories that succeed, and the share of tables with one."""
    noise = AdditiveGaussianModule(
        Bounded(-1.0, 1.0, (2,)), sigma_init=0.2, sigma_end=0.2, annealing_num_steps=1
    )
    collector = Collector(
        Tables(tables),
        TensorDictSequential(policy, noise),
        frames_per_batch=60 * tables,
        total_frames=60 * tables,
        set_truncated=True,
        auto_register_policy_transforms=False,  # the noise is constant
    )
    (played,) = (batch.clone() for batch in collector)
    collector.shutdown()
    done = played["next", "terminated"].any(1)
    rows = played.reshape(-1)
    if done.any():
        rows = select_successful(
            rows, ("next", "terminated"), trajectory_key=KEYS.trajectory
        )
    else:
        rows = rows[:0]
    return rows, done.float().mean().item()


# %%
# Training
# --------
# The buffer scores what is written to it: what moves by more than 1 mm is influenced.
# A score is tied to the state that it was computed from, so that a row that is
# overwritten never keeps an old one.

layout = EntityLayout(
    {"hand": [0, 1], "mug": [2, 3], "box": [4, 5]},
    goal={"mug": [0, 1], "box": [2, 3]},
    achieved={"mug": [2, 3], "box": [4, 5]},
    fixed=["hand"],
)
FIRST, LATER, ROUNDS = 2000, 1000, 3


def learn(counterfactual: bool) -> list[float]:
    """Returns the success in each round."""
    torch.manual_seed(0)
    rb = TensorDictReplayBuffer(storage=LazyTensorStorage(20_000), batch_size=256)
    rb.append_transform(
        ScoreOnWrite(
            MotionInfluence(layout, 1e-3), lookahead=0, trajectory_key=KEYS.trajectory
        )
    )
    if counterfactual:
        rb.append_transform(
            CAIACTransform(
                layout, counterfactual_ratio=0.8, lookahead="next", keys=KEYS
            )
        )
    rows, _ = collect(demonstrator, 30)
    rb.extend(rows)
    features = GoalFeatures(layout, reference="hand")
    features.fit_statistics(rows)
    actor = GoalConditionedActor(features, 2)
    success = []
    for number in range(ROUNDS + 1):
        steps = LATER if number else FIRST
        optimizer = torch.optim.AdamW(actor.parameters(), lr=1e-3, weight_decay=0.1)
        scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        for _ in range(steps):
            batch = rb.sample()
            action = actor(
                observation=batch["observation"], desired_goal=batch["desired_goal"]
            )
            loss = (action - batch["action"]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            scheduler.step()
        rows, share = collect(actor, 100)
        if len(rows):
            rb.extend(rows)
        success.append(share)
        print(f"  round {number}: success {share:.0%}, {len(rb)} rows in the buffer")
    return success


# %%
# The demonstrations are the same. The success is that of the tables just played, with
# the noise of collecting.

curves = {}
for name, counterfactual in (("as recorded", False), ("with counterfactuals", True)):
    print(name)
    curves[name] = learn(counterfactual)

figure, ax = plt.subplots(figsize=(6, 3))
for name, success in curves.items():
    ax.plot(success, "o-", label=name)
ax.set(xlabel="round", ylabel="success", ylim=(0, 1), xticks=range(ROUNDS + 1))
ax.legend()
figure.tight_layout()

# %%
# Without counterfactuals hardly any table is done, so that there is next to nothing to
# learn from. One seed is an illustration, not a measurement.
#
# With a world model, use ``ScoreOnWrite(CAI(model))``. The model was fitted before, so
# that its scores are guesses in states unlike those that it knows. Fit it again from
# time to time, and call ``score_buffer(rb, CAI(model), overwrite=True)``.
# :doc:`/how_to/augment` has the other ways to treat rows without scores, and
# :doc:`plot_past_one_machine` collects in processes of their own.
