"""What lights may do beside shining evenly on everything: links, multipliers and shaping, as `LightControls`.

Surfaces are members of `lightLink` and `shadowLink` by their scene paths [1]_. A light without them, or whose
collections include all there is, has no table. Values of ShapingAPI are those that USD resolves: where it is applied,
a cone that nobody authored has 90 degrees, and a sphere keeps to its front.

.. [1] https://openusd.org/release/user_guides/schemas/usdLux/overview.html, "Light-linking and Shadow-linking"
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from pxr import Sdf, Tf, Usd, UsdLux

from icheat_usd.errors import ImageError
from icheat_usd.kernels.surface import MIRROR_ROUGHNESS
from icheat_usd.lighting.ies import ProfileError, read_profile
from icheat_usd.scene import I32, PLAIN, U8, Bool, Finding, Geometry, LightControls, Materials, Shaping, Surface
from icheat_usd.stage.light_inputs import LightInputs
from icheat_usd.stage.shading import time_code
from icheat_usd.stage.textures import asset_content

_FLAT = ("RectLight", "DiskLight", "DistantLight")  # emit to one side: a cone of 90 degrees cuts nothing
_SHAPED = (*_FLAT, "SphereLight", "CylinderLight")


def read_controls(
    prims: Iterable[Usd.Prim],
    time: Usd.TimeCode | float | None,
    light_paths: Sequence[str],
    surfaces: Sequence[Surface],
    geometry: Geometry,
    materials: Materials,
) -> tuple[tuple[LightControls, ...], list[Finding]]:
    """Controls of each light, and findings about what is not supported.

    Parameters
    ----------
    prims
        Prims that may be lights, meshes that light the scene included.
    time
        When inputs are read; None is the earliest time.
    light_paths
        Scene path of each light. Lights that are not among `prims` are plain.
    surfaces, geometry, materials
        Of the snapshot.

    Returns
    -------
    tuple of LightControls
        One per light; none at all where every light is plain.
    list of Finding
    """
    reader = _Reader(time_code(time), surfaces, geometry, materials)
    wanted = set(light_paths)
    known = {str(prim.GetPath()): reader.read(prim) for prim in prims if str(prim.GetPath()) in wanted}
    found = tuple(known.get(path, PLAIN) for path in light_paths)
    return (found if any(one is not PLAIN for one in found) else ()), list(reader.inputs.report.findings())


class _Reader:
    def __init__(
        self, time: Usd.TimeCode, surfaces: Sequence[Surface], geometry: Geometry, materials: Materials
    ) -> None:
        self.time = time
        self.inputs = LightInputs(time)
        self.paths = [surface.path for surface in surfaces]
        self.instance_surface: I32 = geometry.instance_surface
        self.geometry, self.materials = geometry, materials
        self._tables: dict[bytes, U8] = {}

    def read(self, prim: Usd.Prim) -> LightControls:
        light = UsdLux.LightAPI(prim)
        if not light:
            return PLAIN
        if light.GetFiltersRel().GetTargets():
            self.inputs.unsupported(prim, "light:filters", "the light is not filtered")
        receivers = self._members(prim, light.GetLightLinkCollectionAPI(), "lightLink")
        blockers = self._members(prim, light.GetShadowLinkCollectionAPI(), "shadowLink")
        if self.inputs.value(prim, "shadow:enable", True) is False:
            blockers = self._table(np.zeros(len(self.instance_surface), np.bool_))
        self._report_shadows(prim)
        if receivers is not None:
            self._report_mirrors(prim, receivers)
        diffuse, specular = (self._factor(prim, name) for name in ("diffuse", "specular"))
        shaping = self._shaping(prim)
        if receivers is None and blockers is None and diffuse == specular == 1.0 and shaping is None:
            return PLAIN
        return LightControls(receivers, blockers, diffuse, specular, shaping)

    # Links --------------------------------------------------------------------------------------

    def _members(self, prim: Usd.Prim, collection: Usd.CollectionAPI, name: str) -> U8 | None:
        """(n_instances,) 1 for members; None where all are."""
        if not collection or _includes_everything(collection):
            return None
        try:
            query = collection.ComputeMembershipQuery()
        except Tf.ErrorException as error:
            reason = str(error).partition(" : ")[2].partition("\n")[0].strip().strip("'")
            message = f"its membership expression cannot be used ({reason}), and the light acts on everything; mend it."
            self.inputs.report(prim.GetPath(), name, message)
            return None
        known = {path: bool(query.IsPathIncluded(Sdf.Path(path))) for path in set(self.paths)}
        of_surface = np.array([known[path] for path in self.paths], np.bool_)
        members = of_surface[self.instance_surface] if len(self.paths) else np.zeros(0, np.bool_)
        return None if members.all() else self._table(members)

    def _table(self, members: Bool) -> U8:
        """One array for all lights that are linked alike."""
        table = members.astype(np.uint8)
        return self._tables.setdefault(table.tobytes(), table)

    def _report_mirrors(self, prim: Usd.Prim, receivers: U8) -> None:
        """Domes and glowing meshes are seen in mirrors and glass, linked or not: say so where it shows."""
        if prim.GetTypeName() in _SHAPED:
            return
        clear = _mirrors_or_glass(self.materials)[self.geometry.material]
        begin = self.geometry.mesh_begin
        for instance in np.flatnonzero(receivers == 0).tolist():
            mesh = self.geometry.instance_mesh[instance]
            if clear[begin[mesh] : begin[mesh + 1]].any():
                path = self.paths[self.instance_surface[instance]]
                message = f"it leaves out {path}, but mirrors and clear glass show what is behind them all the same."
                self.inputs.report(prim.GetPath(), "lightLink", message)
                return

    # Factors ------------------------------------------------------------------------------------

    def _factor(self, prim: Usd.Prim, name: str) -> float:
        return self._number(prim, name, 1.0, 0.0)

    def _number(self, prim: Usd.Prim, name: str, default: float, lowest: float = -math.inf) -> float:
        value = self.inputs.number(prim, name, default)
        if math.isfinite(value) and value >= lowest:
            return value
        self.inputs.report(
            prim.GetPath(), name, f"{name} is {value:g}, which counts as {lowest if value < lowest else default:g}."
        )
        return lowest if value < lowest else default

    # Shaping ------------------------------------------------------------------------------------

    def _shaping(self, prim: Usd.Prim) -> Shaping | None:
        kind = str(prim.GetTypeName())
        focus = max(self.inputs.number(prim, "shaping:focus", 0.0), 0.0)
        angle = self.inputs.number(prim, "shaping:cone:angle", 180.0)
        asset = self.inputs.value(prim, "shaping:ies:file", None)
        has_profile = isinstance(asset, Sdf.AssetPath) and bool(asset.path)
        if kind not in _SHAPED:
            self._report_unshaped(prim, focus, has_profile)
            return None
        softness = min(max(self._number(prim, "shaping:cone:softness", 0.0), 0.0), 1.0)
        is_cut = softness > 0.0 or angle < (90.0 if kind in _FLAT else 180.0)
        cutoff = math.radians(max(angle, 0.0)) if is_cut else math.inf
        focus = focus if math.isfinite(focus) else 0.0
        tint = self.inputs.value(prim, "shaping:focusTint", (0.0, 0.0, 0.0))
        plain = Shaping(
            cone=np.array([cutoff * (1.0 - softness) if is_cut else cutoff, cutoff]),
            focus=focus,
            focus_tint=np.array([max(float(c), 0.0) if math.isfinite(c) else 0.0 for c in tint]),
            profile_scale=self._number(prim, "shaping:ies:angleScale", 0.0),
            vertical=np.zeros(0),
            horizontal=np.zeros(0),
            intensity=np.zeros((0, 0)),
        )
        shaping = self._with_profile(prim, asset, plain) if has_profile else plain
        return shaping if is_cut or focus > 0.0 or len(shaping.horizontal) else None

    def _with_profile(self, prim: Usd.Prim, asset: Sdf.AssetPath, shaping: Shaping) -> Shaping:
        try:
            if not asset.resolvedPath:
                raise ProfileError(f"the profile {asset.path} does not exist; restore the file or its path")
            content = asset_content(asset.resolvedPath)
            data = Path(content).read_bytes() if isinstance(content, str) else content
            profile = read_profile(data, asset.path)
        except (ProfileError, ImageError, OSError) as error:
            message = f"{str(error).rstrip('.')}; the light has no profile."
            self.inputs.report(prim.GetPath(), "shaping:ies:file", message)
            return shaping
        intensity = profile.intensity
        if self.inputs.value(prim, "shaping:ies:normalize", False):
            mean = profile.mean()
            intensity = intensity / mean if mean > 0.0 else np.zeros_like(intensity)
        return shaping._replace(vertical=profile.vertical, horizontal=profile.horizontal, intensity=intensity)

    def _report_unshaped(self, prim: Usd.Prim, focus: float, has_profile: bool) -> None:
        if focus > 0.0:
            self.inputs.unsupported(prim, "shaping:focus", "the light spreads evenly")
        cone = UsdLux.ShapingAPI(prim).GetShapingConeAngleAttr()
        if cone and cone.HasAuthoredValue() and (cone.Get(self.time) or 0.0) < 180.0:
            self.inputs.unsupported(prim, "shaping:cone:angle", "the light is not cut to a cone")
        if has_profile:
            self.inputs.unsupported(prim, "shaping:ies:file", "the light has no profile")

    # Shadows ------------------------------------------------------------------------------------

    def _report_shadows(self, prim: Usd.Prim) -> None:
        tint = self.inputs.value(prim, "shadow:color", None)
        if tint is not None and any(c != 0.0 for c in tint):
            self.inputs.unsupported(prim, "shadow:color", "its shadows are black")
        for name in ("shadow:distance", "shadow:falloff"):
            if self.inputs.number(prim, name, -1.0) >= 0.0:
                self.inputs.unsupported(prim, name, "its shadows reach everywhere")


def _includes_everything(collection: Usd.CollectionAPI) -> bool:
    """Whether nothing is said that could leave a surface out."""
    expression = collection.GetMembershipExpressionAttr().Get()
    return (
        collection.GetIncludeRootAttr().Get() is not False
        and collection.GetExpansionRuleAttr().Get() in (None, "", Usd.Tokens.expandPrims)
        and not collection.GetExcludesRel().GetTargets()
        and not (expression is not None and str(expression))
    )


def _mirrors_or_glass(materials: Materials) -> Bool:
    """(n,) which materials are mirrors or clear glass all over."""
    smooth = materials.roughness <= MIRROR_ROUGHNESS
    no_base = (materials.metallic >= 1.0) & (materials.use_specular == 0) | ~materials.diffuse.any(axis=1)
    glass = (materials.opacity <= 0.0) & (materials.opacity_threshold <= 0.0) & (materials.ior != 1.0)
    return np.asarray(smooth & no_base & (materials.ior != 1.0) | glass)
