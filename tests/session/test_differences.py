"""Every kind of difference between two stages and two payloads is found and named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Usd

from icheat_usd.edits.model import MaskedSurface, Payload, SurfaceMask
from icheat_usd.session import add_edit, compare_stages, create_stack
from icheat_usd.session.payload_differences import compare_sidecars, payload_differences
from icheat_usd.sidecar import History, write_payloads
from icheat_usd.stage import schema
from icheat_usd.stage.key_authoring import remove_payload_key, set_payload_key
from tests.stage.edit_stages import layer, shot_stage

WARM = "/World/Edits/warm"


def make(folder: Path) -> Usd.Stage:
    """An edit with keys at 1 and 11 in the sequence, which a shot stage sees twice as slow, and one in the shot."""
    folder.mkdir()
    stage = shot_stage(folder)
    common: dict[str, Any] = {"receivers": ["floor"], "casters": ["Room"]}
    add_edit(stage, None, "warm", layer="seq.usda", parameters={"gain": 2.0}, frame=1, **common)
    file, digests = write_payloads(folder / "seq.usda", [Payload("scale", {"gain": 3.0})], anchor="/World")
    set_payload_key(stage, WARM, layer="seq.usda", time=11, payload=(file, digests[0]))
    add_edit(stage, "/World/Edits", "cool", layer="shot.usda", operation="hsv", **common)
    stage.SetEditTarget(stage.GetRootLayer())
    return stage


@pytest.fixture
def stages(tmp_path: Path) -> tuple[Usd.Stage, Usd.Stage]:
    return make(tmp_path / "a"), make(tmp_path / "b")


def warm(stage: Usd.Stage) -> Usd.Prim:
    return stage.GetPrimAtPath(WARM)


def key_removed(stage: Usd.Stage) -> None:
    remove_payload_key(stage, WARM, layer="seq.usda", time=11)


def key_added(stage: Usd.Stage) -> None:
    set_payload_key(stage, WARM, layer="seq.usda", time=20, payload=None)


def key_replaced(stage: Usd.Stage) -> None:
    folder = Path(layer(stage, "seq.usda").realPath)
    file, digests = write_payloads(folder, [Payload("scale", {"gain": 4.0})], anchor="/World")
    set_payload_key(stage, WARM, layer="seq.usda", time=11, payload=(file, digests[0]))


def held(stage: Usd.Stage) -> None:
    warm(stage).GetAttribute(schema.KEY_INTERPOLATION).Set("held")


def animated(stage: Usd.Stage) -> None:
    for time, value in ((1, 1.0), (5, 0.25), (9, 0.5)):
        warm(stage).GetAttribute(schema.AMOUNT).Set(value, time)


def limited(stage: Usd.Stage) -> None:
    warm(stage).CreateRelationship(schema.RECEIVER_LIMITS, False).AddTarget("/World/Room/wall")


def aimed(stage: Usd.Stage) -> None:
    warm(stage).CreateRelationship(schema.TARGET, False).AddTarget("/World/camera")


def excluded(stage: Usd.Stage) -> None:
    Usd.CollectionAPI(warm(stage), schema.CASTERS).CreateExcludesRel().AddTarget("/World/Room/wall")


def off(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/Edits").GetAttribute(schema.STACK_ENABLED).Set(False)


def for_a_camera(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/Edits").GetRelationship(schema.CAMERA).AddTarget("/World/camera")


def inactive(stage: Usd.Stage) -> None:
    warm(stage).SetActive(False)


def other_operation(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/Edits/cool").GetAttribute(schema.OPERATION).Set("gamma")


def second_stack(stage: Usd.Stage) -> None:
    create_stack(stage, "More", layer="shot.usda")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (key_removed, ["warm: key at 11 removed (seq.usda)"]),
        (key_added, ["warm: key at 20 added (seq.usda)"]),
        (key_replaced, ["warm: key at 11: gain 3 → 4 (seq.usda)"]),
        (held, ["warm: keys linear → held (seq.usda)"]),
        (animated, ["warm: amount 1 → 0.25 at 5, and at 1 more times (shot.usda)"]),
        (limited, ["warm: receiver limits + Room/wall"]),
        (aimed, ["warm: target + camera"]),
        (excluded, ["warm: casters excluded + Room/wall"]),
        (off, ["stack Edits turned off"]),
        (for_a_camera, ["Edits: camera + camera"]),
        (inactive, ["warm deactivated"]),
        (other_operation, ["cool: operation hsv → gamma (shot.usda)"]),
        (second_stack, ["stack More added"]),
    ],
)
def test_a_change_is_named(
    change: Callable[[Usd.Stage], None], expected: list[str], stages: tuple[Usd.Stage, Usd.Stage]
) -> None:
    a, b = stages
    assert compare_stages(a, b) == []
    change(b)
    assert [difference.text for difference in compare_stages(a, b)] == expected
    assert len(compare_stages(b, a)) == len(expected)


def test_stages_are_matched_below_their_default_prims(stages: tuple[Usd.Stage, Usd.Stage]) -> None:
    for stage in stages:
        for name in ("seq.usda", "shot.usda"):
            layer(stage, name).Save()
    outer = Usd.Stage.CreateInMemory()
    outer.SetDefaultPrim(outer.DefinePrim("/Show"))
    outer.GetDefaultPrim().GetReferences().AddReference(stages[1].GetRootLayer().identifier)
    assert compare_stages(stages[0], outer) == []


def test_a_stage_without_edits_lacks_the_whole_stack(stages: tuple[Usd.Stage, Usd.Stage], tmp_path: Path) -> None:
    (tmp_path / "plain").mkdir()
    plain = shot_stage(tmp_path / "plain")
    assert [d.text for d in compare_stages(stages[0], plain)] == ["stack Edits removed"]
    assert [d.text for d in compare_stages(plain, stages[0])] == ["stack Edits added"]


def mask(values: np.ndarray, *names: str) -> SurfaceMask:
    return SurfaceMask(tuple(MaskedSurface(name, 1) for name in names), values.astype(np.float32))


def test_payloads_are_told_apart_in_words() -> None:
    texels = np.zeros((2, 4, 4))
    touched = texels.copy()
    touched[1, :2] = 1.0
    plain = Payload("scale", {"gain": 1.0})
    for a, b, expected in (
        (plain, Payload("hsv", {"hue": 30.0}), ["operation scale → hsv", "gain 1 → default", "hue default → 30"]),
        (plain, Payload("scale", {"gain": 1.0}, scale_delta=(0.0, 0.5, 1.0)), ["baked scale none → (0, 0.5, 1)"]),
        (
            Payload("scale", {}, receiver_mask=mask(texels, "/a", "/b")),
            Payload("scale", {}, receiver_mask=mask(touched, "/a", "/b")),
            ["receiver mask repainted (1 surface, 25 % of texels differ)"],
        ),
        (
            Payload("scale", {}, caster_mask=mask(texels + 1, "/a", "/b")),
            Payload("scale", {}, caster_mask=mask(texels[:1] + 1, "/a")),
            ["caster mask repainted (1 surface, 50 % of texels differ)"],
        ),
        (
            plain,
            Payload("scale", {"gain": 1.0}, caster_mask=mask(texels, "/a", "/b")),
            ["caster mask painted (2 surfaces)"],
        ),
        (
            Payload("scale", {}, receiver_mask=mask(texels, "/a", "/b")),
            Payload("scale", {}, receiver_mask=mask(np.zeros((2, 8, 8)), "/a", "/b")),
            ["receiver mask painted at 8 texels a face, and was at 4"],
        ),
        (plain, Payload("scale", {"gain": 1.0}, made_against={"time": 2.0}), ["written anew with the same contents"]),
    ):
        assert list(payload_differences(a, b)) == expected


def test_sidecars_pair_payloads_of_the_same_edit(tmp_path: Path) -> None:
    files = []
    for name, gains in (("a", (1.0, 2.0)), ("b", (1.0, 3.0))):
        payloads = [Payload("scale", {"gain": gain}) for gain in gains]
        files.append(str(write_payloads(tmp_path / f"{name}.usda", payloads, anchor="/World")[0]))
    ((name, text),) = compare_sidecars(*files)
    assert text.endswith(": gain 2 → 3") and name
    other = write_payloads(
        tmp_path / "c.usda", [Payload("hsv", {"hue": 3.0})], anchor="/World", history=History(edit="/World/Edits/x")
    )[0]
    texts = [text for _, text in compare_sidecars(files[0], str(other))]
    assert sum("only in a.v001" in text for text in texts) == 2 and any(text.endswith(" of x") for text in texts)
