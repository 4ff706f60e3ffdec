"""What the settings of learners may be."""

from __future__ import annotations

from typing import Annotated, Any

from omegaconf import DictConfig, OmegaConf
from pydantic import BaseModel, ConfigDict, Field, ValidationError

__all__ = [
    "BaseSettings",
    "BelowOne",
    "Count",
    "NotNegative",
    "Positive",
    "Share",
    "Sizes",
    "check_settings_of",
]

Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
BelowOne = Annotated[float, Field(gt=0, lt=1)]
Sizes = Annotated[list[Count], Field(min_length=1)]


class BaseSettings(BaseModel):
    """The types and ranges of settings; those without a field are not checked."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False)


def check_settings_of(group: str, settings: DictConfig, kind: type[BaseModel]) -> None:
    """Raises if settings have wrong types, are out of range or missing.

    Args:
        group (str): where they are in the configuration, for the error.
        settings (DictConfig): the settings.
        kind (type): the types and ranges.

    Raises:
        ValueError: some are wrong; the error names all of them.
    """
    given: dict[str, Any] = OmegaConf.to_container(settings, resolve=True)
    try:
        kind.model_validate(given)
    except ValidationError as error:
        problems = {}
        for found in error.errors(include_url=False):
            name, message = str(found["loc"][0]), found["msg"].replace("Input", "it")
            problems[name] = (
                f"{group}.{name} is {given[name]!r}, but {message}"
                if name in given
                else f"{group}.{name} is missing"
            )
        raise ValueError("; ".join(problems.values())) from None
