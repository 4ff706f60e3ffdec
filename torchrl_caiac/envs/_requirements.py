"""The packages that the environments need, as recorded in their datasets."""

from __future__ import annotations

__all__ = ["REQUIREMENTS"]

#: In the form of a requirements file.
REQUIREMENTS = ("gymnasium-robotics>=1.4,<1.5", "mujoco>=3.3.5,<3.12")
