#!/usr/bin/env bash
# torch 2.15.0 on a CPU, joining tensors inside autocast to bfloat16, as models in half precision are sampled there.
# Input: two tensors of two ones; float16 (weights and latents as they are stored), float32, bfloat16.
# Expected: torch.cat joins two float16 tensors inside the block as it does outside, or brings them to one type, as it
#   does for float32 beside float16.
# Seen: float16 beside float16, and beside bfloat16, is refused ("Unexpected floating ScalarType"); float32 beside
#   float16 is joined.
# Met while a model that is stored in half precision was sampled under autocast. Way round: bring stored tensors to
#   float32 or bfloat16 before they are joined.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.15.0 numpy==1.26.4
cd "$folder"
venv/bin/python - <<'PYTHON' | tee seen
import torch

half, single, brain = (torch.ones(2, dtype=kind) for kind in (torch.float16, torch.float32, torch.bfloat16))
print("torch", torch.__version__.split("+")[0])
print("outside", torch.cat([half, half]).dtype)
with torch.autocast("cpu", dtype=torch.bfloat16):
    for one, other in ((single, half), (brain, brain), (half, half), (brain, half)):
        try:
            print("inside", one.dtype, other.dtype, torch.cat([one, other]).dtype)
        except RuntimeError as error:
            print("inside", one.dtype, other.dtype, "refused:", str(error).split(" in ")[0])
PYTHON
diff seen - <<'SEEN'
torch 2.15.0
outside torch.float16
inside torch.float32 torch.float16 torch.float32
inside torch.bfloat16 torch.bfloat16 torch.bfloat16
inside torch.float16 torch.float16 refused: Unexpected floating ScalarType
inside torch.bfloat16 torch.float16 refused: Unexpected floating ScalarType
SEEN
