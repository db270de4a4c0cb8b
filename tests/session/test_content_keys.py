"""Keys change with everything that a result depends on, and with nothing else."""

from __future__ import annotations

import ast
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import icheat_usd
from icheat_usd.scene import LightControls, LightKind, SceneSnapshot, Shaping
from icheat_usd.session import content_keys
from icheat_usd.session.content_keys import ShotKeys, code_digest, code_files, digest, shot_keys
from icheat_usd.session.quality import Quality
from tests.scenes import Image, Light, Mesh, look_at, make_snapshot, quad, translation

QUALITY = Quality()
ALL = set(ShotKeys.__dataclass_fields__)


def snapshot() -> SceneSnapshot:
    sky = Image(np.full((2, 4, 3), 0.5, np.float32))
    lights = [
        Light(LightKind.RECT, 5.0, translation(0, 2, 0)[:3], (1, 1)),
        Light(LightKind.DOME, 1.0, image=sky),
    ]
    return make_snapshot([Mesh(quad())], lights=lights, camera=look_at((0, 1, 2)))


def changed(other: SceneSnapshot, quality: Quality = QUALITY, engine: str = "embree") -> set[str]:
    here, there = shot_keys(snapshot(), QUALITY, "embree"), shot_keys(other, quality, engine)
    return {name for name in ALL if getattr(here, name) != getattr(there, name)}


def with_light(row: int, **values: object) -> SceneSnapshot:
    base = snapshot()
    columns = {}
    for name, value in values.items():
        columns[name] = getattr(base.lights, name).copy()
        columns[name][row] = value
    return replace(base, lights=base.lights._replace(**columns))


def test_the_same_scene_has_the_same_keys() -> None:
    assert changed(snapshot()) == set()


def test_a_lamp_that_moves_costs_light_alone() -> None:
    moved = np.float32(np.eye(3, 4) + [[0, 0, 0, 1], [0, 0, 0, 2], [0, 0, 0, 0]])
    assert changed(with_light(0, to_world=moved)) == {"lights", "cell_light", "view_light"}


def test_the_sky_is_part_of_the_view_and_of_no_row() -> None:
    assert changed(with_light(1, radiance=2)) == {"lights", "cell_light", "view_light", "view"}
    base = snapshot()
    textures = base.textures._replace(texels=base.textures.texels * np.float32(2))
    assert changed(replace(base, textures=textures)) == {"lights", "cell_light", "view_light", "view"}


@pytest.mark.parametrize(
    "controls",
    [
        LightControls(receivers=np.zeros(1, np.uint8)),
        LightControls(blockers=np.zeros(1, np.uint8)),
        LightControls(diffuse=0.5),
        LightControls(specular=0.5),
        LightControls(shaping=Shaping(np.ones(2), 0.0, np.zeros(3), 0.0, np.zeros(0), np.zeros(0), np.zeros((0, 0)))),
    ],
)
def test_controls_of_a_light_cost_light_alone(controls: LightControls) -> None:
    of = {"lights", "cell_light", "view_light"}
    linked = replace(snapshot(), light_controls=(LightControls(), controls))
    assert changed(linked) == of
    assert shot_keys(linked, QUALITY, "embree") == shot_keys(linked, QUALITY, "embree")


def test_a_camera_that_moves_leaves_the_scene() -> None:
    moved = replace(snapshot(), camera=look_at((0, 1, 3)))
    assert changed(moved) == ALL - {"scene", "lights"}
    renamed = replace(snapshot(), camera=replace(snapshot().camera, path="/other"))
    assert changed(renamed) == set()


def test_geometry_materials_and_the_tracer_are_in_every_key_but_the_lights() -> None:
    base = snapshot()
    points = base.geometry.points.copy()
    points[0, 0, 0] += 1
    assert changed(replace(base, geometry=base.geometry._replace(points=points))) == ALL - {"lights"}
    opacity = base.materials._replace(opacity=base.materials.opacity * np.float32(0.5))
    assert changed(replace(base, materials=opacity)) == ALL - {"lights"}
    assert changed(base, engine="reference") == ALL - {"lights"}


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("rays_per_row", 64, {"transport", "packed"}),
        ("row_spacing", 4, {"transport", "packed"}),
        ("record_error", 0.1, {"transport", "packed"}),
        ("record_rays", 64, set()),  # without records
        ("record_share", 0.5, set()),
        ("packing_error", 0.1, {"packed"}),
        ("moving_detail", 2.0, set()),
        ("n_bounces", 2, {"cell_light"}),
        ("rays_per_bounce_row", 16, {"bounces", "rest_bounces", "cell_light", "training", "packed"}),
        ("rest_bounce_rays", 64, {"rest_bounces"}),
        ("dome_samples", 3, {"view_light"}),
        ("dome_places", 64, {"cell_light"}),
        ("n_gather", 64, {"gather", "bounces", "rest_bounces", "training", "transport", "packed", "cell_light"}),
        ("seed", 1, ALL - {"scene", "lights"}),
    ],
)
def test_settings_are_in_the_keys_of_what_they_decide(name: str, value: int, expected: set[str]) -> None:
    assert changed(snapshot(), replace(QUALITY, **{name: value})) == expected


def test_values_that_could_be_confused_have_digests_of_their_own() -> None:
    values = [
        1, 1.0, True, "1", None, "", (), (1,), ((1,),), [1, 2], [12], {"a": 1}, ("a", 1),
        np.zeros(2, np.float32), np.zeros((2, 1), np.float32), np.zeros(2, np.int32), np.float32(1),
    ]  # fmt: skip
    digests = [digest(value) for value in values]
    assert len(set(digests)) == len(digests)
    with pytest.raises(TypeError, match="object has no digest"):
        digest(object())


def test_every_module_that_a_kept_part_depends_on_is_in_the_keys() -> None:
    """Imports are followed from what makes parts, wherever in a source they stand."""
    root = Path(icheat_usd.__file__).parent
    pending, needed = ["icheat_usd.session.shot_parts", "icheat_usd.session.disk_cache"], set[Path]()
    while pending:
        path = root.joinpath(*pending.pop().split(".")[1:])
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        if path in needed or not path.exists():
            continue
        needed.add(path)
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("icheat_usd"):
                pending += [str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)]
            elif isinstance(node, ast.Import):
                pending += [alias.name for alias in node.names if alias.name.startswith("icheat_usd")]
            assert not (isinstance(node, ast.ImportFrom) and node.level), f"{path}: imports here name the whole module"
    names = {path.relative_to(root).as_posix() for path in needed}
    assert {"relight/relighter.py", "session/shot_parts.py", "session/parts.py", "transport/packing.py"} <= names
    assert needed <= set(code_files(root))


def test_other_sources_and_other_libraries_make_other_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = Path(icheat_usd.__file__).parent
    copied = shutil.copytree(root, tmp_path / "icheat_usd", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(content_keys.icheat_usd, "__file__", str(copied / "__init__.py"))
    found = [code_digest.__wrapped__()]
    for name in ("relight/relighter.py", "session/shot_parts.py", "session/parts.py", "kernels/vector.py", "scene.py"):
        with open(copied / name, "a") as file:
            file.write("# changed\n")
        found.append(code_digest.__wrapped__())
    monkeypatch.setattr(content_keys, "version", lambda name: "4.9.9")
    found.append(code_digest.__wrapped__())
    assert len(set(found)) == len(found)
    with open(copied / "cli" / "cache.py", "a") as file:
        file.write("# changed\n")
    assert code_digest.__wrapped__() == found[-1]
