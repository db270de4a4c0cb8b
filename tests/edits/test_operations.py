"""The registry of operations, what they declare, and the checks on their parameters."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from pxr import Sdf

from icheat_usd.edits import operations
from icheat_usd.edits.model import Value
from icheat_usd.edits.operations import Encoding, Level, Measure, Operation, PairEnd, Pairs, Parameter
from icheat_usd.errors import EditError
from icheat_usd.resources import resource_path

KINDS = {
    ("float", Measure.PLAIN): "float",
    ("float", Measure.LENGTH): "float",
    ("color", Measure.PLAIN): "color3f",
    ("color", Measure.POINT): "point3f",
    ("color", Measure.DIRECTION): "vector3f",
    ("array", Measure.PLAIN): "float[]",
    ("bool", Measure.PLAIN): "bool",
    ("token", Measure.PLAIN): "token",
}


def kind_of(parameter: Parameter) -> str:
    """Type that a schema gives to such a parameter."""
    default = parameter.default
    if isinstance(default, tuple):
        form = "array" if parameter.is_array else "color"
    else:
        form = {bool: "bool", str: "token", float: "float"}[type(default)]
    return KINDS[form, parameter.measure]


def rounded(value: object) -> object:
    """Value as float32 numbers, tuples and texts, which compare."""
    if isinstance(value, (bool, str)):
        return value
    try:
        return tuple(np.float32(component) for component in value)  # type: ignore[attr-defined]
    except TypeError:
        return np.float32(value)  # type: ignore[arg-type]


class Declared(NamedTuple):
    type_name: str
    default: object
    choices: tuple[str, ...]
    doc: str


def declared_in_schemas() -> Iterator[tuple[str, Declared]]:
    layer = Sdf.Layer.FindOrOpen(str(resource_path("schemas/usd/generatedSchema.usda")))
    for prim in layer.rootPrims:
        for attribute in prim.attributes:
            if len(attribute.name.split(":")) == 3 and attribute.name.startswith("icheat:"):
                choices = tuple(attribute.allowedTokens or ())
                doc = attribute.customData["userDocBrief"]
                yield attribute.name, Declared(str(attribute.typeName), attribute.default, choices, doc)


SCHEMAS = dict(declared_in_schemas())
REGISTRY = {
    f"icheat:{name}:{parameter.name}": parameter
    for name in operations.names()
    for parameter in operations.find(name).parameters
}


def test_every_schema_has_an_operation_and_the_reverse() -> None:
    assert set(SCHEMAS) == set(REGISTRY)


@pytest.mark.parametrize("name", sorted(REGISTRY))
def test_schema_and_operation_declare_the_same_parameter(name: str) -> None:
    schema, parameter = SCHEMAS[name], REGISTRY[name]
    assert schema.type_name == kind_of(parameter)
    assert rounded(schema.default) == rounded(parameter.default)
    assert schema.choices == parameter.choices
    assert schema.doc and parameter.doc


@pytest.mark.parametrize("name", operations.names())
def test_an_operation_says_what_it_does_and_takes_its_own_defaults(name: str) -> None:
    operation = operations.find(name)
    assert operation.name == name and operation.doc.endswith(".")
    assert {p.name for p in operation.parameters} == set(operation.complete({}, "/edit"))
    assert Encoding.RECIPE in operation.encodings
    assert (Encoding.VECTOR in operation.encodings) == (operation.level is Level.VIEW)


@pytest.mark.parametrize("n_receivers", [1, 5])
@pytest.mark.parametrize("name", [n for n in operations.names() if operations.find(n).level is Level.PAIR])
def test_one_receiver_may_stand_for_all_pairs(name: str, n_receivers: int) -> None:
    rng = np.random.default_rng(1)

    def end(n: int) -> PairEnd:
        normal = rng.normal(size=(n, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        position, albedo = rng.normal(size=(n, 3)), rng.uniform(0, 1, (n, 3))
        return PairEnd(position.astype(np.float32), normal.astype(np.float32), albedo.astype(np.float32))

    operation = operations.find(name)
    parameters = operation.complete({"pivot": 1.0} if name == "falloff" else {}, "/edit")
    pairs = Pairs(rng.uniform(0, 1, (5, 3)).astype(np.float32), end(n_receivers), end(5))
    found = operation.evaluate(parameters, pairs)
    for values in found:
        assert values is None or (values.shape in ((1, 3), (5, 3)) and values.dtype == np.float32)
        assert values is None or np.isfinite(values).all()
    assert (found.offset is not None) == operation.has_offset
    assert (found.through is not None) == operation.has_through


@pytest.mark.parametrize("name", operations.names())
def test_what_is_declared_to_be_used_is_all_that_is_used(name: str) -> None:
    """Coefficients must not change with what the operation does not declare to look at."""
    operation = operations.find(name)
    if operation.level is not Level.PAIR:
        return
    rng = np.random.default_rng(2)
    away = {"hsv": {"hue": 40.0}, "falloff": {"pivot": 1.0, "exponent": 1.0}, "redirect": {"target": (2.0, 2.0, 2.0)}}
    parameters = operation.complete(away.get(name, {}), "/edit")

    def end() -> PairEnd:
        return PairEnd(*(rng.uniform(0.1, 0.9, (4, 3)).astype(np.float32) for _ in range(3)))

    light, receiver, caster = rng.uniform(0.1, 1, (4, 3)).astype(np.float32), end(), end()
    base = operation.evaluate(parameters, Pairs(light, receiver, caster))
    others = {
        "uses_incident": Pairs(light[::-1] * np.float32([1, 2, 3]), receiver, caster),
        "uses_receiver": Pairs(light, end(), caster),
        "uses_caster": Pairs(light, receiver, end()),
    }
    for flag, pairs in others.items():
        changed = operation.evaluate(parameters, pairs)
        same = all(np.array_equal(a, b) for a, b in zip(base, changed, strict=True) if a is not None)
        assert same != getattr(operation, flag), flag
    if not operation.uses_normals:
        turned = (place._replace(normal=end().normal, albedo=end().albedo) for place in (receiver, caster))
        changed = operation.evaluate(parameters, Pairs(light, *turned))
        assert all(np.array_equal(a, b) for a, b in zip(base, changed, strict=True) if a is not None)


@pytest.mark.parametrize(
    ("operation", "given", "complaint"),
    [
        ("scale", {"colour": (1.0, 1.0, 1.0)}, "no parameter 'colour'"),
        ("scale", {"color": 2.0}, "parameter 'color'"),
        ("scale", {"gain": float("nan")}, "parameter 'gain'"),
        ("scale", {"gain": -1.0}, "at least 0.0"),
        ("scale", {"gain": True}, "parameter 'gain'"),
        ("scale", {"gain": 1e19}, "expected no size above 1e\\+18"),
        ("scale", {"color": (1.0, -1e19, 1.0)}, "expected no size above 1e\\+18"),
        ("scale", {"color": (1.0, 1.0)}, "parameter 'color'"),
        ("gamma", {"pivot": 0.0}, "parameter 'pivot'"),
        ("gamma", {"exponent": -1.0}, "parameter 'exponent'"),
        ("falloff", {"pivot": -1.0}, "parameter 'pivot'"),
        ("direction", {"direction": (0.0, 0.0, 0.0)}, "expected a vector with a length"),
        ("redirect", {"spread": 0.5}, "at least 1.0"),
        ("redirect", {"spread": 91.0}, "at most 90"),
        ("paint", {"relative": 1.0}, "parameter 'relative'"),
        ("curve", {"on": "hue"}, "expected one of"),
        ("curve", {"inputs": (0.0, 1.0, 2.0)}, "have 3 and 2 knots"),
        ("curve", {"inputs": (1.0,), "outputs": (1.0,)}, "expected two or more"),
        ("curve", {"inputs": (), "outputs": ()}, "expected two or more"),
        ("curve", {"inputs": (0.0, 0.0)}, "expected rising"),
        ("curve", {"outputs": (1.0, 0.5)}, "do not fall"),
        ("curve", {"inputs": 3.0}, "parameter 'inputs'"),
    ],
)
def test_wrong_parameters_are_named(operation: str, given: dict[str, Value], complaint: str) -> None:
    with pytest.raises(EditError, match=complaint) as error:
        operations.find(operation).complete(given, "/World/Edits/warm")
    assert str(error.value).startswith("/World/Edits/warm: ")


@pytest.mark.filterwarnings("error")
def test_the_largest_parameters_leave_light_finite() -> None:
    largest = {"gain": 1e18, "color": (1e18, 1.0, 0.0)}
    parameters = operations.find("scale").complete(largest, "/World/Edits/warm")
    found = operations.find("scale").constants(parameters)
    assert found is not None and np.isfinite(found.scale * np.float32(100)).all()


def test_a_second_operation_of_the_same_name_is_refused() -> None:
    with pytest.raises(EditError, match="registered already"):
        operations.register(type(operations.find("scale"))())


def test_baked_is_no_operation() -> None:
    class Baked(Operation):
        name = "baked"
        doc = "Not allowed."
        parameters = ()

    with pytest.raises(EditError, match="choose another name"):
        operations.register(Baked())
    assert operations.find("baked") is None and "baked" not in operations.names()
