"""Reader of the authors' released files: `transformer.ckpt`, `image-vae.ckpt`, `pose-vae.ckpt` in one folder.

The files hold pickled dictionaries, so they are read with PyTorch's restricted unpickler: code in them is refused,
never run. They carry no configuration; sizes are inferred from shapes, and what no shape shows (padding, groups, index
embedding) is as released.
"""

import os
import pickle
import re
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from fb_core.files.limits import require_model_sizes
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.networks.vae import VAE, VAEConfig
from fb_core.networks.weights import adopt, require_plain, without_weights

TRANSFORMER_FILE = "transformer.ckpt"
IMAGE_VAE_FILE = "image-vae.ckpt"
RAYMAP_VAE_FILE = "pose-vae.ckpt"
STATE_KEYS = {
    TRANSFORMER_FILE: "transformer_state_dict",
    IMAGE_VAE_FILE: "vae_state_dict",
    RAYMAP_VAE_FILE: "vae_state_dict",
}
"""Where each file keeps its weights; everything else in it (optimiser, discriminator, counters) is ignored."""

WRAPPERS = re.compile(r"^(module\.|model\.)+")
"""Prefixes that training wrappers left on parameter names."""


class Released(NamedTuple):
    """The released networks, in evaluation mode; their weights are mapped files."""

    dit: DiT
    image_vae: VAE
    raymap_vae: VAE


def read_released(folder: str | os.PathLike[str]) -> Released:
    """Read the three released files of a folder.

    Raises ValueError, in one sentence that names the file, for a missing, truncated or unsafe file and for weights of
    another architecture (naming the keys).
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(
            f"checkpoints: expected a folder with {', '.join(STATE_KEYS)}, but there is no folder {folder}."
        )
    missing = [name for name in STATE_KEYS if not (folder / name).is_file()]
    if missing:
        raise ValueError(
            f"checkpoints: {folder} has no {' and no '.join(missing)}; all of {', '.join(STATE_KEYS)} are needed."
        )
    return Released(
        _transformer(folder / TRANSFORMER_FILE),
        _autoencoder(folder / IMAGE_VAE_FILE, padding="zeros"),
        _autoencoder(folder / RAYMAP_VAE_FILE, padding="replicate"),
    )


def read_state(path: Path, key: str) -> dict[str, Tensor]:
    """The tensors under `key` of a pickled dictionary, mapped into memory, their names free of wrappers' prefixes.
    Raises ValueError for files that are damaged, of another architecture, or hold more than tensors.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        raise ValueError(
            f"{path}: refused, because it holds Python objects other than tensors, which could run code."
        ) from error
    except Exception as error:  # a damaged pickle raises whatever it leads to
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ValueError(f"{path}: truncated, or not a PyTorch checkpoint ({reason:.200}).") from error
    state = content.get(key) if isinstance(content, dict) else None
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        description = ", ".join(map(str, content)) if isinstance(content, dict) else type(content).__name__
        raise ValueError(f"{path}: expected a dictionary with the weights under {key!r}, got {description}.")
    foreign = next((name for name in state if not isinstance(name, str)), None)
    if foreign is not None:
        raise ValueError(
            f"{path}: expected names of weights, got the key {foreign!r:.40}; these are weights of another "
            "architecture."
        )
    tensors = {WRAPPERS.sub("", name): value for name, value in state.items()}
    if len(tensors) < len(state):
        raise ValueError(
            f"{path}: two of its weights have the same name but for wrappers' prefixes (module., model.); save them "
            "once."
        )
    require_plain(str(path), tensors)
    return tensors


def _transformer(path: Path) -> DiT:
    state = read_state(path, STATE_KEYS[TRANSFORMER_FILE])
    dit = without_weights(lambda: DiT(_transformer_config(path, state)))
    adopt(str(path), dit, state)
    return dit


def _autoencoder(path: Path, padding: str) -> VAE:
    state = read_state(path, STATE_KEYS[path.name])
    vae = without_weights(lambda: VAE(_autoencoder_config(path, state, padding)))
    adopt(str(path), vae, state)
    return vae


def _transformer_config(path: Path, state: dict[str, Tensor]) -> DiTConfig:
    width, in_channels, patch, _ = _shape(path, state, "pos_embed.proj.weight", 4)
    (head_dim,) = _shape(path, state, "transformer_blocks.0.attn1.norm_q.weight", 1)
    reads_text = "transformer_blocks.0.attn2.to_k.weight" in state
    return _checked(
        path,
        DiTConfig,
        heads=width // head_dim,
        head_dim=head_dim,
        depth=_count(state, r"transformer_blocks\.(\d+)\."),
        patch=patch,
        in_channels=in_channels,
        out_channels=_shape(path, state, "proj_out_2.weight", 2)[0] // patch**2,
        text_width=_shape(path, state, "transformer_blocks.0.attn2.to_k.weight", 2)[1] if reads_text else 0,
        mlp_ratio=_shape(path, state, "transformer_blocks.0.ff.net.2.weight", 2)[1] // width,
    )


def _autoencoder_config(path: Path, state: dict[str, Tensor], padding: str) -> VAEConfig:
    levels = range(_count(state, r"encoder\.down_blocks\.(\d+)\."))
    return _checked(
        path,
        VAEConfig,
        in_channels=_shape(path, state, "encoder.conv_in.weight", 4)[1],
        widths=tuple(
            _shape(path, state, f"encoder.down_blocks.{level}.resnets.0.conv1.weight", 4)[0] for level in levels
        ),
        latent_channels=_shape(path, state, "post_quant_conv.weight", 4)[0],
        encoder_resnets=_count(state, r"encoder\.down_blocks\.0\.resnets\.(\d+)\."),
        decoder_resnets=_count(state, r"decoder\.up_blocks\.0\.resnets\.(\d+)\."),
        norm="group" if "encoder.conv_norm_out.weight" in state else "none",
        padding=padding,
    )


def _checked(path: Path, kind: type, **sizes: Any) -> Any:
    try:
        require_model_sizes(sizes)
        return kind(**sizes)
    except ValueError as error:
        raise ValueError(f"{path}: these are weights of another architecture ({error})") from error


def _shape(path: Path, state: dict[str, Tensor], name: str, dimensions: int) -> tuple[int, ...]:
    if name not in state or state[name].ndim != dimensions or 0 in state[name].shape:
        got = f"shape {list(state[name].shape)}" if name in state else "none"
        raise ValueError(
            f"{path}: these are weights of another architecture (expected {name} with {dimensions} dimensions, got "
            f"{got})."
        )
    return tuple(state[name].shape)


def _count(state: dict[str, Tensor], pattern: str) -> int:
    """How many numbers the pattern finds at the beginning of names."""
    return len({match.group(1) for match in map(re.compile(pattern).match, state) if match})
