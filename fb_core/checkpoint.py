"""Model folders: `config.json` (every architectural choice) beside one safetensors file per network; saved whole or not
at all.

`load` builds the networks without allocating them and maps the files into memory, so that a model costs its weights
once. Parameter names are those of the released checkpoints, so `convert` renames nothing.
"""

import dataclasses
import hashlib
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from fb_core.files.json_files import read_json
from fb_core.files.limits import MOST_SIDE, is_finite, require_between, require_model_sizes
from fb_core.files.ownership import MARK_NAME, Target
from fb_core.files.whole import settled, whole_folder
from fb_core.networks.released import read_released
from fb_core.networks.text import TextEncoder
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.networks.vae import VAE, VAEConfig
from fb_core.networks.weights import adopt, require_names, require_shapes, without_weights

FORMAT_VERSION = 1
RELEASED_LICENSE = "CC BY-NC 4.0"
CONFIG_FILE = "config.json"
_REMEDY = (
    "fillerbuster convert makes one of the authors' files (docs/weights.md says where they are), fillerbuster train of "
    "data; without a folder the bundled model is used"
)
PROMPT_FILE = "empty-prompt.safetensors"
PROMPT_KEY = "embedding"
WEIGHT_FILES = {
    "transformer": "transformer.safetensors",
    "image_vae": "image-vae.safetensors",
    "raymap_vae": "raymap-vae.safetensors",
}
"""File of each network, by its section in the configuration."""


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """The architecture of a whole model."""

    transformer: DiTConfig
    """The diffusion transformer."""
    image_vae: VAEConfig
    """The autoencoder of images."""
    raymap_vae: VAEConfig
    """The autoencoder of raymaps."""

    def __post_init__(self) -> None:
        latents = self.image_vae.latent_channels + self.raymap_vae.latent_channels
        expected = {"out_channels": latents, "in_channels": 2 * latents + 2}
        for name, count in expected.items():
            if getattr(self.transformer, name) != count:
                raise ValueError(
                    f"transformer.{name}: expected {count} for autoencoders with {latents} latent channels together, "
                    f"got {getattr(self.transformer, name)}."
                )


_LATER = {"ray_frames", "known_tokens"}
"""Options of the transformer that came after the first model folders: where a folder lacks one it is the default, as
released.
"""


def _told(config: ModelConfig) -> dict[str, Any]:
    """A configuration as its folder tells it: later options only where they are not the default, so that earlier
    versions read the rest.
    """
    sections = dataclasses.asdict(config)
    defaults = dataclasses.asdict(DiTConfig())
    transformer = sections["transformer"]
    sections["transformer"] = {
        name: value for name, value in transformer.items() if name not in _LATER or value != defaults[name]
    }
    return sections


@dataclass(frozen=True, kw_only=True)
class Loaded:
    """A model read from its folder, in evaluation mode."""

    dit: DiT
    image_vae: VAE
    raymap_vae: VAE
    """Always in float32: origins and directions need more than half precision."""
    config: ModelConfig
    info: dict[str, Any] = field(default_factory=dict)
    """How the model came to be: training command, seed, loss, source, licence; free of form."""
    empty_prompt: Float[Tensor, "words t"] | None = None
    """Text embedding of the empty prompt, where the folder has one."""


def model_target(folder: str | os.PathLike[str], *, overwrite: bool, inputs: tuple[Path, ...] = ()) -> Target:
    """A model folder that is to be written; earlier ones are known by their mark, or by holding a model and nothing
    else.
    """
    return Target(folder=Path(folder), kind="model", overwrite=overwrite, inputs=inputs, earlier=_is_model)


def save(
    folder: str | os.PathLike[str] | Target,
    *,
    dit: DiT,
    image_vae: VAE,
    raymap_vae: VAE,
    info: dict[str, Any] | None = None,
    empty_prompt: Float[Tensor, "words t"] | None = None,
    dtype: torch.dtype | None = None,
) -> Path:
    """Write a model folder, replacing an earlier model there only once the new one is complete; returns the folder.

    `dtype` converts the transformer and the image autoencoder (None keeps theirs); the raymap autoencoder is stored in
    float32. `info` must be JSON. Raises ValueError if the folder holds anything that is not a model, and CannotWrite
    when the disk is full.
    """
    target = folder if isinstance(folder, Target) else model_target(folder, overwrite=True)
    require_model_or_free(target)
    config = ModelConfig(transformer=dit.config, image_vae=image_vae.config, raymap_vae=raymap_vae.config)
    try:
        content = {"format_version": FORMAT_VERSION, **_told(config), "info": info or {}}
        text = json.dumps(content, indent=2, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"info: expected values that JSON can hold (no NaN, no tensors), but {error}.") from error
    with whole_folder(target) as unfinished:
        modules: dict[str, nn.Module] = {"transformer": dit, "image_vae": image_vae, "raymap_vae": raymap_vae}
        for section, file in WEIGHT_FILES.items():
            stored = torch.float32 if section == "raymap_vae" else dtype
            state = modules[section].state_dict()
            save_file(
                {name: value.to(device="cpu", dtype=stored).contiguous() for name, value in state.items()},
                unfinished / file,
            )
        if empty_prompt is not None:
            save_file({PROMPT_KEY: empty_prompt.detach().float().cpu().contiguous()}, unfinished / PROMPT_FILE)
        (unfinished / CONFIG_FILE).write_text(text + "\n", encoding="utf-8")
    return target.folder.resolve()


