"""The optional text encoder: shapes and padding on a tiny random CLIP, and what is said when something is absent."""

import json
import sys
from pathlib import Path

import pytest
import torch

from fb_core.networks.text import TextEncoder


@pytest.fixture
def clip_folder(tmp_path) -> Path:
    """A CLIP text model of two layers with a vocabulary of letters."""
    transformers = pytest.importorskip("transformers", reason="needs the extra `text`")
    letters = [chr(code) for code in range(ord("a"), ord("z") + 1)]
    words = [*letters, *(letter + "</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    (tmp_path / "vocab.json").write_text(json.dumps({word: i for i, word in enumerate(words)}))
    (tmp_path / "merges.txt").write_text("#version: 0.2\n")
    (tmp_path / "tokenizer_config.json").write_text(
        json.dumps({"tokenizer_class": "CLIPTokenizer", "model_max_length": 77})
    )
    config = transformers.CLIPTextConfig(
        vocab_size=len(words),
        hidden_size=16,
        intermediate_size=32,
        num_hidden_layers=2,
        num_attention_heads=2,
        eos_token_id=len(words) - 1,
    )
    torch.manual_seed(0)
    transformers.CLIPTextModel(config).save_pretrained(tmp_path)
    return tmp_path


def test_prompts_are_padded_to_77_words_and_do_not_see_each_other(clip_folder):
    encoder = TextEncoder.from_folder(clip_folder)
    embedding = encoder.encode(["", "a cat", "x " * 200])
    assert embedding.shape == (3, 77, 16) and embedding.dtype == torch.float32
    torch.testing.assert_close(embedding[1], encoder.encode(["a cat"])[0])
    assert (embedding[0] - embedding[1]).abs().max() > 1e-3


def test_an_incomplete_folder_is_refused(clip_folder, tmp_path):
    for file in clip_folder.glob("*.safetensors"):
        file.unlink()
    with pytest.raises(ValueError, match="holds no complete CLIP tokenizer and text model"):
        TextEncoder.from_folder(clip_folder)
    with pytest.raises(ValueError, match="text: expected a folder with the CLIP text model"):
        TextEncoder.from_folder(tmp_path / "nowhere")


def test_without_the_package_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ValueError, match=r"pip install 'fillerbuster\[text\]'"):
        TextEncoder.from_folder(tmp_path)
