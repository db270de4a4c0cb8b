"""Publishing a stage's payloads: every one verified, in one read-only file that is never collected."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from icheat_usd import sidecar
from icheat_usd.errors import EditError, IcheatError, SidecarError
from icheat_usd.scene import Finding
from icheat_usd.session import housekeeping, inspection
from icheat_usd.session.origin import history_entry
from icheat_usd.stage.pinned import PinnedKey, pinned_keys
from icheat_usd.stage.schema import FILE_PATH, PAYLOAD
from icheat_usd.stage.sidecar_uses import repoint_layer
from icheat_usd.stage.stacks import EditFinding, Severity

#: Rules of `icheat check` that only warn, and that stop a publication all the same.
_STALE = ("BakedStale", "BakedParametersChanged", "PaintedSurfaceChanged")


@dataclass(frozen=True)
class Published:
    """What `publish` did; without a file it refused, because of the findings."""

    file: str
    manifest: str
    keys: tuple[PinnedKey, ...]
    payloads: tuple[str, ...]
    repointed: dict[str, int]
    findings: tuple[Finding, ...]


def publish(stage: Any, out: str | None = None, *, layers: Sequence[str] = (), why: str = "") -> Published:
    """Verify every payload of every edit at every key, and pack them into one read-only file with a manifest.

    Muted edits count: a stronger layer may unmute them.

    Parameters
    ----------
    stage
        An open stage whose root layer has a file.
    out : str, optional
        The file to make; by default ``<root layer>.published.v001.icheat.h5`` beside the root layer, or the next.
    layers : sequence of str
        Layer files that shall name the published file from now on; they are saved.

    Returns
    -------
    Published
        With findings and without a file where something is missing, damaged, stale or wrong.

    Raises
    ------
    EditError, SidecarError
        The stage has no payload, or the file or a layer cannot be written.
    """
    keys, findings = pinned_keys(stage)
    damage = _damage(stage, keys)
    damaged = {finding.prim for finding in damage}
    # What is wrong with a payload that cannot be read has been said.
    others = [f for f in _errors(stage, keys) if f.prim not in damaged or f.feature not in (PAYLOAD, FILE_PATH)]
    findings = [*findings, *damage, *others]
    if findings:
        return Published("", "", keys, (), {}, tuple(dict.fromkeys(findings)))
    root = stage.GetRootLayer().realPath
    if not keys:
        raise EditError(f"{root or 'the stage'}: no edit has a payload, so there is nothing to publish")
    if out is None and not root:
        raise EditError("the stage has no file to publish beside; name the file with --out")
    beside = out or str(Path(root).with_suffix(".published.usda"))
    files = dict.fromkeys(key.file for key in keys)
    wanted = {key.digest for key in keys}
    for layer in layers:
        # Also what variants that are not selected name: after repointing it must be in the file.
        uses = housekeeping.uses_of_layer(layer)
        files |= dict.fromkeys(sorted(uses.files))
        wanted |= uses.digests
    entry = history_entry(why or "published")
    file, payloads = sidecar.pack([*files], beside, only=wanted, history=entry, published=True)
    repointed: dict[str, int] = {}
    try:
        manifest = housekeeping.write_manifest(str(file), _manifest(stage, str(file), keys, payloads, entry))
        for layer in layers:
            repointed[layer] = repoint_layer(layer, str(file), files)
    except Exception:
        # Not after an interruption: a layer may have been saved already, and then names the file.
        if not any(repointed.values()):
            file.unlink(missing_ok=True)
            Path(housekeeping.manifest_path(str(file))).unlink(missing_ok=True)
        raise
    return Published(str(file), manifest, keys, tuple(payloads), repointed, ())


def _damage(stage: Any, keys: Sequence[PinnedKey]) -> list[Finding]:
    """Read every payload of every key, each once per anchor."""
    findings: list[Finding] = []
    read: dict[tuple[str, str, str], str] = {}
    for key in keys:
        place = (key.file, key.digest, key.anchor)
        if place not in read:
            try:
                if "[" in key.file and not os.path.isfile(key.file):
                    raise SidecarError(f"{key.file} lies in a package, which cannot be published again; unpack it")
                sidecar.read_payload(key.file, key.digest, anchor=key.anchor)
                read[place] = ""
            except SidecarError as problem:
                read[place] = str(problem)
        if read[place]:
            at = "" if key.time is None else f" at time {key.time:g}"
            findings.append(EditFinding(key.edit, f"icheat:payload{at}", read[place], Severity.ERROR))
    return findings


def _errors(stage: Any, keys: Sequence[PinnedKey]) -> list[Finding]:
    """What `check` calls an error, or stale, at any key."""
    times: list[float | None] = sorted({key.time for key in keys if key.time is not None}) or [None]  # type: ignore[assignment]
    found: dict[Finding, None] = {}
    for time in times:
        try:
            for finding in inspection.check(stage, time):
                if getattr(finding, "severity", "") == Severity.ERROR or getattr(finding, "rule", "") in _STALE:
                    found[finding] = None
        except IcheatError as problem:
            found[EditFinding("/", "check", str(problem), Severity.ERROR)] = None
    return list(found)


def _manifest(
    stage: Any, file: str, keys: Sequence[PinnedKey], payloads: Sequence[str], entry: sidecar.History
) -> dict[str, object]:
    folder = os.path.dirname(file)
    return {
        "version": 1,
        "stage": os.path.relpath(stage.GetRootLayer().realPath or file, folder),
        "file": os.path.basename(file),
        "sha256": hashlib.sha256(Path(file).read_bytes()).hexdigest(),
        "who": entry.who,
        "why": entry.why,
        "when": entry.when,
        "payloads": list(payloads),
        "aliases": dict(sidecar.list_aliases(file)),
        "keys": [{"edit": key.edit, "time": key.time, "payload": key.digest} for key in keys],
    }