def require_model_or_free(target: Target) -> None:
    """Raises ValueError for a folder that a model must not replace: also for a model among other files."""
    folder = settled(target.folder)
    if folder.exists() and not folder.is_symlink():
        _refuse_foreign(folder)
    target.check()


def _refuse_foreign(folder: Path) -> None:
    if not folder.is_dir():
        raise ValueError(f"folder: expected a model folder or a new one, but {folder} is a file.")
    foreign = sorted(
        {entry.name for entry in folder.iterdir()} - {CONFIG_FILE, PROMPT_FILE, MARK_NAME, *WEIGHT_FILES.values()}
    )
    if foreign:
        raise ValueError(
            f"folder: {folder} holds {foreign[0]!r}, which is not part of a model; choose an empty or new folder."
        )


def _is_model(folder: Path) -> bool:
    """Whether a folder without a mark has a configuration of ours; other programs write files called config.json,
    too.
    """
    try:
        config = read_json(folder / CONFIG_FILE)
    except (OSError, ValueError):
        return False
    return isinstance(config, dict) and {"format_version", "transformer", "image_vae", "raymap_vae"} <= set(config)


def load(
    folder: str | os.PathLike[str], *, device: torch.device | str = "cpu", dtype: torch.dtype | None = None
) -> Loaded:
    """Read a model folder onto a device.

    `dtype` converts the transformer and the image autoencoder (None keeps the stored precision); the raymap autoencoder
    is always float32, and beside a transformer in float16 so is the image autoencoder, whose activations would
    overflow. On the CPU, unconverted weights stay mapped files and are shared between processes. Raises ValueError, in
    one sentence that names the culprit, for a missing folder or file, an invalid configuration, weights of another
    architecture, a truncated file, and a precision that the device cannot compute.
    """
    folder = Path(folder)
    config, info = read_config(folder)
    if dtype is not None:
        require_precision(torch.device(device), dtype)
    dit = without_weights(lambda: DiT(config.transformer))
    image_vae = without_weights(lambda: VAE(config.image_vae))
    raymap_vae = without_weights(lambda: VAE(config.raymap_vae))
    _load_weights(dit, folder / WEIGHT_FILES["transformer"], device, dtype)
    _load_weights(image_vae, folder / WEIGHT_FILES["image_vae"], device, dtype and autoencoder_dtype(dtype))
    _load_weights(raymap_vae, folder / WEIGHT_FILES["raymap_vae"], device, torch.float32)
    prompt = folder / PROMPT_FILE
    embedding = _read_prompt(prompt, device) if prompt.exists() else None
    return Loaded(dit=dit, image_vae=image_vae, raymap_vae=raymap_vae, config=config, info=info, empty_prompt=embedding)


def read_config(folder: str | os.PathLike[str]) -> tuple[ModelConfig, dict[str, Any]]:
    """Architecture and info of a model folder, without touching its weights. Raises ValueError as `load` does."""
    path = settled(Path(folder)) / CONFIG_FILE
    if not path.parent.is_dir():
        raise ValueError(f"folder: expected a model folder, but there is no folder {path.parent}; {_REMEDY}")
    if not path.is_file():
        raise ValueError(f"folder: {path.parent} is not a model folder because it has no {CONFIG_FILE}; {_REMEDY}")
    try:
        content = read_json(path)
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON, but {error}.") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a JSON object, got {type(content).__name__}.")
    version = content.pop("format_version", None)
    if version != FORMAT_VERSION:
        raise ValueError(f"{path}: expected format_version {FORMAT_VERSION}, got {version}; this may be a newer model.")
    info = content.pop("info", {})
    if not isinstance(info, dict) or not isinstance(info.get("sampling", {}), dict):
        raise ValueError(f"{path}: expected info, and sampling in it, to be objects; remove what is not.")
    require_names(str(path), WEIGHT_FILES, content)
    sections: dict[str, Any] = {}
    for name, kind in (("transformer", DiTConfig), ("image_vae", VAEConfig), ("raymap_vae", VAEConfig)):
        if not isinstance(content[name], dict):
            raise ValueError(f"{path}: expected section {name!r} to be an object, got {content[name]!r}.")
        expected = {f.name for f in dataclasses.fields(kind)}
        require_names(f"{path}, section {name!r}", expected, content[name].keys() | (_LATER & expected))
        try:
            require_model_sizes(content[name])  # before anything is built by them
            choices: dict[str, Any] = {
                key: tuple(value) if isinstance(value, list) else value for key, value in content[name].items()
            }
            sections[name] = kind(**choices)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}, section {name!r}: {error}") from error
    try:
        return ModelConfig(**sections), info
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def image_size_of(info: dict[str, Any]) -> int:
    """Side in pixels of the views that a model was trained at, by its info; 256 where that does not say. ValueError for
    nonsense.
    """
    size = info.get("image_size", 256)
    if not is_finite(size) or size % 1:
        raise ValueError(f"model: expected a whole number of pixels for image_size, got {size!r}; correct config.json")
    require_between("model: image_size", size, 16, MOST_SIDE)
    return int(size)


