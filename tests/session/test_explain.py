"""What explain says about a pixel agrees with the images of the whole stack."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.errors import EditError
from icheat_usd.image.contact import GREY, contact_sheet, signed_image
from icheat_usd.session import Quality, Session, soft_sphere
from icheat_usd.session.explain import contribution_film, explain_pixel
from tests.session.test_session import ROOM, open_shot, shot  # noqa: F401  a fixture

QUALITY = Quality(n_gather=256, rays_per_row=64, rays_per_bounce_row=32, light_samples=4, n_bounces=4)


@pytest.fixture
def session(shot):  # noqa: F811
    session = Session.open(shot, width=24, height=18, quality=QUALITY)
    common = {"receivers": ["/World/Room"], "casters": ["/World/Block"]}
    session.add_edit("warm", layer="sequence.usda", parameters={"color": (3.0, 1.5, 0.5)}, **common)
    session.set_edit("/World/Edits/warm", layer="shot.usda", amount=0.5)
    session.add_edit("grey", layer="shot.usda", operation="hsv", parameters={"saturation": 0.2}, **common)
    session.add_edit("off", layer="shot.usda", parameters={"gain": 0.0}, **common)
    session.mute_edit("/World/Edits/off", layer="shot.usda")
    return session


def brightest(image: np.ndarray) -> tuple[int, int]:
    y, x = np.unravel_index(np.abs(image).sum(axis=2).argmax(), image.shape[:2])
    return int(x), int(y)


def test_a_pixel_is_explained_as_the_maps_show_it(session):
    film = contribution_film(session)
    assert set(film.layers) == {"beauty", "indirect", "indirect_edited", "edit.warm", "edit.grey"}
    x, y = brightest(film.layer("edit.warm"))
    found = explain_pixel(session, x, y)
    assert found.surfaces[0] == "/World/Room" and (found.width, found.height) == (24, 18)
    assert [share.edit.rpartition("/")[2] for share in found.edits] == ["warm", "grey", "off"]
    warm, grey, off = found.edits
    assert off.note == "muted" and off.change == (0.0, 0.0, 0.0) and off.casters == ()
    assert [share.edit for share in found.touching] == [warm.edit, grey.edit]
    # The pixel is lit anew by other rays, more of them.
    shown = film.layer("edit.warm")[y, x]
    np.testing.assert_allclose(warm.change, shown, atol=0.35 * np.abs(shown).max())
    assert warm.change[0] > 0 and warm.mask == 1.0
    assert [share.path for share in warm.casters] == ["/World/Block"]
    np.testing.assert_allclose(warm.casters[0].change, warm.change, rtol=1e-4, atol=1e-7)
    amount, layer = warm.layers["amount"]
    assert amount == 0.5 and layer.endswith("shot.usda")
    assert warm.layers["color"][1].endswith("sequence.usda")


def test_an_edit_alone_is_the_difference_it_makes(session):
    session.mute_edit("/World/Edits/grey", layer="shot.usda")
    film = contribution_film(session)
    np.testing.assert_allclose(
        film.layer("edit.warm"), film.layer("indirect_edited") - film.layer("indirect"), rtol=1e-3, atol=1e-5
    )


def test_casters_share_an_edit_by_what_they_send(session):
    session.add_edit("all", layer="shot.usda", parameters={"gain": 2.0}, receivers=["/World/Block"], casters=["/World"])
    film = contribution_film(session)
    x, y = brightest(film.layer("edit.all"))
    share = explain_pixel(session, x, y).edits[-1]
    assert {caster.path for caster in share.casters} <= {"/World/Room", "/World/Block"}
    total = np.sum([caster.change for caster in share.casters], axis=0)
    np.testing.assert_allclose(total, share.change, rtol=1e-4, atol=1e-6)
    assert explain_pixel(session, x, y, n_casters=1).edits[-1].casters[0].path == "/World/Room"


def test_casters_share_an_edit_of_their_light_together_by_their_light(session):
    session.mute_edit("/World/Edits/warm", layer="shot.usda")
    session.mute_edit("/World/Edits/grey", layer="shot.usda")
    everything = {"receivers": ["/World/Room"], "casters": ["/World"], "layer": "shot.usda"}
    brush = soft_sphere((0, -2, 0), 0.5, 3.0)
    session.add_edit(
        "contrast", operation="gamma", parameters={"exponent": 2.0}, receiver_brush=brush, frame=1, **everything
    )
    film = contribution_film(session)
    x, y = brightest(film.layer("edit.contrast"))
    share = explain_pixel(session, x, y).edits[-1]
    total = np.sum([caster.change for caster in share.casters], axis=0)
    assert len(share.casters) == 2
    np.testing.assert_allclose(total, share.change, rtol=1e-3, atol=1e-6)


def test_a_pixel_that_no_edit_reaches_says_so(session):
    untouched = ~contribution_film(session).layer("edit.warm").any(axis=2)
    neighbours = [np.roll(untouched, shift, (0, 1)) for shift in np.ndindex(3, 3)]
    y, x = (int(v) - 1 for v in np.argwhere(np.all(neighbours, axis=0))[0])  # beyond what one sample a pixel shows
    found = explain_pixel(session, x, y)
    assert found.touching == () and found.indirect == found.indirect_edited


def test_an_edit_that_rests_changes_nothing(session):
    session.set_edit("/World/Edits/grey", layer="shot.usda", lights=["/World/Block"])
    found = explain_pixel(session, 12, 9, rays=32)
    (grey,) = (share for share in found.edits if share.edit.endswith("grey"))
    assert grey.change == (0.0, 0.0, 0.0) and grey.mask == 0.0 and grey.casters == ()


def test_a_stack_that_is_off_explains_nothing(session):
    session.stage.GetPrimAtPath("/World/Edits").GetAttribute("icheat:stackEnabled").Set(False)
    found = explain_pixel(session, 12, 9)
    assert found.touching == () and [share.note for share in found.edits] == ["the stack is off"] * 3


@pytest.mark.parametrize("pixel", [(24, 0), (0, 18), (-1, 0)])
def test_a_pixel_outside_the_image_is_refused(session, pixel):
    with pytest.raises(EditError, match="24 x 18 pixels, from 0 0 to 23 17"):
        explain_pixel(session, *pixel)


def test_a_contact_sheet_keeps_its_pictures():
    pictures = [np.full((3, 4, 3), value, np.float32) for value in (1, 2, 3)]
    sheet = contact_sheet(pictures, gap=1)
    assert sheet.shape == (7, 9, 3)
    np.testing.assert_array_equal(sheet[:3, 5:], pictures[1])
    np.testing.assert_array_equal(sheet[4:, :4], pictures[2])
    assert (sheet[4:, 5:] == GREY).all()
    with pytest.raises(ValueError, match="one size"):
        contact_sheet([pictures[0], pictures[0][:2]])


def test_a_signed_picture_is_grey_where_nothing_changes():
    difference = np.array([[[0, 0.5, -0.5]]], np.float32)
    np.testing.assert_allclose(signed_image(difference), [[[GREY, 2 * GREY, 0]]], atol=1e-6)
    np.testing.assert_array_equal(signed_image(np.zeros((2, 2, 3), np.float32)), np.full((2, 2, 3), GREY))
