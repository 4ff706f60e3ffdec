"""Buffers that are made in an actor of Ray return what those made here return."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    RayReplayBuffer,
    ReplayBuffer,
    SliceSampler,
    TensorDictReplayBuffer,
    TensorStorage,
)
from torchrl.data.replay_buffers import PrioritizedSampler

from torchrl_caiac import CAIACTransform, EntityLayout, check_dataset
from torchrl_caiac.caiac_buffer import CAIACReplayBuffer
from torchrl_caiac.data import load_transitions, offline_buffer
from torchrl_caiac.data.from_replay_buffer import from_replay_buffer
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.influence import score_buffer
from torchrl_caiac.influence.thresholds import suggest_thresholds
from torchrl_caiac.modules import (
    GaussianWorldModel,
    GoalConditionedActor,
    GoalConditionedCritic,
    GoalFeatures,
    LMPModel,
)
from torchrl_caiac.noise import sample_rows
from torchrl_caiac.objectives import GoalConditionedTD3Loss, LMPLoss
from torchrl_caiac.trajectories import trajectory_index
from torchrl_caiac.transforms import HindsightGoal, WindowGoal

LAYOUT = EntityLayout(
    {"arm": [0], "cup": [1], "box": [2]},
    goal={"cup": [0], "box": [1]},
    achieved={"cup": [1], "box": [2]},
    fixed=["arm"],
)
REMOTE = {"num_cpus": 0.1, "num_gpus": 0}
WINDOW = 4


def reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    return -((achieved - desired).norm(dim=-1) > 0.05).float()


class Distance:
    """Scores an entity by how near the arm is."""

    layout = LAYOUT

    def __call__(self, td: TensorDictBase) -> torch.Tensor:
        state = td["observation"]
        return (1 - (state - state[..., :1]).abs()).clamp_min(0)


def transitions(episodes: int = 12, steps: int = 10, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    rows = episodes * steps
    state = torch.rand(episodes, steps + 1, 3, generator=generator)
    done = torch.zeros(episodes, steps, 1, dtype=torch.bool)
    done[:, -1] = True
    return TensorDict(
        {
            "observation": state[:, :-1].flatten(0, 1),
            "action": torch.rand(rows, 2, generator=generator) * 2 - 1,
            "desired_goal": torch.rand(rows, 2, generator=generator),
            "episode": torch.arange(episodes).repeat_interleave(steps),
            "next": {
                "observation": state[:, 1:].flatten(0, 1),
                "reward": -torch.ones(rows, 1),
                "done": done.flatten(0, 1),
                "terminated": torch.zeros(rows, 1, dtype=torch.bool),
            },
        },
        [rows],
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Transitions with scores."""
    path = tmp_path_factory.mktemp("data") / "rows"
    transitions().memmap(path)
    score_buffer(offline_buffer(load_transitions(path)), Distance())
    return path


@pytest.fixture
def remote(cluster: None) -> Iterator[Callable[..., RayReplayBuffer]]:
    """Makes buffers in actors, which end with the test."""
    made = []

    def make(*args: Any, **kwargs: Any) -> RayReplayBuffer:
        rb = RayReplayBuffer(
            *args, replay_buffer_cls=CAIACReplayBuffer, remote_config=REMOTE, **kwargs
        )
        made.append(rb)
        return rb

    yield make
    for rb in made:
        rb.close()


@pytest.fixture(scope="module")
def actor(folder: Path, cluster: None) -> Iterator[RayReplayBuffer]:
    """An actor that several tests sample, made by the option of TorchRL's buffers."""
    rb = CAIACReplayBuffer(
        folder,
        **hindsight(seed=1),
        service_backend="ray",
        service_backend_options={"remote_config": REMOTE},
    )
    yield rb
    rb.close()


AUGMENTATION = partial(CAIACTransform, LAYOUT, threshold=0.6)
HINDSIGHT = partial(HindsightGoal, LAYOUT, reward)
WINDOWS = partial(WindowGoal, LAYOUT, WINDOW)


def slices() -> SliceSampler:
    return SliceSampler(slice_len=WINDOW, traj_key="episode", cache_values=True)


