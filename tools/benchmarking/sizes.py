"""Sizes and errors of edits in files: the encoding that is chosen, and sampled rows that are forced."""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np


def measure_sizes(arguments: argparse.Namespace) -> dict[str, Any]:
    """Bake made-up edits of one stage in all ways; one line each."""
    from icheat_usd.edits.binding import bind
    from icheat_usd.edits.encodings.bake import at_full_amount, bake_field
    from icheat_usd.edits.encodings.choose import choose
    from icheat_usd.edits.model import EditStack, KeyedPayload, Payload
    from icheat_usd.edits.operations import find
    from icheat_usd.edits.operations.constants import baked_constants
    from icheat_usd.session import Quality, Session
    from icheat_usd.sidecar import write_payloads
    from tools.benchmarking.made_up_edits import edits_of_objects_and_brushes

    stage = arguments.stages[0]
    size = {"width": arguments.width, "height": arguments.height}
    session = Session.open(stage, quality=Quality(n_gather=arguments.gather), **size)
    snapshot, view, gather = session.snapshot, session.view, session.gather
    print(f"  {view.n:,} view samples, {gather.n:,} gather samples", flush=True)
    rows: list[dict[str, Any]] = []

    def stored(payload: Payload) -> int:
        with tempfile.TemporaryDirectory() as folder:
            return os.path.getsize(write_payloads(folder, [payload], anchor="/")[0])

    def image_error(edit: Any, baked: Any) -> dict[str, float]:
        as_rows = replace(
            edit, operation="baked", parameters={}, keys=(KeyedPayload(Payload(edit.operation, {}, rows=baked), 1.0),)
        )
        exact = session.relighter.relight(bind(EditStack("/s", (edit,)), snapshot))
        found = session.relighter.relight(bind(EditStack("/s", (as_rows,)), snapshot))
        off = np.abs(found.indirect_edited - exact.indirect_edited)
        lit = exact.indirect > 1e-3 * exact.indirect.mean()
        return {
            "image_error_max": float((off[lit] / exact.indirect[lit]).max()),
            "image_error_rms": float(np.sqrt((off**2).mean() / (exact.indirect**2).mean())),
            "edit_rms": float(
                np.sqrt(((exact.indirect_edited - exact.indirect) ** 2).mean() / (exact.indirect**2).mean())
            ),
        }

    for name, edit in edits_of_objects_and_brushes(session).items():
        if arguments.edits and name not in arguments.edits:
            continue
        operation = find(edit.operation)
        assert operation is not None
        complete = operation.complete(edit.parameters, edit.path)
        payload = edit.keys[0].payload if edit.keys else Payload(edit.operation, edit.parameters)
        payload = replace(payload, **baked_constants(operation, complete))
        row: dict[str, Any] = {"edit": name, "chosen": choose(edit.operation, complete).value, "bytes": stored(payload)}
        print(f"  {name:<14} {row['chosen']:<8} {row['bytes'] / 1e6:8.3f} MB", flush=True)
        field = bind(at_full_amount(edit), snapshot)
        radiance = session.cell_light.total() if field.uses_incident else None
        for form, options in (
            ("epsilon", {"epsilon": arguments.epsilon}),
            ("coefficients", {"coefficients": arguments.coefficients}),
        ):
            start = time.perf_counter()
            baked = bake_field(field, view, gather, snapshot, where=name, radiance=radiance, **options)
            found: dict[str, Any] = {
                "seconds": time.perf_counter() - start,
                "bytes": stored(replace(payload, rows=baked.rows)),
                "sites": len(baked.rows.site_row),
                "rows": len(baked.rows.row_pattern),
                "entries": len(baked.rows.indices),
                "epsilon_scale": baked.rows.epsilon_scale,
                "measured": baked.measured,
            }
            if arguments.images:
                found |= image_error(edit, baked.rows)
            row[form] = found
            value = next(iter(options.values()))
            print(
                f"    rows, {form} {value}: {found['bytes'] / 1e6:.3f} MB, {found['seconds']:.1f} s,"
                f" {found['sites']:,} sites, scale within {found['epsilon_scale']:.2g}, seen {found['measured']:.2g}"
                + (
                    f", image max {found['image_error_max']:.2g} rms {found['image_error_rms']:.2g}"
                    f" of an edit of rms {found['edit_rms']:.2g}"
                    if arguments.images
                    else ""
                ),
                flush=True,
            )
        rows.append(row)
    return {"stage": Path(stage).name, **size, "gather_samples": gather.n, "edits": rows}
