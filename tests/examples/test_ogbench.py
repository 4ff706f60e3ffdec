"""Tests of the example on OGBench's data, and of the sweep of variance floors."""

from __future__ import annotations

import csv

import pytest
import torch


@pytest.fixture(scope="module")
def cfg(steps, compose, tmp_path_factory):
    cfg = compose(
        "env=ogbench_cube_double",
        "unit=10",
        "floors=[1.0e-3]",
        "steps=20",
        out=tmp_path_factory.mktemp("ogbench"),
        config="sweep_variance_floor",
    )
    steps.collect.collect(cfg)
    return cfg


def test_held_out_rows_are_of_other_episodes_and_steps_apart(steps, cfg):
    environment = steps.parts.make_environment(cfg)
    rows, held_out = environment.rows(), environment.held_out()
    assert len(rows) == 3 * 40 and len(held_out) == 2 * 40 // 4
    first = rows["observation"][rows["episode"] == 0][0]
    assert not torch.equal(first, held_out["observation"][0])
    assert held_out["episode"].unique().tolist() == [0, 1]
    assert not torch.equal(
        held_out["next", "observation"][0], held_out["observation"][1]
    )


def test_models_read_and_predict_the_position_of_the_hand(steps, cfg):
    environment = steps.parts.make_environment(cfg)
    for maker, settings in (
        (steps.fit.make_gaussian, cfg.env.world_model),
        (steps.fit.make_transformer, cfg.env.transformer),
    ):
        model = maker(environment, settings)
        assert model.config["inputs"]["robot"] == [12, 13, 14]
        assert model.input_dim == 3 + 9 + 9 and model.predict_dim == 9
        assert model.floor.tolist() == [0.01] * 9


def test_the_sweep_has_a_line_for_each_floor_and_entity(steps, cfg, tmp_path):
    lines = steps.sweep_variance_floor.sweep(cfg)
    assert [(line["floor"], line["entity"]) for line in lines] == [
        (floor, cube) for floor in ("1 mm", "auto") for cube in ("cube0", "cube1")
    ]
    for line in lines[:2]:
        torch.testing.assert_close(line["value"], 1e-3)
        assert line["reason"] is None
    assert all(line["value"] > 0 and line["reason"] for line in lines[2:])
    # The fits are kept: a second call gives the same table.
    again = steps.sweep_variance_floor.sweep(cfg)
    texts = []
    for found in (lines, again):
        steps.tables.update_csv(
            tmp_path / "table.csv",
            found,
            steps.sweep_variance_floor.COLUMNS,
            experiment="cubes",
        )
        texts.append((tmp_path / "table.csv").read_text())
    assert texts[0] == texts[1]
    assert len(list(csv.DictReader(texts[0].splitlines()))) == 4
