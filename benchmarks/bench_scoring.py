"""Scoring against a plain implementation, the network alone, and float64.

Run with ``pytest benchmarks/bench_scoring.py`` (``make bench``). Both shapes have 64
actions: Fetch-Push with two cubes (34 columns and 4 actions, 3 x 256, 11 predicted
columns of 3 entities) and the kitchen (30 and 9, 5 x 256, all columns of 10 entities).
The speed of the fast mode depends on how many states are near the threshold, so the
states are real: a few episodes of the scripted experts and of random actions, which the
models are fitted to first (about a minute for each). ``outputs/benchmarks`` keeps them,
for the next run and for machines without MuJoCo.

The reference is a direct implementation of eq. 3, with all ``[B, K, K, d]`` tensors in
memory, in float32 and for 256 states at once. In parts of 32 states, which stay in the
cache, it is up to twice as fast: ``reference_of_32_states_per_s``. "Network" is the
plain forward pass of the same rows of states and actions, in such small parts and with
the fastest float32 kernel on this machine.
"""

from __future__ import annotations

import copy
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, ReplayBuffer, TensorStorage

from benchmarks.bench_lmp import kitchen_layout
from benchmarks.bench_sampling import FETCH
from benchmarks.ratios import seconds
from torchrl_caiac._kernels import onednn_has_float32
from torchrl_caiac.data import load_minari, mix_trajectories
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.fit import fit_world_model
from torchrl_caiac.influence import CAI, causal_action_influence, score_buffer
from torchrl_caiac.modules import linear_kernel
from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel
from torchrl_caiac.objectives.entity_dynamics import gaussian_nll

STATES = {"cpu": 1024, "cuda": 65_536}
REFERENCE = 256  # states at once
SMALL = {"cpu": 32, "cuda": 1024}


@dataclass
class Shape:
    """A fitted model, states of its data, and how the experiments use the scores."""

    model: GaussianWorldModel
    states: torch.Tensor
    threshold: float
    smoothing: int

    def some(self, count: int, device: torch.device) -> TensorDict:
        """Returns states spread over all, repeated if there are too few."""
        order = torch.linspace(0, len(self.states) - 1, min(count, len(self.states)))
        rows = order.long().repeat(math.ceil(count / len(order)))[:count]
        states = TensorDict({"observation": self.states[rows]}, [count])
        return states.to(device)


def fetch_model() -> GaussianWorldModel:
    """Fetch-Push with two cubes, positions predicted."""
    predict = {
        name: FETCH.columns[name][:n]
        for name, n in {"gripper": 5, "cube0": 3, "cube1": 3}.items()
    }
    return GaussianWorldModel(FETCH, 4, (256,) * 3, predict)


def kitchen_model() -> GaussianWorldModel:
    """The kitchen, everything predicted."""
    return GaussianWorldModel(kitchen_layout(), 9, (256,) * 5, variance_floor=2e-3)


KEPT = Path("outputs/benchmarks")
ACTIONS = {size: Bounded(-1.0, 1.0, (size,)) for size in (4, 9)}
MODELS = pytest.mark.parametrize("make", [fetch_model, kitchen_model])


@cache
def fitted(name: str) -> Shape:
    """Returns a model and its states, fitted at the first call on this machine."""
    file = KEPT / f"{name}.pt"
    if not file.exists():
        shape = _fit(name)
        KEPT.mkdir(parents=True, exist_ok=True)
        torch.save({"model": shape.model.state_dict(), "states": shape.states}, file)
        return shape
    kept = torch.load(file, weights_only=True)
    is_fetch = name == "Fetch-Push"
    model = fetch_model() if is_fetch else kitchen_model()
    model.load_state_dict(kept["model"])
    return Shape(model, kept["states"], *((0.05, 3) if is_fetch else (0.2, 1)))


