"""Off-screen rendering of MuJoCo environments."""

from __future__ import annotations

import atexit
import importlib
import os
import sys
import weakref
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

try:
    import mujoco
except (ImportError, AttributeError) as error:
    raise ImportError(
        "mujoco could not be imported. If MUJOCO_GL is set (it is "
        f"{os.environ.get('MUJOCO_GL')!r}), its OpenGL libraries may be missing: unset "
        "it (the environments use OpenGL only to render), or "
        "install them (`apt-get install libegl1 libgl1-mesa-dri`). Otherwise: "
        "pip install 'torchrl-caiac[envs]'"
    ) from error

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["OffscreenRenderer", "RenderingUnavailable"]


class RenderingUnavailable(RuntimeError):
    """No OpenGL context could be created; the message says how to get one."""


class OffscreenRenderer:
    """Renders frames of a model in an OpenGL context of its own.

    Shadows and reflections are off: in software they take ten times as long as the
    rest.

    ``mujoco.Renderer`` uses the backend that ``MUJOCO_GL`` named when mujoco was
    imported. This class looks for a backend when it is created, so nothing needs to be
    set before the import, and environments work without OpenGL.

    Args:
        model (mujoco.MjModel): the model.
        width (int): width of the frames, in pixels.
        height (int): height of the frames, in pixels.

    Keyword Args:
        camera (Mapping, optional): attributes of ``mujoco.MjvCamera`` (``lookat``,
            ``distance``, ...).

    Raises:
        RenderingUnavailable: no OpenGL context could be created.
    """

    def __init__(
        self,
        model: Any,
        width: int,
        height: int,
        *,
        camera: Mapping[str, Any] | None = None,
    ) -> None:
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, height)
        self._model = model
        self._context = _gl_context(width, height)
        self._context.make_current()
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._scene = mujoco.MjvScene(model, maxgeom=2000)
        for flag in (
            mujoco.mjtRndFlag.mjRND_SHADOW,
            mujoco.mjtRndFlag.mjRND_REFLECTION,
        ):
            self._scene.flags[flag] = 0
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        for name, value in (camera or {}).items():
            setattr(self._camera, name, value)
        self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)
        self._free = weakref.finalize(self, _free, self._mjr, self._context)
        # Exit functions run last in, first out: this one runs before EGL's own, which
        # finalize does not guarantee.
        atexit.register(self._free)

    def frame(self, data: Any) -> NDArray[np.uint8]:
        """Renders a simulator state.

        Args:
            data (mujoco.MjData): the state, updated by ``mj_forward``.

        Returns:
            numpy.ndarray: RGB frame ``[height, width, 3]``, uint8.
        """
        self._context.make_current()
        mujoco.mjv_updateScene(
            self._model,
            data,
            self._option,
            None,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self._scene,
        )
        pixels = np.empty(
            (self._rectangle.height, self._rectangle.width, 3), dtype=np.uint8
        )
        mujoco.mjr_render(self._rectangle, self._scene, self._mjr)
        mujoco.mjr_readPixels(pixels, None, self._rectangle, self._mjr)
        return np.flipud(pixels).copy()  # OpenGL's first row is the lowest

    def close(self) -> None:
        """Frees the context; so do garbage collection and the interpreter's exit."""
        self._free()
        atexit.unregister(self._free)


def _free(mjr: Any, context: Any) -> None:
    mjr.free()
    context.free()


def _gl_context(width: int, height: int) -> Any:
    """Returns an OpenGL context of the first backend that works."""
    requested = os.environ.get("MUJOCO_GL", "").lower()
    if requested in ("egl", "osmesa", "glfw"):
        backends: tuple[str, ...] = (requested,)
    elif requested in ("disable", "disabled", "off", "false", "0"):
        backends = ()
    elif sys.platform == "linux":
        backends = ("egl", "glfw") if os.environ.get("DISPLAY") else ("egl",)
    else:
        backends = ("glfw",)
    reasons = [] if backends else [f"MUJOCO_GL is {requested!r}"]
    for backend in backends:
        try:
            kind = importlib.import_module(f"mujoco.{backend}").GLContext
            context = kind.__new__(kind)
            # Its __del__ reads this, even if __init__ failed before setting it.
            context._context = None
            context.__init__(width, height)
            return context
        # A missing driver raises different errors, depending on its loader:
        # ImportError, AttributeError, RuntimeError, OpenGL's own errors.
        except Exception as error:
            reasons.append(f"{backend}: {type(error).__name__}: {error}")
    raise RenderingUnavailable(
        "rendering needs OpenGL, and no context could be created "
        f"({'; '.join(reasons)}). On Debian or Ubuntu: apt-get install libegl1 "
        "libgl1-mesa-dri; then leave MUJOCO_GL unset or set it to egl"
    )
