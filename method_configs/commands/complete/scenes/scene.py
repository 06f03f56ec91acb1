"""From photos with cameras to a completed scene: splats of the photos, new views where they are needed, and the film
that splats show.

Each stage leaves its result in the folder of the work, and is skipped where it has one: the capture that is trained on,
the run with its checkpoints, the finished splats, and every frame of the film.
"""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.completion.duration import duration_in_words
from fb_core.completion.fly_through import FoundCameras
from fb_core.completion.options import CompletionConfig
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.data import media
from fb_core.data.capture.camera_path import as_camera_path, read_camera_path
from fb_core.data.capture.captures import FrameToWrite, read_capture, write_capture
from fb_core.data.capture.frames import Capture
from fb_core.data.capture.point_cloud import Points
from fb_core.data.capture.points import read_points
from fb_core.data.photos.photo import Photo
from fb_core.files.json_files import read_json
from fb_core.files.whole import whole_file
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.similarity import Similarity
from fb_core.geometry.viewpoints.camera_paths import path_cameras
from fb_core.geometry.viewpoints.paths import strided_subset
from fb_core.machine.devices import chosen_device
from fb_core.memory.budget import GIB
from fb_nerfstudio.splats.backend import BLUR
from fb_nerfstudio.splats.scene_film import FilmFrame, film_frame, seen_by_photos
from fb_nerfstudio.splats.splat_file import Splats, read_splats, write_splats
from method_configs.commands.complete.options import CompleteOptions
from method_configs.commands.complete.output import FilmFiles, NewViews
from method_configs.commands.complete.scenes.scene_budget import SceneBudget, Speed, measured_speed
from method_configs.commands.complete.scenes.scene_training import train_scene

_FEATURES_SIDE = 960  # of photos in which features are sought for the first Gaussians
_BYTES, _BYTES_TRAINED = 4, 500  # for each pixel of the photos, and of the picture that is trained on
_LARGE = 1000.0  # spreads off the origin from which single precision moves Gaussians: the file's world is then shifted
_logger = logging.getLogger(__name__)

OnProgress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class SceneJob:
    """What a scene is made of."""

    photos: Sequence[Photo]
    """Those whose camera is trusted."""
    cameras: Sequence[Pinholes]
    """Theirs, float64, whole pictures at full size."""
    points_path: Path | None
    """The capture's point cloud in the cameras' world, None without one."""
    options: CompleteOptions
    """What is asked for."""
    device: str
    """Where to compute."""
    work: Path
    """Folder that results of stages are kept in."""

    @staticmethod
    def of(
        photos: Sequence[Photo], found: FoundCameras, points_path: Path | None, options: CompleteOptions, work: Path
    ) -> SceneJob:
        """Of the photos whose cameras were found."""
        return SceneJob(
            photos=[photos[index] for index in found.trusted],
            cameras=[found.camera(index).to(torch.float64) for index in found.trusted],
            points_path=points_path,
            options=options,
            device=str(chosen_device(options.device)),
            work=work,
        )

    def path(self, side: int) -> Pinholes:
        """The film's cameras, its longest side so many pixels, of the photos' aspect (or of a camera path's own)."""
        options = self.options
        if options.path.lower().endswith(".json"):
            read = read_camera_path(Path(options.path), size=side)
            cameras = read.cameras[strided_subset(len(read.cameras), options.views)].to(torch.float64)
            return _inside(cameras, read.aspect)
        squares = path_cameras(options.path, list(self.cameras), options.views, size=1000)
        width, height = self.common_size
        scale = side / max(width, height)
        width, height = _even(width * scale), _even(height * scale)
        focal = squares.focal * (min(width, height) / 1000)
        principal = focal.new_tensor([width / 2, height / 2]).expand(len(squares), 2).contiguous()
        return dataclasses.replace(
            squares.to(torch.float64), focal=focal.double(), principal=principal.double(), width=width, height=height
        )

    @property
    def common_size(self) -> tuple[int, int]:
        """(width, height) of most of the photos; of equally frequent ones the larger."""
        sizes = [(camera.width, camera.height) for camera in self.cameras]
        return max(dict.fromkeys(sizes), key=lambda size: (sizes.count(size), size[0] * size[1]))

    @property
    def to_work(self) -> Similarity:
        """To the world that splats are trained in: the cameras' middle is its origin, the farthest coordinate is 1."""
        centers = torch.cat([camera.centers for camera in self.cameras])
        middle = centers.mean(dim=0)
        reach = float((centers - middle).abs().max())
        scale = 1 / reach if reach > 1e-9 * (1 + float(centers.abs().max())) else 1.0
        return Similarity(rotation=torch.eye(3, dtype=torch.float64), scale=scale, shift=-scale * middle)

    @property
    def offset(self) -> Float[Tensor, " 3"]:
        """What is to be added to places in the splats' file: 0, unless the capture lies so far off that single
        precision would move it.
        """
        centers = torch.cat([camera.centers for camera in self.cameras])
        middle = centers.mean(dim=0)
        return (
            middle
            if float(centers.abs().max()) > _LARGE * max(float((centers - middle).abs().max()), 1e-9)
            else torch.zeros_like(middle)
        )


