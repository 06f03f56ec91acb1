"""Model folders: what is saved comes back, whole or not at all, and every damaged folder is told apart in one
sentence.
"""

import copy
import json
import os
import pickle
from pathlib import Path

import jaxtyping
import pytest
import torch
from safetensors.torch import load_file, save_file

import fb_core.checkpoint as checkpoint
from fb_core.checkpoint import convert, load, model_hash, read_config, save
from fb_core.networks.released import STATE_KEYS, read_released
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.networks.vae import VAE, VAEConfig

INFO = {"command": "train rooms-tiny", "seed": 3, "loss": [0.5, 0.25]}


@pytest.fixture(scope="module")
def networks() -> dict[str, torch.nn.Module]:
    """A complete tiny model."""
    torch.manual_seed(0)
    vae = {"widths": (4, 4, 8, 8), "latent_channels": 2, "encoder_resnets": 1, "decoder_resnets": 1}
    return {
        "dit": DiT(
            DiTConfig(heads=2, head_dim=8, depth=2, in_channels=10, out_channels=4, text_width=5, index="fixed")
        ),
        "image_vae": VAE(VAEConfig(norm_groups=2, **vae)),
        "raymap_vae": VAE(VAEConfig(in_channels=6, norm="none", padding="replicate", **vae)),
    }


@pytest.fixture
def folder(tmp_path, networks) -> Path:
    """A fresh model folder; a test may damage it."""
    return save(tmp_path / "model", info=INFO, empty_prompt=torch.arange(15.0).reshape(3, 5), **networks)


def same(a: torch.nn.Module, b: torch.nn.Module) -> bool:
    """Equal names and values."""
    one, two = a.state_dict(), b.state_dict()
    return one.keys() == two.keys() and all(torch.equal(one[name], two[name]) for name in one)


def edit_config(folder: Path, **changes) -> None:
    """Change top-level entries of config.json; None removes one."""
    path = folder / "config.json"
    content = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))


# Round trip ------------------------------------------------------------------------------------------------------


def test_what_is_saved_comes_back(folder, networks):
    loaded = load(folder)
    for name, network in networks.items():
        assert same(getattr(loaded, name), network)
        assert getattr(loaded, name).config == network.config
        assert not getattr(loaded, name).training
    assert loaded.info == INFO
    assert torch.equal(loaded.empty_prompt, torch.arange(15.0).reshape(3, 5))
    assert read_config(folder) == (loaded.config, INFO)
    assert sorted(path.name for path in folder.parent.iterdir()) == ["model"], "nothing is left beside the folder"


def test_a_loaded_model_can_be_trained_and_its_file_stays(folder):
    loaded, before = load(folder), model_hash(folder)
    optimiser = torch.optim.SGD(loaded.image_vae.parameters(), lr=0.1)
    loaded.image_vae.encode(torch.rand(1, 3, 8, 8)).square().sum().backward()
    optimiser.step()
    assert not same(loaded.image_vae, load(folder).image_vae)
    assert model_hash(folder) == before


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_stored_but_never_for_the_raymaps(tmp_path, networks, dtype):
    loaded = load(save(tmp_path / "half", dtype=dtype, **networks))
    assert loaded.dit.dtype == loaded.image_vae.dtype == dtype
    assert loaded.raymap_vae.dtype == torch.float32
    assert same(loaded.dit, copy.deepcopy(networks["dit"]).to(dtype))
    wide = load(tmp_path / "half", dtype=torch.float32)
    assert wide.dit.dtype == torch.float32


def test_precision_is_chosen_at_loading(folder, networks):
    loaded = load(folder, dtype=torch.bfloat16)
    assert loaded.dit.dtype == loaded.image_vae.dtype == torch.bfloat16
    assert same(loaded.raymap_vae, networks["raymap_vae"])


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="needs Linux to see what is mapped")
def test_weights_are_mapped_not_copied(folder):
    loaded = load(folder)
    address = loaded.dit.pos_embed.proj.weight.data_ptr()
    for line in Path("/proc/self/maps").read_text().splitlines():
        start, end = (int(part, 16) for part in line.split()[0].split("-"))
        if start <= address < end:
            assert line.endswith("transformer.safetensors")
            return
    pytest.fail("the weight lies in no mapping")


