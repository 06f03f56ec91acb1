#!/usr/bin/env bash
# torch 2.15.0 on a CPU, seeds of the noise that diffusion models start from.
# Input: seeds that differ by 2^32 and 2^40, as one gets who keeps the seeds of rounds, scenes or samples apart by high
#   bits (hashes and NumPy's SeedSequence give 64 bits, too).
# Expected: other noise for another seed. torch takes any whole number of 64 bits, refuses larger ones, and says the
#   whole number again (initial_seed).
# Seen: the same noise to the last bit; numpy's generator of the same kind (MT19937) reads all bits.
# Met when several samples of one scene came out the same. Way round: seeds that differ in their low 32 bits.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.15.0 numpy==1.26.4
cd "$folder"
venv/bin/python - <<'PYTHON' | tee seen
import numpy
import torch


def noise(seed):
    generator = torch.Generator().manual_seed(seed)
    return generator.initial_seed(), torch.randn(1000, generator=generator)


print("torch", torch.__version__.split("+")[0])
said, first = noise(5)
for seed in (6, 5 + 2**32, 5 + 2**40):
    said, other = noise(seed)
    theirs = [numpy.random.Generator(numpy.random.MT19937(one)).normal(size=1000) for one in (5, seed)]
    print(seed, "says", said, "same noise:", torch.equal(first, other), "numpy:", bool((theirs[0] == theirs[1]).all()))
PYTHON
diff seen - <<'SEEN'
torch 2.15.0
6 says 6 same noise: False numpy: False
4294967301 says 4294967301 same noise: True numpy: False
1099511627781 says 1099511627781 same noise: True numpy: False
SEEN
