"""The reflectance model against quadrature and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from icheat_usd.materials import (
    dielectric_split,
    effective_albedo,
    evaluate,
    evaluate_specular,
    is_glossy,
    points_on_surface,
    reflectance_to_eye,
    sample_specular,
)
from icheat_usd.scene import SurfacePoints
from tests.scenes import Material, Mesh, make_snapshot, quad, rotation

TILT = rotation((1, 2, 0.5), 50)[:3, :3]


def f32(values: Any) -> NDArray[np.float32]:
    return np.array(values, np.float32)


def points_of(material: Material, n: int, side: int = 0) -> SurfacePoints:
    """`n` times a place on a tilted square whose outward normal is TILT @ +Y."""
    snapshot = make_snapshot([Mesh(quad(), material, transforms=[np.hstack([TILT, np.zeros((3, 1))])])])
    return points_on_surface(snapshot, np.zeros(n), np.zeros(n), np.full((n, 2), 0.3), np.full(n, side))


def at_angle(theta: float, phi: float = 0.4) -> np.ndarray:
    """World direction at `theta` from the square's normal."""
    return TILT @ [np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)]


def many(direction: np.ndarray, n: int) -> np.ndarray:
    return np.tile(np.float32(direction), (n, 1))


def hemisphere(n_cosine: int, n_phi: int) -> tuple[np.ndarray, float]:
    """Midpoint directions about the square's normal, uniform in cosine and phi, and the solid angle of each."""
    cosine, phi = np.meshgrid((np.arange(n_cosine) + 0.5) / n_cosine, (np.arange(n_phi) + 0.5) / n_phi * 2 * np.pi)
    sine = np.sqrt(1 - cosine**2).ravel()
    local = np.column_stack([sine * np.cos(phi.ravel()), cosine.ravel(), sine * np.sin(phi.ravel())])
    return (local @ TILT.T).astype(np.float32), 2 * np.pi / (n_cosine * n_phi)


def test_a_surface_without_interface_is_lambertian() -> None:
    directions, _ = hemisphere(20, 20)
    points = points_of(Material((0.2, 0.5, 0.8)), len(directions))
    value = evaluate(points, many(at_angle(0.7), len(directions)), directions)
    cosine = directions @ TILT[:, 1]
    np.testing.assert_allclose(value, cosine[:, None] * [0.2, 0.5, 0.8] / np.pi, rtol=1e-5)


def test_light_from_below_the_surface_is_not_reflected() -> None:
    directions, _ = hemisphere(8, 8)
    points = points_of(Material(0.8, ior=1.5), len(directions))
    assert not evaluate(points, many(at_angle(0.3), len(directions)), -directions).any()


def test_evaluation_is_reciprocal_and_ignores_the_length_of_directions() -> None:
    rng = np.random.default_rng(1)
    directions, _ = hemisphere(16, 16)
    other = directions[rng.permutation(len(directions))]
    points = points_of(Material((0.3, 0.4, 0.5), roughness=0.4, ior=1.6, metallic=0.3), len(directions))
    one = evaluate(points, directions, other) / (other @ TILT[:, 1])[:, None]
    two = evaluate(points, 7 * other, f32(0.1 * directions)) / (directions @ TILT[:, 1])[:, None]
    np.testing.assert_allclose(one, two, rtol=2e-4)


def test_the_linear_parts_add_up_to_the_whole() -> None:
    directions, _ = hemisphere(16, 16)
    points = points_of(Material((0.3, 0.4, 0.5), roughness=0.3, ior=1.6, metallic=0.5), len(directions))
    eye = many(at_angle(1.1), len(directions))
    parts = evaluate_specular(points, eye, directions)
    cosine = directions @ TILT[:, 1]
    whole = points.albedo * (cosine / np.pi)[:, None] + points.specular * parts.base[:, None]
    whole += points.specular_edge * parts.edge[:, None]
    np.testing.assert_allclose(evaluate(points, eye, directions), whole, rtol=1e-5)


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("angle", [0.0, 0.8, 1.4])
def test_sampling_gives_the_albedo_that_quadrature_of_the_lobe_gives(roughness: float, angle: float) -> None:
    material = Material(1.0, metallic=1.0, roughness=roughness, ior=1.5)
    directions, solid_angle = hemisphere(600, 600)
    points = points_of(material, len(directions))
    parts = evaluate_specular(points, many(at_angle(angle), len(directions)), directions)
    base, edge = (parts.base * solid_angle).sum(), (parts.edge * solid_angle).sum()

    n = 512
    grid = (np.stack(np.meshgrid(np.arange(n), np.arange(n)), -1).reshape(-1, 2) + 0.5) / n
    points = points_of(material, n * n)
    _, weight_base, weight_edge = sample_specular(points, many(at_angle(angle), n * n), grid.astype(np.float32))
    np.testing.assert_allclose(weight_base.mean(dtype=float), base, rtol=3e-3)
    np.testing.assert_allclose(weight_edge.mean(dtype=float), edge, rtol=1e-2, atol=2e-4)
    assert weight_base.max() <= 1 and weight_base.mean() + weight_edge.mean() <= 1


