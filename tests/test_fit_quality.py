"""Tests of what the log says of a fit."""

from __future__ import annotations

import re

import pytest
import torch

from tests.test_fit import SPEC, fit, make, world


def test_a_good_fit_is_not_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    model = make(variance_floor=0.02)
    fit(model, world(), action_spec=SPEC, steps=300, batch_size=128, lr=3e-3)
    assert not caplog.records


@pytest.mark.parametrize("target", ["change", "absolute"])
def test_a_model_that_predicts_nothing_is_warned_of(
    target: str, caplog: pytest.LogCaptureFixture
) -> None:
    data = world()
    data["action"] = data["action"][torch.randperm(2000)]  # not those that were taken
    data["next", "observation"][:, 3] = data["observation"][:, 3]  # stays
    data["next", "observation"][:, 2] = data["observation"][:, 2]
    fit(make(target=target), data, action_spec=SPEC, steps=20, lr=1e-6, check=False)
    (record,) = caplog.records
    assert "the model predicts ['arm'] no better than 'nothing moves', and has" in (
        record.getMessage()
    )
    assert "of one mean and variance for all states and actions" in record.getMessage()


def test_overfitting_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    few = world(60)
    few["next", "observation"] += torch.randn(60, 4)
    fit(
        make(variance_floor=1e-6),
        few,
        action_spec=SPEC,
        steps=300,
        batch_size=60,
        eval_every=10,
        lr=1e-2,
    )
    messages = [record.getMessage() for record in caplog.records]
    assert any(re.match(r"the best step was \d0? of 300", text) for text in messages)
