"""Fitting a world model to stored transitions."""

from __future__ import annotations

import functools
import logging
import math
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Bounded, ReplayBuffer
from tqdm.auto import tqdm

from torchrl_caiac._checks import check_int, check_local
from torchrl_caiac._fit_quality import log_quality
from torchrl_caiac._fit_ranks import Ranks
from torchrl_caiac._fit_rows import FitRows, split_rows, trajectory_numbers
from torchrl_caiac._keys import as_key, jsonable
from torchrl_caiac.check import check_before_use
from torchrl_caiac.checkpoint import TrainingCheckpoint
from torchrl_caiac.modules._action_bounds import filled_bounds, known_bounds
from torchrl_caiac.modules._variance_floor import FoundFloor
from torchrl_caiac.modules.entity_dynamics_model import EntityDynamicsModel

__all__ = ["fit_world_model"]

_LOGGER = logging.getLogger("torchrl_caiac.fit")
_EVAL_ROWS = 4_096  # rows in one forward pass in validation


def fit_world_model(
    model: EntityDynamicsModel,
    data: TensorDictBase | Sequence[TensorDictBase],
    *,
    action_spec: Bounded | None = None,
    steps: int = 100_000,
    batch_size: int = 500,
    lr: float = 8e-4,
    validation_fraction: float = 0.1,
    trajectory_key: NestedKey = "episode",
    eval_every: int = 1_000,
    max_validation_rows: int = 100_000,
    checkpoint: str | Path | None = None,
    checkpoint_every: int = 5_000,
    seed: int = 0,
    max_memory: int = 2**30,
    flush_denormal: bool = True,
    progress: bool = True,
    check: bool = True,
    distributed: bool = False,
) -> TensorDict:
    """Fits a world model by maximum likelihood (paper, A.7).

    It minimises the loss of :class:`~torchrl_caiac.objectives.EntityDynamicsLoss` with
    Adam, on batches drawn with replacement. Whole trajectories are held out for
    validation. The model is left in evaluation mode, with the weights and statistics of
    the step with the lowest negative log likelihood on the validation data. The scale
    of the targets comes from the training trajectories, unless the model has one
    already. The log has a warning if the best step was among the first tenth, or if the
    model predicts an entity no better than by assuming that it does not move.

    With ``checkpoint``, an interrupted call resumes where it stopped when it is
    repeated, and ends with the same weights, bit for bit, as an uninterrupted one. A
    call with more ``steps`` continues a finished one.

    Args:
        model (EntityDynamicsModel): the model, changed in place.
        data (TensorDictBase or sequence of TensorDictBase): transitions ``[T]``, in
            memory or memory-mapped. The transitions of a trajectory may be interleaved
            with others. Trajectories of different datasets are distinct.

    Keyword Args:
        action_spec (Bounded, optional): the action space, ``[A]``, which is recorded in
            the model and from which :class:`~torchrl_caiac.influence.CAI` draws
            actions. Defaults to the bounds that are stored with the data
            (:func:`~torchrl_caiac.data.action_bounds`) or, with a warning, to the
            range of the data.
        steps (int): the number of gradient steps in total. Defaults to ``100_000``.
        batch_size (int): transitions in each step. Defaults to ``500``.
        lr (float): the learning rate. Defaults to ``8e-4``.
        validation_fraction (float): the fraction of the trajectories to hold out, at
            least one trajectory. Defaults to ``0.1``.
        trajectory_key (NestedKey): the trajectory ids, integers ``[T]`` or ``[T, 1]``,
            for example ``("collector", "traj_ids")``. Defaults to ``"episode"``.
        eval_every (int): the number of steps between two validations. Defaults to
            ``1_000``.
        max_validation_rows (int): the number of held-out transitions to validate on;
            if more are held out, a fixed random choice. Defaults to ``100_000``.
        checkpoint (path, optional): the file for a
            :class:`~torchrl_caiac.checkpoint.TrainingCheckpoint`.
        checkpoint_every (int): the number of steps between two checkpoints. Defaults
            to ``5_000``.
        seed (int): the seed of the split and of the batches. Defaults to ``0``.
        max_memory (int): the size in bytes up to which the columns that the model
            reads are copied to one block of memory. Larger data are read batch by
            batch. Defaults to ``2**30`` (1 GiB).
        flush_denormal (bool): whether to treat denormal numbers as zero during the
            call, which can halve the time of a step on a CPU. Defaults to ``True``.
        progress (bool): whether to show a progress bar. Defaults to ``True``.
        check (bool): whether to check a sample of the data first, see
            :func:`~torchrl_caiac.check.check_dataset`. Warnings are logged. Defaults
            to ``True``.
        distributed (bool): whether the processes of the default group of
            ``torch.distributed`` fit the model together, for example under
            ``torchrun``. Each calls this function with the same arguments, and draws
            its own ``batch_size`` transitions in each step; gradients are averaged
            over the processes, so that all end with the same model. The first process
            writes the checkpoint, which the others read: it must be in a file system
            that they share. The result depends on the number of processes. Defaults
            to ``False``.

    Returns:
        TensorDict: one row for each validation, ``[E]``: ``"step"``; ``"train_nll"``,
        the mean over the steps since the last one; ``"validation_nll"``; ``"best"``,
        true if the validation was the best so far (the last such row is the model's);
        and ``("validation_mse", <entity>)``, in squared physical units.

    Raises:
        TypeError: the data are a replay buffer.
        KeyError: a key is missing in the data.
        ValueError: an argument is out of range; the data are empty, contain NaN or
            infinite values, do not fit the model, or have fewer than two trajectories;
            an action is outside of its bounds by more than 1e-3 of their width; bounds
            of several datasets differ; the checkpoint is truncated, or was made with
            other settings or data.
        RuntimeError: the loss is not finite; with ``distributed``, there is no
            process group, or the processes have different settings, data or steps.
        DatasetError: the check found errors.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.modules.gaussian_world_model import GaussianWorldModel
        >>> from torchrl_caiac.fit import fit_world_model
        >>> observation, action = torch.randn(200, 2), 2 * torch.rand(200, 1) - 1
        >>> td = TensorDict(
        ...     {
        ...         "observation": observation,
        ...         "action": action,
        ...         "episode": torch.arange(200) // 10,
        ...         "next": {"observation": observation + 0.1 * action},
        ...     },
        ...     [200],
        ... )
        >>> model = GaussianWorldModel(EntityLayout({"arm": [0], "cup": [1]}), 1, (16,))
        >>> history = fit_world_model(
        ...     model, td, action_spec=Bounded(-1, 1, (1,)), steps=40, eval_every=20,
        ...     batch_size=32, progress=False)
        >>> history["step"], history["validation_mse", "cup"].shape
        (tensor([20, 40]), torch.Size([2]))
    """
    for name, value in (
        ("steps", steps),
        ("batch_size", batch_size),
        ("eval_every", eval_every),
        ("max_validation_rows", max_validation_rows),
        ("checkpoint_every", checkpoint_every),
    ):
        check_int(name, value, 1)
    if not (lr > 0 and math.isfinite(lr)):
        raise ValueError(f"lr must be positive and finite, got {lr!r}")
    if not 0 < validation_fraction < 1:
        raise ValueError(
            f"validation_fraction must be between 0 and 1, got {validation_fraction!r}"
        )
    check_local("data", data)
    if isinstance(data, ReplayBuffer):  # whose samples never end
        raise TypeError(
            f"data is a {type(data).__name__}, expected transitions: pass rb.storage[:]"
        )
    ranks = Ranks(distributed)
    sources = [data] if isinstance(data, TensorDictBase) else list(data)
    bounds = known_bounds(sources, action_spec, model.action_dim)
    rows = FitRows(model, sources, max_memory, bounds)
    low, high = filled_bounds(rows.action_range, bounds, model.action_key)
    generator = torch.Generator().manual_seed(seed)
    key = as_key(trajectory_key)
    trajectories = trajectory_numbers(sources, key)
    train, validation = split_rows(
        trajectories,
        validation_fraction,
        max_validation_rows,
        generator,
    )
    found = None if model.has_floor else model.floor_from(sources)
    if check:
        _check(model, sources, key, found)
    fit = _Fit(model, lr, generator)
    settings: dict[str, Any] = {
        "model": model.config,
        "data_rows": rows.lengths,
        "data_checksum": zlib.crc32(trajectories.numpy().data, rows.checksum),
        "action_bounds": bounds and [bound.tolist() for bound in bounds],
        "batch_size": batch_size,
        "lr": lr,
        "validation_fraction": validation_fraction,
        "trajectory_key": jsonable(key),
        "eval_every": eval_every,
        "max_validation_rows": max_validation_rows,
        "seed": seed,
    }
    if ranks.world > 1:
        settings["processes"] = ranks.world
    keeper: TrainingCheckpoint | None = None
    if checkpoint is not None:
        keeper = TrainingCheckpoint(
            checkpoint,
            settings=settings,
            rng=False,  # the batches have their own generator
            model=model,
            optimizer=fit.optimizer,
            fit=fit,
        )
        load = functools.partial(keeper.load, max_step=steps)
        ranks.by_the_first(load)  # it also removes what an interrupted call left
        fit.step = load()
        if fit.step:
            _LOGGER.info("resuming at step %d of %s", fit.step, keeper.path)
    # Ranks agree before they wait for each other's gradients.
    every = {"steps": steps, "checkpoint_every": checkpoint_every}
    ranks.check_same({**settings, **every, "keeps": keeper is not None}, fit.step)
    if found is not None and not model.has_floor:  # a checkpoint has it
        model.set_floor(found)
    if not model.fitted:
        model.fit_statistics(rows.raw_targets(train))
    model.set_action_bounds(low, high)

    ranks.copy_state(model)
    model.train()
    bar = tqdm(
        total=steps,
        initial=fit.step,
        disable=not progress or ranks.rank > 0,
        desc="world model",
        unit="step",
    )
    with bar, _flushing_denormals(flush_denormal):
        while fit.step < steps:
            size = batch_size * ranks.world
            choice = torch.randint(len(train), (size,), generator=generator)
            choice = choice[ranks.rank :: ranks.world]
            state, action, raw = rows.get(train[choice])
            prediction = model.forward_tensors(state, action)
            loss = model.nll(prediction, model.normalise(raw)).mean()
            fit.optimizer.zero_grad()
            loss.backward()
            ranks.average_gradients(model)
            fit.optimizer.step()
            ranks.average_statistics(model)
            fit.step += 1
            fit.train_sum += loss.detach().double()
            fit.train_count += 1
            bar.update()
            if fit.step % eval_every == 0 or fit.step == steps:
                ranks.average(fit.train_sum)
                fit.validate(rows, validation)
                bar.set_postfix(
                    nll=f"{fit.history[-1]['validation_nll']:.3f}",
                    best=f"{fit.best_nll:.3f}",
                )
            if keeper is not None and (
                fit.step % checkpoint_every == 0 or fit.step == steps
            ):
                ranks.by_the_first(keeper.save, fit.step)
    model.load_state_dict(fit.best)
    model.eval()
    log_quality(model, fit.history, rows, train, validation)
    return fit.table()


