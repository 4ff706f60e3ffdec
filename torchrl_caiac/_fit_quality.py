"""What the log says of a fitted world model."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import torch

from torchrl_caiac._fit_rows import CHUNK, FitRows
from torchrl_caiac.modules.entity_dynamics_model import EntityDynamicsModel
from torchrl_caiac.modules.running_norm import RunningNorm

__all__ = ["log_quality"]

_LOGGER = logging.getLogger("torchrl_caiac.fit")
_SAMPLE = 200_000  # training rows from which the constant prediction is taken


@torch.no_grad()
def log_quality(
    model: EntityDynamicsModel,
    history: Sequence[Mapping[str, float]],
    rows: FitRows,
    train: torch.Tensor,
    validation: torch.Tensor,
) -> None:
    """Logs a warning if the model overfits, or predicts no better than a constant.

    Args:
        model (EntityDynamicsModel): the fitted model.
        history (sequence of Mapping): the validations, in order.
        rows (FitRows): the data.
        train (torch.Tensor): the numbers of the rows for training.
        validation (torch.Tensor): the numbers of the rows for validation.
    """
    best, steps = [row for row in history if row["best"]][-1], history[-1]["step"]
    if best["step"] <= 0.1 * steps:
        _LOGGER.warning(
            "the best step was %d of %d: the model overfits after it. Collect more "
            "data, make the model smaller, let it read fewer columns (inputs), or "
            "lower steps",
            best["step"],
            steps,
        )
    found = []
    still = _entities_that_seem_still(model, best, rows, validation)
    if still:
        found.append(f"predicts {still} no better than 'nothing moves'")
    constant = _constant_nll(model, rows, train, validation)
    if constant is not None and best["validation_nll"] >= constant:
        found.append(
            f"has {best['validation_nll']:.4g} nats on the validation data, no fewer "
            f"than the {constant:.4g} of one mean and variance for all states and "
            "actions"
        )
    if found:
        _LOGGER.warning(
            "the model %s: its scores are not reliable. Fit more steps, or check that "
            "the data have the actions that cause the next states",
            ", and ".join(found),
        )


def _entities_that_seem_still(
    model: EntityDynamicsModel,
    best: Mapping[str, float],
    rows: FitRows,
    validation: torch.Tensor,
) -> list[str]:
    """Returns the entities that 'nothing moves' predicts as well."""
    change = torch.zeros(model.predict_dim, dtype=torch.float64)
    for part in validation.split(CHUNK):
        state, _, raw = rows.get(part)
        if model.target != "change":
            raw = raw - state[:, model.index]
        change += raw.double().square().sum(0).cpu()
    change /= len(validation)
    # Changes below the floor count as noise, which no model predicts.
    floor = model.floor.cpu().square()
    return [
        name
        for name, where in model.predicted.items()
        if change[where].mean() > floor[where].mean()
        and best[f"mse/{name}"] >= change[where].mean()
    ]


def _constant_nll(
    model: EntityDynamicsModel,
    rows: FitRows,
    train: torch.Tensor,
    validation: torch.Tensor,
) -> float | None:
    """Returns the validation NLL of one prediction for all states and actions."""
    statistics = RunningNorm(model.predict_dim).to(model.device)
    stride = -(-len(train) // _SAMPLE)
    for part in train[::stride].split(CHUNK):
        statistics.update(model.normalise(rows.get(part)[2]))
    mean, var = statistics.mean.to(model.dtype), statistics.var.to(model.dtype)
    prediction = model.constant_prediction(mean, var)
    if prediction is None:
        return None
    total = 0.0
    for part in validation.split(CHUNK):
        target = model.normalise(rows.get(part)[2])
        total += model.nll(prediction, target).sum(dtype=torch.float64).item()
    return total / len(validation)
