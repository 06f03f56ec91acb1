"""``fillerbuster complete``: from photos, a film or a posed capture to cameras, new views along a path, and a capture
to train on.
"""

from __future__ import annotations

import dataclasses
import logging
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from fb_core import checkpoint
from fb_core.completion.duration import duration_in_words
from fb_core.completion.fly_through import FEWEST, FoundCameras, choose_context, find_cameras, generate
from fb_core.completion.results.completed_views import FLY_THROUGH, Origin
from fb_core.data.capture.camera_path import read_camera_path
from fb_core.data.capture.captures import read_capture
from fb_core.data.capture.own_files import own_points
from fb_core.data.capture.undistort import is_straight
from fb_core.data.photos.choice import doubtful, require_two_views
from fb_core.data.photos.collection import read_photos
from fb_core.data.photos.photo import Photo
from fb_core.files.ownership import Target
from fb_core.files.whole import whole_folder
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.viewpoints.camera_paths import PATHS, path_cameras
from fb_core.geometry.viewpoints.paths import strided_subset
from fb_core.inpainter import BUNDLED_MODEL, Fillerbuster
from fb_core.machine.clock import Clock
from fb_core.machine.devices import chosen_device
from fb_core.machine.resources import peak_memory_bytes
from method_configs.commands.complete.forecast import forecast
from method_configs.commands.complete.options import CompleteOptions
from method_configs.commands.complete.output import KIND, NewViews, World, is_ours, write_folder, write_report
from method_configs.commands.complete.plan import Plan, pose_sampling
from method_configs.commands.complete.report import announcement_of_work, bars, no_cameras, report_of, what_was_found
from method_configs.commands.complete.self_check import agreement

_WORKING = {
    "file_path",
    "mask_path",
    "train_filenames",
    "val_filenames",
    "test_filenames",
    "camera_model",
    "distortion_params",
    "fisheye_crop_radius",
}
_CHECKED_SIDE = 512  # pixels of the longer side of photos whose cameras are looked for once more
_logger = logging.getLogger(__name__)


class NoCameras(ValueError):
    """Fewer than two photos have a camera that can be trusted; the report is there, a capture is not."""


def complete_scene(source: Path, output: Path, options: CompleteOptions, *, overwrite: bool = False) -> dict[str, Any]:
    """Run the command; returns what report.json holds.

    Raises ValueError in one sentence: for input that cannot be used, for an output folder that is taken, for a full
    disk (then nothing is written), and `NoCameras` when the cameras of fewer than two photos can be trusted (then the
    folder has report and sheet, no capture).
    """
    source, output = source.absolute(), output.absolute()
    target = _target(source, output, options, overwrite)
    target.check()
    scene = options.frames == "scene" and not options.poses_only
    _require_usable(options, scene=scene)
    clock = Clock()
    with clock.stage("reading"):
        job = _read(source, options)
    target = _with_pictures(target, job.photos)
    target.check()
    with clock.stage("loading the model"):
        from_model = not options.poses_only and not scene
        model = _load_model(options, needed=from_model or (options.cameras != "features" and not job.all_known))
    with _work_of_scene(job, options, output, model) if scene else nullcontext() as work:
        cameras, new, details = _work(job, options, model, clock, work)
        job = dataclasses.replace(job, photos=cameras.as_used(job.photos))
        enough = len(cameras.trusted) >= FEWEST
        report = report_of(source, options, job.photos, job.left_out, model, cameras, details)
        try:
            with whole_folder(target) as folder:
                with clock.stage("writing"):
                    world = (
                        job.world if enough or not cameras.trusted else dataclasses.replace(job.world, points_path=None)
                    )
                    write_folder(folder, job.photos, job.left_out, cameras, new, world, fps=options.fps)
                report |= {"seconds": clock.seconds, "peak_memory_gib": round(_peak_memory_gib(), 3)}
                write_report(folder, report)
        except (OSError, ValueError) as error:
            raise ValueError(f"{output}: {error}; nothing was written") from error
    if not enough:
        raise NoCameras(no_cameras(job.photos, cameras, output))
    _logger.info(
        "wrote %s: %d photos with cameras, %d new views",
        output,
        len(cameras.trusted),
        0 if new is None else len(new.images),
    )
    return report


