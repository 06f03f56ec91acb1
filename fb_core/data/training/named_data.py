"""Where the data lie that a person names for a training: plain values, which a command line reads without torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class TrainingData:
    """Where data lie. Without captures and meshes, procedural rooms are the multi-view data."""

    captures: Path | None = None
    """Folder with captures at any depth (each with a transforms.json) to learn from instead of rooms."""
    meshes: Path | None = None
    """Folder with mesh files at any depth to learn from instead of rooms."""
    images: str | None = None
    """WebDataset shards of captioned pictures: a folder, or a pattern such as URL/{0000..9999}.tar."""
    rooms: bool = False
    """Procedural rooms beside captures and meshes."""
    text_encoder: Path | None = None
    """Clone of openai/clip-vit-large-patch14, for presets that read text."""
    lpips: Path | None = None
    """Weights of SqueezeNet 1.1 as torchvision stores them, for the image autoencoder's perceptual loss."""