@pytest.mark.parametrize("angle", [0.0, 0.8, 1.4])
def test_a_smooth_lobe_reflects_what_its_reflectance_to_the_eye_says(angle: float) -> None:
    n = 4096
    u = np.random.default_rng(2).random((n, 2), np.float32)
    points, eye = points_of(Material(0.5, roughness=0.1, ior=1.5), n), many(at_angle(angle), n)
    _, base, edge = sample_specular(points, eye, u)
    sampled = points.specular[0, 0] * base.mean() + points.specular_edge[0, 0] * edge.mean()
    assert reflectance_to_eye(points, eye)[0, 0] == pytest.approx(sampled, rel=0.02)


@pytest.mark.parametrize("roughness", [0.4, 0.9])
def test_samples_are_distributed_as_their_density_says(roughness: float) -> None:
    """Chi-squared over cells of the hemisphere; samples below the horizon are the missing mass."""
    n, bins = 200_000, 12
    eye = at_angle(0.9)
    points = points_of(Material(1.0, metallic=1.0, roughness=roughness, ior=1.5), n)
    u = np.random.default_rng(2).random((n, 2)).astype(np.float32)
    directions, base, edge = sample_specular(points, many(eye, n), u)
    local = directions[base + edge > 0] @ TILT
    phi = np.arctan2(local[:, 2], local[:, 0]) % (2 * np.pi)
    ring = np.clip(local[:, 1] * bins, 0, bins - 1).astype(int)
    cell = ring * bins + np.minimum((phi / (2 * np.pi) * bins).astype(int), bins - 1)
    observed = np.bincount(cell, minlength=bins * bins)

    fine = 40
    grid, solid_angle = hemisphere(bins * fine, bins * fine)
    points = points_of(Material(1.0, metallic=1.0, roughness=roughness), len(grid))
    pdf = evaluate_specular(points, many(eye, len(grid)), grid).pdf
    mass = (pdf * solid_angle).reshape(bins, fine, bins, fine).sum((1, 3)).T.ravel()  # (phi, cosine) to (cosine, phi)
    expected = mass * n
    kept = expected > 20
    statistic = ((observed - expected)[kept] ** 2 / expected[kept]).sum()
    assert kept.sum() > 20
    assert statistic < chi2.ppf(0.9999, kept.sum())
    np.testing.assert_allclose(mass.sum(), len(local) / n, atol=3e-3)


def test_a_weighted_sample_is_the_lobe_over_its_density() -> None:
    n = 2000
    points = points_of(Material((0.9, 0.5, 0.2), metallic=1.0, roughness=0.5, ior=1.5), n)
    eye = many(at_angle(1.2), n)
    u = np.random.default_rng(3).random((n, 2)).astype(np.float32)
    directions, base, edge = sample_specular(points, eye, u)
    up = base + edge > 0
    parts = evaluate_specular(points, eye, directions)
    np.testing.assert_allclose(base[up], (parts.base / parts.pdf)[up], rtol=2e-3, atol=1e-5)
    np.testing.assert_allclose(edge[up], (parts.edge / parts.pdf)[up], rtol=2e-3, atol=1e-5)


def test_the_narrowest_lobe_still_reflects_all_of_a_white_metal() -> None:
    n = 4096
    points = points_of(Material((1.0, 1.0, 1.0), metallic=1.0, roughness=0.02, ior=1.5), n)
    u = np.random.default_rng(4).random((n, 2)).astype(np.float32)
    directions, base, edge = sample_specular(points, many(at_angle(0.5), n), u)
    np.testing.assert_allclose(base + edge, 1, atol=1e-3)
    parts = evaluate_specular(points, many(at_angle(0.5), n), directions)
    np.testing.assert_allclose((parts.base + parts.edge) / parts.pdf, base + edge, rtol=5e-3)


@pytest.mark.parametrize("roughness", [0.05, 0.25, 0.5, 0.75, 1.0])
def test_the_effective_albedo_is_the_white_sky_albedo(roughness: float) -> None:
    """Independent of the fit: cosine-weighted eyes, sampled lobe."""
    n = 100_000
    material = Material((0.6, 0.3, 0.1), metallic=0.5, roughness=roughness, ior=1.5)
    points = points_of(material, n)
    rng = np.random.default_rng(5)
    s2, phi = rng.random(n), 2 * np.pi * rng.random(n)
    eyes = np.column_stack([np.sqrt(s2) * np.cos(phi), np.sqrt(1 - s2), np.sqrt(s2) * np.sin(phi)]) @ TILT.T
    _, base, edge = sample_specular(points, eyes.astype(np.float32), rng.random((n, 2)).astype(np.float32))
    mean = points.albedo[0] + points.specular[0] * base.mean() + points.specular_edge[0] * edge.mean()
    np.testing.assert_allclose(effective_albedo(points)[0], mean, atol=2e-3)


