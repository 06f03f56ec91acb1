"""A training recipe: three stages (image autoencoder, raymap autoencoder, transformer) that end in one model folder."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn

from fb_core import checkpoint
from fb_core.conditioning import encode_frozen
from fb_core.data.training.folders import Resolution, Wanted, at_resolutions, multi_view_source, training_source
from fb_core.data.training.named_data import TrainingData
from fb_core.data.training.sequences import PoolConfig
from fb_core.data.training.task import Source
from fb_core.files.whole import whole_file
from fb_core.machine.precision import resolved
from fb_core.networks.text import WORDS, TextEncoder
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.networks.vae import VAE, VAEConfig
from fb_core.networks.weights import Network
from fb_core.sampling import SamplingConfig
from fb_core.training.run.checkpoints import Checkpoints, read_state
from fb_core.training.run.distributed import ALONE, Group
from fb_core.training.run.loop import OnProgress, OnSheet, Run
from fb_core.training.run.options import EngineConfig, LoopConfig
from fb_core.training.sample_sheets import UnseenRooms, reconstruction_sheet, room_sheet
from fb_core.training.stages.dit_stage import DiTLossConfig, DiTStage, EncodeText, SharedBatches
from fb_core.training.stages.linear_start import start_linear
from fb_core.training.stages.perceptual import load_lpips
from fb_core.training.stages.vae_stage import VAELossConfig, VAEStage, reconstruction_error

STAGES = ("image-vae", "raymap-vae", "dit")
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Everything that decides a model: architectures, data, losses, optimisation."""

    name: str
    """Name of the preset."""
    image_vae: VAEConfig
    """Architecture of the image autoencoder."""
    raymap_vae: VAEConfig
    """Architecture of the raymap autoencoder."""
    dit: DiTConfig
    """Architecture of the transformer."""
    pool: PoolConfig
    """Rooms that the transformer learns from."""
    vae_pool: PoolConfig
    """Rooms that the autoencoders learn from (single views; fewer will do)."""
    image_vae_loop: LoopConfig
    """Optimisation of the image autoencoder."""
    raymap_vae_loop: LoopConfig
    """Optimisation of the raymap autoencoder."""
    dit_loop: LoopConfig
    """Optimisation of the transformer."""
    image_vae_loss: VAELossConfig = VAELossConfig()
    """Loss of the image autoencoder."""
    raymap_vae_loss: VAELossConfig = VAELossConfig()
    """Loss of the raymap autoencoder."""
    dit_loss: DiTLossConfig = DiTLossConfig()
    """Loss and task of the transformer."""
    sampling: SamplingConfig = SamplingConfig()
    """How the finished model samples best; its folder says so."""
    single_view_share: float = 0.0
    """Share of the steps that show captioned single pictures (paper: 0.5), where such data are named."""
    resolutions: tuple[Resolution, ...] = ()
    """Image sizes of the transformer's last steps, each of which has one of them; none = one size throughout."""
    resolutions_from: int = 0
    """Step at which they begin."""
    data: TrainingData = TrainingData()
    """Where the data lie; rooms by default."""
    engine: EngineConfig = EngineConfig()
    """How a machine trains it, unless the command says otherwise."""
    seed: int = 0
    """Decides rooms, weights and every draw."""
    start_from: Path | None = None
    """Model folder whose weights the networks begin with; None = fresh ones."""


def run_stage(
    recipe: Recipe,
    stage: str,
    folder: Path,
    *,
    device: torch.device | str = "cpu",
    steps: int | None = None,
    minutes: float = math.inf,
    on_progress: OnProgress | None = None,
    engine: EngineConfig | None = None,
    group: Group = ALONE,
) -> Run:
    """Train one stage in ``folder/stage`` (resuming what is there). The transformer needs both autoencoders of the same
    folder.

    ``engine`` replaces the recipe's. All processes of a group call this, and see the same folder.

    Raises ValueError for an unknown stage, and for a transformer whose autoencoders are not there yet.
    """
    task, loop = make_stage(recipe, stage, folder, device=device)
    loop = loop if steps is None else dataclasses.replace(loop, steps=steps)
    engine = engine or recipe.engine
    on_sheet = make_sheet(recipe, task) if engine.sheet_every else None
    run = Run(task, loop, folder / stage, preset=recipe.name, engine=engine, group=group, on_sheet=on_sheet)
    run.train(on_progress=on_progress if group.is_main else None, minutes=minutes)
    if isinstance(task, VAEStage) and not run.signal:
        averaged = run.averaged_state()
        if group.is_main:
            task.pool.advance(max(0, run.step - 1))  # the pool of a run that was finished already is still empty
            _record_spread(task, averaged, folder / stage)
        group.wait()
    return run