def _fit(name: str) -> Shape:
    """Collects a few episodes and fits the model to them."""
    from torchrl_caiac.envs import (  # needs MuJoCo
        create_fetch_push_expert,
        create_fetch_push_random,
        create_kitchen_play,
        create_kitchen_random,
        kitchen_transitions,
    )

    torch.manual_seed(0)
    with TemporaryDirectory() as folder:
        options: dict[str, Any] = {"root": folder, "workers": 1, "progress": False}
        if name == "Fetch-Push":
            parts = [
                load_minari(dataset, f"{folder}/{i}", progress=False)
                for i, dataset in enumerate(
                    (
                        create_fetch_push_expert(episodes=30, **options),
                        create_fetch_push_random(episodes=70, **options),
                    )
                )
            ]
            data, model = mix_trajectories(parts), fetch_model()
            fit_world_model(
                model, data, action_spec=ACTIONS[4], steps=2000, progress=False
            )
            return Shape(model, data["observation"].clone(), 0.05, 3)
        dataset, _ = create_kitchen_play(episodes=2, **options)
        random = create_kitchen_random(dataset, ratio=1.0, **options)
        data, more = (kitchen_transitions(d, progress=False) for d in (dataset, random))
        model = kitchen_model()
        fit_world_model(
            model,
            [data, more],
            action_spec=ACTIONS[9],
            lr=8e-4,
            steps=2000,
            progress=False,
        )
        return Shape(model, data["observation"].clone(), 0.2, 1)


def divergences(loc: torch.Tensor, var: torch.Tensor) -> torch.Tensor:
    """Computes eq. 3 of Gaussians ``[B, K, d]`` directly."""
    log_k = math.log(loc.shape[1])
    loc_i, loc_k = loc[:, :, None], loc[:, None]
    var_i, var_k = var[:, :, None], var[:, None]
    kl = (torch.log(var_k / var_i) + (var_i + (loc_i - loc_k) ** 2) / var_k - 1) / 2
    upper = log_k - torch.logsumexp(-kl.sum(-1), -1)
    both = var_i + var_k
    product = -torch.log(2 * math.pi * both) / 2 - (loc_i - loc_k) ** 2 / (2 * both)
    entropy = torch.log(2 * math.pi * math.e * var).sum(-1) / 2
    lower = log_k - entropy - torch.logsumexp(product.sum(-1), -1)
    return (upper.clamp_min(0) + lower.clamp_min(0)).mean(-1).div(2).clamp_max(log_k)


@torch.no_grad()
def network(
    model: GaussianWorldModel,
    actions: torch.Tensor,
    states: TensorDict,
    at_once: int,
    *,
    score: bool,
) -> None:
    """The plain forward pass, and with ``score`` the reference."""
    for part in states.split(at_once):
        rows = part[:, None].expand(len(part), len(actions)).clone()
        rows["action"] = actions.expand(len(part), -1, -1)
        out = model(rows)
        loc, var = out["prediction", "loc"], out["prediction", "var"]
        for columns in model.predicted.values() if score else ():
            divergences(loc[..., columns], var[..., columns])


@pytest.mark.parametrize("name", ["Fetch-Push", "kitchen"])
def bench_estimator(
    benchmark: Any, name: str, device: torch.device, judge: Callable[..., None]
) -> None:
    """Both modes of CAI as a whole, network and divergences."""
    shape = fitted(name)
    model = copy.deepcopy(shape.model).to(device).eval()
    rows = STATES[device.type]
    td = shape.some(rows, device)
    exact = CAI(model, compile=True)
    fast = CAI(model, compile=True, mode="fast", threshold=shape.threshold)
    begin = time.perf_counter()
    exact(td[:2])
    benchmark.extra_info["s_compiling"] = round(time.perf_counter() - begin, 1)
    fast.prepare(shape.some(2048, device), rows, smoothing=shape.smoothing)
    few = td[:4]
    loc, var = model.for_actions(exact.actions)(model.layout.read(few))
    written = [divergences(loc[..., c], var[..., c]) for c in model.predicted.values()]
    torch.testing.assert_close(
        torch.stack(written, -1), exact(few), atol=1e-5, rtol=1e-4
    )
    plain = partial(network, model, exact.actions, td)
    small = SMALL[device.type]

    def forward(kernel: Literal["plain", "onednn"]) -> None:
        with linear_kernel(kernel):
            plain(small, score=False)

    kernels = ("plain", "onednn") if onednn_has_float32() else ("plain",)
    spent = seconds(
        {
            "exact": lambda: exact(td),
            "fast": lambda: fast(td),
            **{f"network, {kernel}": partial(forward, kernel) for kernel in kernels},
            "reference": lambda: plain(REFERENCE, score=True),
            f"reference_of_{small}": lambda: plain(small, score=True),
        },
        rounds=5,
        warmup=1,
    )
    spent["network"] = min(spent[f"network, {kernel}"] for kernel in kernels)
    for what, took in spent.items():
        benchmark.extra_info[f"{what}_states_per_s"] = round(rows / took)
    for what, of, least in (
        ("exact", "reference", 5),
        ("exact", "network", 0.9),
        ("fast", "reference", 12),
    ):
        judge(f"{name}, {what} / {of}, rate", spent[of] / spent[what], at_least=least)

    double = CAI(copy.deepcopy(model).double())
    double.actions = double.actions.double()
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(len(shape.states), generator=generator)[:2048]
    sample = TensorDict({"observation": shape.states[chosen]}, [len(chosen)]).to(device)
    truth = double(sample.apply(torch.Tensor.double))
    error = (exact(sample) - truth).abs()
    error = torch.minimum(error / 1e-5, error / (1e-4 * truth))
    judge(f"{name}, exact, error / allowed error", error.max().item(), at_most=1)
    below = truth <= shape.threshold
    agree = ((fast(sample) <= shape.threshold) == below).double().mean().item()
    judge(f"{name}, fast, masks as by float64", agree, at_least=0.999)
    benchmark.pedantic(exact, args=(td,), rounds=3)


