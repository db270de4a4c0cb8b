"""What is precomputed to sample the lights of a snapshot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.kernels.environment import dome_columns_cdf
from icheat_usd.kernels.guide import Guide
from icheat_usd.kernels.lights import LightTables
from icheat_usd.lighting.guide import Effort, learn_guide, no_guide
from icheat_usd.materials import points_on_surface
from icheat_usd.scene import F32, F64, I32, I64, LightKind, SceneSnapshot, SurfacePoints, Texture
from icheat_usd.steps import Steps, all_steps
from icheat_usd.tracing import Tracer

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec.709

# Where the emission of a textured triangle is averaged for its share of the samples.
_PLACES = np.array([(1, 1), (4, 1), (1, 4), (2.5, 2.5), (1, 2.5), (2.5, 1), (2, 2), (0.3, 0.3), (5.4, 0.3), (0.3, 5.4)])
_PLACES = (_PLACES / 6.0).astype(np.float32)

# Share of a textured triangle's weight that does not depend on those places: they may all be black.
_BLIND_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class LightSampler:
    """Distributions over the texels of domes and the triangles of mesh lights of one snapshot."""

    tables: LightTables
    guide: Guide  #: from where the light of domes can be seen
    emissive_key: I64  #: (n_emissive,) ascending: instance x number of triangles + triangle
    emissive_row: I64  #: (n_emissive,) row of `Lights.triangle` with that key
    emissive_light: I32  #: (n_emissive,) light that owns each row of `Lights.triangle`
    n_triangles: int

    def emissive_rows(self, instance: I32, triangle: I32) -> I64:
        """Rows of `Lights.triangle` that hits lie on, (n,); -1 where they are no light."""
        row = np.full(len(instance), -1, np.int64)
        if len(self.emissive_key):
            key = instance.astype(np.int64) * self.n_triangles + triangle
            place = np.minimum(np.searchsorted(self.emissive_key, key), len(self.emissive_key) - 1)
            found = (instance >= 0) & (self.emissive_key[place] == key)
            row[found] = self.emissive_row[place[found]]
        return row


def build_light_sampler(
    snapshot: SceneSnapshot,
    tracer: Tracer | None = None,
    points: SurfacePoints | None = None,
    seed: int = 0,
    effort: Effort | None = None,
) -> LightSampler:
    """Prepare the sampling of every light: all of `prepare_light_sampler`."""
    return all_steps(prepare_light_sampler(snapshot, tracer, points, seed, effort))


def prepare_light_sampler(
    snapshot: SceneSnapshot,
    tracer: Tracer | None = None,
    points: SurfacePoints | None = None,
    seed: int = 0,
    effort: Effort | None = None,
) -> Steps[LightSampler]:
    """Prepare the sampling of every light, in steps.

    Dome texels get a probability proportional to the luminance of the bilinear image averaged
    over the texel times its solid angle; triangles of a mesh light one proportional to world
    area times mean luminance of the emission.

    Parameters
    ----------
    tracer, points : Tracer and SurfacePoints, optional
        With both, the sampler learns from where around these points domes can be seen, which saves
        most of the noise in rooms with windows. Light elsewhere is as right, only noisier.
    seed : int
        Of the rays that learn; what is learnt depends on nothing else.
    effort : Effort, optional
        How much is learnt.
    """
    lights = snapshot.lights
    n = len(lights.kind)
    linear = lights.to_world[:, :, :3].astype(np.float64)
    determinant = np.abs(np.linalg.det(linear)) if n else np.zeros(0)
    to_local = np.zeros((n, 3, 3))
    for light in np.flatnonzero(determinant > 0.0):
        to_local[light] = np.linalg.inv(linear[light])
    columns_begin, columns_cdf, rows_begin, rows_cdf = _dome_distributions(snapshot)
    cdf, corners, emission = _triangle_distributions(snapshot)
    n_triangles = len(snapshot.geometry.points)
    key = lights.triangle_instance.astype(np.int64) * n_triangles + lights.triangle
    order = np.argsort(key, kind="stable")
    tables = LightTables(
        to_local=to_local,
        determinant=determinant,
        columns_begin=columns_begin,
        columns_cdf=columns_cdf,
        rows_begin=rows_begin,
        rows_cdf=rows_cdf,
        triangle_cdf=cdf,
        triangle_corners=corners,
        triangle_emission=emission,
    )
    guide = no_guide(n)
    if tracer is not None and points is not None:
        guide = yield from learn_guide(snapshot, tracer, tables, points, seed, effort or Effort())
    return LightSampler(
        tables=tables,
        guide=guide,
        emissive_key=key[order],
        emissive_row=order,
        emissive_light=np.repeat(np.arange(n, dtype=np.int32), np.diff(lights.triangle_begin)),
        n_triangles=n_triangles,
    )


def _dome_distributions(snapshot: SceneSnapshot) -> tuple[np.ndarray, F32, np.ndarray, F64]:
    lights, textures = snapshot.lights, snapshot.textures
    columns_begin = np.full(len(lights.kind), -1, np.int64)
    rows_begin = np.full(len(lights.kind), -1, np.int64)
    columns: list[F32] = []
    rows: list[F64] = []
    n_columns = n_rows = 0
    for light in np.flatnonzero((lights.kind == LightKind.DOME) & (lights.texture >= 0)):
        texture = int(lights.texture[light])
        width, height = int(textures.width[texture]), int(textures.height[texture])
        cdf = np.zeros(width * height, np.float32)
        weight = np.zeros(height)
        dome_columns_cdf(textures.texels, int(textures.begin[texture]), width, height, cdf, weight)
        total = weight.sum()
        cumulative = np.cumsum(weight) / total if total > 0.0 else weight
        if total > 0.0:
            cumulative[np.flatnonzero(weight)[-1] :] = 1.0  # rounding must not leave the last row short
        columns_begin[light], rows_begin[light] = n_columns, n_rows
        columns.append(cdf)
        rows.append(cumulative)
        n_columns += width * height
        n_rows += height
    return (
        columns_begin,
        np.concatenate(columns) if columns else np.zeros(1, np.float32),
        rows_begin,
        np.concatenate(rows) if rows else np.zeros(1),
    )


def _triangle_distributions(snapshot: SceneSnapshot) -> tuple[F64, F64, F32]:
    geometry, materials, lights = snapshot.geometry, snapshot.materials, snapshot.lights
    n = len(lights.triangle)
    if n == 0:
        return np.zeros(1), np.zeros((1, 3, 3)), np.zeros((1, 3), np.float32)
    to_world = geometry.instance_to_world[lights.triangle_instance].astype(np.float64)
    corners = np.einsum("nij,nkj->nki", to_world[:, :, :3], geometry.points[lights.triangle]) + to_world[:, None, :, 3]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)

    used = materials.texture[geometry.material[lights.triangle]]
    # a cut-out emits nothing in its holes, so its opacity makes the emission vary as well
    textured = (used[:, Texture.EMISSION] >= 0) | (used[:, Texture.OPACITY] >= 0)
    emission = np.zeros((n, 3))
    for group, places in ((~textured, _PLACES[:1]), (textured, _PLACES)):
        rows = np.flatnonzero(group)
        for place in places if len(rows) else ():
            emission[rows] += _emission_at(snapshot, rows, place) / len(places)
    luminance = np.maximum(emission @ _LUMINANCE, 0.0)

    cdf = np.zeros(n)
    for begin, end in zip(lights.triangle_begin[:-1], lights.triangle_begin[1:], strict=True):
        if end == begin:
            continue
        part = slice(int(begin), int(end))
        weight = area[part] * luminance[part]
        if textured[part].any():
            mean = weight.sum() / max(area[part].sum(), 1e-300)
            blind = np.where(textured[part], area[part] * (mean if mean > 0.0 else 1.0), 0.0)
            weight = weight + _BLIND_SHARE * blind
        total = weight.sum()
        if total > 0.0:
            cdf[part] = np.cumsum(weight) / total
            cdf[int(begin) + int(np.flatnonzero(weight)[-1]) : int(end)] = 1.0
    return cdf, np.ascontiguousarray(corners), emission.astype(np.float32)


def _emission_at(snapshot: SceneSnapshot, rows: np.ndarray, place: F32) -> F32:
    lights = snapshot.lights
    points = points_on_surface(
        snapshot,
        np.ascontiguousarray(lights.triangle_instance[rows]),
        np.ascontiguousarray(lights.triangle[rows]),
        np.tile(place, (len(rows), 1)),
        np.zeros(len(rows), np.uint8),
    )
    return points.emission
