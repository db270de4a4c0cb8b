"""What `Session.render` may be asked for beside its default: photons, and the denoiser."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.cli import main
from icheat_usd.errors import ImageError
from icheat_usd.resources import resource_path
from icheat_usd.session import GatherSettings, Quality, Session
from icheat_usd.session.layer_names import DEFAULT
from icheat_usd.session.quality import QUICK

BOX = resource_path("sample_stages/cornell_box/shot.usda")
EFFORT = GatherSettings(samples_per_pixel=2, edge_samples=0)


@pytest.fixture(scope="module")
def session() -> Session:
    return Session.open(BOX, width=24, height=24, quality=Quality(n_gather=4096, rays_per_bounce_row=64))


def test_help_states_the_defaults_that_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "--help"]) == 0
    text, usual = " ".join(capsys.readouterr().out.split()), GatherSettings()
    for said in (
        f"camera samples a pixel; default {usual.samples_per_pixel} (quick: {QUICK.samples_per_pixel}) ",
        f"pixels with edges; default {usual.edge_samples} (quick: {QUICK.edge_samples}) ",
        f"no light is cached; default {usual.gather_rays} (quick: {QUICK.gather_rays}) ",
        f"before the last one; default {usual.n_bounces}",
        f"rays are traced; default {usual.cache.noise} ",
        f"default {usual.pixel_filter} ",
    ):
        assert said in f"{text} ", said


def test_photons_give_the_light_that_the_cells_give(session: Session) -> None:
    plain, photons = (session.render(replace(EFFORT, bounces=bounces)) for bounces in ("cells", "photons"))
    for layer in ("indirect", "indirect_edited"):
        assert not np.array_equal(plain.layer(layer), photons.layer(layer))
        assert photons.layer(layer).mean() == pytest.approx(plain.layer(layer).mean(), rel=0.03)
    np.testing.assert_array_equal(plain.layer("direct"), photons.layer("direct"))
    with pytest.raises(ValueError, match="'rays' is none of cells, photons"):
        replace(EFFORT, bounces="rays")


def test_a_denoised_frame_keeps_what_no_edit_touches(session: Session) -> None:
    pytest.importorskip("pyoidn")
    layers = (*DEFAULT, "lights_indirect", "lights_indirect_edited")
    plain, clean = (session.render(replace(EFFORT, denoise=denoise), layers) for denoise in (False, True))
    untouched = ~plain.layer("edit_delta").any(axis=2)
    assert 20 < untouched.sum() < untouched.size - 20
    np.testing.assert_array_equal(clean.layer("indirect_edited")[untouched], clean.layer("indirect")[untouched])
    for layer in ("direct", "indirect", "indirect_edited", "beauty"):
        assert not np.array_equal(plain.layer(layer), clean.layer(layer))
        assert clean.layer(layer).mean() == pytest.approx(plain.layer(layer).mean(), rel=0.05)
    # The only light has all of it.
    (lamp,) = (name.partition(".")[2] for name in clean.layers if name.startswith("light_indirect."))
    for layer in ("indirect", "indirect_edited"):
        np.testing.assert_allclose(clean.layer(f"light_{layer}.{lamp}"), clean.layer(layer), rtol=1e-5, atol=1e-7)


def test_the_denoiser_is_missed_before_the_work(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    monkeypatch.setattr("icheat_usd.session.rendering.final_gather", lambda *_, **__: pytest.fail("it was rendered"))
    with pytest.raises(ImageError, match="Open Image Denoise"):
        session.render(replace(EFFORT, denoise=True))