@pytest.mark.parametrize("mode", ["exact", "fast"])
@pytest.mark.parametrize("name", ["Fetch-Push", "kitchen"])
def bench_threads(
    benchmark: Any,
    name: str,
    mode: Literal["exact", "fast"],
    judge: Callable[..., None],
) -> None:
    """``score_buffer`` on the CPU: one thread, and one for each of up to four cores."""
    shape, rows = fitted(name), 16_384
    states = shape.some(rows, torch.device("cpu"))
    states["next"] = states.clone()
    states["episode"] = torch.arange(rows) // 100
    rb = ReplayBuffer(storage=TensorStorage(states))
    estimator = CAI(
        shape.model.eval(), compile=True, mode=mode, threshold=shape.threshold
    )

    def score(threads: int) -> None:
        torch.set_num_threads(threads)
        score_buffer(
            rb,
            estimator,
            done_key=None,
            overwrite=True,
            check=False,
            progress=False,
        )

    cores = min(4, len(os.sched_getaffinity(0)))
    calls = {n: partial(score, n) for n in (1, cores)}
    spent = seconds(calls, rounds=3, warmup=1)
    judge(
        f"{name}, {mode}, {cores} threads / 1, rate",
        spent[1] / spent[cores],
        at_least=0.75 * cores,
    )
    benchmark.pedantic(calls[cores], rounds=1)


@MODELS
@pytest.mark.parametrize("compile", [True, False], ids=["kernel", "stepwise"])
def bench_divergences(
    benchmark: Any,
    make: Callable[[], GaussianWorldModel],
    compile: bool,
    device: torch.device,
) -> None:
    """Equation 3 alone, for all entities of given Gaussians."""
    rows = STATES[device.type] // 16
    model = make()
    loc = torch.randn(rows, 64, model.predict_dim, device=device)
    var = torch.rand(rows, 64, model.predict_dim, device=device) + 0.1

    def score() -> None:
        for where in model.predicted.values():
            causal_action_influence(loc[..., where], var[..., where], compile=compile)
        if device.type == "cuda":
            torch.cuda.synchronize()

    benchmark.pedantic(score, rounds=20, warmup_rounds=2)


_PEAK = """
import json, sys
import torch
from tensordict import TensorDict
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence import CAI
from torchrl_caiac.modules import GaussianWorldModel

torch.set_num_threads(1)

def score(rows, entities, actions, hidden, **options):
    layout = EntityLayout({f"e{i}": [2 * i, 2 * i + 1] for i in range(entities)})
    model = GaussianWorldModel(layout, 2, (hidden,))
    model.fit_statistics(torch.ones(1, model.predict_dim))
    model.set_action_bounds(-1.0, 1.0)
    td = TensorDict({"observation": torch.zeros(rows, 2 * entities)}, [rows])
    CAI(model, actions, **options)(td)

def peak():
    with open("/proc/self/status") as file:
        return next(int(x.split()[1]) for x in file if x.startswith("VmHWM")) / 1024

score(2, 2, 2, 4)
before = peak()
score(*json.loads(sys.argv[1]), **json.loads(sys.argv[2]))
print(peak() - before)
"""


