#!/usr/bin/env bash
# torch 2.15.0 on a CPU, group normalisation (torch.nn.functional.group_norm) in float32, as in the autoencoders of
# latent diffusion, whose weights are often laid out channels last for speed.
# Input: the same [2, 32, 64, 64] random pictures about a mean of 0, 10, 100, contiguous and channels last, 8 groups.
# Expected: the layout of the memory changes the last digits only: both answers as near to the one in float64.
# Seen: channels last the error grows with the square of the mean (variance as the mean of squares less the square of
#   the mean); about a mean of 100 it is thousands of times that of the contiguous layout, 3.5e-2 where the answers have
#   a standard deviation of 1.
# Met when autoencoders were laid out channels last. Way round: only those without group norm are.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.15.0 numpy==1.26.4
cd "$folder"
venv/bin/python - <<'PYTHON' | tee seen
import torch
import torch.nn.functional as F

torch.set_num_threads(1)
print("torch", torch.__version__.split("+")[0])
for mean in (0, 10, 100):
    pictures = torch.randn(2, 32, 64, 64, generator=torch.Generator().manual_seed(0)) + mean
    exact = F.group_norm(pictures.double(), 8)
    plain, last = (
        float((F.group_norm(x, 8).double() - exact).abs().max())
        for x in (pictures, pictures.contiguous(memory_format=torch.channels_last))
    )
    digits = int(torch.tensor(last / plain).log10())
    told = "as exact, nearly" if last < 1e-5 else f"{10**digits} times less exact, or more"
    print(f"mean {mean} | contiguous: error below 1e-4: {plain < 1e-4} | channels last: {told}")
PYTHON
diff - seen <<'EXPECTED'
torch 2.15.0
mean 0 | contiguous: error below 1e-4: True | channels last: as exact, nearly
mean 10 | contiguous: error below 1e-4: True | channels last: 100 times less exact, or more
mean 100 | contiguous: error below 1e-4: True | channels last: 1000 times less exact, or more
EXPECTED
echo "As described: group norm loses digits when the channels are last."
