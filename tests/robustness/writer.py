"""A process that authors edits and may be killed on the way: run by `test_killed.py` and `test_two_writers.py`.

    python -m tests.robustness.writer sweep FOLDER add|publish STRIDE
    python -m tests.robustness.writer loop COUNT STAGE LAYER NAME

`sweep` has writers end without any clean-up before and after every write,
flush, link, rename and layer save in turn, and looks at what each leaves.
Every writer is a fork of this process, which itself opens no stage and so has
no threads.
"""

from __future__ import annotations

import os
import shutil
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from pxr import Sdf

from icheat_usd.edits.model import MaskedSurface, SurfaceMask
from icheat_usd.errors import IcheatError
from icheat_usd.session import authoring, housekeeping, inspection, publishing
from icheat_usd.sidecar import list_payloads, read_payload

KILLED = 86


class _Fuse:
    """Counts calls, and ends the process at one of them: before it acts, or half-way."""

    def __init__(self, blow_at: int) -> None:
        self.blow_at = blow_at
        self.count = 0

    def guard(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*args: Any, **kwargs: Any) -> Any:
            self.count += 1
            if self.count == self.blow_at:
                os._exit(KILLED)
            result = function(*args, **kwargs)
            self.count += 1  # once more after it has acted, before anyone knows
            if self.count == self.blow_at:
                os._exit(KILLED)
            return result

        return counted

    def install(self) -> None:
        for module, names in (
            (os, ("fsync", "link", "replace", "rename", "unlink", "open", "chmod")),
            (h5py.Group, ("create_dataset", "create_group")),
            (h5py.File, ("__init__", "close")),
            (Sdf.Layer, ("Save",)),
        ):
            for name in names:
                setattr(module, name, self.guard(getattr(module, name)))


def add(stage_file: str, layer: str, name: str) -> None:
    """One edit with a painted mask, as `icheat edit add` writes it."""
    stage = inspection.open_stage(stage_file)
    texels = np.linspace(0, 1, 6 * 256, dtype=np.float32).reshape(6, 16, 16)
    authoring.add_edit(
        stage,
        inspection.find_stack(stage),
        name,
        layer=layer,
        parameters={"gain": 0.5},
        receivers=["Floor"],
        casters=["Wall"],
        receiver_mask=SurfaceMask((MaskedSurface("/World/Floor", 6),), texels),
    )


SCENE = """#usda 1.0
(
    defaultPrim = "World"
)
def Xform "World"
{
    def Cube "Floor" {}
    def Cube "Wall" {}
    def Scope "Edits" (prepend apiSchemas = ["IcheatStackAPI"]) {}
}
"""
SHOT = """#usda 1.0
(
    defaultPrim = "World"
    subLayers = [@./scene.usda@]
)
"""


def make_stage(folder: Path) -> Path:
    """A room below a shot layer, with an empty stack."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.usda").write_text(SCENE)
    (folder / "shot.usda").write_text(SHOT)
    return folder / "shot.usda"


def edits(stage_file: Path) -> list[str]:
    """Names of the edits of a stage with nothing wrong."""
    stage = inspection.open_stage(str(stage_file))
    stack = inspection.find_stack(stage)
    assert stack is not None
    findings = inspection.check(stage)
    assert not findings, findings
    return [edit.path.rpartition("/")[2] for edit in inspection.describe_stack(stage, stack).edits]


def verify_sidecars(folder: Path) -> int:
    """Every file under a final name is whole: all its payloads have the digests that name them."""
    files = [file for file in folder.iterdir() if file.name.endswith(".icheat.h5")]
    for file in files:
        assert list_payloads(file)
        for digest in list_payloads(file):
            read_payload(file, digest, anchor="/World")
    return len(files)


def _forked(action: Callable[[], None]) -> int:
    """Exit status of a fork of this process that does something."""
    sys.stdout.flush()
    process = os.fork()
    if process:
        return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    try:
        action()
        sys.stdout.flush()
        os._exit(0)
    except BaseException:
        traceback.print_exc()
        os._exit(1)


def publish(stage_file: str) -> None:
    """Publish and repoint, as `icheat publish --layer` does."""
    published = publishing.publish(inspection.open_stage(stage_file), layers=[stage_file])
    assert published.file and not published.findings, published.findings


def _killed_at(stage: Path, step: int, verb: str) -> None:
    fuse = _Fuse(step)
    fuse.install()
    if verb == "publish":
        publish(str(stage))
    else:
        add(str(stage), "shot.usda", "late")
    (stage.parent / "steps").write_text(str(fuse.count))


def _look(folder: Path) -> None:
    """What a killed writer left: all that was committed, and nothing that stops the next writer."""
    if (folder / "publishing").exists():
        _look_after_publish(folder)
        return
    before = edits(folder / "shot.usda")
    assert before in (["early"], ["early", "late"]), before
    assert verify_sidecars(folder) >= len(before)
    add(str(folder / "shot.usda"), "shot.usda", "next")
    assert edits(folder / "shot.usda") == [*before, "next"]
    left = [path.name for path in folder.iterdir() if path.name.startswith(".")]
    assert not left, left
    collected = housekeeping.collect([str(folder)], min_age_hours=0.0)
    assert not collected.problems and len(collected.unnamed) <= 1, collected
    assert verify_sidecars(folder) == len(before) + 1 + len(collected.unnamed)
    print("late" if "late" in before else "early", len(collected.unnamed), flush=True)


def _look_after_publish(folder: Path) -> None:
    assert edits(folder / "shot.usda") == ["early"]
    n_files = verify_sidecars(folder)
    published = "published" in (folder / "shot.usda").read_text()
    publish(str(folder / "shot.usda"))
    assert edits(folder / "shot.usda") == ["early"] and verify_sidecars(folder) == n_files + 1
    left = [path.name for path in folder.iterdir() if path.name.startswith(".")]
    assert not left, left
    # Without its manifest too a published file says itself that it is one.
    collected = housekeeping.collect([str(folder)], min_age_hours=0.0)
    assert not collected.problems and all("published" not in item.file for item in collected.unnamed), collected
    print("repointed" if published else "as before", n_files, flush=True)


def sweep(folder: Path, verb: str, stride: int) -> None:
    """Kill a writer at every step, or every so many, and look at what it left; prints one line for each."""
    make_stage(folder / "start")
    assert _forked(lambda: add(str(folder / "start" / "shot.usda"), "shot.usda", "early")) == 0
    if verb == "publish":
        (folder / "start" / "publishing").touch()
    step = 1 - stride
    while True:
        step += stride
        place = Path(shutil.copytree(folder / "start", folder / "killed"))
        status = _forked(lambda place=place, step=step: _killed_at(place / "shot.usda", step, verb))  # type: ignore[misc]
        if status == 0:
            assert step - stride <= int((place / "steps").read_text()) < step
            return
        assert status == KILLED, f"step {step}: the writer ended with {status}"
        assert _forked(lambda place=place: _look(place)) == 0, f"step {step}"  # type: ignore[misc]
        shutil.rmtree(place)


def loop(count: int, stage: str, layer: str, name: str) -> None:
    """Add edits one after the other; says which were kept, and of which the user was told that they were not."""
    print("ready", flush=True)
    sys.stdin.readline()  # both writers start at the same moment
    for index in range(count):
        try:
            add(stage, layer, f"{name}{index}")
            print(f"kept {name}{index}", flush=True)
        except IcheatError as error:
            print(f"told {name}{index}: {error}", flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "sweep":
        sweep(Path(sys.argv[2]), sys.argv[3], int(sys.argv[4]))
    else:
        loop(int(sys.argv[2]), *sys.argv[3:])
