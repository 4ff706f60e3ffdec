"""Saving and loading world models, whose arguments are saved with the weights."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, TypeVar

from torch import nn

from torchrl_caiac._keys import key_from_json
from torchrl_caiac.entities import EntityLayout

__all__ = ["SavedModel"]

_Model = TypeVar("_Model", bound="SavedModel")


class SavedModel(nn.Module):
    """A world model whose ``state_dict`` has its arguments.

    Attributes:
        fitted (bool): whether the scale of the targets is known.
        floor_reasons (dict of str to str): how the variance floor was found.
    """

    layout: EntityLayout
    fitted: bool
    floor_reasons: dict[str, str]

    @property
    def config(self) -> dict[str, Any]:
        """The class of the model and its arguments, JSON-compatible."""
        raise NotImplementedError(f"{type(self).__name__} has no config")

    @classmethod
    def from_config(cls: type[_Model], config: Mapping[str, Any]) -> _Model:
        """Creates an untrained model with the arguments of another.

        Args:
            config (Mapping): the :attr:`config` of a model of this class.

        Returns:
            EntityDynamicsModel: the model.

        Raises:
            ValueError: the config is that of another class.

        Examples:
            >>> from torchrl_caiac import EntityLayout
            >>> from torchrl_caiac.modules import GaussianWorldModel
            >>> model = GaussianWorldModel(EntityLayout({"arm": [0, 1]}), 2, (8,))
            >>> twin = GaussianWorldModel.from_config(model.config)
            >>> twin.load_state_dict(model.state_dict())
            <All keys matched successfully>
        """
        kwargs = dict(config)
        named = kwargs.pop("class", None)
        if named != cls.__name__:
            raise ValueError(
                f"expected the config of a {cls.__name__}, got that of a {named}: call "
                f"{named}.from_config"
            )
        kwargs["layout"] = EntityLayout.from_dict(kwargs["layout"])
        kwargs["action_key"] = key_from_json(kwargs["action_key"])
        kwargs["out_keys"] = [key_from_json(key) for key in kwargs["out_keys"]]
        return cls(**kwargs)

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the part of ``state_dict`` that is not a tensor."""
        return {
            "config": json.dumps(self.config),
            "fitted": self.fitted,
            "floor_reasons": dict(self.floor_reasons),
        }

    def set_extra_state(self, state: Any) -> None:
        """Restores the output of :meth:`get_extra_state`."""
        self.fitted = bool(state["fitted"])
        self.floor_reasons = dict(state.get("floor_reasons", {}))

    def _load_from_state_dict(
        self, state_dict: Any, prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        # Compared before any tensor is copied, so that an error changes nothing.
        extra = state_dict.get(f"{prefix}_extra_state")
        if extra is not None:
            found = json.loads(extra["config"])
            own = json.loads(json.dumps(self.config))
            for name in {**own, **found}:
                value = own.get(name)
                if found.get(name) == value:
                    continue
                where = ""
                if name == "layout":
                    saved = found[name]
                    where = (
                        " (its "
                        + ", ".join(
                            key
                            for key in {**value, **saved}
                            if value.get(key) != saved.get(key)
                        )
                        + ")"
                    )
                    found[name] = EntityLayout.from_dict(saved)
                    value = self.layout
                raise ValueError(
                    f"the saved world model has another {name}{where}, saved:\n"
                    f"{found.get(name)}\nthis model:\n{value}\nCreate the model with "
                    f"the saved arguments ({found['class']}.from_config)"
                )
            if f"{prefix}action_low" not in state_dict:
                raise ValueError(
                    "the saved world model is of an earlier version, which did not "
                    "record the bounds of the actions: fit it again"
                )
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
