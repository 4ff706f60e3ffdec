from __future__ import annotations

import sys

import numpy as np
import pytest

from torchrl_caiac.envs.kitchen import KitchenEnv
from torchrl_caiac.envs.rendering import RenderingUnavailable


def test_frames_or_a_clear_error():
    env = KitchenEnv(render_mode="rgb_array", render_size=(64, 48))
    env.reset(seed=0)
    before = env.qpos
    try:
        frame = env.render()
    except RenderingUnavailable as error:
        # A machine without OpenGL: only the message can be tested.
        assert "apt-get install" in str(error)
        return
    assert frame.shape == (48, 64, 3) and frame.dtype == np.uint8
    assert frame.std() > 10
    changed = env.default_state()
    changed[22] = -1.5
    frames = env.render_states([before, changed])
    assert frames.shape == (2, 48, 64, 3)
    assert np.array_equal(frames[0], frame)
    assert not np.array_equal(frames[1], frame)
    assert np.array_equal(env.qpos, before)
    with pytest.raises(ValueError, match=r"\[S, 30\]"):
        env.render_states(np.zeros((2, 21)))
    env.close()
    assert np.array_equal(env.render(), frame)  # works again after close
    env.close()
    env.close()


def test_no_render_mode_no_frame():
    env = KitchenEnv()
    env.reset(seed=0)
    assert env.render() is None


@pytest.mark.parametrize(
    ("variable", "value"), [("MUJOCO_GL", "disabled"), ("MUJOCO_EGL_DEVICE_ID", "99")]
)
def test_the_environment_works_without_opengl(monkeypatch, variable, value):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setenv(variable, value)
    egl = sys.modules.get("mujoco.egl")
    if egl is not None:  # it keeps a display that an earlier test found
        monkeypatch.setattr(egl, "EGL_DISPLAY", None)
    env = KitchenEnv(render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(RenderingUnavailable, match="apt-get install libegl1"):
        env.render()
    env.step(np.zeros(9))
    env.close()
