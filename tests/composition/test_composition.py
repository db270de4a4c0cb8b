"""Composition is USD's alone: layers, arcs and times mean what they mean to anything else on a stage.

Each case is a stage of three layers and the one layer that a person would write for the same image.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from pxr import Sdf, Ts, Usd

from icheat_usd.errors import SidecarError
from tests.composition import cases_in_time, cases_of_arcs, cases_of_layers, cases_of_variants
from tests.composition.reading import open_case, read_case
from tests.composition.stages import Case, retimed, write_case, write_flat

THEMES = (cases_of_layers, cases_of_variants, cases_of_arcs, cases_in_time)
CASES = {case.name: case for module in THEMES for case in module.CASES}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[dict[str, Any], dict[str, Any]]]:
    """How to open each case, composed and flat."""
    folder = tmp_path_factory.mktemp("composition")
    return {
        case.name: (write_case(case, folder / str(index)), write_flat(case, folder / str(index)))
        for index, case in enumerate(CASES.values())
    }


@pytest.fixture(params=CASES.values(), ids=CASES.keys())
def case(request: pytest.FixtureRequest) -> Case:
    return request.param  # type: ignore[no-any-return]


def test_layers_mean_what_one_layer_by_hand_means(case: Case, written: dict[str, Any]) -> None:
    composed, flat = (read_case(opened) for opened in written[case.name])
    assert composed["edits"] == flat["edits"]
    assert composed["digest"] == flat["digest"] and composed["enabled"] == flat["enabled"]


def test_a_scaled_layer_offset_moves_all_times(case: Case, written: dict[str, Any]) -> None:
    composed, flat = written[case.name]
    for how in case.retimings:
        moved = read_case(retimed(composed, how))
        assert moved["edits"] == read_case(flat)["edits"]


def flattening_keeps_splines() -> bool:
    stage = Usd.Stage.CreateInMemory()
    attribute = stage.DefinePrim("/prim").CreateAttribute("value", Sdf.ValueTypeNames.Float)
    spline = Ts.Spline("float")
    spline.SetKnot(Ts.Knot("float", time=1.0, value=2.0))
    attribute.SetSpline(spline)
    layer = stage.Flatten()
    return bool(layer.GetAttributeAtPath("/prim.value").HasInfo("spline"))


def test_what_usd_flattens_means_the_same(case: Case, written: dict[str, Any]) -> None:
    composed = written[case.name][0]
    if "spline" in case.name and not flattening_keeps_splines():
        pytest.skip("this USD drops splines when it flattens")
    flattened = Path(composed["root"]).with_name("flattened.usda")
    open_case(composed).Flatten().Export(str(flattened))
    read = read_case(composed | {"root": str(flattened), "session": "", "muted": []})
    wanted = read_case(composed)
    assert (read["edits"], read["digest"]) == (wanted["edits"], wanted["digest"])


def test_no_case_passes_by_what_the_sequence_says_alone(case: Case, written: dict[str, Any]) -> None:
    composed = written[case.name][0]
    alone = composed | {"root": composed["root"].replace("shot.usda", "sequence.usda"), "session": "", "muted": []}
    if case.muted:
        alone = composed | {"muted": []}
    wanted = read_case(composed)
    try:
        read = read_case(alone)
    except SidecarError:
        return
    assert (read["edits"], read["enabled"]) != (wanted["edits"], wanted["enabled"])


def test_the_layer_of_each_value_is_told(case: Case, written: dict[str, Any]) -> None:
    told = read_case(written[case.name][0])
    assert {name: told["winners"][name] for name in case.winners} == case.winners
    assert told["removed"] == case.removed


def test_check_finds_what_is_wrong_and_nothing_else(case: Case, written: dict[str, Any]) -> None:
    composed = written[case.name][0]
    for opened in (composed, *(retimed(composed, how) for how in case.retimings)):
        assert {rule for rule, _, _ in read_case(opened)["checked"]} == set(case.findings)


def test_a_host_that_composed_first_reads_the_same(written: dict[str, Any]) -> None:
    opened = [
        each
        for case in CASES.values()
        for each in (written[case.name][0], *(retimed(written[case.name][0], how) for how in case.retimings))
    ]
    code = (
        "from pxr import Usd\nUsd.Stage.CreateInMemory().DefinePrim('/composed/before', 'Scope')\n"
        "from tests.composition.reading import main\nmain()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=json.dumps(opened),
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
        env={name: value for name, value in os.environ.items() if name != "PXR_PLUGINPATH_NAME"},
    )
    assert done.returncode == 0, done.stderr
    late = json.loads(done.stdout)
    assert len(late) == len(opened) and not any(told.pop("registered") for told in late)
    for each, told in zip(opened, late, strict=True):
        here = read_case(each)
        assert here.pop("registered") and told == here