def _require_usable(options: CompleteOptions, *, scene: bool) -> None:
    """Raises ValueError in one sentence, before photos are read and cameras looked for, which takes minutes: for a
    device, a path, known cameras, a model or a prompt that cannot be used. Weights are mapped, not read.
    """
    chosen_device(options.device)
    _path_of_file(options, _CHECKED_SIDE)
    if options.known_poses is not None:
        read_capture(options.known_poses)
    if options.cameras != "features" or not (scene or options.poses_only):
        reads_text = bool(checkpoint.load(options.model or BUNDLED_MODEL).config.transformer.text_width)
        _require_readable(options, reads_text=reads_text)
    if scene:
        from fb_core.completion.options import CompletionConfig  # nerfstudio takes a while
        from fb_nerfstudio.refusal import refuse_bad_model

        given = {"model": options.model, "prompt": options.prompt or "", "text_encoder": options.text_encoder}
        refuse_bad_model(CompletionConfig(enabled=options.generate, **given))


def _work_of_scene(
    job: Job, options: CompleteOptions, output: Path, model: Fillerbuster | None
) -> AbstractContextManager[Path]:
    """Where the work is kept."""
    from method_configs.commands.complete.scenes.scene_work import question_of, work_beside

    return work_beside(output, question_of(job.photos, options, None if model is None else model.model_hash))


# ---- input -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Job:
    """What was read."""

    photos: list[Photo]
    """Those that show something."""
    left_out: dict[str, str]
    """The others, with the reason."""
    world: World
    """Of the known cameras, or upright."""

    @property
    def all_known(self) -> bool:
        """Whether every photo has a camera already."""
        return all(photo.camera is not None for photo in self.photos)


def _target(source: Path, output: Path, options: CompleteOptions, overwrite: bool) -> Target:
    """The output, and all that the command reads: photos, known cameras, model, text encoder, camera path."""
    path = [Path(options.path)] if options.path.lower().endswith(".json") else []
    given = [source, options.known_poses, options.model, options.text_encoder, *path]
    inputs = tuple(one for one in given if one is not None)
    return Target(folder=output, kind=KIND, overwrite=overwrite, inputs=inputs, earlier=is_ours)


def _with_pictures(target: Target, photos: list[Photo]) -> Target:
    """The target, which spares also pictures that lie elsewhere through links; one of each folder stands for all
    in it.
    """
    one_of_each = {path.parent: path for path in (photo.source.resolve() for photo in photos)}
    return dataclasses.replace(target, inputs=(*target.inputs, *one_of_each.values()))


def _read(source: Path, options: CompleteOptions) -> Job:
    photos = read_photos(source)
    world = _world_of(source) if photos[0].camera is not None else None
    if options.known_poses is not None:
        photos, world = _with_known_poses(photos, options.known_poses), _world_of(options.known_poses)
    unknown = [photo for photo in photos if photo.camera is None]
    if len(unknown) == len(photos):
        require_two_views(photos)
    left_out = doubtful(photos) if unknown else {}
    left_out = {photo.name: left_out[photo.name] for photo in unknown if photo.name in left_out}
    for name, reason in left_out.items():
        _logger.warning("left out: %s (%s)", name, reason)
    upright = World(
        extra={"orientation_override": "none"}
    )  # our worlds stand upright already; nerfstudio shall not turn them
    return Job(
        photos=[photo for photo in photos if photo.name not in left_out], left_out=left_out, world=world or upright
    )


def _world_of(source: Path) -> World:
    """What a posed capture, a folder or its JSON file, says beside its cameras."""
    capture = read_capture(source)
    return World(
        extra={key: value for key, value in capture.extra.items() if key not in _WORKING},
        points_path=own_points(capture),
        straight=frozenset(
            frame.image_path for frame in capture.frames if is_straight(frame.camera_model, frame.distortion)
        ),
    )