def _check(
    model: EntityDynamicsModel,
    sources: Sequence[TensorDictBase],
    key: NestedKey,
    found: FoundFloor | None,
) -> None:
    floors = None
    # The floor of absolute targets is not that of changes.
    if model.target == "change":
        floors = model.entity_floors(found)
    for td in sources:
        if len(td):
            check_before_use(
                td,
                model.layout,
                action_key=model.action_key,
                reward_key=None,
                trajectory_key=key,
                variance_floor=floors,
                predict=model.config["predict"],
            )


class _Fit:
    """The state of a fit next to its model and its optimizer."""

    def __init__(
        self, model: EntityDynamicsModel, lr: float, generator: torch.Generator
    ) -> None:
        self.model = model
        fused = model.device.type in ("cpu", "cuda")
        self.optimizer = torch.optim.Adam(model.parameters(), lr=lr, fused=fused)
        self.generator = generator
        self.step = 0
        self.best: dict[str, Any] = {}
        self.best_nll = math.inf
        self.history: list[dict[str, float]] = []
        self.train_sum = torch.zeros((), dtype=torch.float64, device=model.device)
        self.train_count = 0

    @torch.no_grad()
    def validate(self, rows: FitRows, index: torch.Tensor) -> None:
        """Adds a row to the history, and keeps the model's state if it is the best."""
        model = self.model
        model.eval()
        nll = torch.zeros((), dtype=torch.float64)
        error = torch.zeros(model.predict_dim, dtype=torch.float64)
        for part in index.split(_EVAL_ROWS):
            state, action, raw = rows.get(part)
            prediction = model.forward_tensors(state, action)
            target = model.normalise(raw)
            nll += model.nll(prediction, target).sum(dtype=torch.float64).cpu()
            square = (target - prediction[0]).square()
            error += square.sum(0, dtype=torch.float64).cpu()
        model.train()
        # In physical units the error of change and of absolute targets is the same.
        error *= model.target_scale.cpu().square() / len(index)
        row = {
            "step": self.step,
            "train_nll": (self.train_sum / max(1, self.train_count)).item(),
            "validation_nll": nll.item() / len(index),
        }
        if not all(map(math.isfinite, row.values())):
            raise RuntimeError(
                f"the loss is not finite at step {self.step} ({row}): lower lr, or "
                "raise the model's variance_floor"
            )
        for name, where in model.predicted.items():
            row[f"mse/{name}"] = error[where].mean().item()
        row["best"] = row["validation_nll"] < self.best_nll
        if row["best"]:
            self.best_nll = row["validation_nll"]
            self.best = _copy(model.state_dict())
        self.history.append(row)
        self.train_sum.zero_()
        self.train_count = 0

    def table(self) -> TensorDict:
        """Returns the history as a tensordict ``[E]``."""

        def column(name: str, dtype: torch.dtype = torch.float64) -> torch.Tensor:
            return torch.tensor([row[name] for row in self.history], dtype=dtype)

        return TensorDict(
            {
                "step": column("step", torch.int64),
                "train_nll": column("train_nll"),
                "validation_nll": column("validation_nll"),
                "best": column("best", torch.bool),
                "validation_mse": {
                    name: column(f"mse/{name}") for name in self.model.predicted
                },
            },
            [len(self.history)],
        )

    def state_dict(self) -> dict[str, Any]:
        """Returns what a checkpoint saves."""
        return {
            "generator": self.generator.get_state(),
            "best": self.best,
            "best_nll": self.best_nll,
            "history": self.history,
            "train_sum": self.train_sum,
            "train_count": self.train_count,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self.generator.set_state(state["generator"])
        self.train_sum.copy_(state["train_sum"])
        for name in ("best", "best_nll", "history", "train_count"):
            setattr(self, name, state[name])


def _copy(state: dict[str, Any]) -> dict[str, Any]:
    return {
        key: value.detach().clone() if isinstance(value, torch.Tensor) else value
        for key, value in state.items()
    }


@contextmanager
def _flushing_denormals(enabled: bool) -> Iterator[None]:
    """Treats denormal numbers as zero in the block, if enabled."""
    # torch has no getter for the current setting: add two denormal numbers instead.
    denormal = torch.tensor([1e-310], dtype=torch.float64)
    already = not bool((denormal + denormal).any())
    changed = enabled and not already and torch.set_flush_denormal(True)
    try:
        yield
    finally:
        if changed:
            torch.set_flush_denormal(False)