def test_saving_again_replaces_the_model(folder, networks):
    changed = copy.deepcopy(networks["dit"])
    torch.nn.init.zeros_(changed.pos_embed.proj.bias)
    save(folder, **{**networks, "dit": changed})
    loaded = load(folder)
    assert same(loaded.dit, changed)
    assert loaded.info == {} and loaded.empty_prompt is None


def test_a_failure_while_saving_leaves_the_old_model(folder, networks, monkeypatch):
    before, calls = model_hash(folder), []

    def failing(tensors, path):
        calls.append(path)
        if len(calls) == 2:
            raise OSError("No space left on device")
        save_file(tensors, path)

    monkeypatch.setattr(checkpoint, "save_file", failing)
    with pytest.raises(OSError, match="No space left"):
        save(folder, **networks)
    assert model_hash(folder) == before
    assert sorted(path.name for path in folder.parent.iterdir()) == ["model"]


def test_saving_refuses_what_is_not_a_model_folder(tmp_path, networks):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").touch()
    with pytest.raises(ValueError, match=r"holds 'holiday.jpg', which is not part of a model"):
        save(tmp_path / "photos", **networks)
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="is a file"):
        save(tmp_path / "file", **networks)


def test_info_that_json_cannot_hold_is_refused(tmp_path, networks):
    for info in ({"loss": torch.zeros(1)}, {"loss": float("nan")}):
        with pytest.raises(ValueError, match="info: expected values that JSON can hold"):
            save(tmp_path / "model", info=info, **networks)
    assert not list(tmp_path.iterdir())


def test_networks_that_do_not_belong_together_are_refused(tmp_path, networks):
    other = DiT(DiTConfig(heads=2, head_dim=8, depth=1, in_channels=10, out_channels=3))
    with pytest.raises(ValueError, match=r"transformer.out_channels: expected 4 .* got 3"):
        save(tmp_path / "model", **{**networks, "dit": other})


def test_hash_stands_for_architecture_and_weights(tmp_path, folder, networks):
    copied = save(tmp_path / "copy", empty_prompt=torch.arange(15.0).reshape(3, 5), info={"other": 1}, **networks)
    assert model_hash(copied) == model_hash(folder)
    assert len(model_hash(folder)) == 16
    hashes = {model_hash(folder)}
    hashes.add(model_hash(save(copied, dtype=torch.bfloat16, **networks)))
    nudged = copy.deepcopy(networks["raymap_vae"])
    nudged.quant_conv.bias.data[0] += 1e-6
    hashes.add(model_hash(save(copied, **{**networks, "raymap_vae": nudged})))
    edit = json.loads((copied / "config.json").read_text())["transformer"] | {"index": "none"}
    edit_config(copied, transformer=edit)
    hashes.add(model_hash(copied))
    assert len(hashes) == 4


# Damaged folders -------------------------------------------------------------------------------------------------


def test_no_such_folder(tmp_path):
    with pytest.raises(ValueError, match=r"there is no folder .*nowhere; fillerbuster convert makes one"):
        load(tmp_path / "nowhere")


def test_a_folder_without_config(tmp_path):
    with pytest.raises(ValueError, match=r"is not a model folder because it has no config.json"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "expected JSON, but"),
        ("\x80", "format_version|expected JSON"),
        ("[1]", "expected a JSON object, got list"),
        ("{}", "expected format_version 1, got None"),
        ('{"format_version": 2}', "expected format_version 1, got 2"),
    ],
)
def test_a_config_that_is_no_config(folder, text, message):
    (folder / "config.json").write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=message):
        load(folder)


