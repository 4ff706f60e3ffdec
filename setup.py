"""Lists the packages. Everything else about the project is in pyproject.toml.

The wheel has the examples as ``torchrl_caiac_examples``, for ``caiac demo``.
"""

from __future__ import annotations

from setuptools import find_packages, setup

EXAMPLES = "torchrl_caiac_examples"

setup(
    packages=[
        *find_packages(include=["torchrl_caiac*"]),
        EXAMPLES,
        *(f"{EXAMPLES}.{name}" for name in find_packages("examples")),
    ],
    package_dir={EXAMPLES: "examples"},
)