def make_stage(
    recipe: Recipe, stage: str, folder: Path | None, *, device: torch.device | str = "cpu"
) -> tuple[VAEStage | DiTStage, LoopConfig]:
    """A stage with fresh weights and how it is optimised. Without a folder the transformer learns from autoencoders as
    they are born.

    Raises ValueError for unknown stages.
    """
    if stage not in STAGES:
        raise ValueError(f"stage: expected one of {list(STAGES)}, got {stage!r}")
    if stage != "dit":
        return _vae_stage(recipe, stage, device)
    image_vae, raymap_vae = (
        _new_vae(recipe, kind).to(device) if folder is None else trained_vae(recipe, kind, folder, device)
        for kind in STAGES[:2]
    )
    encode_text = _encode_text(recipe, device, stands_in=folder is None) if recipe.dit.text_width else None
    return dit_stage(recipe, image_vae, raymap_vae, device=device, encode_text=encode_text), recipe.dit_loop


def dit_stage(
    recipe: Recipe,
    image_vae: VAE,
    raymap_vae: VAE,
    *,
    device: torch.device | str = "cpu",
    encode_text: EncodeText | None = None,
    source: Source | None = None,
    shared: SharedBatches | None = None,
) -> DiTStage:
    """The transformer with fresh weights between finished autoencoders; ``source`` and ``shared`` where trainings share
    their data.
    """
    network = DiT(recipe.dit).initialize(torch.Generator().manual_seed(recipe.seed))
    return DiTStage(
        _begun(network, recipe, "transformer").to(device),
        image_vae=image_vae,
        raymap_vae=raymap_vae,
        pool=sequences_of(recipe, image_vae, device) if source is None else source,
        config=recipe.dit_loss,
        seed=recipe.seed,
        encode_text=encode_text,
        shared=shared,
        encoding=resolved(recipe.engine.precision, device),
    )


def sequences_of(recipe: Recipe, image_vae: VAE, device: torch.device | str = "cpu") -> Source:
    """The transformer's data: at one size, and from some step on at one of several in each step."""
    precision = resolved(recipe.engine.precision, device)
    wanted = Wanted(
        data=recipe.data,
        pool=recipe.pool,
        single_share=recipe.single_view_share,
        seed=recipe.seed + 1,
        device=device,
        encode=lambda images: encode_frozen(image_vae, images, 64, precision),
    )
    source = training_source(wanted, per_row=recipe.dit_loss.images_per_row)
    if not recipe.resolutions:
        return source
    sizes = ", ".join(str(one.image_size) for one in recipe.resolutions)
    _logger.info("views of %s pixels in turn from step %d on", sizes, recipe.resolutions_from)
    return at_resolutions(source, recipe.resolutions, wanted, from_step=recipe.resolutions_from)


def _encode_text(recipe: Recipe, device: torch.device | str, *, stands_in: bool) -> EncodeText:
    """Embeddings of captions; zeros in a trial run without the text model."""
    if stands_in and recipe.data.text_encoder is None:
        return lambda texts: torch.zeros(len(texts), WORDS, recipe.dit.text_width or 0, device=device)
    return _text_encoder(recipe, device).encode


def require_text_encoder(recipe: Recipe) -> None:
    """Raises ValueError where a preset that reads text was given no folder for it, or one that is none; weights are not
    read.
    """
    if recipe.data.text_encoder is None:
        raise ValueError(
            f"preset {recipe.name!r} reads text: give a folder with the CLIP text model (a clone of "
            "openai/clip-vit-large-patch14), "
            "or choose a preset without text"
        )
    TextEncoder.require(recipe.data.text_encoder)