def _with_known_poses(photos: list[Photo], capture: Path) -> list[Photo]:
    """The photos; those that the capture has by the same file name come from there, with camera and without lens
    distortion.
    """
    posed: dict[str, Photo] = {}
    by_name: dict[str, list[Photo]] = {}
    for photo in read_photos(capture):
        by_name.setdefault(photo.source.name, []).append(photo)
    for photo in photos:
        namesakes = by_name.get(photo.source.name, [])
        if len(namesakes) > 1:  # rigs have one file of each name in every camera's folder
            namesakes = [one for one in namesakes if _same_file(one.source, photo.source)]
        if len(namesakes) == 1:
            posed[photo.source.name] = namesakes[0]
        elif photo.source.name in by_name:
            _logger.warning(
                "%s: --known-poses has several pictures of this name, none is this photo; its camera is looked for",
                photo.name,
            )
    if not any(photo.source.name in by_name for photo in photos):
        raise ValueError(
            f"--known-poses {capture}: none of its pictures has the file name of a photo, such as "
            f"{photos[0].source.name}; rename them"
        )
    lenses = {photo.size: photo for photo in (*(one for many in by_name.values() for one in many), *posed.values())}

    def merged(photo: Photo) -> Photo:
        if photo.source.name in posed:
            return dataclasses.replace(posed[photo.source.name], name=photo.name)
        lens = lenses.get(
            photo.size
        )  # a photo that tells no focal length was taken with the lens of posed photos of its size
        if lens is None or photo.focal_prior is not None:
            return photo
        return dataclasses.replace(photo, focal_prior=lens.focal_prior, device=lens.device)

    return [merged(photo) for photo in photos]


def _same_file(one: Path, other: Path) -> bool:
    """Whether two files hold the same bytes."""
    return one.stat().st_size == other.stat().st_size and one.read_bytes() == other.read_bytes()


def _load_model(options: CompleteOptions, *, needed: bool) -> Fillerbuster | None:
    if not needed:
        return None
    device = chosen_device(options.device)
    model = Fillerbuster.from_pretrained(options.model, device=device, text_encoder=options.text_encoder)
    _require_readable(options, reads_text=model.reads_text)
    return model


def _require_readable(options: CompleteOptions, *, reads_text: bool) -> None:
    if options.prompt and not reads_text:
        raise ValueError(f"--prompt: this model reads no text; leave the prompt out, got {options.prompt!r}")


# ---- work ------------------------------------------------------------------------------------------------------------


def _work(
    job: Job, options: CompleteOptions, model: Fillerbuster | None, clock: Clock, work: Path | None = None
) -> tuple[FoundCameras, NewViews | None, dict[str, Any]]:
    """Cameras, then new views; what the report is to say of these. With a folder to work in, a scene and its film."""
    if work is not None:
        return _work_on_scene(job, options, model, clock, work)
    side = None if model is None else options.size or model.size
    path = None if side is None else _path_of_file(options, side)
    views = options.views if path is None else len(path)
    plan = None if model is None or options.poses_only else Plan.of(len(job.photos), views, model, options)
    sampling = None if model is None else pose_sampling(model, options)
    expected = forecast(job.photos, options, model, plan, sampling)
    _logger.info(announcement_of_work(job.photos, options, model, plan, sampling, expected))
    cameras = _find_cameras(job, options, model, clock)
    photos = cameras.as_used(job.photos)
    if plan is not None and len(cameras.trusted) >= FEWEST:
        _logger.info(
            "The cameras took %.0f s; %s left.",
            clock.seconds["cameras"],
            duration_in_words(expected.left(clock.seconds)),
        )
    if plan is None or model is None or len(cameras.trusted) < FEWEST:
        return cameras, None, {}
    context = choose_context(cameras, options.photos)
    if path is None:
        path = path_cameras(options.path, [cameras.camera(index) for index in cameras.trusted], views, size=plan.side)
    if len(context) < plan.photos:
        plan = Plan.of(len(context), views, model, options)
    with bars() as on_progress, clock.stage("new views"):
        images = generate(
            [photos[index] for index in context],
            [cameras.camera(index) for index in context],
            path,
            plan.passes,
            model,
            seed=options.seed,
            sampling=plan.sampling,
            prompt=options.prompt,
            on_progress=on_progress,
        )
    number = {view: number for number, chosen in enumerate(plan.passes.views) for view in chosen}
    origins = tuple(
        Origin(
            role=FLY_THROUGH,
            round=number[view],
            seed=options.seed + number[view],
            prompt=options.prompt or "",
            model_hash=model.model_hash,
        )
        for view in range(len(path))
    )
    details: dict[str, Any] = {
        "context": [job.photos[index].name for index in context],
        "passes": [len(chosen) for chosen in plan.passes.views],
    }
    new = NewViews(images=images, cameras=path, origins=origins)
    if options.check:
        with bars(), clock.stage("self-consistency"):
            details["self_consistency"] = agreement(photos, cameras, context, new, model, options)
    return cameras, new, details


