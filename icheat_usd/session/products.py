"""RenderProduct prims as outputs: what each variable means here, and what of it is not supported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from icheat_usd.errors import ImageError, StageError
from icheat_usd.scene import Finding
from icheat_usd.session import layer_names
from icheat_usd.session.rendering import Output
from icheat_usd.stage.render_products import RenderProduct, RenderVariable, names_products, read_render_products


def product_output(product: RenderProduct) -> tuple[Output, tuple[Finding, ...]]:
    """The file that a product asks for; the frame is still to be put into its path.

    Raises
    ------
    ImageError
        A variable is of no layer that there is, or two share a name.
    """
    layers: dict[str, layer_names.Layer] = {}
    half: set[str] = set()
    findings: list[Finding] = []
    for variable in product.variables:
        source = layer_names.canonical(variable.source, variable.source_type, variable.path)
        name = layer_names.layer_name(source, variable.name)
        if source in layer_names.FAMILIES and variable.name:
            findings.append(
                Finding(variable.path, "aov:name", f"'{variable.name}' cannot name several layers; ignored.")
            )
            name = source
        if name in layers:
            raise ImageError(
                f"{product.path}: two variables are called '{name}'; give {variable.path} another aov name"
            )
        layers[name] = layer_names.Layer(source, name)
        if variable.n_channels == 4 and name == "beauty":
            layers["alpha"] = layer_names.Layer("alpha", "alpha")
            half |= {"alpha"} if variable.is_half else set()
        else:
            findings += _data_type(variable, source)
        if variable.is_half and source != "depth" and layer_names.n_channels(source):
            half.add(name)
    if not layers:
        layers = {name: layer_names.Layer(name, name) for name in layer_names.DEFAULT}
    file = Path(product.file)
    if file.suffix.lower() == ".png" and len(layers) > 1:
        shown = next(iter(layers))
        findings.append(
            Finding(product.path, "orderedVars", f"a .png holds one layer, {shown}; write an .exr for all.")
        )
    output = Output(file, tuple(layers.values()), frozenset(half), product=product.path)
    return output, tuple(findings)


def product_findings(stage: Any, frame: float | None = None) -> tuple[Finding, ...]:
    """What would keep the products of the stage's render settings from being written, and what is not supported."""
    if not names_products(stage):
        return ()
    try:
        products, findings = read_render_products(stage, frame)
    except StageError as problem:
        return (Finding("", "", str(problem)),)
    found = list(findings)
    for product in products:
        try:
            found += product_output(product)[1]
        except ImageError as problem:
            found.append(Finding(product.path, "orderedVars", str(problem)))
        folder = Path(product.file).parent
        if "#" not in str(folder) and not folder.is_dir():
            message = f"the folder {folder} does not exist; make it before rendering, or name another"
            found.append(Finding(product.path, "productName", message))
    return tuple(found)


def _data_type(variable: RenderVariable, source: str) -> list[Finding]:
    there = layer_names.n_channels(source)
    found = []
    if there and variable.n_channels and variable.n_channels != there:
        found.append(Finding(variable.path, "dataType", f"{source} has {there} channel(s) a pixel; all are written."))
    if variable.is_half and (source == "depth" or not there):
        found.append(Finding(variable.path, "dataType", f"16 bits are too few for {source}; 32 are written."))
    return found
