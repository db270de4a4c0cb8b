"""What differs between two payloads, and between two sidecars, in an artist's words."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np

from icheat_usd import sidecar
from icheat_usd.edits.model import Payload, SurfaceMask
from icheat_usd.edits.staleness import changes, value_text

_ARROW = "\N{RIGHTWARDS ARROW}"

#: Weights that differ by less are the same to the eye: half a step of eight bits.
_SAME_WEIGHT = 0.5 / 255


def payload_differences(a: Payload, b: Payload) -> tuple[str, ...]:
    """Never empty: payloads have different digests where they differ at all."""
    return tuple(_differences(a, b)) or ("written anew with the same contents",)


def _differences(a: Payload, b: Payload) -> Iterator[str]:
    if a.operation != b.operation:
        yield f"operation {a.operation} {_ARROW} {b.operation}"
    for name in dict.fromkeys([*a.parameters, *b.parameters]):
        texts = [value_text(p.parameters[name]) if name in p.parameters else "default" for p in (a, b)]
        if texts[0] != texts[1]:
            yield f"{name} {texts[0]} {_ARROW} {texts[1]}"
    for side in ("receiver", "caster"):
        yield from _mask_differences(f"{side} mask", getattr(a, f"{side}_mask"), getattr(b, f"{side}_mask"))
    for label, name in (("scale", "scale_delta"), ("emission", "emission"), ("offset", "offset")):
        was, is_ = getattr(a, name), getattr(b, name)
        if was != is_:
            texts = ["none" if value is None else value_text(value) for value in (was, is_)]
            yield f"baked {label} {texts[0]} {_ARROW} {texts[1]}"
    yield from _row_differences(a, b)
    against = changes(a.made_against, b.made_against)
    if against:
        yield f"made against another scene: {', '.join(change.text for change in against[:3])}"


def _mask_differences(label: str, a: SurfaceMask | None, b: SurfaceMask | None) -> Iterator[str]:
    if a is None and b is None:
        return
    if a is None or b is None:
        mask = a or b
        assert mask is not None
        yield f"{label} {'painted' if a is None else 'removed'} ({_surfaces(len(mask.surfaces))})"
        return
    if a.resolution != b.resolution:
        yield f"{label} painted at {b.resolution} texels a face, and was at {a.resolution}"
        return
    were, are = _texels_by_surface(a), _texels_by_surface(b)
    touched, differing, total = 0, 0, 0
    for key in dict.fromkeys([*were, *are]):
        was, is_ = were.get(key), are.get(key)
        if was is not None and is_ is not None and was.shape == is_.shape:
            n = int(np.count_nonzero(np.abs(was - is_) > _SAME_WEIGHT))
            size = was.size
        else:
            size = max(part.size for part in (was, is_) if part is not None)
            n = sum(int(np.count_nonzero(part > _SAME_WEIGHT)) for part in (was, is_) if part is not None)
        touched, differing, total = touched + (n > 0), differing + n, total + size
    if differing:
        share = 100 * differing / max(total, 1)
        percent = f"{share:.0f}" if share >= 1 else f"{share:.2g}"
        yield f"{label} repainted ({_surfaces(touched)}, {percent} % of texels differ)"


def _texels_by_surface(mask: SurfaceMask) -> dict[tuple[str, int, str], np.ndarray]:
    ends = np.cumsum([surface.n_faces for surface in mask.surfaces])
    return {
        (surface.path, surface.instance_id, surface.part): mask.texels[end - surface.n_faces : end]
        for surface, end in zip(mask.surfaces, ends.tolist(), strict=True)
    }


def _row_differences(a: Payload, b: Payload) -> Iterator[str]:
    if (a.rows is None) != (b.rows is None):
        yield "sampled rows baked" if a.rows is None else "sampled rows removed"
    elif a.rows is not None and b.rows is not None:
        bounds = [max(rows.epsilon_scale, rows.epsilon_emission, rows.epsilon_offset) for rows in (a.rows, b.rows)]
        columns = [(rows.indptr, rows.indices, rows.numbers, rows.row_step) for rows in (a.rows, b.rows)]
        same = all(np.array_equal(x, y) for x, y in zip(*columns, strict=True))
        if not same or bounds[0] != bounds[1]:
            bound = f", bound {bounds[0]:.2g} {_ARROW} {bounds[1]:.2g}" if bounds[0] != bounds[1] else ""
            yield f"sampled rows baked anew ({len(a.rows.row_pattern)} {_ARROW} {len(b.rows.row_pattern)}{bound})"


def _surfaces(n: int) -> str:
    return f"{n} surface{'s' * (n != 1)}"


def compare_sidecars(a: str, b: str) -> list[tuple[str, str]]:
    """Differences of two sidecars: name of an edit or digest, and text.

    A payload of one file is compared with that of the other whose history names the same edit; payloads themselves
    do not know their edits.

    Raises
    ------
    SidecarError
        A file is missing, damaged or no sidecar.
    """
    held = [set(sidecar.list_payloads(file)) for file in (a, b)]
    only = [held[0] - held[1], held[1] - held[0]]
    about = [_edits_of(file) for file in (a, b)]
    found: list[tuple[str, str]] = []
    paired: set[str] = set()
    for old in sorted(only[0]):
        candidates = [new for new in sorted(only[1] - paired) if _is_same(about[0].get(old), about[1].get(new))]
        if not candidates and len(only[0]) == len(only[1]) == 1:
            # Two files that hold one thing each, and do not say what it is.
            candidates = [new for new in only[1] if not (about[0].get(old) and about[1].get(new))]
        if not candidates:
            continue
        new = candidates[0]
        paired |= {old, new}
        name = about[1].get(new, "").rpartition("/")[2] or new[:12]
        payloads = [sidecar.read_payload(file, digest, anchor="/") for file, digest in ((a, old), (b, new))]
        text = "; ".join(payload_differences(payloads[0], payloads[1]))
        found.append((name, f"{name}: {old[:12]} {_ARROW} {new[:12]}: {text}"))
    for file, digests, edits in zip((a, b), only, about, strict=True):
        for digest in sorted(digests - paired):
            name = edits.get(digest, "").rpartition("/")[2]
            of = f" of {name}" if name else ""
            found.append((name or digest[:12], f"only in {os.path.basename(file)}: {digest[:12]}{of}"))
    return found


def _edits_of(file: str) -> dict[str, str]:
    return {
        digest: str(getattr(entry, "edit", "")) for entry in sidecar.read_history(file) for digest in entry.payloads
    }


def _is_same(a: str | None, b: str | None) -> bool:
    return bool(a) and a == b
