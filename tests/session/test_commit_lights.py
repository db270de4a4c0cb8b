"""Lights of a live session in a layer: opened again they are what was shown, and undo takes them out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from icheat_usd.errors import EditError
from icheat_usd.scene import SceneSnapshot
from icheat_usd.session import Quality, Session
from icheat_usd.session.commit_lights import write_lights
from icheat_usd.session.content_keys import digest
from icheat_usd.session.light_changes import all_lights, changed_light, new_light, read_image
from icheat_usd.session.live import LiveSession
from icheat_usd.session.live_state import UNCHANGED, LiveState
from tests.session.test_session import ROOM

QUALITY = Quality(n_gather=192, rays_per_row=16, rays_per_bounce_row=16, light_samples=2, n_bounces=3)

#: Centimetres, Z up, lights below a turned and scaled parent, and every way to say how bright a light is.
STAGE = """\
#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 0.01
    upAxis = "Z"
)
def Xform "World"
{
    def Cube "Room"
    {
        double size = 400
        token orientation = "leftHanded"
    }
    def Xform "Rig"
    {
        double3 xformOp:translate = (20, -10, 30)
        float3 xformOp:rotateXYZ = (20, -35, 70)
        float3 xformOp:scale = (1.5, 1.5, 1.5)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]
        def RectLight "Rect"
        {
            bool inputs:normalize = 1
            float inputs:intensity = 3000
            color3f inputs:color = (1, 0.5, 0.25)
            float inputs:exposure = 2
            bool inputs:enableColorTemperature = 1
            float inputs:colorTemperature = 4000
            float inputs:width = 60
            float inputs:height = 20
            double3 xformOp:translate = (0, 0, 40)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }
        def SphereLight "Sphere"
        {
            float inputs:radius = 4
            float inputs:intensity = 50
        }
        def SphereLight "Point"
        {
            bool treatAsPoint = 1
            float inputs:radius = 0
            float inputs:intensity = 100
        }
        def CylinderLight "Tube"
        {
            float inputs:radius = 2
            float inputs:length = 30
            color3f inputs:color = (0, 0, 1)
        }
        def DiskLight "Disk"
        {
            float inputs:intensity = 7
        }
    }
    def DistantLight "Sun"
    {
        float inputs:angle = 2
        float inputs:intensity = 3
        bool inputs:normalize = 1
    }
    def DomeLight_1 "Sky"
    {
        float inputs:intensity = 0.5
    }
    def Camera "Camera"
    {
        float focalLength = 15
        double3 xformOp:translate = (0, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
"""


def changed(snapshot: SceneSnapshot, state: LiveState, name: str, **values: object) -> LiveState:
    """What `LiveSession.set_light` does to a state."""
    path = next(path for path in snapshot.light_paths if path.endswith(f"/{name}"))
    given = dict.fromkeys(("gain", "move", "turn", "to_world", "radiance", "size")) | {"image": {}} | values
    now = all_lights(snapshot, state)[path]
    return state.with_light(path, **changed_light(path, now, **given))


def shown(snapshot: SceneSnapshot, state: LiveState) -> dict[str, tuple[np.ndarray, ...]]:
    """Kind, place, radiance and size of each light, as the live evaluator has them."""
    found = {}
    for path, light in all_lights(snapshot, state).items():
        if not light.removed:
            row = snapshot.light_paths.index(path) if path in snapshot.light_paths else -1
            kind = light.added if row < 0 else snapshot.lights.kind[row]
            radiance = np.multiply(light.radiance, light.gain)
            found[path] = (np.array(int(kind)), light.to_world, radiance, np.array(light.size))
    return found


def test_every_kind_of_change_of_every_kind_of_light_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "shot.usda"
    path.write_text(STAGE)
    session = Session.open(path, width=8, height=6)
    snapshot = session.snapshot
    state = changed(snapshot, UNCHANGED, "Rect", move=(0.1, 0.2, -0.3), turn=((0, 1, 0), 30), size=(80, 10))
    state = changed(snapshot, state, "Sphere", gain=0.25)
    state = changed(snapshot, state, "Point", size=(3,), gain=(1, 2, 3))
    state = changed(snapshot, state, "Tube", radiance=(3, 2, 1), gain=(0.5, 1, 0))
    state = changed(snapshot, state, "Disk", gain=0.0)
    state = changed(snapshot, state, "Sun", size=(0.05,), turn=((1, 0, 0), 10))
    state = changed(snapshot, state, "Sky", turn=((0, 0, 1), 50), gain=2.0)
    added = new_light("/World/New/Key", "rect", None, (0.5, 0.1, 0.2), (1, 2, 3), (0.3, 0.2), {})
    state = state.with_light("/World/New/Key", **vars(added))
    wanted = shown(snapshot, state)
    assert write_lights(session.stage, snapshot, state, layer="shot.usda", frame=None, why="test") == ()

    again = Session.open(path, width=8, height=6).snapshot
    found = shown(again, UNCHANGED)
    assert set(found) == set(wanted)
    for name, light in wanted.items():
        for a, b in zip(found[name], light, strict=True):
            np.testing.assert_allclose(a, b, rtol=3e-6, atol=3e-6, err_msg=name)
    stage = Usd.Stage.Open(str(path))
    about = stage.GetPrimAtPath("/World/Rig/Sphere").GetCustomDataByKey("icheat")
    assert about["why"] == "test" and about["who"] and about["when"].startswith("20")
    sphere = stage.GetRootLayer().GetPrimAtPath("/World/Rig/Sphere")
    assert {"inputs:intensity", "inputs:radius"} == set(sphere.properties.keys()), "dimming writes intensity alone"


def test_links_multipliers_and_shaping_outlive_a_commit(tmp_path: Path) -> None:
    path = tmp_path / "shot.usda"
    opinions = """def RectLight "Rect" ( prepend apiSchemas = ["ShapingAPI"] )
        {
            float inputs:specular = 0.5
            float inputs:shaping:cone:angle = 50
            rel collection:lightLink:excludes = </World/Room>
    """
    path.write_text(STAGE.replace('def RectLight "Rect"\n        {', opinions))
    session = Session.open(path, width=8, height=6)
    snapshot = session.snapshot
    before = snapshot.controls(snapshot.light_paths.index("/World/Rig/Rect"))
    assert before.specular == 0.5 and before.shaping is not None and before.receivers is not None
    state = changed(snapshot, UNCHANGED, "Rect", move=(0.1, 0.2, -0.3), turn=((0, 1, 0), 30), size=(80, 10), gain=2.0)
    assert write_lights(session.stage, snapshot, state, layer="shot.usda", frame=None, why="") == ()
    again = Session.open(path, width=8, height=6).snapshot
    after = again.controls(again.light_paths.index("/World/Rig/Rect"))
    assert digest(after) == digest(before) and not np.array_equal(again.lights.to_world, snapshot.lights.to_world)


def test_a_removed_light_is_deactivated_and_can_be_activated_again(tmp_path: Path) -> None:
    path = tmp_path / "shot.usda"
    path.write_text(STAGE)
    session = Session.open(path, width=8, height=6)
    state = UNCHANGED.with_light("/World/Rig/Disk", removed=True)
    write_lights(session.stage, session.snapshot, state, layer="shot.usda", frame=None, why="")
    stage = Usd.Stage.Open(str(path))
    assert not stage.GetPrimAtPath("/World/Rig/Disk").IsActive()
    assert "/World/Rig/Disk" not in Session.open(path, width=8, height=6).snapshot.light_paths


def test_what_cannot_be_written_is_one_sentence_and_leaves_the_layer(tmp_path: Path) -> None:
    asset = tmp_path / "lamp.usda"
    asset.write_text(
        """#usda 1.0
        (defaultPrim = "Lamp")
        def Xform "Lamp"
        {
            def SphereLight "Bulb"
            {
                float inputs:radius = 0.1
            }
        }
        """
    )
    path = tmp_path / "shot.usda"
    more = """def Xform "Placed" (
            instanceable = true
            prepend references = @./lamp.usda@
        )
        {
        }
        def SphereLight "Walks"
        {
            double3 xformOp:translate.timeSamples = { 1: (0, 0, 0), 5: (0, 1, 0) }
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }
        def SphereLight "Pulses"
        {
            float inputs:intensity.timeSamples = { 1: 1, 5: 9 }
        }
        def RectLight "Lamp"
        {
            def Scope "Below"
            {
            }
    """
    path.write_text(ROOM.replace('def RectLight "Lamp"\n    {', more))
    session = Session.open(path, width=8, height=6, frame=1.0)
    snapshot = session.snapshot
    session.stage.GetRootLayer().Save(force=True)
    before = path.read_text()

    def refused(state: LiveState, message: str, frame: float | None = None) -> None:
        with pytest.raises(EditError, match=message):
            write_lights(session.stage, snapshot, state, layer="shot.usda", frame=frame, why="")
        assert path.read_text() == before and session.stage.GetRootLayer().ExportToString() == before

    refused(changed(snapshot, UNCHANGED, "Bulb", gain=2.0), "lies in the instance /World/Placed, whose lights")
    refused(changed(snapshot, UNCHANGED, "Walks", move=(1, 0, 0)), "/World/Walks moves over time")
    refused(changed(snapshot, UNCHANGED, "Pulses", gain=2.0), "intensity changes over time; give the frame")
    refused(UNCHANGED.with_light("/World/Lamp", removed=True), "/World/Lamp/Below lies below it")
    image = np.ones((2, 4, 3), np.float32)
    refused(changed(snapshot, UNCHANGED, "Lamp", image=read_image(image)), "its image is in memory alone")
    taken = new_light("/World/Block", "rect", None, (0, 0, 0), 1.0, (1, 1), {})
    refused(UNCHANGED.with_light("/World/Block", **vars(taken)), "/World/Block exists already as a Cube")
    # The first light is written, the second refused: neither stays.
    both = changed(snapshot, changed(snapshot, UNCHANGED, "Lamp", gain=2.0), "Bulb", gain=2.0)
    refused(both, "lies in the instance")

    # With a frame it is a key there.
    state = changed(snapshot, UNCHANGED, "Pulses", gain=2.0)
    assert write_lights(session.stage, snapshot, state, layer="shot.usda", frame=3.0, why="") == ()
    intensity = session.stage.GetPrimAtPath("/World/Pulses").GetAttribute("inputs:intensity")
    assert intensity.GetTimeSamples() == [1.0, 3.0, 5.0] and intensity.Get(3.0) == pytest.approx(2.0)
    state = changed(snapshot, UNCHANGED, "Walks", move=(1, 0, 0))
    write_lights(session.stage, snapshot, state, layer="shot.usda", frame=3.0, why="")
    place = UsdGeom.XformCache(3.0).GetLocalToWorldTransform(session.stage.GetPrimAtPath("/World/Walks"))
    assert tuple(place.ExtractTranslation()) == pytest.approx((1, 0, 0))


def test_a_stronger_layer_is_named(tmp_path: Path) -> None:
    (tmp_path / "weak.usda").write_text(ROOM)
    path = tmp_path / "shot.usda"
    path.write_text(
        '#usda 1.0\n(\ndefaultPrim = "World"\nmetersPerUnit = 1\nupAxis = "Y"\nsubLayers = [@./weak.usda@]\n)\n'
        'over "World"\n{\nover "Lamp"\n{\nfloat inputs:intensity = 20\n}\n}\n'
    )
    session = Session.open(path, width=8, height=6)
    state = changed(session.snapshot, UNCHANGED, "Lamp", gain=0.5)
    findings = write_lights(session.stage, session.snapshot, state, layer="weak.usda", frame=None, why="")
    assert [finding.feature for finding in findings] == ["inputs:intensity"] and "shot.usda" in findings[0].message


def test_a_session_goes_on_from_what_it_wrote_and_undo_takes_it_back(tmp_path: Path) -> None:
    path = tmp_path / "shot.usda"
    path.write_text(ROOM)
    authoring_session = Session.open(path)
    authoring_session.add_edit(
        "warm", layer="shot.usda", parameters={"gain": 3.0}, receivers=["/World/Room"], casters=["/World/Block"]
    )
    before = path.read_text()
    with LiveSession.open(path, width=20, height=15, quality=QUALITY) as live:
        unchanged = live.frame(level="rest")
        live.set_light("Lamp", gain=(0.5, 0.7, 0.9), move=(0.2, -0.1, 0.3))
        live.add_light("/World/Fill", "sphere", at=(-1, 0, 0), radiance=4.0, size=(0.1,))
        live.set_amount("warm", 0.5)
        changed_image = live.frame(level="rest")
        assert live.commit_lights("shot.usda", why="softer") == ()
        assert not live.state.lights and live.state.edits
        np.testing.assert_allclose(live.frame(level="rest"), changed_image, rtol=1e-3, atol=1e-5)
        assert live.lights["/World/Fill"].added is None
        live.set_light("Fill", gain=0.0)
        live.undo()
        assert live.undo() == "commit lights"
        assert path.read_text() == before and set(live.state.lights) == {"/World/Lamp", "/World/Fill"}
        np.testing.assert_array_equal(live.frame(level="rest"), changed_image)
        assert live.redo() == "commit lights"
        assert live.lights["/World/Fill"].added is None
        while live.undo():
            pass
        np.testing.assert_array_equal(live.frame(level="rest"), unchanged)