def _text_encoder(recipe: Recipe, device: torch.device | str) -> TextEncoder:
    require_text_encoder(recipe)
    assert recipe.data.text_encoder is not None
    return TextEncoder.from_folder(recipe.data.text_encoder, device=device)


def make_sheet(recipe: Recipe, task: VAEStage | DiTStage) -> OnSheet:
    """What draws a stage's sample sheets: an unseen room, reconstructed by an autoencoder or completed by the
    transformer.
    """
    rooms = UnseenRooms(family=recipe.pool.families[-1], views=recipe.dit_loss.task.views, size=recipe.pool.image_size)
    if isinstance(task, VAEStage):
        return reconstruction_sheet(task.network.config, rooms, device=_device_of(task))
    vaes = {"image_vae": task.image_vae, "raymap_vae": task.raymap_vae}
    return room_sheet(recipe.dit, rooms, **vaes, sampling=recipe.sampling, device=_device_of(task))


def _device_of(task: VAEStage | DiTStage) -> torch.device:
    return next(task.network.parameters()).device


def _vae_stage(recipe: Recipe, kind: str, device: torch.device | str) -> tuple[VAEStage, LoopConfig]:
    loss, loop = {
        "image-vae": (recipe.image_vae_loss, recipe.image_vae_loop),
        "raymap-vae": (recipe.raymap_vae_loss, recipe.raymap_vae_loop),
    }[kind]
    perceptual = None
    if kind == "image-vae":  # learns from all data; raymaps come from multi-view data alone (paper)
        share = recipe.single_view_share
        wanted = Wanted(data=recipe.data, pool=recipe.vae_pool, single_share=share, seed=recipe.seed + 1, device=device)
        pool = training_source(wanted, per_row=1)
        if loss.perceptual and recipe.data.lpips is not None:
            perceptual = load_lpips(recipe.data.lpips).to(device)
        elif loss.perceptual:
            _logger.warning("the perceptual loss is left out: no file with the weights of LPIPS's backbone was named")
    else:
        pool = multi_view_source(recipe.data, recipe.vae_pool, with_images=False, seed=recipe.seed + 1, device=device)
    return VAEStage(
        _new_vae(recipe, kind).to(device), pool, kind=kind, config=loss, seed=recipe.seed, perceptual=perceptual
    ), loop


def _new_vae(recipe: Recipe, kind: str) -> VAE:
    config = recipe.image_vae if kind == "image-vae" else recipe.raymap_vae
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        network = VAE(config)
    network = start_linear(network, torch.Generator().manual_seed(recipe.seed)) if config.norm == "none" else network
    return _begun(network, recipe, kind.replace("-", "_"))


def _begun(network: Network, recipe: Recipe, section: str) -> Network:
    """The network with the weights that the recipe starts from, if it does."""
    if recipe.start_from is not None:
        checkpoint.load_section(recipe.start_from, section, network)
    return network


def adopt_autoencoders(recipe: Recipe, folder: Path) -> None:
    """Take both autoencoders of the model that the recipe starts from as finished stages, where there is none yet.

    Raises ValueError for a folder that is no model, or one whose autoencoders are others than the recipe's.
    """
    if recipe.start_from is None:
        return
    config, info = checkpoint.read_config(recipe.start_from)
    records = {record.get("stage"): record for record in info.get("training", [])}
    for kind, loop in zip(STAGES[:2], (recipe.image_vae_loop, recipe.raymap_vae_loop), strict=True):
        target = folder / kind
        if (target / "spread.json").exists():
            continue
        network, record = _new_vae(recipe, kind), records.get(kind, {})
        theirs = config.image_vae if kind == "image-vae" else config.raymap_vae
        state = {"stage": kind, "preset": recipe.name, "step": loop.steps, "average": network.state_dict()}
        state |= {"seconds": record.get("seconds", 0), "smoothed": record.get("losses", {})}
        target.mkdir(parents=True, exist_ok=True)
        Checkpoints(target, keep=1).write(state)
        _finish_vae(target, record.get("reconstruction", {}) | {"scaling": theirs.scaling})


