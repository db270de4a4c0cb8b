"""A sequence layer under a shot layer, for tests that author and read edits."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from pxr import Sdf, Usd, UsdGeom

import icheat_usd  # noqa: F401  announces the schemas before anything composes
from icheat_usd.edits.model import Payload

SURFACES = ("/World/floor", "/World/Room/wall", "/World/Room/ceiling")
DIGEST = "ab" * 32
OTHER = "cd" * 32
THIRD = "ef" * 32


def shot_stage(folder: Path, offset: float = 0.0, scale: float = 1.0) -> Usd.Stage:
    """shot.usda over seq.usda, the latter with the scene and under a layer offset."""
    sequence = Usd.Stage.CreateNew(str(folder / "seq.usda"))
    UsdGeom.SetStageUpAxis(sequence, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(sequence, 1.0)
    sequence.SetDefaultPrim(UsdGeom.Xform.Define(sequence, "/World").GetPrim())
    UsdGeom.Xform.Define(sequence, "/World/Room")
    for path in SURFACES:
        mesh = UsdGeom.Mesh.Define(sequence, path)
        mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
        mesh.CreateFaceVertexCountsAttr([3])
        mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
        mesh.CreateExtentAttr([(0, 0, 0), (1, 1, 0)])
    UsdGeom.Camera.Define(sequence, "/World/camera")
    sequence.Save()
    shot = Usd.Stage.CreateNew(str(folder / "shot.usda"))
    UsdGeom.SetStageUpAxis(shot, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(shot, 1.0)
    shot.GetRootLayer().subLayerPaths.append("./seq.usda")
    shot.GetRootLayer().subLayerOffsets[0] = Sdf.LayerOffset(offset, scale)
    shot.GetRootLayer().defaultPrim = "World"
    shot.Save()
    (folder / "edits.v001.icheat.h5").write_bytes(b"payloads")
    return shot


def layer(stage: Usd.Stage, name: str) -> Sdf.Layer:
    """The stage's own layer of that file name."""
    return next(found for found in stage.GetLayerStack() if Path(found.identifier).name == name)


class RecordingReader:
    """Stands for a sidecar: any digest is a scale edit whose recipe has this gain."""

    def __init__(self, operation: str = "scale", **recipe: float) -> None:
        self.calls: list[tuple[str, str | bytes, str, str]] = []
        self.operation = operation
        self.recipe = recipe

    def __call__(self, file: str, source: str | bytes, digest: str, anchor: str) -> Payload:
        self.calls.append((file, source, digest, anchor))
        return Payload(self.operation, dict(self.recipe))


def stock_findings(stage: Usd.Stage) -> list[str] | None:
    """Errors of all validators that come with USD, not of ours; None where this USD cannot load its validators."""
    if Usd.GetVersion() < (0, 26, 5):
        return None
    from pxr import UsdValidation

    every = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    validators = [validator for validator in every if not validator.GetMetadata().name.startswith("icheat")]
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    return [f"{error.GetName()}: {error.GetMessage()}" for error in errors]


def python(code: str, *arguments: str, environment: dict[str, str] | None = None) -> str:
    """Standard output of another Python process."""
    import os

    root = str(Path(icheat_usd.__file__).resolve().parents[1])
    clean = {k: v for k, v in os.environ.items() if k != "PXR_PLUGINPATH_NAME"}
    clean["PYTHONPATH"] = root
    command: Sequence[str] = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env={**clean, **(environment or {})}, cwd="/")
    assert done.returncode == 0, done.stderr
    return done.stdout
