#!/usr/bin/env bash
# trimesh 5.2.0, reading a PLY point cloud whose colours are unsigned 16-bit numbers (a scanner's export).
# Input: two points in ASCII, property ushort red, green, blue; the colour is full red, half green, no blue: 65535 32768
#   0.
# Expected: colours of 8 bits that mean the same, 255 128 0, as trimesh gives for the same colour in uchar and in float.
# Seen: 255 0 0: the low byte of each number is kept. Nothing is said.
# Met while a capture's points were read to start splats from. Way round: read the stored numbers from the cloud's
#   metadata.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check trimesh==5.2.0 numpy==1.26.4
cd "$folder"
venv/bin/python - <<'PYTHON' | tee seen
import io

import trimesh

print("trimesh", trimesh.__version__)
for kind, colour in (("uchar", "255 128 0"), ("float", "1.0 0.5 0.0"), ("ushort", "65535 32768 0")):
    lines = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {axis}" for axis in "xyz")]
    lines += [f"property {kind} {name}" for name in ("red", "green", "blue")]
    lines += ["end_header", f"0 0 0 {colour}", f"1 0 0 {colour}", ""]
    cloud = trimesh.load(io.BytesIO("\n".join(lines).encode()), file_type="ply", process=False)
    print(kind, cloud.colors[0][:3].tolist())
PYTHON
diff seen - <<'SEEN'
trimesh 5.2.0
uchar [255, 128, 0]
float [255, 128, 0]
ushort [255, 0, 0]
SEEN