def test_config_with_missing_unknown_and_impossible_entries(folder, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # users run without the tests' type checks
    original = json.loads((folder / "config.json").read_text())
    cases = [
        ({"raymap_vae": None}, "got missing raymap_vae"),
        ({"upsampler": {}}, "got unknown upsampler"),
        ({"transformer": 7}, "section 'transformer' to be an object, got 7"),
        ({"transformer": original["transformer"] | {"rope": True}}, "section 'transformer': .* got unknown rope"),
        (
            {"transformer": original["transformer"] | {"depth": -1}},
            "section 'transformer': depth: expected a positive integer, got -1",
        ),
        ({"transformer": original["transformer"] | {"out_channels": 9}}, "transformer.out_channels: expected 4"),
        ({"image_vae": original["image_vae"] | {"widths": [4, 4]}}, "section 'image_vae': widths: expected 4"),
    ]
    for changes, message in cases:
        (folder / "config.json").write_text(json.dumps(original))
        edit_config(folder, **changes)
        with pytest.raises(ValueError, match=message):
            load(folder)


def test_missing_weights_file(folder):
    (folder / "image-vae.safetensors").unlink()
    for read in (load, model_hash):
        with pytest.raises(ValueError, match=r"is incomplete because it has no image-vae.safetensors"):
            read(folder)


@pytest.mark.parametrize("keep", [0, 4, 300, -1])
def test_truncated_weights(folder, keep):
    path = folder / "transformer.safetensors"
    content = path.read_bytes()
    path.write_bytes(content[:keep])
    with pytest.raises(ValueError, match=r"transformer.safetensors: truncated, or not a safetensors file"):
        load(folder)


def test_weights_with_unknown_missing_and_misshapen_keys(folder):
    path = folder / "transformer.safetensors"
    original = load_file(path)
    bias = "proj_out_2.bias"
    cases = [
        ({name: value for name, value in original.items() if name != bias}, f"got missing {bias}"),
        (original | {"extra.weight": torch.zeros(1)}, "got unknown extra.weight"),
        (original | {bias: torch.zeros(3)}, rf"expected {bias} of shape \[16\], got \[3\]"),
    ]
    for tensors, message in cases:
        save_file(tensors, path)
        with pytest.raises(ValueError, match=message):
            load(folder)


def test_beside_float16_the_autoencoders_stay_in_float32(folder, monkeypatch):
    monkeypatch.setattr(checkpoint, "require_precision", lambda device, dtype: None)  # as on a GPU
    loaded = load(folder, dtype=torch.float16)
    assert loaded.dit.dtype == torch.float16
    assert loaded.image_vae.dtype == loaded.raymap_vae.dtype == torch.float32


def test_precisions_that_cannot_be_computed(folder):
    with pytest.raises(ValueError, match="float16 is not offered on the CPU"):
        load(folder, dtype=torch.float16)
    with pytest.raises(ValueError, match="expected a floating point type"):
        load(folder, dtype=torch.int8)


# Released files --------------------------------------------------------------------------------------------------


@pytest.fixture
def released(tmp_path, networks) -> Path:
    """Released-style files of a tiny model, with a trainer's extras and a wrapper's prefix."""
    root = tmp_path / "checkpoints"
    root.mkdir()
    torch.manual_seed(1)
    dit = DiT(DiTConfig(heads=2, head_dim=8, depth=3, text_width=5))
    image = VAE(VAEConfig(widths=(32, 32, 64, 64)))
    rays = VAE(VAEConfig(in_channels=6, widths=(4, 4, 8, 8), norm="none", padding="replicate"))
    extras = {"global_step": 5, "global_seed": 0, "optimizer_state_dict": {"state": {0: {"exp_avg": torch.zeros(3)}}}}
    for (file, key), network, prefix in zip(
        STATE_KEYS.items(), (dit, image, rays), ("module.", "model.", "module.model."), strict=True
    ):
        torch.save({key: {prefix + name: value for name, value in network.state_dict().items()}, **extras}, root / file)
    return root


def test_conversion_infers_all_sizes(released, tmp_path):
    original, loaded = read_released(released), load(convert(released, tmp_path / "converted"))
    assert loaded.dit.config == DiTConfig(heads=2, head_dim=8, depth=3, text_width=5)
    assert loaded.image_vae.config == VAEConfig(widths=(32, 32, 64, 64))
    assert loaded.raymap_vae.config == VAEConfig(in_channels=6, widths=(4, 4, 8, 8), norm="none", padding="replicate")
    assert (
        same(loaded.dit, original.dit)
        and same(loaded.image_vae, original.image_vae)
        and same(loaded.raymap_vae, original.raymap_vae)
    )
    assert loaded.info["license"] == "CC BY-NC 4.0"


def test_conversion_of_the_golden_files_is_exact(shared_path, tmp_path):
    source = shared_path("golden/reference/transformer.ckpt").parent
    loaded = load(convert(source, tmp_path / "converted"))
    state = torch.load(source / "transformer.ckpt", weights_only=True)["transformer_state_dict"]
    assert all(torch.equal(loaded.dit.state_dict()[name], value) for name, value in state.items())
    assert load(convert(source, tmp_path / "half", dtype=torch.bfloat16)).dit.dtype == torch.bfloat16


class Bomb:
    """Pickles to a call that leaves a trace."""

    def __init__(self, trace: Path):
        self.trace = trace

    def __reduce__(self):
        return os.mkdir, (str(self.trace),)


@pytest.mark.parametrize("format", ["torch", "pickle"])
def test_code_in_a_released_file_is_refused_and_never_run(released, tmp_path, format):
    trace, path = tmp_path / "exploded", released / "pose-vae.ckpt"
    content = {"vae_state_dict": {}, "bomb": Bomb(trace)}
    if format == "torch":
        torch.save(content, path)
    else:
        path.write_bytes(pickle.dumps(content))
    with pytest.raises(ValueError, match=r"pose-vae.ckpt: (refused|truncated)"):
        convert(released, tmp_path / "converted")
    assert not trace.exists() and not (tmp_path / "converted").exists()


def test_released_files_that_are_missing_truncated_or_strange(released, tmp_path):
    output, path = tmp_path / "converted", released / "transformer.ckpt"
    content = path.read_bytes()
    original = torch.load(path, weights_only=True)
    state = original["transformer_state_dict"]
    first, last = "module.pos_embed.proj.weight", "module.proj_out_2.weight"
    for change, message in [
        (lambda: path.write_bytes(content[: len(content) // 2]), "transformer.ckpt: truncated"),
        (lambda: path.write_bytes(b""), "transformer.ckpt: truncated"),
        (
            lambda: torch.save({"weights": 1}, path),
            "expected a dictionary with the weights under 'transformer_state_dict', got weights",
        ),
        (lambda: torch.save([1], path), "got list"),
        (
            lambda: torch.save({"transformer_state_dict": {}}, path),
            "another architecture .expected pos_embed.proj.weight .* got none",
        ),
        (
            lambda: torch.save({"transformer_state_dict": state | {"module.rope": torch.zeros(1)}}, path),
            "got unknown rope",
        ),
        (lambda: torch.save({"transformer_state_dict": state | {first: torch.zeros(16)}}, path), r"got shape \[16\]"),
        (
            lambda: torch.save({"transformer_state_dict": {k: v for k, v in state.items() if k != last}}, path),
            "proj_out_2.weight",
        ),
        (
            lambda: torch.save({"transformer_state_dict": state | {last: state[last].long()}}, path),
            "numbers, got int64",
        ),
        (
            lambda: torch.save({"transformer_state_dict": state | {last: state[last].to_sparse()}}, path),
            "got a sparse_coo one",
        ),
        (
            lambda: torch.save({"transformer_state_dict": state | {last: state[last].to(torch.cfloat)}}, path),
            "got complex64",
        ),
        (
            lambda: torch.save({"transformer_state_dict": state | {7: torch.zeros(1)}}, path),
            "names of weights, got the key 7",
        ),
        (
            lambda: torch.save({"transformer_state_dict": state | {("a", 1): torch.zeros(1)}}, path),
            "got the key .'a', 1.",
        ),
        (
            lambda: torch.save({"transformer_state_dict": state | {last[7:]: state[last]}}, path),
            "same name but for wrappers",
        ),
        (
            lambda: torch.save(
                {"transformer_state_dict": state | {first: torch.zeros(1, 1, 1, 1).expand(2**30, 66, 2, 2)}}, path
            ),
            "repeats",
        ),
        (path.unlink, r"has no transformer.ckpt; all of"),
    ]:
        change()
        with pytest.raises(ValueError, match=message):
            convert(released, output)
    with pytest.raises(ValueError, match="there is no folder"):
        convert(tmp_path / "nowhere", output)
    assert not output.exists()