def complete_with_splats(job: SceneJob, *, seconds: float, on_progress: OnProgress) -> tuple[NewViews, dict[str, Any]]:
    """The completed scene and what the report is to say of it.

    Args:
        job: photos and cameras.
        seconds: that are left for it.
        on_progress: told what is being done, how much of it is done, and how much there is.

    Raises ValueError in one sentence for what cannot be trained on.
    """
    budget = _budget(job, seconds)
    _logger.info(announcement_of_scene(job, budget))
    capture = _capture_to_train(job, budget.photo_side)
    budget = dataclasses.replace(
        budget, schedule=dataclasses.replace(budget.schedule, scale=_scale_of(capture, budget.photo_side))
    )
    splats, generated, trust = _trained(job, capture, budget, on_progress)
    film, shares = _film(job, capture, splats, budget, on_progress)
    details = {
        "splats": {
            "file": "splats.ply",
            "gaussians": len(splats),
            "offset": job.offset.tolist(),
            "steps": budget.schedule.steps,
            "photo_side": budget.photo_side,
            "generated_views": 0 if generated is None else len(generated),
            "trust": trust,
        },
        "film": {
            "width": film.cameras.width,
            "height": film.cameras.height,
            **{name: round(sum(one[name] for one in shares) / len(shares), 6) for name in shares[0]},
            "frames": [
                {
                    **share,
                    "camera_to_world": film.cameras.camera_to_world[index].tolist(),
                    "focal": film.cameras.focal[index].tolist(),
                }
                for index, share in enumerate(shares)
            ],
        },
    }
    return _new_views(generated, film), details


def announcement_of_scene(job: SceneJob, budget: SceneBudget) -> str:
    """One sentence on what is about to be done and how long it may take."""
    size = job.path(budget.film_side)
    along = (
        f"along {Path(job.options.path).name}"
        if job.options.path.endswith(".json")
        else f"along the {job.options.path}"
    )
    width, height = job.common_size
    memory = int(1.3 * GIB) + _BYTES * len(job.photos) * width * height + _BYTES_TRAINED * budget.photo_side**2
    new = ", with new views where no photo shows anything" if job.options.generate else ""
    return (
        f"Training splats of {len(job.photos)} photos of up to {budget.photo_side} pixels for {budget.schedule.steps} "
        f"steps{new}, "
        f"then a film of {len(size)} pictures of {size.width}x{size.height} {along}; "
        f"{duration_in_words(budget.seconds, memory)}."
    )