def test_the_effective_albedo_of_a_pure_diffuse_is_its_albedo_and_never_above_one() -> None:
    np.testing.assert_allclose(effective_albedo(points_of(Material((0.2, 0.5, 0.8)), 1)), [[0.2, 0.5, 0.8]])
    assert effective_albedo(points_of(Material(1.0, ior=1.5), 1)).max() == 1
    assert not effective_albedo(points_of(Material(1.0, opacity=0.0, ior=1.5), 1)).any()


def test_glossy_are_surfaces_with_a_lobe_that_scatters() -> None:
    assert is_glossy(points_of(Material(0.5, ior=1.5), 1))[0]
    assert not is_glossy(points_of(Material(0.5, ior=1.0), 1))[0]
    assert not is_glossy(points_of(Material(0.5, ior=1.5, metallic=1.0, roughness=0.0), 1))[0]
    assert not is_glossy(points_of(Material(0.5, ior=1.5, opacity=0.0), 1))[0]


def fresnel(theta: float, ior: float) -> float:
    """Sine and tangent form, unlike the kernel's."""
    if theta == 0:
        return ((ior - 1) / (ior + 1)) ** 2
    inner = np.arcsin(np.sin(theta) / ior)
    s = np.sin(theta - inner) / np.sin(theta + inner)
    p = np.tan(theta - inner) / np.tan(theta + inner)
    return (s * s + p * p) / 2


@pytest.mark.parametrize("angle", [0.0, 0.3, np.arctan(1.5), 1.2, 1.5])
def test_glass_splits_light_by_fresnel_and_bends_it_by_snell(angle: float) -> None:
    split = dielectric_split(points_of(Material(opacity=0.0, ior=1.5), 1), many(-at_angle(angle), 1))
    np.testing.assert_allclose(split.weight_reflected[0], fresnel(angle, 1.5), rtol=1e-4)
    np.testing.assert_allclose(split.weight_reflected + split.weight_refracted, 1, rtol=1e-6)
    np.testing.assert_allclose(split.reflected[0], at_angle(angle, 0.4 + np.pi), atol=1e-6)
    inner = np.arcsin(np.sin(angle) / 1.5)
    np.testing.assert_allclose(split.refracted[0], -at_angle(inner), atol=1e-6)


def test_inside_glass_the_way_out_is_the_way_in_reversed_or_totally_reflected() -> None:
    back = points_of(Material(opacity=0.0, ior=1.5), 1, side=1)
    inner = 0.6
    split = dielectric_split(back, many(at_angle(inner), 1))
    outer = np.arcsin(1.5 * np.sin(inner))
    np.testing.assert_allclose(split.refracted[0], at_angle(outer), atol=1e-6)
    np.testing.assert_allclose(split.weight_reflected[0], fresnel(outer, 1.5), rtol=1e-4)
    beyond = dielectric_split(back, many(at_angle(np.arcsin(1 / 1.5) + 1e-3), 1))
    assert (beyond.weight_reflected == 1).all() and not beyond.weight_refracted.any()


def test_mirrors_holes_and_translucent_surfaces_split_without_glass() -> None:
    incoming = many(-at_angle(0.7), 1)
    mirror = dielectric_split(points_of(Material((0.9, 0.5, 0.1), metallic=1.0, roughness=0.0), 1), incoming)
    np.testing.assert_allclose(mirror.weight_reflected[0], (0.9, 0.5, 0.1), rtol=1e-5)
    black = Material(0.0, specular=(0.9, 0.5, 0.1), use_specular=True, roughness=0.0)
    edge = dielectric_split(points_of(black, 1), incoming)
    schlick = f32([0.9, 0.5, 0.1]) + (1 - f32([0.9, 0.5, 0.1])) * (1 - np.cos(0.7)) ** 5
    np.testing.assert_allclose(edge.weight_reflected[0], schlick, rtol=1e-5)
    np.testing.assert_allclose(mirror.reflected[0], at_angle(0.7, 0.4 + np.pi), atol=1e-6)
    assert not mirror.weight_refracted.any()
    hole = dielectric_split(points_of(Material(opacity=0.1, opacity_threshold=0.5), 1), incoming)
    assert not hole.weight_reflected.any() and (hole.weight_refracted == 1).all()
    np.testing.assert_allclose(hole.refracted, incoming, atol=1e-6)
    veil = dielectric_split(points_of(Material(opacity=0.25), 1), incoming)
    assert not veil.weight_reflected.any() and (veil.weight_refracted == 0.75).all()
