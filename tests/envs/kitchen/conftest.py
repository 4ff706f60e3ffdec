"""Environments shared by the tests of the Franka-Kitchen."""

from __future__ import annotations

import pytest

from torchrl_caiac.envs.kitchen import KitchenEnv
from torchrl_caiac.envs.kitchen.datasets.collection import make_franka_kitchen


@pytest.fixture(scope="module")
def env():
    """The environment of this package."""
    env = KitchenEnv("microwave")
    yield env
    env.close()


@pytest.fixture(scope="module")
def franka_kitchen():
    """``FrankaKitchen-v1``, which never ends an episode by itself."""
    env = make_franka_kitchen(["microwave", "kettle"])
    yield env
    env.close()
