"""Digests of estimators: what changes the scores changes the digest."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer

from tests.influence.scoring import LAYOUT, episodes, ready
from torchrl_caiac.influence import (
    CAI,
    AttentionInfluence,
    DistanceInfluence,
    MotionInfluence,
    ResidualInfluence,
    score_buffer,
)
from torchrl_caiac.influence.estimator_digest import DigestCache, estimator_digest
from torchrl_caiac.modules import GaussianWorldModel, TransformerWorldModel


class Plain:
    layout = LAYOUT

    def __init__(self, scale):
        self.scale = scale

    def __call__(self, td):
        return td["observation"].abs() * torch.as_tensor(self.scale)


class Slotted:
    __slots__ = ("scale",)

    def __init__(self, scale):
        self.scale = scale


class Module(nn.Module):
    def __init__(self, scale):
        super().__init__()
        self.scale = scale


@dataclass
class Wrapped:
    model: nn.Module

    def score(self, td):
        return self.model(td["observation"])


@dataclass
class Ensemble:
    models: object


class Committee(nn.Module):
    """Has settings in its repr, and models that are not registered."""

    def __init__(self, models):
        super().__init__()
        self.models = models

    def extra_repr(self):
        return "committee"


class Described(Plain):
    def __repr__(self):
        return "Described()"


def linear(scale):
    model = nn.Linear(3, 3)
    nn.init.constant_(model.weight, scale)
    nn.init.zeros_(model.bias)
    return model


def long_tensor(scale):
    """Its repr leaves out the middle."""
    values = torch.zeros(10_000)
    values[5_000] = scale
    return values


def closure(scale):
    return lambda td: td["observation"] * scale


MAKERS = {
    "number": Plain,
    "tensor": lambda scale: Plain(torch.full((3,), scale)),
    "array": lambda scale: Plain(np.full(10_000, scale)),
    "list": lambda scale: Plain([1, (scale, "a")]),
    "dict": lambda scale: Plain({"a": {"b": scale}}),
    "set": lambda scale: Plain({"a", f"b{scale}"}),
    "object": lambda scale: Plain(Plain(scale)),
    "slots": Slotted,
    "module in an object": lambda scale: Plain(linear(scale)),
    "module in a dataclass": lambda scale: Wrapped(linear(scale)),
    "attribute of a module": Module,
    "attribute of a module inside": lambda scale: nn.Sequential(Module(scale)),
    "weights": linear,
    "closure": closure,
    "default": lambda scale: lambda td, factor=scale: td["observation"] * factor,
    "method": lambda scale: Wrapped(linear(scale)).score,
    "list in a dataclass": lambda scale: Ensemble([linear(scale)]),
    "dict in a dataclass": lambda scale: Ensemble({"a": (linear(scale),)}),
    "tensor in a dataclass": lambda scale: Ensemble([long_tensor(scale)]),
    "array in a dataclass": lambda scale: Ensemble([long_tensor(scale).numpy()]),
    "set in a dataclass": lambda scale: Ensemble({long_tensor(scale)}),
    "tensordict": lambda scale: Ensemble(TensorDict({"a": long_tensor(scale)}, [])),
    "object in a dataclass": lambda scale: Ensemble(Ensemble([linear(scale)])),
    "dataclass in an object": lambda scale: Plain(Ensemble([linear(scale)])),
    "function in a dataclass": lambda scale: Ensemble(closure(linear(scale))),
    "list in a module": lambda scale: Committee([linear(scale)]),
    "list in a module inside": lambda scale: nn.Sequential(Committee([linear(scale)])),
    "array of objects": lambda scale: Plain(np.array([1, long_tensor(scale)], object)),
    "partial": lambda scale: functools.partial(torch.mul, other=linear(scale)),
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_what_changes_the_scores_changes_the_digest(make):
    assert estimator_digest(make(1.0)) == estimator_digest(make(1.0))
    assert estimator_digest(make(1.0)) != estimator_digest(make(2.0))


def test_the_code_of_a_function_changes_the_digest():
    def double(td):
        return td["observation"] * 2

    first = double

    def double(td):
        return td["observation"] * 3

    assert first.__qualname__ == double.__qualname__
    assert estimator_digest(first) != estimator_digest(double)


MODEL = linear(1.0)


def read_global(td):
    return MODEL(td["observation"])


def read_nested(td):
    return [MODEL(x) for x in td["observation"]]


def read_in_lambda(td):
    return (lambda x: MODEL(x))(td["observation"])


def call_another(td):
    return read_global(td) if len(td) else call_another(td)


@pytest.mark.parametrize(
    "function", [read_global, read_nested, read_in_lambda, call_another]
)
@pytest.mark.parametrize(
    "value",
    [
        linear(2.0),
        torch.ones(3),
        np.ones(3),
        lambda x: x,
        [linear(2.0)],
        2.0,
    ],
    ids=["module", "tensor", "array", "function", "list", "number"],
)
def test_globals_of_a_function_change_the_digest(function, value, monkeypatch):
    before = estimator_digest(function)
    assert estimator_digest(function) == before
    monkeypatch.setitem(globals(), "MODEL", value)
    assert estimator_digest(function) != before
    monkeypatch.setitem(globals(), "MODEL", linear(1.0))
    assert estimator_digest(function) == before


def test_weights_of_a_global_model_change_the_digest(monkeypatch):
    monkeypatch.setitem(globals(), "MODEL", linear(1.0))
    before = estimator_digest(read_global)
    nn.init.constant_(MODEL.bias, 1.0)
    assert estimator_digest(read_global) != before


def test_equal_values_have_one_digest_whether_or_not_they_are_one_object():
    part = Plain([1.0])
    shared, apart = Plain([part, part]), Plain([part, Plain([1.0])])
    assert estimator_digest(shared) == estimator_digest(apart)
    part = linear(1.0)
    shared, apart = Ensemble([part, part]), Ensemble([part, linear(1.0)])
    assert estimator_digest(shared) == estimator_digest(apart)


def add(model):
    model.weight.add_(1.0)


def train(model):
    model.weight.grad = torch.ones_like(model.weight)
    torch.optim.SGD(model.parameters(), 0.1).step()


def load(model):
    model.load_state_dict(linear(5.0).state_dict())


def replace(model):
    model.weight = nn.Parameter(torch.full((3, 3), 4.0))


@pytest.mark.parametrize("change", [add, train, load, replace])
@pytest.mark.parametrize("wrap", [lambda m: m, lambda m: Committee([m]), Ensemble])
def test_a_cache_has_the_digest_of_the_estimator(wrap, change):
    model, cache = linear(1.0), DigestCache()
    estimator = wrap(model)
    before = cache.digest(estimator)
    assert before == cache.digest(estimator) == estimator_digest(estimator)
    with torch.no_grad():
        change(model)
    assert cache.digest(estimator) == estimator_digest(estimator) != before


def test_a_cache_notices_weights_that_take_the_place_of_others():
    model, cache = linear(1.0), DigestCache()
    for scale in range(50):  # freed memory is used again
        model.weight = nn.Parameter(torch.full((3, 3), float(scale)))
        assert cache.digest(model) == estimator_digest(model)


def test_a_cache_reads_what_other_processes_may_write():
    model, cache = linear(1.0).share_memory(), DigestCache()
    cache.digest(model)
    model.weight.data.fill_(7.0)
    assert cache.digest(model) == estimator_digest(model)


def test_a_cache_notices_other_settings():
    model, cache = Module(1.0), DigestCache()
    cache.digest(model)
    model.scale = 2.0
    assert cache.digest(model) == estimator_digest(model)


def test_buffers_that_are_not_saved_change_the_digest():
    first, second = linear(1.0), linear(1.0)
    for i, model in enumerate((first, second)):
        model.register_buffer("offset", torch.tensor(float(i)), persistent=False)
    assert estimator_digest(first) != estimator_digest(second)


def test_an_estimator_may_name_its_settings():
    assert estimator_digest(Described(1.0)) == estimator_digest(Described(2.0))
    settings = Described([1, {"a": 1.0}]), Described([{"b": "c"}])
    assert estimator_digest(settings[0]) == estimator_digest(settings[1])
    models = Described(linear(1.0)), Described(linear(2.0))
    assert estimator_digest(models[0]) != estimator_digest(models[1])


def test_an_object_that_is_part_of_itself_has_a_digest():
    estimators = [Plain(scale) for scale in (1.0, 1.0, 2.0)]
    for estimator in estimators:
        estimator.me = [estimator]
    first, same, other = map(estimator_digest, estimators)
    assert first == same != other


def test_a_model_that_was_trained_further_has_other_scores():
    rows: TensorDict = episodes([5, 7])
    rb = ReplayBuffer(storage=LazyTensorStorage(20))
    rb.extend(rows)
    score_buffer(rb, Plain(1.0), progress=False)
    with pytest.raises(ValueError, match="have other settings: estimator was"):
        score_buffer(rb, Plain(3.0), progress=False)


def test_functions_of_described_objects_change_the_digest():
    class Described:
        def __init__(self, make):
            self.make = make

        def __repr__(self):
            return "Described"

    one, other = (lambda: 1), (lambda: 2)
    assert estimator_digest(Described(one)) != estimator_digest(Described(other))
    assert estimator_digest(Described(one)) == estimator_digest(Described(one))


@pytest.mark.parametrize(
    "make",
    [
        lambda data: MotionInfluence(LAYOUT).fit(data),
        lambda data: ResidualInfluence(LAYOUT).fit(data, steps=2, progress=False),
        lambda data: DistanceInfluence(
            LAYOUT, {name: [own[0]] for name, own in LAYOUT.columns.items()}, "arm"
        ),
        lambda data: CAI(ready(GaussianWorldModel(LAYOUT, 2, (8,)))),
        lambda data: AttentionInfluence(
            ready(TransformerWorldModel(LAYOUT, 2, 1, 1, 4))
        ),
    ],
    ids=["motion", "residual", "distance", "cai", "attention"],
)
def test_scoring_does_not_change_the_digest(make):
    """So that what was added later is scored by the same estimator."""
    rows = episodes([30, 30])
    rb = ReplayBuffer(storage=LazyTensorStorage(200), batch_size=8)
    rb.extend(rows)
    estimator = make(rb)
    before = estimator_digest(estimator)
    score_buffer(rb, estimator, progress=False)
    assert estimator_digest(estimator) == before
    rows["episode"] += 10
    rb.extend(rows)
    score_buffer(rb, estimator, progress=False)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (functools.partial(torch.clamp, max=1), functools.partial(torch.clamp, max=2)),
        (torch.relu, torch.tanh),
    ],
)
def test_partial_and_builtin_functions_of_described_objects(one, other):
    class Described:
        def __init__(self, function):
            self.function = function

        def __repr__(self):
            return "Described()"

    assert estimator_digest(Described(one)) == estimator_digest(Described(one))
    assert estimator_digest(Described(one)) != estimator_digest(Described(other))
