"""Small datasets shared by the tests of the kitchen's datasets."""

from __future__ import annotations

import os

import gymnasium
import gymnasium_robotics
import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer

from torchrl_caiac.envs.kitchen import (
    Demonstrations,
    create_kitchen_demonstrations,
    create_kitchen_random,
)

TASKS = ["microwave", "kettle", "light switch", "slide cabinet"]


@pytest.fixture(scope="session")
def groups():
    return (
        Demonstrations("microwave", 1, {"slide_cabinet": 0.37}),
        Demonstrations("kettle", 2),
    )


@pytest.fixture(scope="session")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("minari")


@pytest.fixture(scope="session")
def work(tmp_path_factory):
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="session")
def demonstrations(groups, root, work):
    before = os.environ.get("MINARI_DATASETS_PATH")
    dataset, report = create_kitchen_demonstrations(
        demonstrations=groups, root=root, work=work, workers=1, progress=False
    )
    assert os.environ.get("MINARI_DATASETS_PATH") == before
    assert report.collected == 3
    assert not list(root.glob(".partial-*"))
    return dataset


@pytest.fixture(scope="session")
def random_actions(demonstrations, root, work):
    return create_kitchen_random(
        demonstrations,
        ratio=0.5,
        steps=4,
        simulator_states=True,
        starts_per_file=8,
        root=root,
        work=work,
        workers=1,
        progress=False,
    )


@pytest.fixture(scope="session")
def foreign(tmp_path_factory):
    """A dataset with the schema of ``D4RL/kitchen/mixed-v2``, and its arrays."""
    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make("FrankaKitchen-v1", tasks_to_complete=TASKS)
    rng = np.random.default_rng(0)
    widths = {"microwave": 1, "kettle": 7, "light switch": 2, "slide cabinet": 1}
    episodes = []
    for length in (5, 1, 3):
        goals = {
            kind: {name: rng.normal(size=(length + 1, w)) for name, w in widths.items()}
            for kind in ("achieved_goal", "desired_goal")
        }
        episodes.append(
            {
                "observations": {
                    "observation": rng.normal(size=(length + 1, 59)),
                    **goals,
                },
                "actions": rng.uniform(-1, 1, (length, 9)).astype(np.float32),
                "rewards": rng.integers(0, 5, length).astype(float),
                "terminations": np.arange(length) == 4,
                "truncations": np.zeros(length, bool),
            }
        )
    root = tmp_path_factory.mktemp("remote")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        minari.create_dataset_from_buffers(
            "D4RL/kitchen/mixed-v2",
            [EpisodeBuffer(**episode) for episode in episodes],
            env=env,
        )
    env.close()
    return root, episodes
