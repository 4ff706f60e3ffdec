"""Keeps one output folder to one set of settings."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, OmegaConf


def keep_settings(cfg: DictConfig, section: str, folder: Path | None = None) -> None:
    """Writes a section of the configuration beside its results, or compares with it.

    Raises:
        ValueError: the folder's results were made with other settings.
    """
    folder = Path(cfg.out) if folder is None else folder
    path = folder / f"{section}.yaml"
    text = OmegaConf.to_yaml(cfg[section])
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    elif path.read_text() != text:
        raise ValueError(
            f"{folder} holds results of other settings, see {path}: delete the folder, "
            "or give another one with out=..."
        )
