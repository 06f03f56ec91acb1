"""Sampling: integrate a velocity from noise (t = 1) to data (t = 0); guidance and MultiDiffusion are wrappers of
callables.

``integrate(guided(tiled(predict), ...), noise, times)``: `predict` evaluates the network on some of the views under
every branch of guidance at once, `tiled` keeps that signature, and `guided` makes a velocity field of it. Tiling sits
inside guidance, so the guidance map never leaves its views. The ideas live in `fb_core.sampling`, one file each; this
is the door to them.
"""

from fb_core.sampling.guidance import GuidanceVariant, branches, combined, evaluated_by, guidance_map, guided
from fb_core.sampling.integration.jumps import Jumping, jumps_of, piece_of
from fb_core.sampling.integration.solvers import SOLVERS, Point, VelocityField, evaluations
from fb_core.sampling.integration.time_grids import GRIDS, reference_grid, time_grid
from fb_core.sampling.integration.trajectory import OnStep, OnTrajectory, SamplingInterrupted, Trajectory, integrate
from fb_core.sampling.options import SamplingConfig
from fb_core.sampling.randomness import Orders, given_order, noise_of, random_orders
from fb_core.sampling.reference import reference_field
from fb_core.sampling.starts import imposed, known_channels, reference_started, started
from fb_core.sampling.tiling import Predict, tiled, windows

__all__ = [
    "GRIDS",
    "SOLVERS",
    "GuidanceVariant",
    "Jumping",
    "OnStep",
    "OnTrajectory",
    "Orders",
    "Point",
    "Predict",
    "SamplingConfig",
    "SamplingInterrupted",
    "Trajectory",
    "VelocityField",
    "branches",
    "combined",
    "evaluated_by",
    "evaluations",
    "given_order",
    "guidance_map",
    "guided",
    "imposed",
    "integrate",
    "jumps_of",
    "known_channels",
    "noise_of",
    "piece_of",
    "random_orders",
    "reference_field",
    "reference_grid",
    "reference_started",
    "started",
    "tiled",
    "time_grid",
    "windows",
]
