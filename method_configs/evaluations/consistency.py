"""``fillerbuster eval consistency``: relative rotation accuracy of films rendered from finished runs (paper, section
4).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from fb_core.files.limits import MOST_SIDE, MOST_VIEWS, require_between
from method_configs.benchmarks.table_files import TableFiles, origin_of

if TYPE_CHECKING:
    from torch import Tensor

    from fb_core.evaluation.metrics.correspondences import Matcher
    from fb_core.evaluation.metrics.relative_rotation import PairResult
    from fb_core.evaluation.results import Report
    from fb_core.geometry.cameras import Pinholes
    from method_configs.evaluations.true_films import Film

_CURVE_DEGREES = 30.0


@dataclass(frozen=True, kw_only=True)
class Consistency(TableFiles):
    """Whether a film of a finished run turns as its cameras do: relative rotation accuracy (RRA) of frames within a
    second.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, each with config.yml; runs of one method on several captures also get a mean."""
    path: str = "ellipse"
    """ellipse (fitted to the captured cameras), orbit, spiral, or a camera path's JSON file in the run's world."""
    seconds: float = 10.0
    """Length of the film (a camera path's file has its own)."""
    fps: float = 24.0
    """Frames per second; pairs are at most so many frames apart."""
    pairs: int = 20
    """Pairs of frames in each film, the same ones for all runs."""
    size: int = 512
    """Side of the square frames in pixels."""
    fov: float | None = 60.0
    """Field of view in degrees; None takes the captured cameras'."""
    loftr: Path | None = None
    """kornia's weights loftr_outdoor.ckpt (the paper's matcher); without them correspondences are SIFT features."""
    true_film: bool = True
    """Also judge what is true: a procedural room rendered exactly along the same path, or another capture's photos."""
    controls: bool = False
    """Also judge what the metric is worth: a room with paint on its blank walls, and that or the photos spoilt (cameras
    shuffled, blurred, frames that disagree)."""

    def run(self) -> None:
        """Render the frames that are needed, judge them, report."""
        from fb_core.evaluation.metrics.correspondences import loftr_matcher, sift_matches
        from fb_core.evaluation.metrics.relative_rotation import PairResult, accuracy
        from fb_core.evaluation.results import Report

        self._check()
        matcher = sift_matches if self.loftr is None else loftr_matcher(self.loftr)
        report = Report(seed=self.seed)
        judged: dict[tuple[str, str], list[PairResult]] = {}
        poses: dict[str, str] = {}
        part = f"RRA: {self.pairs} pairs within a second of {self.fps:g} frames, {self._matcher}, {self.size} pixels"
        for run in self.runs:
            result = self._judged(run, matcher, poses)
            for method, pairs in result["pairs"].items():
                key = (method, result["capture"])
                if key not in judged:  # of two runs of one method on one capture the first is told
                    judged[key] = [PairResult(**values) for values in pairs]
                    model = result["model"] if method == result["method"] else "-"
                    report.rows.append(
                        {"part": part, "method": method, "capture": key[1], "model": model} | accuracy(judged[key])
                    )
        report.rows.extend(means(report.rows, poses))
        self.publish(report, lambda report, figure: draw(report, judged, figure, self._matcher))

    @property
    def _matcher(self) -> str:
        return "SIFT" if self.loftr is None else "LoFTR"

    def _check(self) -> None:
        if not self.runs:
            raise ValueError(
                "consistency: expected one or more folders of runs, got none; name a folder with config.yml"
            )
        if not (self.fps > 0 and self.seconds > 0 and self.size >= 32 and self.pairs >= 1):
            raise ValueError(
                "consistency: expected seconds and fps above 0, 32 or more pixels and a pair, "
                f"got seconds {self.seconds:g}, fps {self.fps:g}, size {self.size}, pairs {self.pairs}"
            )
        require_between("frames of the film, seconds times fps", self.seconds * self.fps, 1, MOST_VIEWS)
        require_between("size", self.size, 32, MOST_SIDE)
        if self.fov is not None:
            require_between("fov", self.fov, 1, 179)

    def _judged(self, run: Path, matcher: Matcher, poses: dict[str, str]) -> dict[str, Any]:
        """``pairs`` of each film as plain values, the run's ``method``, its ``capture``'s name, its ``model``'s hash.

        Args:
            run: its folder.
            matcher: finds correspondences.
            poses: digest of the poses of each capture that an earlier run of this command was trained on, whose true
                film is there already; this run's is added.
        """
        from fb_nerfstudio.runs.finished_run import capture_of, identity_of, read_run

        config, state = read_run(run)
        capture, method = capture_of(config), config.method_name
        name, digest = scene_name(capture), poses_digest(capture)
        if poses.get(name, digest) != digest:  # another capture in a folder of the same name
            name = f"{name} {digest}"
        with_truth = self.true_film and digest not in poses.values()
        poses[name] = digest
        options = ("seed", "path", "seconds", "fps", "pairs", "size", "fov", "controls")
        asked = (
            {option: getattr(self, option) for option in options}
            | identity_of(run, state)
            | {"matcher": str(self.loftr or "SIFT"), "true_film": with_truth}
        )
        del state
        file = f"{method}-{name}-{_digest(asked['run'])}"
        result = self.kept(file, asked, lambda: self._measured(run, method, capture, matcher, with_truth))
        return result | {"capture": name, "method": method}

    def _measured(self, run: Path, method: str, capture: Path, matcher: Matcher, with_truth: bool) -> dict[str, Any]:
        from fb_core.evaluation.metrics.relative_rotation import frame_pairs
        from fb_nerfstudio.runs.finished_run import load_run, quiet
        from method_configs.evaluations.true_films import Film, true_films

        with quiet():
            pipeline = load_run(run)
            captured = captured_cameras(pipeline)
        cameras, bank = self.film(captured), pipeline.datamanager.generated_views
        pairs = frame_pairs(len(cameras), most_apart=max(1, round(self.fps)), count=self.pairs, seed=self.seed)
        films = {method: Film(pictures=rendered_by(pipeline, cameras), cameras=cameras, pairs=pairs)}
        if with_truth:
            films |= true_films(capture, pipeline, captured, films[method], seed=self.seed, controls=self.controls)
        judged = {name: self._judge(film, matcher, f"{name}: pair") for name, film in films.items()}
        return {
            "pairs": {name: [dataclasses.asdict(pair) for pair in results] for name, results in judged.items()},
            "model": "-" if bank is None or not len(bank) else bank.origins[0].model_hash[:8],
        }

    def film(self, captured: list[Pinholes]) -> Pinholes:
        """The film's cameras in the world of the captured ones."""
        from fb_core.data.capture.camera_path import read_camera_path
        from fb_core.geometry.viewpoints.camera_paths import path_cameras

        if self.path.endswith(".json"):
            return read_camera_path(Path(self.path), size=self.size).cameras
        return path_cameras(
            self.path, captured, max(2, round(self.seconds * self.fps)), size=self.size, fov_degrees=self.fov
        )

    def _judge(self, film: Film, matcher: Matcher, what: str) -> list[PairResult]:
        import torch
        from rich.progress import Progress

        from fb_core.evaluation.metrics.relative_rotation import judge_pairs

        with Progress(transient=True) as bars, torch.no_grad():
            bar = bars.add_task(what, total=len(film.pairs))
            return judge_pairs(
                film.pictures,
                film.cameras,
                film.pairs,
                matcher,
                on_pair=lambda done, _: bars.update(bar, completed=done),
            )


def scene_name(capture: Path) -> str:
    """What a capture is called in tables: its folder, with the one above where that is only called capture."""
    folder = capture.parent if capture.suffix == ".json" else capture
    return f"{folder.parent.name}-{folder.name}" if folder.name in ("capture", "data", "nerfstudio") else folder.name


def _digest(text: str) -> str:
    import hashlib

    return hashlib.sha256(text.encode()).hexdigest()[:8]


def poses_digest(capture: Path) -> str:
    """The same for copies of a capture, whose photos may be masked or scaled: they show one scene from the same
    places. Of one that is gone, its folder's.
    """
    from fb_core.data.capture.captures import read_capture

    try:
        frames = read_capture(capture).frames
    except (ValueError, OSError):
        return _digest(str(capture.absolute()))
    poses = sorted(frame.camera.camera_to_world.flatten().tolist() for frame in frames)
    return _digest("\n".join(" ".join(f"{number + 0.0:.6g}" for number in pose) for pose in poses))


def captured_cameras(pipeline: Any) -> list[Pinholes]:
    """Of the pictures that the run was trained on, in its world."""
    from fb_nerfstudio.bridge import to_pinhole_list

    _ = pipeline.datamanager.cached_train  # undistorts, which changes the cameras
    return to_pinhole_list(pipeline.datamanager.train_dataset.cameras.to("cpu"))


def rendered_by(pipeline: Any, cameras: Pinholes) -> Callable[[int], Tensor]:
    """Frames of the film as the run's splats show them, on the CPU."""
    from fb_nerfstudio.bridge import to_nerfstudio

    def picture(frame: int) -> Tensor:
        outputs = pipeline.model.get_outputs_for_camera(
            to_nerfstudio(cameras[frame].to(dtype_of(pipeline)), pipeline.device)
        )
        return outputs["rgb"].detach().float().cpu().movedim(-1, 0).clamp(0, 1)

    return picture


def dtype_of(pipeline: Any) -> Any:
    """Of the numbers that the run's cameras are told in."""
    return pipeline.datamanager.train_dataset.cameras.camera_to_worlds.dtype


def means(rows: Sequence[dict[str, Any]], poses: Mapping[str, str]) -> list[dict[str, Any]]:
    """Of each method that has several captures: the mean over these, and half the 95 % interval of the share within 5
    degrees. Captures of the same ``poses`` (by name) are copies of one, and together count once.
    """
    from fb_core.evaluation.ablations import interval

    result = []
    for method in dict.fromkeys(row["method"] for row in rows):
        copies: dict[str, list[dict[str, Any]]] = {}
        for row in rows:
            if row["method"] == method:
                copies.setdefault(poses[row["capture"]], []).append(row)
        if len(copies) > 1:
            mean: dict[str, Any] = {"part": "RRA, mean over captures", "method": method, "captures": len(copies)}
            for name in ("rra_1", "rra_2", "rra_5", "rra_10", "rra_20", "maa_10", "median_degrees", "failed"):
                each = [sum(float(row[name]) for row in same) / len(same) for same in copies.values()]
                mean[name], half = interval(each)
                if name == "rra_5":
                    mean["rra_5_interval"] = half
            result.append(mean)
    return result


def draw(report: Report, judged: dict[tuple[str, str], list[PairResult]], path: Path, matcher: str) -> None:
    """The share of pairs below each threshold, one curve for each method over all its captures."""
    import numpy as np

    from method_configs.benchmarks.figures import new_axes, save_figure

    figure, axes = new_axes("share of pairs with a smaller error")
    limits = np.geomspace(0.1, _CURVE_DEGREES, 200)
    for method in dict.fromkeys(method for method, _ in judged):
        errors = np.array([one.error_degrees for key, results in judged.items() if key[0] == method for one in results])
        axes.plot(limits, [(errors < limit).mean() for limit in limits], label=f"{method} ({len(errors)} pairs)")
    axes.set_xscale("log")
    axes.set_ylim(0, 1.02)
    axes.set_xlabel(f"error of the relative rotation in degrees ({matcher})")
    figure.legend(loc="outside lower center", ncols=2, fontsize="small")
    save_figure(figure, path, origin_of(report))