def hindsight(**kwargs: Any) -> dict[str, Any]:
    return dict(augmentation=AUGMENTATION, goals=HINDSIGHT, batch_size=32, **kwargs)


def windows(**kwargs: Any) -> dict[str, Any]:
    return dict(
        augmentation=partial(AUGMENTATION, threshold=0.9, window=WINDOW),
        goals=WINDOWS,
        sampler=slices,
        batch_size=8 * WINDOW,
        **kwargs,
    )


def assert_same(one: TensorDictBase, other: TensorDictBase) -> None:
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    for key in one.keys(True, True):
        assert torch.equal(one[key], other[key]), key


def test_is_the_buffer_that_is_made_by_hand(folder: Path) -> None:
    generator = torch.Generator().manual_seed(3)
    goals = HINDSIGHT(generator=generator)
    by_hand = offline_buffer(
        load_transitions(folder), 32, sample_unit=goals, generator=generator
    )
    by_hand.append_transform(AUGMENTATION(generator=generator))
    by_hand.append_transform(goals)
    rb = CAIACReplayBuffer(folder, seed=3, **hindsight())
    for _ in range(3):
        assert_same(rb.sample(), by_hand.sample())


@pytest.mark.parametrize(
    ("kind", "donors"),
    [(hindsight, None), (hindsight, "folder"), (windows, "self")],
    ids=["hindsight", "hindsight-folder", "windows-self"],
)
def test_batches_of_an_actor_are_those_of_a_buffer_here(
    kind: Callable[..., dict[str, Any]],
    donors: str | None,
    folder: Path,
    remote: Callable[..., RayReplayBuffer],
) -> None:
    settings = kind(donors=folder if donors == "folder" else donors, seed=1)
    here, there = CAIACReplayBuffer(folder, **settings), remote(folder, **settings)
    assert len(there) == len(here) == 120
    assert there.batch_size == here.batch_size
    seen = [(here.sample(), there.sample()) for _ in range(3)]
    for one, other in seen:
        assert_same(one, other)
    assert seen[0][0]["caiac", "swapped"].any()
    assert not torch.equal(seen[0][0]["index"], seen[1][0]["index"])
    if kind is windows:
        goals = torch.cat([batch["desired_goal"] for batch, _ in seen])
        assert (goals.view(-1, WINDOW, 2).diff(dim=1) == 0).all()
    else:
        assert seen[0][0]["hindsight", "relabeled"].any()


def test_an_actor_is_extended_and_scores(
    remote: Callable[..., RayReplayBuffer], tmp_path: Path
) -> None:
    rows = transitions()
    settings = hindsight(seed=2)
    batches = []
    for make in (CAIACReplayBuffer, remote):
        storage = partial(LazyMemmapStorage, 200)
        rb = make(storage, **settings)
        rb.extend(rows[:100])
        assert len(rb) == 100
        rb.extend(rows[100:])
        (rb.client() if make is remote else rb).score(Distance(), batch_size=50)
        batches.append(rb.sample())
    assert_same(*batches)


def test_an_actor_takes_transforms_and_priorities(
    folder: Path, remote: Callable[..., RayReplayBuffer]
) -> None:
    sampler = partial(PrioritizedSampler, 120, alpha=1.0, beta=1.0)
    rb = remote(folder, **hindsight(sampler=sampler, seed=0))
    priorities = torch.full((120,), 1e-6)
    priorities[17] = 1e6
    rb.update_priority(torch.arange(120), priorities)
    rb.append_transform(partial(_with_leaf, "mark"))
    batch = rb.sample()
    assert (batch["index"] == 17).all()
    assert batch["mark"].all()


def _with_leaf(name: str, td: TensorDictBase) -> TensorDictBase:
    return td.set(name, torch.ones(td.shape))


def test_td3_trains_from_an_actor(folder: Path, actor: RayReplayBuffer) -> None:
    rb, here = actor, CAIACReplayBuffer(folder, **hindsight(seed=1))
    assert_same(here.sample(), rb.sample())
    torch.manual_seed(0)
    features = GoalFeatures(LAYOUT)
    features.fit_statistics(rb.sample())
    loss = GoalConditionedTD3Loss(
        GoalConditionedActor(features, 2, (32,)),
        [GoalConditionedCritic(features, 2, (32,)) for _ in range(2)],
    )
    loss.make_value_estimator(gamma=0.97)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    values = []
    for _ in range(60):
        out = loss(rb.sample())
        optimizer.zero_grad()
        (out["loss_qvalue"] + out["loss_actor"]).backward()
        optimizer.step()
        values.append(float(out["loss_qvalue"].detach()))
    assert sum(values[-10:]) < sum(values[:10]) / 2