def trained_vae(recipe: Recipe, kind: str, folder: Path, device: torch.device | str = "cpu") -> VAE:
    """The averaged weights of an autoencoder stage, scaled so that its latents have unit variance (flow matching starts
    from N(0, 1)).
    """
    network, _ = _trained_vae(recipe, kind, folder)
    return network.to(device).eval().requires_grad_(False)


def _trained_vae(recipe: Recipe, kind: str, folder: Path) -> tuple[VAE, dict]:
    config = recipe.image_vae if kind == "image-vae" else recipe.raymap_vae
    spread = folder / kind / "spread.json"
    if not spread.exists():
        raise ValueError(
            f"stage {kind!r} of preset {recipe.name!r} is not finished ({spread} is missing); train that stage first"
        )
    network = VAE(dataclasses.replace(config, scaling=json.loads(spread.read_text())["scaling"]))
    return network, _load_average(network, folder / kind, recipe.name, kind)


@torch.no_grad()
def _record_spread(task: VAEStage, averaged: dict, folder: Path) -> None:
    """Write the scaling that gives the trained latents unit variance, and how well the autoencoder reconstructs."""
    task.network.load_state_dict(averaged)
    task.network.eval()
    values = torch.cat([task.values(-1 - k, range(task.batch)) for k in range(16)])
    mean, _ = task.network.posterior(values)
    rows = {"scaling": 1.0 / float(mean.std()), "views": len(values), **reconstruction_error(task.network, values)}
    _finish_vae(folder, rows)


def _finish_vae(folder: Path, spread: dict[str, float]) -> None:
    """The file of scaling and reconstruction, whose being there says that an autoencoder's stage is finished."""
    with whole_file(folder / "spread.json") as unfinished:
        unfinished.write_text(json.dumps(spread, indent=1) + "\n")


def export(recipe: Recipe, folder: Path, output: Path, *, dtype: torch.dtype = torch.float32) -> None:
    """Write the averaged weights of all three stages as one model folder with the record of their training."""
    dit = DiT(recipe.dit)
    records = [_load_average(dit, folder / "dit", recipe.name, "dit")]
    vaes = {}
    for kind in STAGES[:2]:
        vaes[kind], record = _trained_vae(recipe, kind, folder)
        records.append(record | {"reconstruction": json.loads((folder / kind / "spread.json").read_text())})
    info = {
        "preset": recipe.name,
        "seed": recipe.seed,
        "image_size": recipe.pool.image_size,
        "views": recipe.dit_loss.task.views,
        "families": list(recipe.pool.families),
        "sampling": _differences(recipe.sampling),
        "training": records,
    }
    if recipe.start_from is not None:
        info["started_from"] = checkpoint.model_hash(recipe.start_from)
    prompt = _text_encoder(recipe, "cpu").encode([""])[0] if recipe.dit.text_width else None
    networks = {"dit": dit, "image_vae": vaes["image-vae"], "raymap_vae": vaes["raymap-vae"]}
    checkpoint.save(output, **networks, info=info, empty_prompt=prompt, dtype=dtype)
    _logger.info("wrote the model to %s", output)


def _differences(sampling: SamplingConfig) -> dict:
    """The options that are not the defaults."""
    defaults = dataclasses.asdict(SamplingConfig())
    return {name: value for name, value in dataclasses.asdict(sampling).items() if value != defaults[name]}


def _load_average(network: nn.Module, folder: Path, preset: str, stage: str) -> dict:
    path = folder / "checkpoint.pt"
    if not path.exists():
        raise ValueError(
            f"stage {stage!r} of preset {preset!r} is not trained yet ({path} is missing); train that stage first"
        )
    state = read_state(path)
    try:
        network.load_state_dict(state["average"])
        return {"stage": stage, "steps": state["step"], "seconds": round(state["seconds"]), "losses": state["smoothed"]}
    except (KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise ValueError(
            f"{path} holds no finished stage {stage!r} of preset {preset!r} ({' '.join(str(error).split())[:200]}); "
            "train that stage again"
        ) from error
