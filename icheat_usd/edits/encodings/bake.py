"""Baking: pair functions of an edit, or of a whole stack, sampled and coded as rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.encodings.assemble import assemble
from icheat_usd.edits.encodings.coding import ColumnsDiffer, RowCoder
from icheat_usd.edits.encodings.pair_samples import PAIRS_AT_ONCE, PairSamples
from icheat_usd.edits.encodings.rows import Mixture, bind_rows
from icheat_usd.edits.encodings.sampled import SampledRows, contract, tree_shape
from icheat_usd.edits.encodings.sites import choose_sites, pixel_footprint
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import Blend, Edit, EditStack
from icheat_usd.edits.operations import Level
from icheat_usd.errors import EditError
from icheat_usd.materials import take_points
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.samples.tree import build_tree
from icheat_usd.scene import F32, SceneSnapshot
from icheat_usd.transport import Transport

#: Largest error of S by default. Half of it is for what rows leave out, half for what lies between them.
EPSILON = 0.02

_MEASURED_SAMPLES, _MEASURED_LEAVES = 2048, 64


class BakedRows(NamedTuple):
    """Rows, and how far they were seen to be off between their samples."""

    rows: SampledRows
    measured: float  #: largest difference of S at random view samples and gather samples of the view baked for
    n_view: int  #: view samples that the edit touches
    lost: float  #: most radiance that an aggregate adds where it cannot scale; rows do not hold it


def at_full_amount(edit: Edit) -> EditStack:
    """The one edit that is baked: full amount, all lights; amount, blend and lights stay opinions in USD."""
    whole = replace(edit, amount=1.0, enabled=True, blend=Blend.COMPOSE, lights=())
    return EditStack(path="", edits=(whole,))


def check_bakeable(field: EditField, where: str) -> None:
    """Refuse what rows of S, E and O cannot hold.

    Raises
    ------
    EditError
        It says which edit, and what to do.
    """
    if field.n_groups > 1:
        names = ", ".join(bound.edit.path for bound in field.edits if bound.edit.lights)
        raise EditError(
            f"{where}: {names} acts on some lights only, which rows cannot tell apart; mute it or bake it alone"
        )
    if field.aggregates and len(field.edits) > 1:
        names = ", ".join(bound.edit.path for bound in field.edits if bound.level is Level.AGGREGATE)
        raise EditError(
            f"{where}: {names} looks at all light of its casters as the weaker edits leave it, which rows of a whole"
            " stack cannot hold; mute it to flatten the others, and keep it as its recipe"
        )
    for bound in field.edits:
        operation = bound.operation
        if operation is not None and operation.has_through:
            raise EditError(
                f"{bound.edit.path}: operation '{operation.name}' asks for light behind occluders, which is found by"
                " rays and cannot be baked as rows; leave it as its recipe"
            )
        if bound.level is Level.VIEW:
            raise EditError(
                f"{bound.edit.path}: operation '{bound.edit.operation}' acts on receivers alone and is exact as it"
                " is; there is nothing to bake"
            )


def bake_field(
    field: EditField,
    view: ViewSamples,
    gather: GatherSamples,
    snapshot: SceneSnapshot,
    *,
    where: str,
    radiance: F32 | None = None,
    transport: Transport | None = None,
    epsilon: float = EPSILON,
    coefficients: int | None = None,
    progress: Progress = silent,
) -> BakedRows:
    """Sample S, E and O of a field and code them.

    Parameters
    ----------
    field : EditField
        One edit (see `at_full_amount`), or a stack that is frozen.
    where : str
        Path of the edit, for messages.
    radiance : (n_gather, 3) float32
        Light that leaves the gather samples; needed where the field uses it.
    transport : Transport, optional
        From the gather samples to the view samples; needed where the field has aggregates.
    epsilon : float
        Allowed error of S; of E and O, relative to their largest value.
    coefficients : int, optional
        Keep this many in each row instead; `epsilon` then only says how far apart rows may lie.

    Raises
    ------
    EditError
        The field is nothing that rows can hold, or it touches no sample.
    """
    check_bakeable(field, where)
    work = PairSamples(field, view, gather, radiance, transport)
    if not work.leaves.any():
        raise EditError(f"{where}: its casters hold no gather sample, so there is nothing to bake; check icheatCasters")
    if not work.touched.any():
        raise EditError(f"{where}: the camera sees none of its receivers, so there is nothing to bake; move it")

    tests = work.test_leaves()
    allowed = work.tolerance(tests, 0.5 * epsilon)
    sites = choose_sites(
        view, pixel_footprint(view, snapshot), work.on_touched_sides(), work.judged(tests, allowed, progress), progress
    )
    contraction = contract(gather.tree.lo, gather.tree.mid, gather.tree.hi, work.leaves)
    area = gather.area[work.leaf_numbers]
    tree = build_tree(tree_shape(contraction.split_size, work.n_leaves), area.astype(np.float64), b"rows")
    try:
        coder = RowCoder(tree, allowed, coefficients, work.alike_columns(tests))
        row_of_site, factor = work.code(coder, sites.samples, progress)
    except ColumnsDiffer:
        coder = RowCoder(tree, allowed, coefficients)
        row_of_site, factor = work.code(coder, sites.samples, progress)
    coded = coder.finish()
    rows = assemble(coded, row_of_site, factor, sites, work, tree, area, snapshot)
    return BakedRows(rows, largest_error(work, [(rows, 1.0)], snapshot), int(work.touched.sum()), work.lost)


def largest_error(work: PairSamples, keys: Sequence[tuple[SampledRows, float]], snapshot: SceneSnapshot) -> float:
    """Largest difference of S between a field and rows, at random pairs that either touches.

    Parameters
    ----------
    keys : sequence of (SampledRows, float)
        Rows and their weights: those of two keys are interpolated as in an edit. A key that is missing is the identity.
    """
    rng = np.random.default_rng(2)
    bound = [(bind_rows(rows, snapshot, ""), np.float32(weight)) for rows, weight in keys]
    touched, sending = work.touched.copy(), work.leaves.copy()
    for key, _ in bound:
        touched |= key.locate_receivers(work.view.points).confidence > 0
        sending |= key.locate_casters(work.gather.points) >= 0
    samples, leaves = (
        np.sort(rng.permutation(np.flatnonzero(which))[:n])
        for which, n in ((touched, _MEASURED_SAMPLES), (sending, _MEASURED_LEAVES))
    )
    if not len(samples) or not len(leaves):
        return 0.0
    at_view, at_gather = take_points(work.view.points, samples), take_points(work.gather.points, leaves)
    located = [(key.locate_receivers(at_view), key.locate_casters(at_gather)) for key, _ in bound]
    total = sum(weight * mixture.confidence for (_, weight), (mixture, _) in zip(bound, located, strict=True))
    largest, step = 0.0, max(1, PAIRS_AT_ONCE // len(leaves))
    for begin in range(0, len(samples), step):
        some = np.arange(begin, min(begin + step, len(samples)))
        decoded = np.zeros((len(some) * len(leaves), 3), np.float32)
        for (key, weight), (mixture, leaf) in zip(bound, located, strict=True):
            # As `EditField` does it: where one key has no samples, the other speaks alone.
            share = weight if len(keys) == 1 else weight * mixture.confidence / np.where(total > 0, total, 1)
            wide = Mixture._make(np.repeat(column[some], len(leaves), axis=0) for column in mixture)
            share = np.repeat(np.broadcast_to(share, len(samples))[some], len(leaves))
            decoded += share[:, None] * (key.evaluate(wide, np.tile(leaf, len(some))).scale - np.float32(1))
        exact = work.pairs_of(samples[some], leaves)[:, :, :3].reshape(-1, 3)
        largest = max(largest, float(np.abs(decoded - exact).max()))
    return largest
