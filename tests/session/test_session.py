"""The open document: authoring through real layers and sidecars, and the images that result."""

from __future__ import annotations

import shutil
import textwrap

import numpy as np
import pytest

from icheat_usd.errors import EditError, SidecarError, StageError
from icheat_usd.image.exr import read_exr, write_exr
from icheat_usd.image.png import write_png
from icheat_usd.session import DRAFT, GatherSettings, Quality, Session, soft_sphere

QUALITY = Quality(n_gather=256, rays_per_row=32, rays_per_bounce_row=32, light_samples=4, n_bounces=4)

ROOM = """\
#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "World"
{
    def Cube "Room"
    {
        double size = 4
        token orientation = "leftHanded"
        color3f[] primvars:displayColor = [(0.7, 0.7, 0.7)]
    }
    def Cube "Block"
    {
        double size = 1
        double3 xformOp:translate = (0.5, -1.5, -0.5)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        color3f[] primvars:displayColor = [(0.8, 0.2, 0.1)]
    }
    def RectLight "Lamp"
    {
        float inputs:intensity = 20
        float inputs:width = 1
        float inputs:height = 1
        double3 xformOp:translate = (0, 1.95, 0)
        float xformOp:rotateX = -90
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
    }
    def Camera "Camera"
    {
        float focalLength = 15
        float horizontalAperture = 20
        float verticalAperture = 15
        double3 xformOp:translate = (0, 0, 1.9)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
"""


@pytest.fixture
def shot(tmp_path):
    """A shot layer over a sequence layer over a room."""
    (tmp_path / "room.usda").write_text(ROOM)
    for name, weaker in (("sequence", "room"), ("shot", "sequence")):
        (tmp_path / f"{name}.usda").write_text(
            textwrap.dedent(f"""\
                #usda 1.0
                (
                    defaultPrim = "World"
                    metersPerUnit = 1
                    upAxis = "Y"
                    subLayers = [@./{weaker}.usda@]
                )
                """)
        )
    return tmp_path / "shot.usda"


def open_shot(shot) -> Session:
    return Session.open(shot, width=24, height=18, quality=QUALITY)


def warm(session: Session, **values):
    values = {
        "layer": "shot.usda",
        "operation": "scale",
        "parameters": {"color": (3.0, 1.5, 0.5)},
        "receivers": ["/World/Room"],
        "casters": ["/World/Block"],
    } | values
    return session.add_edit("warm", **values)


def test_a_pipeline_script_edits_previews_and_renders(shot, tmp_path):
    session = open_shot(shot)
    session.add_edit(
        "warm",
        layer="shot.usda",
        operation="scale",
        parameters={"color": (3.0, 1.5, 0.5)},
        receivers=["/World/Room"],
        casters=["/World/Block"],
        receiver_brush=soft_sphere((0, -2, 0), 0.5, 3.0),
    )
    preview = session.relight()
    write_exr(preview, tmp_path / "preview.exr")
    write_png(preview, tmp_path / "preview.png")
    final = session.render(GatherSettings(samples_per_pixel=1, gather_rays=16, light_samples=1))
    for film in (preview, final):
        assert set(film.layers) == {
            "beauty", "direct", "indirect", "indirect_edited", "edit_delta", "albedo", "normal", "depth",
        }  # fmt: skip
        delta = film.layer("edit_delta")
        assert delta[..., 0].max() > 0 and delta[..., 2].min() < 0
        np.testing.assert_allclose(
            film.layer("beauty"), film.layer("direct") + film.layer("indirect_edited"), rtol=1e-5, atol=1e-6
        )
    again = read_exr(tmp_path / "preview.exr")
    np.testing.assert_array_equal(again.layer("indirect_edited"), preview.layer("indirect_edited"))
    assert again.metadata["stackDigest"] == session.stack.digest
    assert again.metadata["camera"] == "/World/Camera"


def test_a_second_session_sees_the_same_edit_through_the_files(shot):
    session = open_shot(shot)
    warm(session, caster_brush=soft_sphere((0.5, -1.0, 0), 0.2, 1.5))
    first, second = session.relight(), open_shot(shot).relight()
    np.testing.assert_array_equal(first.layer("indirect_edited"), second.layer("indirect_edited"))
    assert np.abs(second.layer("edit_delta")).max() > 0
    assert (shot.parent / "shot.v001.icheat.h5").exists()


def test_muted_and_zeroed_edits_give_the_unedited_bits_in_both_renderers(shot):
    plain = open_shot(shot)
    settings = GatherSettings(samples_per_pixel=1, gather_rays=8, light_samples=1)
    expected = plain.relight().layer("beauty"), plain.render(settings).layer("beauty")
    session = open_shot(shot)
    edit = warm(session)
    assert (session.relight().layer("beauty") != expected[0]).any()
    for values in ({"enabled": False}, {"enabled": True, "amount": 0.0}):
        session.set_edit(edit, layer="shot.usda", **values)
        np.testing.assert_array_equal(session.relight().layer("beauty"), expected[0])
        np.testing.assert_array_equal(session.render(settings).layer("beauty"), expected[1])


