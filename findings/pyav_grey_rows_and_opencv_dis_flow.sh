#!/usr/bin/env bash
# PyAV 18.1.0 and OpenCV 4.10.0.84 (Python wheels), optical flow between two frames of a small film.
# Input: two black frames of 120 x 90 pixels, made grey by PyAV; a film of a phone's preview size.
# Expected: to_ndarray gives an array that OpenCV's functions take, for 120 pixels across as for 128.
# Seen: rows of 120 bytes come with the decoder's padding to 128, a view that is not contiguous; DISOpticalFlow.calc
#   refuses it
# with an assertion (I0.isContinuous()), though other functions of OpenCV take such views. Widths that are multiples of
#   16 work.
# Met while frames of a film were chosen by how far the camera moves. Way round: numpy.ascontiguousarray.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    av==18.1.0 opencv-python-headless==4.10.0.84 numpy==1.26.4
cd "$folder"
venv/bin/python - <<'PYTHON' | tee seen
import av
import cv2
import numpy as np

print("PyAV", av.__version__, "OpenCV", cv2.__version__)
flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
for width in (128, 120):
    frame = av.VideoFrame.from_ndarray(np.zeros((90, width, 3), dtype=np.uint8), format="rgb24")
    grey = frame.reformat(format="gray8").to_ndarray()
    blurred = cv2.blur(grey, (3, 3)).shape
    print(width, "contiguous", grey.flags["C_CONTIGUOUS"], "row bytes", grey.strides[0], "blurred", blurred)
    try:
        print(width, "flow", flow.calc(grey, grey, None).shape)
    except cv2.error as error:
        print(width, "flow refused:", error.err)
PYTHON
diff seen - <<'SEEN'
PyAV 18.1.0 OpenCV 4.10.0
128 contiguous True row bytes 128 blurred (90, 128)
128 flow (90, 128, 2)
120 contiguous False row bytes 128 blurred (90, 120)
120 flow refused: I0.isContinuous()
SEEN