def test_latent_motor_plans_train_from_an_actor(
    folder: Path, remote: Callable[..., RayReplayBuffer]
) -> None:
    """On augmented windows of it, as from a buffer here."""
    settings = windows(donors="self", seed=4)
    trained = []
    for make in (CAIACReplayBuffer, remote):
        rb = make(folder, **settings)
        torch.manual_seed(0)
        model = LMPModel(3, 2, 2, WINDOW, plan_dim=4, hidden_size=32)
        model.fit_statistics(rb.sample().reshape(-1, WINDOW))
        loss = LMPLoss(model)
        optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
        values = []
        for _ in range(40):
            batch = rb.sample().reshape(-1, WINDOW)
            assert batch["caiac", "swapped"].any()
            out = loss(batch)
            total = out["loss_reconstruction"] + out["loss_kl"]
            optimizer.zero_grad()
            total.backward()
            optimizer.step()
            values.append(float(total.detach()))
        assert sum(values[-5:]) < 0.85 * sum(values[:5])
        trained.append(values)
    assert trained[0] == trained[1]


USES: dict[str, Callable[[Any], Any]] = {
    "score_buffer": lambda rb: score_buffer(rb, Distance()),
    "donors": lambda rb: CAIACTransform(LAYOUT, 0.5, donors=rb),
    "check_dataset": lambda rb: check_dataset(rb, LAYOUT),
    "trajectory_index": trajectory_index,
    "fit_world_model": lambda rb: fit_world_model(
        GaussianWorldModel(LAYOUT, 2, (8,)), rb, steps=1
    ),
    "from_replay_buffer": lambda rb: from_replay_buffer(rb, "unused"),
    "suggest_thresholds": lambda rb: suggest_thresholds(rb, LAYOUT),
    "sample_rows": lambda rb: sample_rows(rb, 3),
}


@pytest.mark.parametrize("client", [False, True], ids=["buffer", "client"])
def test_buffers_of_other_processes_are_refused(
    client: bool, actor: RayReplayBuffer
) -> None:
    rb: Any = actor.client() if client else actor
    for name, use in USES.items():
        with pytest.raises(TypeError, match=r"in another process.*load_transitions"):
            use(rb)
            pytest.fail(name)


def test_goals_that_were_sent_in_two_parts_say_what_to_do(
    folder: Path, cluster: None
) -> None:
    goals = HINDSIGHT()
    rb = RayReplayBuffer(
        replay_buffer_cls=TensorDictReplayBuffer,
        storage=partial(LazyTensorStorage, 200),
        sample_unit=goals,
        transform=goals,
        batch_size=4,
        remote_config=REMOTE,
    )
    try:
        rb.extend(transitions())
        with pytest.raises(RuntimeError, match="CAIACReplayBuffer"):
            rb.sample()
    finally:
        rb.close()


def test_wrong_arguments_are_named(folder: Path) -> None:
    with pytest.raises(ValueError, match="no augmentation that draws them"):
        CAIACReplayBuffer(folder, donors="self")
    with pytest.raises(TypeError, match=r"goals must be a function.*HindsightGoal"):
        CAIACReplayBuffer(folder, goals=HINDSIGHT())  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="augmentation must be a function"):
        CAIACReplayBuffer(folder, augmentation=AUGMENTATION())
    with pytest.raises(TypeError, match="goals made a CAIACTransform"):
        CAIACReplayBuffer(folder, goals=AUGMENTATION)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"data made a ReplayBuffer, not"):
        CAIACReplayBuffer(ReplayBuffer)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="donors must be a folder"):
        storage = TensorStorage(load_transitions(folder))
        CAIACReplayBuffer(folder, augmentation=AUGMENTATION, donors=storage)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="sample_unit"):
        CAIACReplayBuffer(folder, sample_unit=HINDSIGHT())