def test_a_shot_overrides_one_parameter_of_the_sequence(shot):
    session = open_shot(shot)
    edit = warm(session, layer="sequence.usda")
    before = session.relight()
    session.set_edit(edit, layer="shot.usda", amount=0.5)
    after = session.relight()
    np.testing.assert_allclose(after.layer("edit_delta"), 0.5 * before.layer("edit_delta"), rtol=1e-3, atol=1e-5)
    assert "icheat:scale:color" in (shot.parent / "sequence.usda").read_text()
    assert "icheat:amount = 0.5" in shot.read_text()
    assert "icheat:scale:color" not in shot.read_text()


def test_a_refused_edit_leaves_layer_and_folder_as_they_were(shot):
    session = open_shot(shot)
    before = shot.read_text(), sorted(p.name for p in shot.parent.iterdir())
    for values, complaint in (
        ({"receivers": ["/World/Nowhere"]}, "Nowhere"),
        ({"parameters": {"colour": (1.0, 1.0, 1.0)}}, "colour"),
        ({"operation": "wrap"}, "wrap"),
        ({"layer": "other.usda"}, "other.usda"),
    ):
        with pytest.raises(EditError, match=complaint):
            warm(session, **values)
        assert before == (shot.read_text(), sorted(p.name for p in shot.parent.iterdir()))


def test_missing_damaged_and_foreign_payloads_are_named(shot):
    session = open_shot(shot)
    warm(session, receiver_brush=soft_sphere((0, -2, 0), 0.5, 3.0))
    sidecar = shot.parent / "shot.v001.icheat.h5"
    content = sidecar.read_bytes()
    sidecar.write_bytes(content[: len(content) // 2])
    with pytest.raises(SidecarError, match="shot.v001.icheat.h5"):
        open_shot(shot).relight()
    sidecar.unlink()
    with pytest.raises((SidecarError, EditError), match="shot.v001.icheat.h5"):
        open_shot(shot).relight()
    sidecar.write_bytes(content)
    # The same shot over another scene: the painted surface has other faces there.
    elsewhere = shot.parent / "elsewhere"
    elsewhere.mkdir()
    for name in ("shot.usda", "sequence.usda", "shot.v001.icheat.h5"):
        shutil.copy(shot.parent / name, elsewhere)
    sphere = ROOM.replace('Cube "Room"', 'Sphere "Room"').replace("double size = 4", "double radius = 4")
    (elsewhere / "room.usda").write_text(sphere)
    (finding,) = [f for f in open_shot(elsewhere / "shot.usda").findings if f.feature == "painted mask"]
    assert "another topology of /World/Room" in finding.message and "carried over by nearest surface" in finding.message


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (None, "missing.usda"),
        ("not usd", "broken.usda"),
        ('#usda 1.0\ndef Xform "World" {}\n', "camera"),
        ('#usda 1.0\ndef Camera "Camera" {}\n', "nothing to light"),
        (ROOM.replace('def Camera "Camera"', 'def Camera "Other" {}\n    def Camera "Camera"'), "/World/Other"),
    ],
    ids=["missing", "not USD", "no camera", "empty", "two cameras"],
)
def test_unusable_stages_give_one_clear_error(tmp_path, content, complaint):
    path = tmp_path / ("missing.usda" if content is None else "broken.usda")
    if content is not None:
        path.write_text(content)
    with pytest.raises(StageError, match=complaint):
        Session.open(path, quality=DRAFT).relight()


@pytest.mark.parametrize("placing", ["moved by 10 km", "in millimetres", "in kilometres"])
def test_where_and_in_which_unit_a_room_stands_does_not_matter(tmp_path, placing):
    """The same floats but for rounding, hence the same rays: only a ray at an edge may fall on the other side.

    From the middle of the room two pixels look at the very edges of the block, where the side that is seen, and with
    it where gather samples go, is a matter of rounding; hence the camera is moved a little.
    """
    own = ROOM.replace("(0, 0, 1.9)", "(0.031, 0.017, 1.9)")
    room = {
        "moved by 10 km": own.replace(
            'def Xform "World"\n{',
            'def Xform "World"\n{\n    double3 xformOp:translate = (10000, -300, 10000)\n'
            '    uniform token[] xformOpOrder = ["xformOp:translate"]',
        ),
        "in millimetres": own.replace("metersPerUnit = 1\n", "metersPerUnit = 0.001\n"),
        "in kilometres": own.replace("metersPerUnit = 1\n", "metersPerUnit = 1000\n"),
    }[placing]
    assert own != ROOM and room != own
    films = []
    for name, text in (("here", own), ("there", room)):
        (tmp_path / f"{name}.usda").write_text(text)
        session = Session.open(tmp_path / f"{name}.usda", width=24, height=18, quality=QUALITY)
        films.append((session.relight(), session.render(GatherSettings(1, 16, 4))))
    # Where records of the final gather go hangs on the order of floats that are all but equal.
    for here, there, most in zip(*films, (1e-4, 0.01), strict=True):
        ours, theirs = here.layer("beauty").mean(axis=2), there.layer("beauty").mean(axis=2)
        assert ours.mean() > 0.05
        assert np.quantile(np.abs(theirs / ours - 1), 0.95) < most
        assert theirs.mean() == pytest.approx(ours.mean(), rel=most / 2)
