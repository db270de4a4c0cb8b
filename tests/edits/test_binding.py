"""What binding a stack to a scene refuses, drops and groups."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.edits.binding import bind
from icheat_usd.edits.model import Edit, EditStack, KeyedPayload, Payload, Selection
from icheat_usd.errors import EditError
from tests import scenes

SNAPSHOT = scenes.cornell(8, 8)
EVERYTHING = Selection(frozenset(surface.path for surface in SNAPSHOT.surfaces))


def edit(**values: object) -> Edit:
    return replace(Edit("/Edits/one", "scale", {"gain": 2.0}, EVERYTHING, EVERYTHING), **values)  # type: ignore[arg-type]


def stack(*edits: Edit) -> EditStack:
    return EditStack("/Edits", tuple(replace(e, path=f"/Edits/e{i}") for i, e in enumerate(edits)))


def test_an_edit_whose_lights_are_out_does_nothing() -> None:
    assert bind(stack(edit(lights=("/no/such/light",))), SNAPSHOT).is_identity


def test_lights_that_no_edit_tells_apart_form_a_group() -> None:
    (lamp,) = SNAPSHOT.light_paths
    both = replace(SNAPSHOT, light_paths=(lamp, "/sun", "/sky"))
    field = bind(stack(edit(lights=("/sun",)), edit(), edit(lights=("/sky", lamp))), both)
    assert field.n_groups == 2
    assert field.light_group[0] == field.light_group[2] != field.light_group[1]
    sun = field.light_group[1]
    assert [list(np.flatnonzero(bound.groups)) for bound in field.edits] == [[sun], [0, 1], [1 - sun]]


def test_a_light_may_be_named_by_what_it_is_in() -> None:
    lights = replace(SNAPSHOT, light_paths=("/Rig/key", "/Rigger"))
    (bound,) = bind(stack(edit(lights=("/Rig",))), lights).edits
    assert bound.groups.sum() == 1


def test_muted_and_zero_edits_are_not_bound() -> None:
    assert bind(stack(edit(amount=0.0), edit(enabled=False)), SNAPSHOT).is_identity


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"operation": "gloom"}, "operation 'gloom' is unknown and no payload holds it baked"),
        ({"operation": "unshadow", "parameters": {}}, "no occluders in this scene"),
        ({"parameters": {"gian": 2.0}}, "has no parameter 'gian'"),
        ({"parameters": {"gain": -2.0}}, "expected at least 0"),
    ],
)
def test_what_cannot_be_bound_is_refused_by_name(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(EditError, match=message) as refusal:
        bind(stack(edit(**wrong)), SNAPSHOT)
    assert "/Edits/e0" in str(refusal.value)


def test_an_unknown_operation_uses_what_its_payload_holds_baked() -> None:
    payload = Payload("theirs", {"depth": 3.0}, scale_delta=(1.0, 0.5, 0.0), emission=(0.0, 0.0, 0.2))
    (bound,) = bind(stack(edit(operation="theirs", keys=(KeyedPayload(payload, 1.0),))), SNAPSHOT).edits
    (baked,) = bound.baked
    assert baked is not None and baked.emission is not None and baked.offset is None
    assert np.array_equal(baked.scale, np.float32([[2.0, 1.5, 1.0]]))
    assert np.array_equal(baked.emission, np.float32([[0.0, 0.0, 0.2]]))


def test_a_point_is_taken_to_the_scene_s_centre() -> None:
    moved = replace(SNAPSHOT, centre=np.array([10.0, 20.0, 30.0]))
    aimed = edit(operation="redirect", parameters={"target": (10.0, 21.0, 30.0)})
    (bound,) = bind(stack(aimed), moved).edits
    assert bound.parameters[0]["target"] == (0.0, 1.0, 0.0)
