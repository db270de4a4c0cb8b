"""Rays against a snapshot: nearest hits, occlusion, and paths over mirrors, glass and holes."""

from icheat_usd.tracing._rays import unit_directions
from icheat_usd.tracing.paths import PathEnds, first_surfaces, transmittance
from icheat_usd.tracing.protocol import Tracer, build_tracer, spawn_origins, spawn_points

__all__ = [
    "PathEnds",
    "Tracer",
    "build_tracer",
    "first_surfaces",
    "spawn_origins",
    "spawn_points",
    "transmittance",
    "unit_directions",
]
