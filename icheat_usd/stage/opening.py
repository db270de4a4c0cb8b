"""Open a stage, loading what can be loaded and saying what cannot."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pxr import Ar, Sdf, Tf, Usd, UsdUtils

from icheat_usd.errors import StageError
from icheat_usd.scene import Finding


@contextmanager
def quiet_usd() -> Iterator[UsdUtils.CoalescingDiagnosticDelegate]:
    """Keep USD's warnings off stderr; yields the delegate that collects them instead."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield delegate
    finally:
        # Diagnostics left inside are printed when the delegate dies.
        delegate.TakeUncoalescedDiagnostics()


def open_stage(path: str | os.PathLike[str]) -> Usd.Stage:
    """Open a stage for reading, all payloads loaded.

    Assets and sublayers that are missing do not stop it: `composition_findings`
    lists them, and so does every snapshot of the stage.

    Parameters
    ----------
    path
        A USD file (`.usd`, `.usda`, `.usdc`, `.usdz`) or an identifier that the asset resolver knows.

    Raises
    ------
    StageError
        There is no such file, it is not USD, or its root layer cannot be read.
    """
    name = os.fspath(path)
    if os.path.isdir(name):
        raise StageError(f"{name} is a folder; give the stage's root layer, a .usd, .usda, .usdc or .usdz file.")
    with quiet_usd():
        if not os.path.exists(name) and not Ar.GetResolver().Resolve(name):
            raise StageError(f"{name} does not exist; give a .usd, .usda, .usdc or .usdz file, or check its path.")
        if not Sdf.FileFormat.FindByExtension(name):
            raise StageError(
                f"{name} is not a USD file (its extension is '{Path(name).suffix}'); "
                "give a .usd, .usda, .usdc or .usdz file."
            )
        try:
            return Usd.Stage.Open(name)
        except Tf.ErrorException as error:
            reason = _first_reason(error)
            raise StageError(f"{name} cannot be read as USD ({reason}); check or export it again.") from None


def composition_findings(stage: Usd.Stage) -> tuple[Finding, ...]:
    """What the stage refers to and could not compose, one finding per missing asset (or per prim without one)."""
    grouped: dict[tuple[str, str], tuple[str, str, int]] = {}
    errors = [
        (
            type(error).__name__.removeprefix("Error"),
            str(getattr(getattr(error, "rootSite", None), "path", "")) or "/",
            " ".join(str(error).split()),
        )
        for error in stage.GetCompositionErrors()
    ]
    # USD composes in parallel: the order in which it finds errors differs from run to run.
    for kind, prim, text in sorted(errors):
        asset = re.search(r"@([^@]+)@", text)
        key = (kind, asset.group(1) if asset else prim)
        first_prim, first_text, count = grouped.get(key, (prim, text, 0))
        grouped[key] = (first_prim, first_text, count + 1)
    return tuple(
        Finding(prim, f"composition: {kind}", text + (f" And {count - 1} more times." if count > 1 else ""))
        for (kind, _), (prim, text, count) in grouped.items()
    )


def _first_reason(error: Tf.ErrorException) -> str:
    try:
        commentaries = [str(getattr(part, "commentary", part)) for part in error.args]
    except UnicodeDecodeError:
        return "it holds text that is not UTF-8"
    reason = " ".join(commentaries[0].split()) if commentaries else "no reason given"
    return reason if len(reason) <= 200 else reason[:197] + "..."
