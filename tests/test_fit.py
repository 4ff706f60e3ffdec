"""Tests of fitting a world model: learning, splitting, and exact resume."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, LazyTensorStorage, ReplayBuffer, Unbounded

import torchrl_caiac._fit_rows as fit_rows
import torchrl_caiac.fit as module
from tests.killing import run_killed
from torchrl_caiac._files import whole_file
from torchrl_caiac.data.write_transitions import write_transitions
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.influence.cai import CAI
from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel
from torchrl_caiac.modules.transformer_world_model import TransformerWorldModel
from torchrl_caiac.noise import resting_noise
from torchrl_caiac.objectives.entity_dynamics import EntityDynamicsLoss

LAYOUT = EntityLayout({"arm": [0, 1], "cup": [2, 3]})


def world(rows: int = 2000, *, seed: int = 0, dtype: Any = torch.float32) -> TensorDict:
    """An arm that follows the action and moves the cup where it touches it."""
    generator = torch.Generator().manual_seed(seed)
    observation = torch.rand(rows, 4, generator=generator, dtype=dtype) * 2 - 1
    action = torch.rand(rows, 2, generator=generator, dtype=dtype) * 2 - 1
    touches = (observation[:, :1] - observation[:, 2:3]).abs() < 0.5
    change = 0.1 * torch.cat([action, action * touches], 1)
    noise = 1e-3 * torch.randn(rows, 4, generator=generator, dtype=dtype)
    return TensorDict(
        {
            "observation": observation,
            "action": action,
            "episode": torch.arange(rows) // 20,
            "next": {"observation": observation + change + noise},
        },
        [rows],
    )


def make(**kwargs: Any) -> GaussianWorldModel:
    torch.manual_seed(0)
    return GaussianWorldModel(LAYOUT, 2, kwargs.pop("hidden_sizes", (32, 32)), **kwargs)


def fit(model: GaussianWorldModel, data: Any, **kwargs: Any) -> TensorDict:
    settings = {"steps": 60, "batch_size": 32, "eval_every": 20, "progress": False}
    return fit_world_model(model, data, **{**settings, **kwargs})


def assert_equal(a: GaussianWorldModel, b: GaussianWorldModel) -> None:
    left, right = a.state_dict(), b.state_dict()
    assert left.keys() == right.keys()
    for key, value in left.items():
        if isinstance(value, torch.Tensor):
            assert value.dtype == right[key].dtype
            # The bounds of the actions are NaN until they are known.
            assert torch.equal(value.nan_to_num(7.0), right[key].nan_to_num(7.0)), key
        else:
            assert value == right[key], key


def test_learns_the_dynamics_and_where_the_cup_moves() -> None:
    data, model = world(4000), make(hidden_sizes=(64, 64), variance_floor=0.02)
    history = fit(model, data, steps=800, eval_every=200, batch_size=256, lr=3e-3)
    assert history["step"].tolist() == [200, 400, 600, 800]
    mse = history["validation_mse"][-1]
    assert mse["arm"] < 2e-5 and mse["cup"] < 6e-4  # of 0.0033 and 0.0015
    assert history["validation_nll"][-1] < history["validation_nll"][0]
    fresh = world(500, seed=1)
    own = EntityDynamicsLoss(model).entity_mse(fresh)
    assert own["arm"] < 2e-5 and own["cup"] < 6e-4
    assert not model.training
    # And the influence that follows from it is the truth: where the arm touches.
    state = fresh["observation"]
    truth = (state[:, 0] - state[:, 2]).abs() < 0.5
    arm, cup = CAI(model, num_actions=32)(fresh).unbind(-1)
    pairs = cup[truth][:, None] - cup[~truth][None]
    assert (pairs > 0).float().mean() > 0.95
    assert arm.min() > 1 and cup[~truth].median() < 0.1 < 0.5 < cup[truth].median()


def test_history_agrees_with_the_loss_on_the_held_out_rows() -> None:
    data, model = world(), make()
    history = fit(model, data, steps=40)
    rows = fit_rows.split_rows(
        data["episode"], 0.1, 10**6, torch.Generator().manual_seed(0)
    )
    held_out = data[rows[1]]
    assert len(held_out) == 200
    assert not set(held_out["episode"].tolist()) & set(
        data["episode"][rows[0]].tolist()
    )
    assert history["best"][-1]
    loss = EntityDynamicsLoss(model).eval()
    torch.testing.assert_close(
        history["validation_nll"][-1].float(), loss(held_out)["loss_nll"].detach()
    )
    mse = loss.entity_mse(held_out)
    for name in LAYOUT.names:
        torch.testing.assert_close(
            history["validation_mse", name][-1].float(), mse[name]
        )
    reference = make()
    reference.fit_statistics(data[rows[0]])
    torch.testing.assert_close(reference.target_scale, model.target_scale)


def test_best_step_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    states = []
    original = module._Fit.validate

    def validate(self: Any, *args: Any) -> None:
        original(self, *args)
        states.append(module._copy(self.model.state_dict()))

    monkeypatch.setattr(module._Fit, "validate", validate)
    model = make()
    # A rate this high makes it worse again and again.
    history = fit(model, world(400), steps=60, eval_every=5, lr=0.2)
    best = int(history["validation_nll"].argmin())
    assert best != len(states) - 1
    assert history["best"].nonzero()[-1].item() == best
    for key, value in model.state_dict().items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, states[best][key])


def test_seeded_and_independent_of_the_global_generator() -> None:
    data = world(400)
    one, two, three = make(), make(), make()
    fit(one, data)
    torch.manual_seed(123)
    fit(two, data)
    fit(three, data, seed=1)
    assert_equal(one, two)
    assert not torch.equal(one.loc_head.weight, three.loc_head.weight)


@pytest.mark.parametrize("kwargs", [{}, {"spectral_norm": True, "target": "absolute"}])
def test_interrupted_and_resumed_ends_with_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kwargs: Any
) -> None:
    data = world(400)
    reference = make(**kwargs)
    expected = fit(reference, data)
    path = tmp_path / "folder" / "fit.ckpt"
    options: dict[str, Any] = {"checkpoint": path, "checkpoint_every": 25}
    interrupted = make(**kwargs)
    forward = interrupted.forward_tensors
    calls = []

    def dies(*args: Any) -> Any:
        calls.append(1)
        if len(calls) > 44:
            raise KeyboardInterrupt
        return forward(*args)

    monkeypatch.setattr(interrupted, "forward_tensors", dies)
    with pytest.raises(KeyboardInterrupt):
        fit(interrupted, data, **options)
    assert [p.name for p in path.parent.iterdir()] == ["fit.ckpt"]

    # What a killed write leaves is removed by the next call.
    def half() -> Iterator[None]:
        with whole_file(path) as partial:
            partial.write_text("half")
            (path.parent / f".{partial.name}.stage-1f").mkdir()
            yield

    run_killed(half)
    assert len(list(path.parent.iterdir())) == 3
    torch.manual_seed(99)
    resumed = GaussianWorldModel(LAYOUT, 2, (32, 32), **kwargs)
    history = fit(resumed, data, **options)
    assert [p.name for p in path.parent.iterdir()] == ["fit.ckpt"]
    assert_equal(resumed, reference)
    assert (history == expected).all()
    # Finished: the same call does nothing, a larger number of steps continues.
    again = make(**kwargs)
    before = path.read_bytes()
    assert (fit(again, data, **options) == expected).all()
    assert_equal(again, reference)
    assert path.read_bytes() == before
    longer, straight = make(**kwargs), make(**kwargs)
    assert (
        fit(longer, data, **options, steps=80) == fit(straight, data, steps=80)
    ).all()
    assert_equal(longer, straight)
    refused = make(**kwargs)
    with pytest.raises(ValueError, match="has 80 steps, more than the requested 60"):
        fit(refused, data, **options)
    assert_equal(refused, make(**kwargs))
    assert not refused.fitted


def transformer() -> TransformerWorldModel:
    torch.manual_seed(0)
    return TransformerWorldModel(LAYOUT, 2, layers=2, heads=2, width=16)


def test_transformers_are_fitted_and_resumed(tmp_path: Path) -> None:
    data, path = world(2000), tmp_path / "fit.ckpt"
    settings: Any = {
        "steps": 300,
        "batch_size": 128,
        "lr": 3e-3,
        "eval_every": 100,
        "progress": False,
    }
    model = transformer()
    history = fit_world_model(model, data, **settings)
    mse = history["validation_mse"][-1]
    assert mse["arm"] < 3e-4 and mse["cup"] < 1e-3  # of 0.0033 and 0.0015
    loss = EntityDynamicsLoss(model).eval()
    rows = fit_rows.split_rows(
        data["episode"], 0.1, 10**6, torch.Generator().manual_seed(0)
    )
    held_out = loss(data[rows[1]])
    torch.testing.assert_close(
        history["validation_nll"][history["best"]][-1].float(),
        held_out["loss_nll"].detach(),
    )
    halfway = transformer()
    fit_world_model(halfway, data, **{**settings, "steps": 200}, checkpoint=path)
    resumed = transformer()
    again = fit_world_model(resumed, data, **settings, checkpoint=path)
    assert (again == history).all()
    for key, value in model.state_dict().items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, resumed.state_dict()[key]), key
    with pytest.raises(ValueError, match=r"settings .*model\.class: saved 'Trans"):
        fit_world_model(make(), data, **settings, checkpoint=path)


def test_checkpoints_that_are_refused(tmp_path: Path) -> None:
    data = world(400)
    path = tmp_path / "fit.ckpt"
    fit(make(), data, checkpoint=path)
    good = path.read_bytes()

    def refused(message: str, td: TensorDict = data, **kwargs: Any) -> None:
        model = kwargs.pop("model", None) or make()
        model.set_action_bounds(0.0, 1.0)
        before = module._copy(model.state_dict())
        with pytest.raises(ValueError, match=message):
            fit(model, td, checkpoint=path, **kwargs)
        for key, value in model.state_dict().items():
            if isinstance(value, torch.Tensor):
                assert torch.equal(value, before[key])

    for half in (good[: len(good) // 2], b"", b"something else"):
        path.write_bytes(half)
        refused("not a readable checkpoint.*delete it")
    damaged = bytearray(good)
    damaged[len(good) // 2] ^= 255
    path.write_bytes(damaged)
    refused("not a readable checkpoint")
    path.unlink()
    path.mkdir()
    refused("not a readable checkpoint")
    path.rmdir()
    from torchrl.checkpoint import Checkpoint

    Checkpoint(fit=torch.nn.Linear(1, 1), format="archive").save(path)
    refused("not a readable checkpoint")
    path.write_bytes(good)
    refused("other settings .batch_size: saved 32, given 16.: repeat", batch_size=16)
    refused("seed: saved 0, given 3", seed=3)
    refused(r"data_rows: saved \[400\], given \[380\]", world(380))
    refused(r"settings \(data_checksum: [^;]*\)", world(400, seed=5))
    refused(
        r"settings \(model.hidden_sizes: saved \[32, 32\], given \[16\]\)",
        model=make(hidden_sizes=(16,)),
    )
    assert path.read_bytes() == good


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_storages_and_memory_limits_make_no_difference(
    tmp_path: Path, dtype: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = world(400, dtype=dtype)
    whole, mapped, streamed = make(), make(), make()
    expected = fit(whole, data)
    fit(mapped, data.memmap(tmp_path / "data"))
    monkeypatch.setattr(fit_rows, "CHUNK", 37)
    loaded = TensorDict.load_memmap(tmp_path / "data")
    history = fit(streamed, loaded, max_memory=0)
    assert_equal(whole, mapped)
    # The statistics are merged from other chunks, hence the rounding.
    torch.testing.assert_close(
        streamed.loc_head.weight, whole.loc_head.weight, atol=1e-4, rtol=1e-4
    )
    torch.testing.assert_close(
        history["validation_nll"], expected["validation_nll"], atol=1e-3, rtol=1e-3
    )


@pytest.mark.parametrize("max_memory", [0, 2**30])
def test_several_data_sets_are_one(max_memory: int) -> None:
    data = world(400)
    first, second = data[:120].clone(), data[120:].clone()
    second["episode"] -= 6  # counts from 0 again
    one, two = make(), make()
    fit(one, data)
    fit(two, [first, second], max_memory=max_memory)
    assert_equal(one, two)


def test_nested_keys() -> None:
    flat = world(200)

    def part(x: torch.Tensor) -> dict[str, Any]:
        return {"arm": x[:, :2], "cup": {"x": x[:, 2:3], "y": x[:, 3:]}}

    td = TensorDict(
        {
            "state": part(flat["observation"]),
            "agent": {"action": flat["action"]},
            "meta": {"trajectory": flat["episode"].unsqueeze(-1)},
            "next": {"state": part(flat["next", "observation"])},
        },
        [200],
    )
    layout = EntityLayout.from_keys({"arm": ("state", "arm"), "cup": ("state", "cup")})
    torch.manual_seed(0)
    model = GaussianWorldModel(
        layout,
        2,
        (32, 32),
        widths=layout.widths(td),
        action_key=("agent", "action"),
    )
    other = make()
    history = fit(model, td, trajectory_key=("meta", "trajectory"))
    expected = fit(other, flat)
    assert (history == expected).all()


def test_statistics_that_the_model_has_are_kept() -> None:
    model = make()
    model.fit_statistics(torch.randn(10, 4) * 7)
    scale = model.target_scale.clone()
    fit(model, world(400), steps=2)
    assert torch.equal(model.target_scale, scale)


def test_an_automatic_floor_comes_from_the_data(tmp_path: Path) -> None:
    data, path = world(), tmp_path / "fit"
    halves = [data[:1000], data[1000:]]
    model = make(variance_floor="auto")
    assert not model.has_floor and model.config["variance_floor"] == "auto"
    fit(model, halves, steps=40, checkpoint=path)
    noise = resting_noise(data, LAYOUT)
    floor = [f for name in LAYOUT.names for f in noise[name].floor]
    torch.testing.assert_close(model.floor, torch.tensor(floor, dtype=torch.float64))
    assert model.floor_reasons == {name: noise[name].reason for name in LAYOUT.names}
    assert "rests" in model.floor_reasons["cup"]
    # It is part of the checkpoint, and of the state that another model loads.
    resumed = make(variance_floor="auto")
    fit(resumed, halves, steps=60, checkpoint=path)
    once = make(variance_floor="auto")
    fit(once, halves, steps=60)
    assert_equal(resumed, once)
    twin = GaussianWorldModel.from_config(once.config)
    twin.load_state_dict(once.state_dict())
    assert twin.has_floor and twin.floor_reasons == once.floor_reasons
    assert torch.equal(twin.floor, once.floor)


def test_denormals_are_flushed_in_the_block_only() -> None:
    denormal = torch.tensor([1e-310], dtype=torch.float64)
    seen = []
    with module._flushing_denormals(True):
        seen.append(bool((denormal + denormal).any()))
    with module._flushing_denormals(False):
        seen.append(bool((denormal + denormal).any()))
    assert seen[1] and bool((denormal + denormal).any())
    if torch.set_flush_denormal(True):
        assert not seen[0]
        with module._flushing_denormals(True):
            pass
        assert not bool((denormal + denormal).any())
        torch.set_flush_denormal(False)


def test_divergence_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make()
    with torch.no_grad():
        model.loc_head.bias[0] = float("nan")
    with pytest.raises(RuntimeError, match="not finite at step 20"):
        fit(model, world(200))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"steps": 0}, "steps must be an int of at least 1, got 0"),
        ({"batch_size": -1}, "batch_size"),
        ({"eval_every": 0}, "eval_every"),
        ({"checkpoint_every": 0}, "checkpoint_every"),
        ({"lr": 0.0}, "lr must be positive"),
        ({"lr": float("inf")}, "lr must be positive"),
        ({"validation_fraction": 0.0}, "validation_fraction"),
        ({"validation_fraction": 1.0}, "validation_fraction"),
    ],
)
def test_wrong_arguments_are_named(kwargs: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fit(make(), world(100), **kwargs)


def test_a_replay_buffer_is_refused() -> None:
    data = world(40)
    rb = ReplayBuffer(storage=LazyTensorStorage(60), batch_size=8)
    rb.extend(data)
    with pytest.raises(TypeError, match=r"is a ReplayBuffer.*rb\.storage\[:\]"):
        fit(make(), rb)
    torch.testing.assert_close(fit(make(), rb.storage[:]), fit(make(), data))


def test_wrong_data_are_named(tmp_path: Path) -> None:
    data = world(100)

    def refused(error: Any, message: str, td: Any) -> None:
        model = make()
        path = tmp_path / "refused.ckpt"
        with pytest.raises(error, match=message):
            fit(model, td, checkpoint=path)
        assert not model.fitted and not path.exists()

    refused(ValueError, "data are empty", data[:0])
    refused(ValueError, "data are empty", [])
    refused(ValueError, r"batch size \[10, 10\]", data.reshape(10, 10))
    refused(ValueError, "single trajectory", data[:20])
    refused(KeyError, "the trajectory key .+episode", data.exclude("episode"))
    refused(KeyError, "lack the action .+action", data.exclude("action"))
    refused(KeyError, "observation", data.exclude("observation"))
    refused(KeyError, "next", data.exclude("next"))
    other = data.clone()
    other["action"] = torch.zeros(100, 5)
    refused(ValueError, r"shape of 'action' is \[100, 5\].*\[100, 2\]", other)
    other = data.clone()
    other["episode"] = torch.zeros(100)
    refused(ValueError, "'episode' is torch.float32", other)
    for key, shown in (
        ("observation", "'observation' is nan for entity 'cup' in row 43"),
        (("next", "observation"), r"\('next', 'observation'\) is nan for entity 'cup'"),
    ):
        other = data.clone()
        other[key][43, 2] = float("nan")
        refused(ValueError, shown, other)
    other = data.clone()
    other["action"][99, 1] = -float("inf")
    refused(ValueError, "'action' is -inf in column 1 of row 199", [data, other])
    shutil.rmtree(tmp_path)


# --- the bounds of the actions -------------------------------------------------------

SPEC = Bounded(-1.0, 1.0, (2,))


def test_bounds_are_those_of_the_spec_then_of_the_folder_then_of_the_data(
    tmp_path: Path,
) -> None:
    data = world(400)
    stored = write_transitions(
        data.clone().set(("next", "done"), torch.zeros(400, 1, dtype=torch.bool)),
        tmp_path / "data",
        action_bounds=([-1.0, -1.5], [1.0, 1.5]),
    )
    for sources, spec, low, high in (
        (data, SPEC, [-1.0, -1.0], [1.0, 1.0]),
        (stored, SPEC, [-1.0, -1.0], [1.0, 1.0]),
        (stored, None, [-1.0, -1.5], [1.0, 1.5]),
        ([data, stored], None, [-1.0, -1.5], [1.0, 1.5]),
    ):
        model = make()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            fit(model, sources, action_spec=spec)
        assert model.action_low.tolist() == low and model.action_high.tolist() == high
        twin = make()
        twin.load_state_dict(model.state_dict())
        assert_equal(twin, model)
    model = make()
    with pytest.warns(UserWarning, match=r"not known: 'action' is .* \[-0\.998048, 0"):
        fit(model, data)
    assert torch.equal(model.action_low, data["action"].amin(0))
    assert torch.equal(model.action_high, data["action"].amax(0))


@pytest.mark.parametrize("scale", [90.0, 0.01])
def test_the_unit_of_the_actions_does_not_matter(scale: float) -> None:
    """Degrees and small forces give the scores of actions in [-1, 1]."""
    data, fresh = world(2000), world(200, seed=1)
    found = []
    for unit in (1.0, scale):
        own = data.clone().set("action", data["action"] * unit)
        model = make(variance_floor=0.02)
        spec = Bounded(-unit, unit, (2,))
        fit(model, own, steps=300, batch_size=128, lr=3e-3, action_spec=spec)
        found.append(CAI(model, num_actions=32)(fresh)[:, 1])
    assert 0.2 < (found[0] > 0.1).float().mean() < 0.8
    assert ((found[0] > 0.1) == (found[1] > 0.1)).float().mean() > 0.98


def test_actions_outside_of_the_bounds_are_refused() -> None:
    data = world(400)
    data["action"][123, 1] = 1.005
    message = r"'action' is 1\.005 in column 1 of row 123, expected \[-1, 1\] \(1 such"
    with pytest.raises(ValueError, match=message):
        fit(make(), data, action_spec=SPEC)
    with pytest.raises(ValueError, match="column 1 of row 523"):
        fit(make(), [world(400), data], action_spec=SPEC)
    data["action"][123, 1] = 1.001  # rounding
    fit(make(), data, action_spec=SPEC)
    with pytest.raises(TypeError, match="Bounded spec, got Unbounded"):
        fit(make(), data, action_spec=Unbounded((2,)))
    with pytest.raises(ValueError, match=r"shape \[3\].*\[2\]"):
        fit(make(), data, action_spec=Bounded(-1.0, 1.0, (3,)))


def test_data_sets_with_other_bounds_are_refused(tmp_path: Path) -> None:
    data = world(400).set(("next", "done"), torch.zeros(400, 1, dtype=torch.bool))
    one, other = (
        write_transitions(
            data, tmp_path / f"{high}", action_bounds=([-1.0] * 2, [1.0, high])
        )
        for high in (1.0, 90.0)
    )
    with pytest.raises(ValueError, match=r"dataset 1 .* x \[-1, 90\].* x \[-1, 1\]"):
        fit(make(), [one, other])
    fit(make(), [one, other], action_spec=SPEC)


@pytest.mark.parametrize(
    ("column", "columns"),
    [(torch.zeros(400), [0]), (torch.linspace(0.2, 0.29, 400), [0]), (None, [])],
)
def test_actions_that_hardly_vary_are_warned_of(
    column: torch.Tensor | None, columns: list[int]
) -> None:
    data = world(400)
    if column is not None:
        data["action"][:, 0] = column
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        fit(make(), data, action_spec=SPEC)
    texts = [str(warning.message) for warning in found]
    assert len(texts) == len(columns)
    if columns:
        assert texts[0].startswith(f"the columns {columns} of 'action' hardly vary")
    # Without a spec, a constant column is still one.
    data["action"][:, 1] = 0.5
    with pytest.warns(UserWarning, match=r"columns \[.*1\] of 'action' hardly vary"):
        fit(make(), data, check=False)


def test_checkpoints_record_the_bounds(tmp_path: Path) -> None:
    path, data = tmp_path / "fit", world(400)
    fit(make(), data, action_spec=SPEC, checkpoint=path, steps=20)
    with pytest.raises(ValueError, match="action_bounds: saved"):
        fit(make(), data, action_spec=Bounded(-2, 2, (2,)), checkpoint=path)
    resumed, straight = make(), make()
    fit(resumed, data, action_spec=SPEC, checkpoint=path)
    fit(straight, data, action_spec=SPEC)
    assert_equal(resumed, straight)
    old = resumed.state_dict()
    del old["action_low"], old["action_high"]
    with pytest.raises(ValueError, match="is of an earlier version"):
        make().load_state_dict(old)


def test_discrete_actions_are_refused() -> None:
    data = world(60)
    choice = torch.arange(60) % 2
    data["action"] = torch.nn.functional.one_hot(choice).float()
    with pytest.raises(ValueError, match=r"'action' is one-hot .* MotionInfluence"):
        fit(make(), data)
    for action in (choice, choice.unsqueeze(-1), choice.bool()):
        with pytest.raises(ValueError, match=r"'action' is torch.*MotionInfluence"):
            fit(make(), data.set("action", action))


def test_corrected_trajectories_are_other_data(tmp_path: Path) -> None:
    data, path = world(400), tmp_path / "model"
    fit(make(), data, checkpoint=path)
    data["episode"] = data["episode"].flip(0)
    with pytest.raises(ValueError, match="data_checksum"):
        fit(make(), data, checkpoint=path)


def test_a_floor_from_the_data_is_checked(caplog: pytest.LogCaptureFixture) -> None:
    """Positions of objects in other units raise the floor of an entity that moves."""
    data = world(400)
    layout = EntityLayout(
        {"arm": [0, 1], "cup": [2, 3]}, positions={"arm": [0, 1], "cup": [2, 3]}
    )
    for key in ("observation", ("next", "observation")):
        data[key][:, :2] *= 50
    model = GaussianWorldModel(layout, 2, (8,), variance_floor="auto")
    with caplog.at_level("WARNING"):
        fit(model, data)
    assert "floor_too_high" in caplog.text


def test_a_refused_fit_leaves_no_floor(tmp_path: Path) -> None:
    good, bad = world(400), world(400)
    bad["next", "observation"] *= 1000
    model, fresh = (make(variance_floor="auto") for _ in range(2))
    fit(make(variance_floor="auto"), good, checkpoint=tmp_path / "fit")
    with pytest.raises(ValueError, match="data_checksum"):
        fit(model, bad, checkpoint=tmp_path / "fit")
    assert not model.has_floor and model.floor.isnan().all()
    fit(model, good)
    fit(fresh, good)
    assert torch.equal(model.floor, fresh.floor)
