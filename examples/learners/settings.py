"""What the settings of learners may be."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from omegaconf import DictConfig, OmegaConf
from pydantic import BaseModel, ConfigDict, Field, ValidationError

__all__ = [
    "AugmentationSettings",
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


class AugmentationSettings(BaseSettings):
    """What the settings ``env.augmentation`` may be, besides those of methods."""

    counterfactual_ratio: Share = 0.5
    swap_prob: Share = 1.0
    threshold: float | dict[str, float] = 0.05
    lookahead: Annotated[int, Field(ge=0)] | Literal["next", "goal"] | None = None
    hindsight: dict[str, Any] = {}


def check_settings_of(group: str, settings: Any, kind: type[BaseModel]) -> None:
    """Raises if settings have wrong types, are out of range or missing.

    Args:
        group (str): where they are in the configuration, for the error.
        settings (Any): the settings; an error if they are no ``DictConfig``.
        kind (type): the types and ranges.

    Raises:
        ValueError: some are wrong; the error names all of them.
    """
    if not isinstance(settings, DictConfig):
        raise ValueError(f"{group} is {settings}, but it should be a group of settings")
    given: dict[str, Any] = OmegaConf.to_container(settings, resolve=True)
    try:
        kind.model_validate(given)
    except ValidationError as error:
        problems: dict[str, str] = {}
        for found in error.errors(include_url=False):
            name, *inner = found["loc"]
            message = found["msg"].replace("Input", "it")
            if inner and isinstance(inner[0], int):
                message = f"element {inner[0]}: {message}"
            problems[name] = (
                f"{problems[name]}, or {message}" if name in problems else message
            )
        raise ValueError(
            "; ".join(
                f"{group}.{name} is {given[name]!r}, but {message}"
                if name in given
                else f"{group}.{name} is missing"
                for name, message in problems.items()
            )
        ) from None
