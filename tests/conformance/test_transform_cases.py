"""The cases that TorchRL tests every transform in."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.envs import (
    Compose,
    GymEnv,
    ParallelEnv,
    SerialEnv,
    Transform,
    TransformedEnv,
)

from tests.conformance.world import Known, layout_of, transitions
from torchrl_caiac import CAIACTransform, CoDATransform
from torchrl_caiac.influence import ScoreOnWrite, score_buffer
from torchrl_caiac.transforms import HindsightGoal, WindowGoal

LAYOUT = layout_of("flat")


def reward(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    return -(achieved - desired).abs().sum(-1)


MAKERS: dict[str, Callable[[], Any]] = {
    "caiac": lambda: CAIACTransform(LAYOUT, 0.5, reward_fn=reward),
    "coda": lambda: CoDATransform(LAYOUT, 0.5, reward_fn=reward),
    "hindsight": lambda: HindsightGoal(LAYOUT, reward, future=0.0, random=1.0),
    "window": lambda: WindowGoal(LAYOUT, 1),
    "score on write": lambda: ScoreOnWrite(
        Known(LAYOUT, graphs=False), lookahead=0, key="written"
    ),
}
every = pytest.mark.parametrize("name", MAKERS)


def rows() -> TensorDict:
    rb = TensorDictReplayBuffer(storage=LazyTensorStorage(60))
    rb.extend(transitions("flat", [0, 1, 2, 3]))
    options: dict[str, Any] = {"lookahead": 0, "progress": False, "check": False}
    score_buffer(rb, Known(LAYOUT, graphs=False), **options)
    score_buffer(rb, Known(LAYOUT, graphs=True), key=("coda", "graph"), **options)
    return rb.storage[:].clone().exclude("index")


def buffer(transform: Transform, **kwargs: Any) -> ReplayBuffer:
    unit = {"sample_unit": transform} if isinstance(transform, WindowGoal) else {}
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(60), batch_size=16, **unit, **kwargs
    )
    rb.append_transform(transform)
    rb.extend(rows())
    return rb


def made(name: str, out: TensorDictBase) -> bool:
    """Whether a transform left its mark."""
    keys = {
        "caiac": ("caiac", "swapped"),
        "coda": ("caiac", "swapped"),
        "hindsight": ("hindsight", "relabeled"),
        "window": "desired_goal",
        "score on write": "written",
    }
    leaf = out.get(keys[name], None)
    if name == "window" and leaf is not None:
        return bool((leaf % 100 < 99).all())
    return leaf is not None


@every
def test_alone(name: str) -> None:
    transform, td = MAKERS[name](), rows()
    before = td.clone()
    if name == "window":
        with pytest.raises(RuntimeError, match="sample_unit"):
            transform(td)
    else:
        out = transform(td)
        assert made(name, out) == (name != "score on write")
    assert (td == before).all()


@every
def test_composed(name: str) -> None:
    if name == "window":
        return test_in_a_buffer(name)
    compose = Compose(MAKERS[name](), Compose())
    assert made(name, compose(rows())) == (name != "score on write")


@every
def test_in_a_buffer(name: str) -> None:
    rb = buffer(MAKERS[name]())
    assert made(name, rb.sample())
    for batch in (rb.sample(), rb.sample()):
        assert batch.batch_size == (16,)


@every
def test_inverse(name: str) -> None:
    transform, td = MAKERS[name](), transitions("flat", [0])
    before = td.clone()
    out = transform.inv(td)
    assert (td == before).all()
    assert made(name, out) == (name == "score on write")
    added = set(out.keys(True, True)) - set(td.keys(True, True))
    assert added == set(transform.out_keys_inv)


def env() -> GymEnv:
    return GymEnv("Pendulum-v1")


@every
@pytest.mark.parametrize("kind", ["single", "serial", "parallel", "inside"])
def test_environments_are_refused(name: str, kind: str) -> None:
    transform = MAKERS[name]()
    make: dict[str, Callable[[], Any]] = {
        "single": lambda: TransformedEnv(env(), transform),
        "serial": lambda: TransformedEnv(SerialEnv(2, env), transform),
        "parallel": lambda: TransformedEnv(ParallelEnv(1, env), transform),
        "inside": lambda: SerialEnv(2, lambda: TransformedEnv(env(), MAKERS[name]())),
    }
    # TorchRL compares the specs of inner environments with their keys first.
    errors = (RuntimeError, KeyError) if kind == "inside" else RuntimeError
    made_env = None
    try:
        with pytest.raises(errors, match=r"appended to a ReplayBuffer|unaccounted for"):
            made_env = make[kind]()
            made_env.rollout(2)
    finally:
        if made_env is not None and not made_env.is_closed:
            made_env.close()


@every
def test_copies(name: str) -> None:
    transform = MAKERS[name]()
    for copy in (transform.clone(), pickle.loads(pickle.dumps(transform))):
        assert type(copy) is type(transform)
        assert made(name, buffer(copy).sample())
    state = transform.state_dict()
    transform.load_state_dict(state)


@every
def test_from_a_factory(name: str) -> None:
    if name == "window":
        return test_in_a_buffer(name)
    rb = ReplayBuffer(
        storage=LazyTensorStorage(60),
        batch_size=16,
        transform_factory=MAKERS[name],
        delayed_init=True,
    )
    rb.extend(rows())
    assert made(name, rb.sample())
