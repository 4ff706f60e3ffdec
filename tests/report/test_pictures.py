from __future__ import annotations

import base64
import io
import logging
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from tensordict import TensorDict

from tests.report.test_write_report import check_page, report
from tests.report.walks import scored_dataset, transitions
from torchrl_caiac import EntityLayout
from torchrl_caiac.layouts import ready_layout
from torchrl_caiac.report.pictures import as_pictures, known_renderer

SIZE = (480, 360)


def frames_of(layout: EntityLayout, observations: Any) -> NDArray[np.uint8]:
    render = known_renderer(layout)
    assert render is not None
    states = torch.as_tensor(np.asarray(observations, dtype=np.float32))
    return render(TensorDict({"observation": states}, [len(states)]))


def decoded(address: str) -> NDArray[np.uint8]:
    data = base64.b64decode(address.removeprefix("data:image/jpeg;base64,"))
    return np.asarray(Image.open(io.BytesIO(data)))


def test_kitchen() -> None:
    from torchrl_caiac.envs import KitchenEnv

    env = KitchenEnv(render_mode="rgb_array", render_size=SIZE)
    state = env.reset(seed=0)[0]["observation"]
    opened = state.copy()
    opened[22] = -0.7  # the microwave
    frames = frames_of(ready_layout("kitchen/positions"), [state, opened])
    assert np.array_equal(frames, env.render_states(np.stack([state, opened])))
    assert not np.array_equal(frames[0], frames[1])
    full = env.full_observation
    (frame,) = frames_of(ready_layout("kitchen/franka"), [full])
    own = np.concatenate([full[:9], full[18:39]])
    assert full.shape == (59,) and np.allclose(own, state, atol=0.02)
    assert np.array_equal(frame, env.render_states(np.float32(own)[None])[0])
    env.close()


def test_fetch_push() -> None:
    from torchrl_caiac.envs import FetchPushCubes

    env = FetchPushCubes(2, render_mode="rgb_array", render_size=SIZE)
    observation = env.reset(seed=3)[0]["observation"]
    hidden = np.tile([0.0, 0.0, -9.0], 2)
    expected = env.render_states([env.simulator_state()], hidden)[0]
    turned = observation.copy()
    turned[15] = np.pi / 4  # the first cube, about the vertical axis
    frames = frames_of(ready_layout("fetch_push_cubes/2"), [observation, turned])
    assert np.abs(frames[0].astype(int) - expected).mean() < 0.5
    change = np.abs(frames[1].astype(int) - frames[0]).max(-1) > 30
    assert 10 < change.sum() < 2000
    env.close()


@pytest.mark.parametrize("name", ["cube-double", "scene"])
def test_ogbench(name: str) -> None:
    import mujoco

    from torchrl_caiac.envs.ogbench import OGBenchSimulator
    from torchrl_caiac.envs.rendering import OffscreenRenderer

    simulator = OGBenchSimulator(name)
    camera = {
        "type": mujoco.mjtCamera.mjCAMERA_FIXED.value,
        "fixedcamid": simulator.model.camera("front").id,
    }
    renderer = OffscreenRenderer(simulator.model, *SIZE, camera=camera)
    observations, expected = [], []
    for seed in (0, 1):
        state = simulator.reset(seed=seed)
        state[simulator.model.nq : simulator.model.nq + simulator.model.nv] = 0.0
        simulator.restore(state)
        for _ in range(3):  # with the gripper half closed
            simulator.step([0.3, 0.1, 0.0, 0.2, 0.8])
        observations.append(simulator.observation())
        expected.append(renderer.frame(simulator.data))
    renderer.close()
    simulator.close()
    frames = frames_of(ready_layout(f"ogbench/{name}"), observations)
    for frame, true in zip(frames, expected, strict=True):
        # A few pixels at the edges of what is between two substeps.
        differs = np.abs(frame.astype(int) - true).max(-1) > 24
        assert differs.mean() < 0.002
    assert (np.abs(frames[0].astype(int) - frames[1]).max(-1) > 24).mean() > 0.02


def test_other_layouts() -> None:
    kitchen = ready_layout("kitchen/positions")
    columns = {f"x{name}": own for name, own in kitchen.columns.items()}
    assert known_renderer(EntityLayout(columns)) is None
    assert known_renderer(EntityLayout.from_keys({"arm": "arm"})) is None
    assert known_renderer(ready_layout("metaworld/one-object")) is None


def test_difference_is_outlined() -> None:
    recorded = np.full((60, 80, 3), 40, np.uint8)
    made = recorded.copy()
    made[20:40, 30:50] = 200
    first, second = (decoded(address) for address in as_pictures(recorded, made))
    for picture in (first, second):
        amber = (picture[..., 0] > 180) & (picture[..., 2] < 90)
        rows, columns = np.nonzero(amber)
        # Around the difference, not in it.
        assert 12 <= rows.min() < 20 and 39 < rows.max() <= 47
        assert 22 <= columns.min() < 30 and 49 < columns.max() <= 57
        assert not amber[24:36, 34:46].any()
    same = [decoded(address) for address in as_pictures(recorded, recorded)]
    assert np.array_equal(*same) and np.abs(same[0].astype(int) - 40).max() < 4


@pytest.mark.parametrize(
    "made", [np.zeros((60, 80, 3)), np.zeros((60, 81, 3), np.uint8), np.zeros(3)]
)
def test_frames_that_are_none(made: Any) -> None:
    with pytest.raises(ValueError, match="rendered frames are"):
        as_pictures(np.zeros((60, 80, 3), np.uint8), made)


def test_render_function(walks, tmp_path) -> None:
    def render(states: TensorDict) -> NDArray[np.uint8]:
        shade = (states["observation"][:, 3] * 40).to(torch.uint8).numpy()
        return np.tile(shade[:, None, None, None], (1, 24, 32, 3))

    text = report(walks, tmp_path, render=render, examples=2)
    page = check_page(text)
    assert text.count('src="data:image/jpeg;base64,') == 4
    assert "Left, a recorded state. Right, its counterfactual" in page.text

    for wrong, message in (
        (lambda states: render(states)[1:], "returned 3 frames for 4 states"),
        (lambda states: render(states) / 255, "rendered frames are"),
    ):
        with pytest.raises(ValueError, match=message):
            report(walks, tmp_path, render=wrong, examples=2, overwrite=True)

    def broken(states: TensorDict) -> NDArray[np.uint8]:
        raise RuntimeError("no such thing")

    with pytest.raises(RuntimeError, match="no such thing"):
        report(walks, tmp_path, render=broken, overwrite=True)


def test_no_opengl(tmp_path, monkeypatch, caplog) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disable")
    scored = scored_dataset(transitions(4, 10, 30), ready_layout("kitchen/positions"))
    with caplog.at_level(logging.WARNING, logger="torchrl_caiac.report"):
        page = check_page(report(scored, tmp_path))
    assert "could not render: rendering needs OpenGL" in page.text
    assert "recorded place of a swapped entity" in page.text
    assert "the examples are not rendered" in caplog.text
    # Nobody asked for pictures, so nothing is missing.
    page = check_page(report(scored, tmp_path, render=None, overwrite=True))
    assert "could not render" not in page.text