def _budget(job: SceneJob, seconds: float) -> SceneBudget:
    """Decided once, and kept: a command that goes on does not decide anew."""
    path = job.work / "scene.json"
    if path.is_file():
        state = read_json(path)
        speed, seconds = Speed(**state["speed"]), float(state["seconds"])
    else:
        speed = measured_speed(job.device)
        with whole_file(path) as unfinished:
            unfinished.write_text(
                json.dumps({"speed": dataclasses.asdict(speed), "seconds": seconds}), encoding="utf-8"
            )
    return SceneBudget.of(seconds, speed, job.options, photos=job.common_size, device=job.device)


def _capture_to_train(job: SceneJob, side: int) -> Capture:
    """The photos, all of them to be trained on, in the world of the training; larger than they are trained on, for the
    sake of features.
    """
    folder = job.work / "capture"
    if folder.is_dir():
        return read_capture(folder)
    frames = []
    for photo, camera in zip(job.photos, job.cameras, strict=True):
        image, mask = photo.load_with_mask(max(side, _FEATURES_SIDE))
        camera = job.to_work.cameras(camera).scaled(image.shape[2], image.shape[1])
        frames.append(
            FrameToWrite(name=photo.name, image=image, mask=None if bool((mask >= 1).all()) else mask, camera=camera)
        )
    names = [f"images/{frame.name}.png" for frame in frames]
    extra = {
        "orientation_override": "none",
        "train_filenames": names,
        "val_filenames": names[:1],
        "test_filenames": names[:1],
    }
    points = None
    if job.points_path is not None:
        read = read_points(job.points_path)
        points = Points(positions=job.to_work.points(read.positions), colors=read.colors) if len(read) else None
    return write_capture(folder, frames, points=points, extra=extra)


def _scale_of(capture: Capture, side: int) -> float:
    """What makes the longest side of the largest picture so many pixels."""
    return min(1.0, side / max(max(size) for size in capture.sizes))


def _trained(
    job: SceneJob, capture: Capture, budget: SceneBudget, on_progress: OnProgress
) -> tuple[Splats, CompletedViews | None, float | None]:
    """Splats and generated views in the world of the photos (the splats less `SceneJob.offset`), and the trust in the
    model.
    """
    file, rest = job.work / "splats.ply", job.work / "generated.pt"
    if not file.is_file():
        scene = train_scene(
            capture.root,
            job.work / "runs",
            budget.schedule,
            completion_of(job, budget),
            device=job.device,
            seed=job.options.seed,
            on_progress=on_progress,
        )
        back = job.to_work.inverse
        generated = scene.generated
        if generated is not None:
            generated = dataclasses.replace(generated, cameras=back.cameras(generated.cameras))
        with whole_file(rest) as unfinished:
            torch.save({"views": None if generated is None else generated.state(), "trust": scene.trust}, unfinished)
        with whole_file(file) as unfinished:  # last: it says that both are there
            write_splats(unfinished, scene.splats.moved(dataclasses.replace(back, shift=back.shift - job.offset)))
    state = torch.load(rest, map_location="cpu", weights_only=True)
    return (
        read_splats(file),
        None if state["views"] is None else CompletedViews.from_state(state["views"]),
        state["trust"],
    )


def completion_of(job: SceneJob, budget: SceneBudget) -> CompletionConfig:
    """What is generated, as ``ns-train fillerbuster`` would, and with the film's views among those that are chosen
    from.
    """
    options, path = job.options, job.work / "path.json"
    if not path.is_file():
        cameras = job.to_work.cameras(job.path(budget.film_side))
        with whole_file(path) as unfinished:
            unfinished.write_text(json.dumps(as_camera_path(cameras)), encoding="utf-8")
    return CompletionConfig(
        enabled=options.generate,
        at_step=budget.schedule.complete_at,
        context_views=options.photos,
        model=options.model,
        prompt=options.prompt or "",
        text_encoder=options.text_encoder,
        image_size=options.size,
        steps=options.steps,
        precision=options.precision,
        seed=options.seed,
        film_path=path,
    )


# ---- the film --------------------------------------------------------------------------------------------------------