def _open(path: Path, device: torch.device | str):
    if not path.is_file():
        raise ValueError(f"folder: {path.parent} is incomplete because it has no {path.name}.")
    try:
        return safe_open(path, framework="pt", device=str(device))
    except SafetensorError as error:
        raise ValueError(f"{path}: truncated, or not a safetensors file ({error}).") from error


def load_section(folder: str | os.PathLike[str], section: str, network: nn.Module) -> None:
    """Give a network the weights of one section ("transformer", "image_vae" or "raymap_vae") of a model folder, in its
    own precision.

    Raises ValueError, in one sentence, for a folder that is no model and for weights that do not fit.
    """
    path = Path(folder) / WEIGHT_FILES[section]
    read_config(Path(folder))
    with _open(path, "cpu") as file:
        names = list(file.keys())
        require_shapes(str(path), network, {name: tuple(file.get_slice(name).get_shape()) for name in names})
        network.load_state_dict({name: file.get_tensor(name) for name in names})


def _read_prompt(path: Path, device: torch.device | str) -> Tensor:
    with _open(path, device) as file:
        require_names(str(path), [PROMPT_KEY], file.keys())
        return file.get_tensor(PROMPT_KEY)


def _load_weights(module: nn.Module, path: Path, device: torch.device | str, dtype: torch.dtype | None) -> None:
    """Give a module without weights the tensors of a file; only a conversion copies, one tensor at a time."""
    with _open(path, device) as file:
        names = list(file.keys())
        require_shapes(str(path), module, {name: tuple(file.get_slice(name).get_shape()) for name in names})
        adopt(str(path), module, {name: file.get_tensor(name).to(dtype=dtype) for name in names})


def require_precision(device: torch.device, dtype: torch.dtype) -> None:
    """Raises ValueError for a type that is no floating-point type, or that the device does not compute in."""
    if not dtype.is_floating_point:
        raise ValueError(f"dtype: expected a floating point type, got {dtype}.")
    if device.type == "cpu" and dtype == torch.float16:
        raise ValueError(
            "dtype: float16 is not offered on the CPU, where it is slow and overflows; use bfloat16 or float32."
        )


def autoencoder_dtype(dtype: torch.dtype) -> torch.dtype:
    """Precision of the image autoencoder beside a transformer of `dtype`: activations of float16 would overflow, so it
    stays float32.
    """
    return torch.float32 if dtype == torch.float16 else dtype


def model_hash(folder: str | os.PathLike[str]) -> str:
    """Sixteen hexadecimal digits that stand for a model's architecture and stored weights; its info does not count.
    Raises ValueError for a folder that lacks a file.
    """
    folder = Path(folder)
    config, _ = read_config(folder)
    digest = hashlib.sha256(json.dumps(dataclasses.asdict(config), sort_keys=True).encode())
    for name in (*WEIGHT_FILES.values(), PROMPT_FILE):
        path = folder / name
        if name == PROMPT_FILE and not path.exists():
            continue
        if not path.is_file():
            raise ValueError(f"folder: {folder} is incomplete because it has no {name}.")
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()[:16]


def convert(
    checkpoints: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    dtype: torch.dtype | None = None,
    text_encoder: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
) -> Path:
    """Turn the folder of released `.ckpt` files into a model folder; returns it.

    `text_encoder` is a folder with the CLIP text model; with it, the embedding of the empty prompt is stored too, and
    multi-view use needs CLIP no more. `overwrite` replaces an earlier model. Raises ValueError as
    `networks.released.read_released` and `save` do.
    """
    inputs = tuple(Path(given) for given in (checkpoints, text_encoder) if given is not None)
    target = model_target(output, overwrite=overwrite, inputs=inputs)
    require_model_or_free(target)  # before gigabytes are read
    released = read_released(checkpoints)
    prompt = None
    if text_encoder is not None:
        prompt = TextEncoder.from_folder(text_encoder).encode([""])[0]
    info = {"source": "converted from the authors' released checkpoints", "license": RELEASED_LICENSE}
    return save(
        target,
        dit=released.dit,
        image_vae=released.image_vae,
        raymap_vae=released.raymap_vae,
        info=info,
        empty_prompt=prompt,
        dtype=dtype,
    )
