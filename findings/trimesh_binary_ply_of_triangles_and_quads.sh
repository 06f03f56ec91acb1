#!/usr/bin/env bash
# trimesh 5.2.0, reading a binary PLY mesh whose faces have different numbers of corners.
# Input: four corners; the faces are a quad and a triangle, in ASCII and in binary little endian. PLY's face lists tell
#   the number of corners of every face, so that they may differ; modelling programs write such files.
# Expected: three triangles from either file, as a quad alone gives two.
# Seen: three from the ASCII file; the binary one is refused ("PLY is unexpected length!"), because every face is taken
#   to be as long as the first one. Faces that are all quads or all triangles are read.
# Met while models were trained on meshes. Way round: write triangles, or ASCII.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check trimesh==5.2.0 numpy==1.26.4
cd "$folder"
venv/bin/python - <<'PYTHON' | tee seen
import io
import struct

import numpy as np
import trimesh

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
HEADER = ["element vertex 4", "property float x", "property float y", "property float z"]


def written(faces, form):
    lines = ["ply", f"format {form} 1.0", *HEADER, f"element face {len(faces)}"]
    start = "\n".join([*lines, "property list uchar int vertex_indices", "end_header", ""]).encode()
    if form == "ascii":
        rows = [*CORNERS.astype(int).tolist(), *([len(face), *face] for face in faces)]
        return start + "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    return start + CORNERS.tobytes() + b"".join(struct.pack(f"<B{len(face)}i", len(face), *face) for face in faces)


print("trimesh", trimesh.__version__)
for name, faces in (("quad", [[0, 1, 2, 3]]), ("quad and triangle", [[0, 1, 2, 3], [0, 1, 2]])):
    for form in ("ascii", "binary_little_endian"):
        try:
            mesh = trimesh.load(io.BytesIO(written(faces, form)), file_type="ply", process=False)
            print(name, form, len(mesh.faces), "triangles")
        except ValueError as error:
            print(name, form, "refused:", error)
PYTHON
diff seen - <<'SEEN'
trimesh 5.2.0
quad ascii 2 triangles
quad binary_little_endian 2 triangles
quad and triangle ascii 3 triangles
quad and triangle binary_little_endian refused: PLY is unexpected length!
SEEN
