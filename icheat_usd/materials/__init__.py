"""Surfaces and their reflectance: what a place on a triangle looks like, and how it scatters light."""

from icheat_usd.materials.bsdf import (
    DeltaSplit,
    SpecularTerms,
    dielectric_split,
    effective_albedo,
    evaluate,
    evaluate_specular,
    is_glossy,
    reflectance_to_eye,
    sample_specular,
)
from icheat_usd.materials.surface import (
    concatenate_points,
    empty_points,
    nonzero_rows,
    points_on_surface,
    shade_hits,
    take_points,
)

__all__ = [
    "DeltaSplit",
    "SpecularTerms",
    "concatenate_points",
    "dielectric_split",
    "effective_albedo",
    "empty_points",
    "evaluate",
    "evaluate_specular",
    "is_glossy",
    "nonzero_rows",
    "points_on_surface",
    "reflectance_to_eye",
    "sample_specular",
    "shade_hits",
    "take_points",
]