@pytest.mark.parametrize(
    ("what", "sizes", "options"),
    [
        ("2M states", (2_000_000, 2, 2, 4), {}),
        ("2M states, fast", (2_000_000, 2, 17, 4), {"mode": "fast", "threshold": 0.1}),
        ("300 entities, kernel", (64, 300, 64, 8), {"compile": True}),
        ("6,000 actions", (2, 1, 6000, 8), {"compile": False}),
        ("6,000 actions, kernel", (2, 1, 6000, 8), {"compile": True}),
    ],
)
def bench_memory(
    benchmark: Any,
    what: str,
    sizes: tuple[int, ...],
    options: dict[str, Any],
    judge: Callable[..., None],
) -> None:
    """The peak of a process, in MiB, above one that has scored two states."""
    command = [sys.executable, "-W", "ignore", "-c", _PEAK]
    command += [json.dumps(sizes), json.dumps(options)]

    def run() -> float:
        out = subprocess.run(command, capture_output=True, text=True, check=True)
        rows, entities = sizes[:2]
        data = 4 * rows * 3 * entities / 2**20  # the states and the scores
        return float(out.stdout) - data

    judge(
        f"{what}, MiB above model, data and scores",
        benchmark.pedantic(run, rounds=1),
        at_most=512,
    )


def bench_growth(benchmark: Any, judge: Callable[..., None], tmp_path: Path) -> None:
    """Rows of a memmap, with a small model: the cost per row must not grow."""
    layout = EntityLayout({"arm": range(2), "cup": range(2, 4)})
    model = GaussianWorldModel(layout, 2, (16,))
    model.fit_statistics(torch.ones(1, model.predict_dim))
    model.set_action_bounds(-1.0, 1.0)
    estimator = CAI(model, 8, compile=True)
    micros = {}
    for rows in (10_000, 100_000, 1_000_000):
        episode = torch.arange(rows) // 100
        state = torch.randn(rows, 4)
        ends = torch.arange(rows) % 100 == 99
        data = TensorDict(
            {
                "observation": state,
                "episode": episode,
                "next": {"observation": state.roll(-1, 0), "done": ends[:, None]},
            },
            [rows],
        ).memmap(tmp_path / str(rows))
        rb = ReplayBuffer(storage=TensorStorage(data))

        def run(rb: ReplayBuffer = rb) -> None:
            score_buffer(
                rb,
                estimator,
                smoothing=3,
                overwrite=True,
                check=False,
                progress=False,
            )

        rounds = 1 if rows == 1_000_000 else 3
        if rows == 1_000_000:
            benchmark.pedantic(run, rounds=1)
        micros[rows] = 1e6 * seconds({"": run}, rounds=rounds, warmup=1)[""] / rows
    benchmark.extra_info["us_per_row"] = {k: round(v, 2) for k, v in micros.items()}
    for rows in (100_000, 1_000_000):
        judge(
            f"small model, time a row, {rows:,} rows / 10,000",
            micros[rows] / micros[10_000],
            at_most=1.2,
        )


@MODELS
def bench_gradient_step(
    benchmark: Any, make: Callable[[], GaussianWorldModel], device: torch.device
) -> None:
    """One step of fitting on 500 rows."""
    model = make().to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=8e-4)
    state = torch.randn(500, model.state_dim, device=device)
    action = torch.randn(500, model.action_dim, device=device)
    target = torch.randn(500, model.predict_dim, device=device)

    def step() -> None:
        optimizer.zero_grad()
        loc, var = model.forward_tensors(state, action)
        gaussian_nll(loc, var, target).mean().backward()
        optimizer.step()
        if device.type == "cuda":
            torch.cuda.synchronize()

    benchmark.pedantic(step, rounds=50, warmup_rounds=5)