def _film(
    job: SceneJob, capture: Capture, splats: Splats, budget: SceneBudget, on_progress: OnProgress
) -> tuple[FilmFiles, list[dict[str, float]]]:
    """Every frame as two pictures, and its shares; those that are there are not drawn again."""
    cameras, folder = job.path(budget.film_side), job.work / "film"
    film, shares = FilmFiles(folder=folder, cameras=cameras, splats=job.work / "splats.ply"), []
    splats = splats.to(job.device)
    seen: Bool[Tensor, " m"] | None = None
    for number in range(len(cameras)):
        if not film.told(number).is_file():
            if seen is None:
                seen = _seen(job, capture, splats, budget.schedule.scale, on_progress)
            frame = film_frame(
                splats, seen, cameras[number].moved(-job.offset), blur=blur_of(job, cameras, budget.photo_side)
            )
            _keep_frame(film, number, frame)
        shares.append({name: float(value) for name, value in read_json(film.told(number)).items()})
        on_progress("drawing the film", number + 1, len(cameras))
    return film, shares


def blur_of(job: SceneJob, cameras: Pinholes, photo_side: int) -> float:
    """Blur of the film's Gaussians in square pixels: what the training gave them, on pictures that show the same more
    finely.
    """
    camera = job.cameras[0]
    trained = float(camera.focal.mean()) * min(1.0, photo_side / max(camera.width, camera.height))
    return BLUR * max(1.0, float(cameras.focal.mean()) / trained) ** 2


def _seen(job: SceneJob, capture: Capture, splats: Splats, scale: float, on_progress: OnProgress) -> Bool[Tensor, " m"]:
    """Which of the splats the photos show, as large as they were trained on."""
    back = job.to_work.inverse
    cameras, masks = [], list[Bool[Tensor, "_h _w"] | None]()
    for frame in capture.frames:
        width, height = (max(1, int(side * scale)) for side in (frame.camera.width, frame.camera.height))
        cameras.append(back.cameras(frame.camera).moved(-job.offset).scaled(width, height))
        masks.append(None if frame.mask_path is None else media.resize(frame.load_mask(), height, width)[0] >= 0.5)
    return seen_by_photos(
        splats, cameras, masks, lambda done, total: on_progress("looking at what photos show", done, total)
    )


def _keep_frame(film: FilmFiles, number: int, frame: FilmFrame) -> None:
    film.folder.mkdir(exist_ok=True)
    for path, picture in ((film.picture(number), frame.image), (film.trust(number), frame.trust_picture)):
        with whole_file(path) as unfinished:
            media.write_image(unfinished, picture)
    with whole_file(film.told(number)) as unfinished:  # last: it says that the pictures are there
        unfinished.write_text(json.dumps(frame.shares), encoding="utf-8")


def _new_views(generated: CompletedViews | None, film: FilmFiles) -> NewViews:
    """Generated views for the capture, those of which nothing is trained on left out, and the film."""
    if generated is not None:
        generated = generated[[index for index, mask in enumerate(generated.masks) if bool(mask.any())]]
    if generated is None or not len(generated):
        return NewViews(images=torch.zeros(0, 3, 1, 1), cameras=film.cameras[[]].scaled(1, 1), origins=(), film=film)
    return NewViews(
        images=generated.images.movedim(-1, 1).float() / 255,
        masks=generated.masks.movedim(-1, 1).float(),
        cameras=generated.cameras,
        origins=generated.origins,
        film=film,
    )


def _inside(squares: Pinholes, aspect: float) -> Pinholes:
    """The path's own pictures in the middle of the squares that they were read as."""
    side = squares.width
    width, height = (side, _even(side / aspect)) if aspect >= 1 else (_even(side * aspect), side)
    return squares.cropped((side - width) // 2, (side - height) // 2, width, height)


def _even(length: float) -> int:
    """Films want even sides."""
    return max(2, round(length) // 2 * 2)
