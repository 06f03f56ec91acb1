"""What a person asks for in the viewer while a training runs: requests, the queue between both threads, and their
plans.

The viewer's threads put requests, the training takes them between two iterations. Nothing here knows viser or
nerfstudio.
"""

from __future__ import annotations

import hashlib
import math
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.context_views import nearest_context
from fb_core.completion.planning.plan import CompletionPlan, PlannedRound, focal_of_new_views
from fb_core.completion.results.completed_views import ANCHOR, DENSIFY, REQUESTED, CompletedViews
from fb_core.geometry.cameras import Pinholes

MOST_VIEWS = 32
"""Views that one request may ask for."""
MOST_WAITING = 16
"""Requests that may wait for the training at a time."""


@dataclass(frozen=True, kw_only=True)
class CompleteFrom:
    """Generate views from where a person stands in the viewer."""

    camera_to_world: Float[Tensor, "3 4"]
    """The place and where it looks; OpenCV axes, scene units."""
    views: int = 1
    """This one and its neighbours in a fan."""
    seed: int = 0
    """Decides the pictures."""
    prompt: str = ""
    """What is to be seen, for models that read text."""

    def __post_init__(self) -> None:
        if not 1 <= self.views <= MOST_VIEWS:
            raise ValueError(f"views: expected 1 to {MOST_VIEWS} views, got {self.views}")
        _check_seed(self.seed)


@dataclass(frozen=True, kw_only=True)
class CompleteMissing:
    """Generate views of what nobody has seen, from where they show most of it."""

    views: int = 8
    """At most so many."""
    seed: int = 0
    """Decides the pictures."""
    prompt: str = ""
    """What is to be seen, for models that read text."""

    def __post_init__(self) -> None:
        if not 1 <= self.views <= MOST_VIEWS:
            raise ValueError(f"views: expected 1 to {MOST_VIEWS} views, got {self.views}")
        _check_seed(self.seed)


@dataclass(frozen=True, kw_only=True)
class RegenerateRound:
    """Generate the views of a round anew, from the same cameras."""

    number: int
    """The round."""
    seed: int | None = 0
    """Decides the pictures; where it is the round's own, the next one is taken. None keeps seed and prompt: what
    conditions the round has changed.
    """
    prompt: str = ""
    """What is to be seen, for models that read text."""

    def __post_init__(self) -> None:
        _check_seed(self.seed or 0)


@dataclass(frozen=True, kw_only=True)
class RemoveView:
    """Take one view out of the bank."""

    key: str
    """Which one, see :func:`key_of`: a place in the bank would mean another view after an earlier request."""


Request = CompleteFrom | CompleteMissing | RegenerateRound | RemoveView


class RequestQueue:
    """Requests on their way from the viewer's threads to the training's; closed while nothing trains."""

    def __init__(self, closed: str = "Nothing trains here, so nothing will be generated.") -> None:
        self._lock = threading.Lock()
        self._waiting: deque[Request] = deque()
        self._closed: str | None = closed

    def __len__(self) -> int:
        with self._lock:
            return len(self._waiting)

    @property
    def closed(self) -> str | None:
        """The sentence that says why nothing is taken any more; None while requests are."""
        with self._lock:
            return self._closed

    def open(self) -> None:
        """The training takes requests from now on."""
        with self._lock:
            self._closed = None

    def close(self, reason: str) -> int:
        """Nothing is taken any more; returns how many requests were waiting, which are dropped."""
        with self._lock:
            dropped = len(self._waiting)
            self._waiting.clear()
            self._closed = reason
            return dropped

    def put(self, request: Request) -> None:
        """Let a request wait for the training. Raises ValueError with a sentence when it is closed or too many wait."""
        with self._lock:
            if self._closed is not None:
                raise ValueError(self._closed)
            if len(self._waiting) >= MOST_WAITING:
                raise ValueError(f"{MOST_WAITING} requests are waiting already; ask again when some of them are done.")
            self._waiting.append(request)

    def take(self) -> Request | None:
        """The request that has waited longest, None when there is none."""
        with self._lock:
            return self._waiting.popleft() if self._waiting else None


@dataclass(frozen=True, kw_only=True)
class PlannedRequest:
    """A request that generates, ready to run."""

    plan: CompletionPlan
    """With this one round."""
    replaces: tuple[int, ...]
    """Places in the bank that the new views take; empty when they are added."""
    done: CompletedViews | None
    """The other views of the bank; the anchors among them condition the new ones."""


