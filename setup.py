"""Lists the packages, and gives the README to package indexes.

Everything else about the project is in pyproject.toml. The wheel has the examples as
``torchrl_caiac_examples``, for ``caiac demo``.
"""

from __future__ import annotations

import re
from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).parent
EXAMPLES = "torchrl_caiac_examples"


def long_description() -> str:
    """Returns the README with the addresses of its files, for pages elsewhere."""
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    source = re.search(r'^Source = "(.+)"$', project, flags=re.MULTILINE)[1]
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    text = re.sub(r"(!\[[^]]*\]\()(?!https?:)", rf"\g<1>{source}/raw/main/", text)
    return re.sub(r"(\]\()(?!https?:|#)", rf"\g<1>{source}/blob/main/", text)


setup(
    long_description=long_description(),
    long_description_content_type="text/markdown",
    packages=[
        *find_packages(include=["torchrl_caiac*"]),
        EXAMPLES,
        *(f"{EXAMPLES}.{name}" for name in find_packages("examples")),
    ],
    package_dir={EXAMPLES: "examples"},
)
