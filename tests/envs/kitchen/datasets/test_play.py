from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from torchrl_caiac.envs.kitchen import (
    KITCHEN_TASKS,
    PLAY_ANY_START_ID,
    PLAY_ANY_START_ORDERS,
    PLAY_ID,
    PLAY_ORDERS,
    KitchenEnv,
    create_kitchen_play,
    kitchen_transitions,
)


def test_play_does_its_tasks_one_after_another(tmp_path):
    orders = (("kettle", "slide cabinet"), ("bottom burner",))
    options = {"orders": orders, "episodes": 1, "seed": 3, "progress": False}
    dataset, report = create_kitchen_play(
        root=tmp_path / "minari", work=tmp_path / "work", workers=1, **options
    )
    assert dataset.id == PLAY_ID
    assert report.collected == 2
    rows = kitchen_transitions(dataset, progress=False)
    metadata = dataset.storage.get_episode_metadata(range(2))
    default = KitchenEnv.default_state()
    for number, (order, known) in enumerate(zip(orders, metadata, strict=True)):
        assert json.loads(known["options"]["tasks"]) == list(order)
        own = rows[rows["episode"] == number]
        np.testing.assert_allclose(own["sim", "qpos"][0], default, atol=1e-6)
        names = [name.replace(" ", "_") for name in order]
        played = own["task"].unique_consecutive()
        assert [KITCHEN_TASKS[task] for task in played] == names
        # The tasks are done; everything else stays unchanged.
        last = own["next", "observation"][-1]
        moved = (own["sim", "qpos"] - torch.as_tensor(default)).abs().amax(0)
        for name, columns in KitchenEnv.layout.columns.items():
            where = torch.tensor(columns)
            if name in names:
                goal = torch.as_tensor(KitchenEnv.solved(name)).float()
                assert (last[where] - goal).norm() < 0.3
                # It moves while its task is played, not before.
                first = int((own["task"] == KITCHEN_TASKS.index(name)).nonzero()[0])
                way = (own["sim", "qpos"] - own["sim", "qpos"][0])[:, where].abs()
                assert way[: first + 1].max() < 0.02
                assert way.max() > 0.2
            elif name != "robot":
                assert moved[where].max() < 0.02
    # Finished episodes are not collected again.
    again, report = create_kitchen_play(
        root=tmp_path / "minari", work=tmp_path / "work", overwrite=True, **options
    )
    assert (report.collected, report.reused) == (0, 2)
    assert (kitchen_transitions(again, progress=False) == rows).all()


def test_orders_of_play_are_narrow_and_contain_all_tasks():
    tasks = {task.replace(" ", "_") for order in PLAY_ORDERS for task in order}
    assert tasks == set(KITCHEN_TASKS)
    assert {len(order) for order in PLAY_ORDERS} == {4}
    # What is done when a task begins: few of the 64 combinations of six others.
    for task in {task for order in PLAY_ORDERS for task in order}:
        begun = {
            frozenset(order[: order.index(task)])
            for order in PLAY_ORDERS
            if task in order
        }
        assert len(begun) <= 5
    # No counterfactual shows what never rests once it was moved.
    early = {task.replace(" ", "_") for order in PLAY_ORDERS for task in order[:-1]}
    assert early == tasks


def test_orders_that_begin_with_any_task_are_balanced_and_narrow():
    assert len(PLAY_ANY_START_ORDERS) == 7
    for place in range(4):
        tasks = {order[place].replace(" ", "_") for order in PLAY_ANY_START_ORDERS}
        assert tasks == set(KITCHEN_TASKS)
    for task in {task for order in PLAY_ANY_START_ORDERS for task in order}:
        begun = {
            frozenset(order[: order.index(task)])
            for order in PLAY_ANY_START_ORDERS
            if task in order
        }
        assert sorted(map(len, begun)) == [0, 1, 2, 3]
        # Each contains the smaller ones.
        assert all(a <= b or b <= a for a in begun for b in begun)


def test_every_task_is_done_from_the_default_start(tmp_path):
    dataset, report = create_kitchen_play(
        PLAY_ANY_START_ID,
        orders=PLAY_ANY_START_ORDERS,
        episodes=1,
        max_steps=440,
        root=tmp_path,
        workers=1,
        progress=False,
    )
    assert report.collected == 7
    rows = kitchen_transitions(dataset, progress=False)
    default = torch.as_tensor(KitchenEnv.default_state())
    for number, order in enumerate(PLAY_ANY_START_ORDERS):
        own = rows[rows["episode"] == number]
        torch.testing.assert_close(own["sim", "qpos"][0], default, atol=1e-6, rtol=0)
        names = [name.replace(" ", "_") for name in order]
        # A task that is undone is played again.
        played = own["task"].unique_consecutive().tolist()
        first = list(dict.fromkeys(KITCHEN_TASKS[task] for task in played))
        assert first == names
        last = own["next", "observation"][-1]
        for name in names:
            goal = torch.as_tensor(KitchenEnv.solved(name)).float()
            columns = torch.tensor(KitchenEnv.layout.columns[name])
            assert (last[columns] - goal).norm() < 0.3


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"orders": [["toaster"]]}, KeyError, "toaster"),
        ({"orders": [["kettle", "kettle"]]}, ValueError, "each only once"),
        ({"orders": [[]]}, ValueError, "at least one task"),
        ({"orders": []}, ValueError, "no demonstrations"),
        ({"episodes": 0}, ValueError, "no demonstrations"),
        ({"speeds": (0.5, 0.2)}, ValueError, "lowest"),
        ({"speeds": (0.0, 0.2)}, ValueError, "lowest"),
    ],
)
def test_wrong_orders_of_play(wrong, error, message, tmp_path):
    with pytest.raises(error, match=message):
        create_kitchen_play(root=tmp_path, **wrong)
    assert not any(tmp_path.iterdir())
