"""The CLIP text encoder of the released model (optional extra `text`); multi-view use needs the empty prompt's
embedding only.
"""

import os
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

WORDS = 77
"""Every prompt is padded or cut to this many tokens; the padding is attended to, as in training."""


class TextEncoder:
    """CLIP ViT-L/14's text model: prompts to the hidden states after its final norm, in float32."""

    def __init__(self, tokenizer: Any, model: Any):
        self.tokenizer = tokenizer
        self.model = model

    @staticmethod
    def require(folder: str | os.PathLike[str]) -> None:
        """Raises ValueError if the package transformers or the folder is absent; nothing is read, so that it takes no
        time.
        """
        try:
            import transformers  # noqa: F401  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise ValueError(
                "text: prompts need the package transformers, which `pip install 'fillerbuster[text]'` installs."
            ) from error
        if not Path(folder).is_dir():
            raise ValueError(
                "text: expected a folder with the CLIP text model (a clone of openai/clip-vit-large-patch14), got "
                f"{folder}."
            )

    @staticmethod
    def from_folder(folder: str | os.PathLike[str], *, device: torch.device | str = "cpu") -> "TextEncoder":
        """Read tokenizer and text model from a local clone of `openai/clip-vit-large-patch14`; nothing is downloaded.

        Raises ValueError if the package transformers, the folder or its contents are absent.
        """
        TextEncoder.require(folder)
        from transformers import CLIPTextModel, CLIPTokenizer  # pyright: ignore[reportMissingImports]

        try:
            tokenizer = CLIPTokenizer.from_pretrained(folder, local_files_only=True)
            model = CLIPTextModel.from_pretrained(folder, local_files_only=True, use_safetensors=True)
        except (OSError, ValueError, TypeError) as error:
            reason = str(error).strip().splitlines()[0]
            raise ValueError(f"text: {folder} holds no complete CLIP tokenizer and text model ({reason}).") from error
        return TextEncoder(tokenizer, model.to(device).float().eval())

    @torch.no_grad()
    def encode(self, prompts: list[str]) -> Float[Tensor, "b words t"]:
        """Embeddings of prompts, 77 x 768 each for the released model; an empty prompt is a prompt too."""
        tokens = self.tokenizer(prompts, padding="max_length", max_length=WORDS, truncation=True, return_tensors="pt")
        return self.model(tokens.input_ids.to(self.model.device)).last_hidden_state.float()
