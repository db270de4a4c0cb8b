"""A stage at one time code, turned into arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pxr import Usd, UsdGeom

from icheat_usd.errors import StageError
from icheat_usd.progress import Progress, silent
from icheat_usd.scene import SceneSnapshot
from icheat_usd.stage.camera import (
    find_camera,
    frame_camera,
    named_settings_findings,
    read_camera,
    read_render_choices,
)
from icheat_usd.stage.instancing import InstancerReader
from icheat_usd.stage.light_controls import read_controls
from icheat_usd.stage.light_tags import read_light_tags
from icheat_usd.stage.lights import read_lights, read_mesh_factors, with_mesh_lights
from icheat_usd.stage.materials import MaterialLibrary
from icheat_usd.stage.opening import composition_findings, quiet_usd
from icheat_usd.stage.placing import GeometryBuilder
from icheat_usd.stage.refusals import named_refusals
from icheat_usd.stage.reporting import Reporter
from icheat_usd.stage.transforms import Placement
from icheat_usd.stage.walking import walk

#: Value of `camera` that frames all geometry instead of looking through a camera of the stage.
AUTO_CAMERA = "auto"


@named_refusals
def take_snapshot(
    stage: Usd.Stage,
    *,
    camera: str | None = None,
    time: float | None = None,
    width: int | None = None,
    height: int | None = None,
    subdivision_level: int | None = 2,
    purposes: Sequence[str] | None = None,
    product: str | None = None,
    progress: Progress = silent,
) -> SceneSnapshot:
    """Read everything that is rendered from a stage at one time.

    Parameters
    ----------
    stage
        Not changed.
    camera
        Path of a camera; by default that of the render settings, else the stage's only one.
        ``"auto"`` makes one that frames all geometry.
    time
        Time code; by default the stage's start time code where it has one, else the earliest sample of each value.
    width, height : pixels
        By default as the render settings say, else 640 wide with the camera's aspect.
    subdivision_level
        Steps of subdivision surfaces; None shows their control meshes as they are, in a fraction of the time.
    purposes
        Purposes that are shown; by default the render settings' included ones, else "default" and "render".
    product
        Path of the RenderProduct whose opinions about the image count; the render settings' first one by default.
    progress
        Told how far the reading is.

    Returns
    -------
    SceneSnapshot
        In metres about the scene's centre, stage axes kept; its `findings` list what could not be read.

    Raises
    ------
    StageError
        No camera can be chosen, or the chosen one cannot be used.
    """
    if subdivision_level is not None and subdivision_level < 0:
        raise StageError(f"The subdivision level is {subdivision_level}; give 0 or more.")
    code = time if time is not None else _start_time(stage)
    when = Usd.TimeCode.EarliestTime() if code is None else Usd.TimeCode(code)
    report = Reporter()
    with quiet_usd():
        choices = read_render_choices(stage, when, product)
        report.extend(named_settings_findings(stage))
        _check_range(stage, time, report)
        wanted = None if camera is None else str(camera)
        camera_prim = None if wanted == AUTO_CAMERA else find_camera(stage, wanted, choices)
        report.extend(composition_findings(stage))

        progress("reading the stage", 0.0)
        found = walk(stage.GetPseudoRoot(), report)
        materials = MaterialLibrary(stage, when)
        shown_purposes = choices.purposes if purposes is None else purposes
        builder = GeometryBuilder(when, materials, subdivision_level, shown_purposes, choices.material_purpose, report)
        gprims = [prim for prim in found.gprims if builder.is_shown(prim)]
        progress("reading the stage", 0.2)
        builder.place_prims(gprims, builder.add_meshes(gprims))
        progress("reading the stage", 0.6)
        instancers = InstancerReader(builder)
        for prim in found.instancers:
            if builder.is_shown(prim):
                instancers.place(prim)

        meters_per_unit = _meters_per_unit(stage, report)
        bounds = builder.bounds()
        middle = np.zeros(3) if bounds is None else 0.5 * (bounds[0] + bounds[1])
        placement = Placement(meters_per_unit, middle * meters_per_unit)
        if bounds is None:
            report("/", "geometry", "the stage shows no geometry at this time; check visibility, purpose and payloads.")
        geometry = builder.build(placement)

        progress("reading the stage", 0.8)
        lights_shown = [prim for prim in found.lights if builder.is_shown(prim)]
        lights, light_paths, light_findings = read_lights(lights_shown, when, placement, materials.textures)
        tables, material_paths = materials.tables()
        lights, light_paths = with_mesh_lights(
            lights,
            light_paths,
            geometry,
            builder.surfaces,
            tables,
            materials.textures.table(),
            read_mesh_factors(lights_shown, when),
        )
        controls, control_findings = read_controls(lights_shown, when, light_paths, builder.surfaces, geometry, tables)
        report.extend(materials.findings)
        report.extend(light_findings)
        report.extend(control_findings)

        if camera_prim is None:
            half = np.zeros(3) if bounds is None else 0.5 * (bounds[1] - bounds[0]) * meters_per_unit
            view = frame_camera(-half, half, str(UsdGeom.GetStageUpAxis(stage)), width, height, choices)
        else:
            view = read_camera(camera_prim, when, placement, choices, width, height)
        progress("reading the stage", 1.0)
        return SceneSnapshot(
            geometry=geometry,
            surfaces=tuple(builder.surfaces),
            materials=tables,
            material_paths=material_paths,
            textures=materials.textures.table(),
            lights=lights,
            light_paths=light_paths,
            light_controls=controls,
            light_tags=read_light_tags([*lights_shown, *gprims], when, light_paths),
            camera=view,
            stage_path=stage.GetRootLayer().realPath or stage.GetRootLayer().identifier,
            time_code=code,
            centre=placement.centre,
            radius=builder.radius(placement),
            findings=report.findings(),
        )


def _start_time(stage: Usd.Stage) -> float | None:
    return float(stage.GetStartTimeCode()) if stage.HasAuthoredMetadata("startTimeCode") else None


def _check_range(stage: Usd.Stage, time: float | None, report: Reporter) -> None:
    """Report a frame that the stage does not claim to have: what is animated holds there."""
    if time is None or not stage.HasAuthoredTimeCodeRange():
        return
    first, last = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    if first <= last and not first <= time <= last:
        message = f"frame {time:g} lies outside of the stage's frames {first:g}:{last:g}, beyond which animation holds."
        report("/", "time", message)


def _meters_per_unit(stage: Usd.Stage, report: Reporter) -> float:
    value = float(UsdGeom.GetStageMetersPerUnit(stage))
    if np.isfinite(value) and value > 0.0:
        return value
    report("/", "metersPerUnit", f"metersPerUnit is {value}; 0.01, USD's own fallback, is used.")
    return 0.01
