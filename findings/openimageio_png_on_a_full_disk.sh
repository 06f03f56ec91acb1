#!/usr/bin/env bash
# OpenImageIO 3.0.21.0 (Python wheel), writing a PNG where the device has no room left.
# Input: 600 x 600 pixels of RGB noise, 8 bits; the file is a link to /dev/full, which refuses every byte as a full disk
#   does.
# Expected: write_image or close is false, as their documentation has it for a failure.
# Seen: both are true; only has_error, which callers ask after a false, tells that bytes were lost. The picture is cut
#   short.
# Met while a completed capture was written to a disk that was nearly full. Way round: encode into memory, write the
#   bytes oneself.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check OpenImageIO==3.0.21.0 numpy==1.26.4
ln -s /dev/full "$folder/picture.png"
cd "$folder"
venv/bin/python - <<'PYTHON' | tee seen
import numpy as np
import OpenImageIO as oiio

picture = np.random.default_rng(0).integers(0, 256, (600, 600, 3), dtype=np.uint8)
out = oiio.ImageOutput.create("picture.png")
print("OpenImageIO", oiio.VERSION_STRING)
print("open", out.open("picture.png", oiio.ImageSpec(600, 600, 3, "uint8")))
print("write_image", out.write_image(picture))
print("close", out.close())
print("has_error", out.has_error)
out.geterror()
PYTHON
diff seen - <<'SEEN'
OpenImageIO 3.0.21.0
open True
write_image True
close True
has_error True
SEEN