def plan_request(
    request: CompleteFrom | RegenerateRound,
    scene: CompletionPlan,
    bank: CompletedViews | None,
    cameras: Sequence[Pinholes],
    config: CompletionConfig,
    known: Sequence[Bool[Tensor, "_h _w"] | None] | None = None,
) -> PlannedRequest:
    """Decide cameras and context.

    New views have the lens of the context and the size of the bank's, and are conditioned on the captured views that
    show most of what they will (:func:`nearest_context`). A round of an automatic completion keeps the context that it
    had.

    Args:
        request: what is asked for.
        scene: shape, shell, context and size, as an automatic completion finds them.
        bank: the generated views so far.
        cameras: the capture's.
        config: the completion's options.
        known: of each captured picture its known part, None for all of it; without, all of them are known.

    Raises:
        ValueError: a sentence for a place outside the scene and for a round that is not there.
    """
    size, aspect = scene.size if bank is None else bank.cameras.width, 1.0
    if isinstance(request, CompleteFrom):
        focal = focal_of_new_views(cameras, scene.context, size)
        new = fan_from(request, scene, focal=focal, size=size)
        taken = [config.densify_rounds] if bank is None else [config.densify_rounds, *bank.rounds]
        number = 1 + max(taken)  # smaller ones are the automatic rounds'
        role, seed, prompt, replaces = REQUESTED, request.seed, request.prompt, ()
    else:
        replaces = (
            () if bank is None else tuple(i for i, origin in enumerate(bank.origins) if origin.round == request.number)
        )
        if bank is None or not replaces:
            raise ValueError(f"Round {request.number} has no views any more; nothing was generated.")
        new, number, origin = bank[replaces].cameras.to("cpu"), request.number, bank.origins[replaces[0]]
        role, aspect = origin.role, origin.aspect
        if request.seed is None:
            seed, prompt = origin.seed, origin.prompt
        else:
            seed, prompt = request.seed + (request.seed == origin.seed), request.prompt
    nearest = role == REQUESTED or (role == DENSIFY and config.context_choice == "overlap")
    context = nearest_context(cameras, new, scene.shell, config.context_views, known) if nearest else scene.context
    remaining = [] if bank is None else [index for index in range(len(bank)) if index not in set(replaces)]
    planned = PlannedRound(number=number, role=role, seed=seed, prompt=prompt, cameras=new, aspect=aspect)
    plan = CompletionPlan(
        shape=scene.shape,
        shell=scene.shell,
        captured=len(cameras),
        context=tuple(context),
        rounds=(planned,),
        size=size,
    )
    return PlannedRequest(
        plan=plan, replaces=replaces, done=bank[remaining] if bank is not None and remaining else None
    )


def fan_from(request: CompleteFrom, scene: CompletionPlan, *, focal: float, size: int) -> Pinholes:
    """The asked-for camera, then neighbours alternately to its right and left, each turned by half a picture (less in a
    full circle).

    In captures that look outward the cameras turn where they stand, about the capture's up; in captures that look
    inward they go around what these look at. Raises ValueError with a sentence when the place is not finite, or outside
    the surface around a room.
    """
    pose = request.camera_to_world.to(scene.shape.center)
    if not bool(torch.isfinite(pose).all()):
        raise ValueError("The viewer's camera has no finite place; move it and ask again.")
    shape, place = scene.shape, pose[:, 3]
    if shape.outward and not bool(scene.shell.contains(place[None])[0]):
        raise ValueError(
            "The camera stands outside the walls of the scene as far as they are known; move inside and ask again."
        )
    picture = 2 * math.atan(size / 2 / focal)
    step = min(picture / 2, 2 * math.pi / request.views)
    turns = [step * ((number + 1) // 2) * (1 if number % 2 else -1) for number in range(request.views)]
    pivot = place if shape.outward else shape.focus
    poses = torch.stack([_turned(pose, shape.up, angle, pivot) for angle in turns])
    like = poses.new_ones(len(poses), 2)
    cameras = Pinholes(camera_to_world=poses, focal=like * focal, principal=like * (size / 2), width=size, height=size)
    return cameras.to(torch.float32)


def key_of(views: CompletedViews, index: int) -> str:
    """A name for a generated view that stays while others come and go, and ends when it is generated anew."""
    origin, camera = views.origins[index], views.cameras.camera_to_world[index]
    identity = f"{origin.role} {origin.round} {origin.seed} {origin.model_hash} {camera.double().cpu().tolist()}"
    return hashlib.sha256(identity.encode()).hexdigest()[:16]


def place_of(bank: CompletedViews | None, key: str) -> int | None:
    """Where in the bank the view of this name is, None when it is not there."""
    return None if bank is None else next((index for index in range(len(bank)) if key_of(bank, index) == key), None)


def without_view(bank: CompletedViews | None, key: str) -> CompletedViews | None:
    """The bank without one view, None when that was the last. Raises ValueError with a sentence when it is not
    there.
    """
    place = place_of(bank, key)
    if bank is None or place is None:
        raise ValueError("This view is not there any more; nothing was removed.")
    return None if len(bank) == 1 else bank[[index for index in range(len(bank)) if index != place]]


def standing_on(bank: CompletedViews | None, number: int) -> list[int]:
    """The rounds that a round conditioned: all others, ascending, for the anchors, none for any other round."""
    if bank is None or all(origin.role != ANCHOR for origin in bank.origins if origin.round == number):
        return []
    return [other for other in bank.rounds if other != number]


def merged(bank: CompletedViews | None, replaces: Sequence[int], new: CompletedViews) -> CompletedViews:
    """The bank with the new views: in the places of those they replace, or behind all others. Raises ValueError for
    another size.
    """
    if bank is None:
        return new
    together = CompletedViews.cat([bank, new])
    if not replaces:
        return together
    order = list(range(len(bank)))
    for offset, place in enumerate(replaces):
        order[place] = len(bank) + offset
    return together[order]


def _check_seed(seed: int) -> None:
    if not 0 <= seed < 2**63 - 1:
        raise ValueError(f"seed: expected a whole number from 0 to 2^63 - 2, got {seed}")


def _turned(
    pose: Float[Tensor, "3 4"], axis: Float[Tensor, "3"], radians: float, pivot: Float[Tensor, "3"]
) -> Float[Tensor, "3 4"]:
    """The pose turned about an axis through ``pivot`` (Rodrigues), clockwise as seen from above: to the camera's
    right.
    """
    x, y, z = F.normalize(axis, dim=0).unbind()
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    rotation = torch.eye(3).to(pose) - math.sin(radians) * cross + (1 - math.cos(radians)) * (cross @ cross)
    center = pivot + rotation @ (pose[:, 3] - pivot)
    return torch.cat([rotation @ pose[:, :3], center[:, None]], dim=1)
