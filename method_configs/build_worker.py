"""One build of the project that answers another process: completes views that lie in files and says how long that took.

``python build_worker.py`` with a checkout's root on PYTHONPATH; it uses what every version offers, so that builds can be
compared. Each line that it reads names files and options in JSON; each answer is a line that starts with ``ANSWER``.
"""

from __future__ import annotations

import json
import sys
import time

ANSWER = "answer "
"""Begins the lines that are answers; libraries may print others."""


def main() -> None:
    """Answer until there is no more to read."""
    import numpy as np
    import torch

    from fb_core.inpainter import Fillerbuster
    from fb_core.views import Views

    model = Fillerbuster.from_pretrained()
    sampling = model.recommended_sampling
    print(ANSWER + json.dumps({"steps": sampling.steps}), flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        with np.load(asked["views"]) as stored:
            images, raymaps = (torch.from_numpy(stored[name]) for name in ("images", "raymaps"))
        known = torch.ones_like(images[:, :1])
        image_known = known.clone()
        image_known[asked["known"] :] = 0
        views = Views(images=images * image_known, image_known=image_known, raymaps=raymaps, rays_known=known)
        generator = torch.Generator().manual_seed(asked["seed"])
        began, began_cpu = time.perf_counter(), time.process_time()
        answer = model.complete(views, generator=generator, sampling=sampling)
        took = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - began_cpu}
        np.save(asked["answer"], answer.images[asked["known"] :].clamp(0, 1).numpy())
        print(ANSWER + json.dumps(took), flush=True)


if __name__ == "__main__":
    main()