def _find_cameras(job: Job, options: CompleteOptions, model: Fillerbuster | None, clock: Clock) -> FoundCameras:
    """And say what was found."""
    sampling = None if model is None else pose_sampling(model, options)
    with bars() as on_progress, clock.stage("cameras"):
        cameras = find_cameras(
            job.photos,
            method=options.cameras,
            model=model,
            seed=options.seed,
            sampling=sampling,
            on_progress=on_progress,
        )
    for line in what_was_found(job.photos, cameras):
        _logger.info(line)
    return cameras


def _work_on_scene(
    job: Job, options: CompleteOptions, model: Fillerbuster | None, clock: Clock, work: Path
) -> tuple[FoundCameras, NewViews | None, dict[str, Any]]:
    """Cameras, splats, new views where they are needed, a film; what an earlier try has kept is not done again."""
    from method_configs.commands.complete.scenes.scene import SceneJob, complete_with_splats
    from method_configs.commands.complete.scenes.scene_work import keep_cameras, kept_cameras

    began = time.perf_counter()
    cameras = kept_cameras(work, job.photos)
    if cameras is None:
        sampling = None if model is None else pose_sampling(model, options)
        expected = forecast(job.photos, options, model, None, sampling)
        _logger.info(announcement_of_work(job.photos, options, model, None, sampling, expected))
        cameras = _find_cameras(job, options, model, clock)
        keep_cameras(work, cameras)
    else:
        _logger.info("Going on with what an earlier try has left: %d cameras are there.", len(cameras.trusted))
    if len(cameras.trusted) < FEWEST:
        return cameras, None, {}
    scene = SceneJob.of(cameras.as_used(job.photos), cameras, job.world.points_path, options, work)
    left = 60 * options.minutes - (time.perf_counter() - began)
    with bars() as on_progress, clock.stage("scene"):
        new, details = complete_with_splats(scene, seconds=left, on_progress=on_progress)
    return cameras, new, details


def _path_of_file(options: CompleteOptions, side: int) -> Pinholes | None:
    """The cameras of a camera path's file, thinned evenly to the number of views."""
    if not options.path.lower().endswith(".json"):
        if options.path not in PATHS:
            raise ValueError(f"--path: expected {', '.join(PATHS)} or a camera path's .json file, got {options.path!r}")
        return None
    cameras = read_camera_path(Path(options.path), size=side).cameras
    return cameras[strided_subset(len(cameras), options.views)]


def _peak_memory_gib() -> float:
    """Of this process, from its start; with a GPU, of the GPU."""
    if torch.cuda.is_available() and torch.cuda.max_memory_allocated():
        return torch.cuda.max_memory_allocated() / 2**30
    return peak_memory_bytes() / 2**30
