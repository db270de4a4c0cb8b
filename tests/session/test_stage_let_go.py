"""What has read a stage lets go of it at once: USD would go on serving its layers, also when their files change."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator

import pytest

pytest.importorskip("pxr")

from pxr import Sdf  # noqa: E402

from icheat_usd.resources import resource_path  # noqa: E402
from icheat_usd.session import GatherSettings, LiveSession, Quality, Session, inspection  # noqa: E402
from icheat_usd.stage import open_stage, take_snapshot  # noqa: E402

STAGES = [
    str(resource_path(f"sample_stages/{name}/shot.usda"))
    for name in ("animated_room", "cornell_box", "furnished_room", "glossy_set", "staircase")
]


def session(path: str) -> Session:
    return Session.open(path, width=8, height=8, quality=Quality(n_gather=512))


def show_live(path: str) -> None:
    with LiveSession.open(path, width=8, height=8, quality=Quality(n_gather=512)) as live:
        live.frame()


def inspect(path: str) -> None:
    stage = inspection.open_stage(path)
    inspection.describe_stack(stage, "/World/Edits")
    inspection.check(stage)


READERS: dict[str, Callable[[str], object]] = {
    "a snapshot": lambda path: take_snapshot(open_stage(path), width=8, height=8),
    "an inspection": inspect,
    "a preview": lambda path: session(path).relight(),
    "a live preview": show_live,
    "a final frame": lambda path: session(path).render(
        GatherSettings(samples_per_pixel=1, edge_samples=0), ["indirect_edited"]
    ),
}


@pytest.fixture
def no_collection() -> Iterator[None]:
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.mark.parametrize("path", STAGES, ids=lambda path: path.split("/")[-2])
@pytest.mark.parametrize("reader", READERS)
def test_no_layer_stays_open(reader: str, path: str, no_collection: None) -> None:
    READERS[reader](path)
    assert Sdf.Layer.Find(path) is None
