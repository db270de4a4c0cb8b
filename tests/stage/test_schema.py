"""The applied schemas: generated as committed, found by USD, readable without it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from pxr import Usd

import icheat_usd
from icheat_usd.edits import operations
from icheat_usd.plugin_path import plugin_directories
from icheat_usd.stage import schema
from tests.stage.edit_stages import python

REPOSITORY = Path(icheat_usd.__file__).resolve().parents[1]


def test_committed_files_are_what_the_source_generates() -> None:
    pytest.importorskip("jinja2")
    if Usd.GetVersion() < (0, 26, 5):
        pytest.skip("usdGenSchema of this usd-core lacks Pixar's schema sources")
    done = subprocess.run(
        [sys.executable, str(REPOSITORY / "tools" / "regenerate_schemas"), "--check"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_packaged_fallbacks_equal_those_of_the_registry() -> None:
    assert schema.is_registered()
    for name, properties in schema.packaged_schemas().items():
        definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(name)
        for property_name, declared in properties.items():
            attribute = definition.GetAttributeDefinition(property_name)
            if declared.type_name is None:
                assert definition.GetRelationshipDefinition(property_name)
            else:
                assert attribute.GetTypeName() == declared.type_name
                assert attribute.GetFallbackValue() == declared.fallback


def test_operations_and_their_parameters_come_from_the_schemas() -> None:
    found = schema.operations()
    known = {name: operations.find(name) for name in operations.names()}
    assert {name: set(operation.parameters) for name, operation in found.items()} == {
        name: {parameter.name for parameter in operation.parameters} for name, operation in known.items() if operation
    }
    assert found["scale"].api_schema == "IcheatScaleAPI"
    assert {n: schema.to_value(p.fallback) for n, p in found["hsv"].parameters.items()} == {
        "hue": 0.0,
        "saturation": 1.0,
        "value": 1.0,
    }
    assert schema.to_value(found["scale"].parameters["color"].fallback) == (1.0, 1.0, 1.0)


def test_every_attribute_has_a_label_a_group_and_a_sentence() -> None:
    for name in schema.packaged_schemas():
        definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(name)
        for property_name in definition.GetPropertyNames():
            if property_name.startswith("icheat:"):
                assert definition.GetPropertyMetadata(property_name, "displayName")
                assert definition.GetPropertyMetadata(property_name, "displayGroup")
                assert schema.packaged_schemas()[name][property_name].doc.endswith(".")


def test_schemas_apply_only_to_the_types_they_are_made_for() -> None:
    stage = Usd.Stage.CreateInMemory()
    can = {
        (kind, name): bool(stage.DefinePrim(f"/{kind}", kind).CanApplyAPI(name))
        for kind in ("Scope", "Mesh", "RenderSettings", "RenderPass")
        for name in (schema.EDIT_API, schema.STACK_API, "IcheatScaleAPI", "IcheatHsvAPI")
    }
    allowed = {key for key, value in can.items() if value}
    assert allowed == {
        ("Scope", schema.EDIT_API),
        ("Scope", schema.STACK_API),
        ("Scope", "IcheatScaleAPI"),
        ("Scope", "IcheatHsvAPI"),
        ("RenderSettings", schema.STACK_API),
        ("RenderPass", schema.STACK_API),
    }


def test_an_edit_selects_nothing_until_told_to() -> None:
    stage = Usd.Stage.CreateInMemory()
    prim = stage.DefinePrim("/edit", "Scope")
    prim.ApplyAPI(schema.EDIT_API)
    for name in (schema.RECEIVERS, schema.CASTERS):
        assert Usd.CollectionAPI(prim, name).HasNoIncludedPaths()
    assert prim.GetAttribute("icheat:amount").Get() == 1.0


# --------------------------------------------------------------------------- registration


def test_importing_the_package_loads_no_usd_and_announces_the_schemas() -> None:
    code = (
        "import sys, os, icheat_usd; assert not any(m.split('.')[0] == 'pxr' for m in sys.modules);"
        "print(os.environ['PXR_PLUGINPATH_NAME'])"
    )
    listed = python(code, environment={"PXR_PLUGINPATH_NAME": "/somewhere/else"}).strip().split(":")
    assert listed == [*map(str, plugin_directories()), "/somewhere/else"]


def test_schemas_are_known_when_usd_is_imported_first_or_last() -> None:
    known = "print(Usd.SchemaRegistry().FindAppliedAPIPrimDefinition('IcheatEditAPI') is not None)"
    assert python(f"import icheat_usd\nfrom pxr import Usd\n{known}").strip() == "True"
    assert python(f"from pxr import Usd, UsdGeom, Plug\nimport icheat_usd\n{known}").strip() == "True"


def test_the_locator_prints_an_absolute_directory_without_loading_usd() -> None:
    code = "import sys; from icheat_usd.plugin_path import main; main(); print('pxr' in sys.modules)"
    path, loaded = python(code).split()
    directories = [Path(directory) for directory in path.split(os.pathsep)]
    assert all(directory.is_absolute() and (directory / "plugInfo.json").is_file() for directory in directories)
    assert len(directories) == 2 and (directories[0] / "generatedSchema.usda").is_file()
    assert loaded == "False"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "icheat_usd.plugin_path"], capture_output=True, text=True, cwd=REPOSITORY
    )
    assert (done.stdout.strip(), done.stderr) == (path, "")


def test_reading_and_authoring_edits_needs_no_compiler_and_no_image_library() -> None:
    code = (
        "import sys, icheat_usd.stage.authoring, icheat_usd.stage.check\n"
        "print([name for name in ('numba', 'h5py', 'OpenImageIO', 'OpenEXR', 'embreex') if name in sys.modules])"
    )
    assert python(code).strip() == "[]"
