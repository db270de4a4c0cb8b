"""Suite `edits`: what a render costs with edits over what it costs without, for each way to hold an edit.

Every edit has receivers on at least 30 % of what the camera sees, and casters on at least 30 % of what gather rays
hit, but for those said to be apart: many small ones that only together have so much. Renders with and without edits
take turns; the light of the gather samples, which all share, is not in their times, and binding the stack is.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from icheat_usd.edits.binding import bind
from icheat_usd.edits.encodings.bake import at_full_amount, bake_field
from icheat_usd.edits.model import EMPTY_STACK, Edit, EditStack, KeyedPayload, Payload
from icheat_usd.edits.painting import paint_mask, soft_sphere
from icheat_usd.final_gather.hits import trace_hemisphere
from icheat_usd.materials import take_points
from icheat_usd.samples import view_samples
from icheat_usd.scene import F64, I32
from icheat_usd.stage import open_stage, take_snapshot
from tools.benchmarking.goals import Goal, at_least, at_most
from tools.benchmarking.made_up_edits import one_edit
from tools.benchmarking.parts import Effort
from tools.benchmarking.render_efforts import lesser, said_of_lesser
from tools.benchmarking.render_frame import Frame, replay, warm

#: Least share of the view, and of the hits, that edits act on.
LEAST_SHARE = 0.3

ENCODINGS = ("object", "brush", "vector", "recipe", "rows")
_COUNTS, _QUICK_COUNTS = (1, 8, 64), (1, 3)
#: Of those that gather rays of their own, or look rows up, which takes minutes by the dozen.
_FEWER = {"recipe": (1, 8), "rows": (1, 8)}
_ROUNDS, _QUICK_ROUNDS = 15, 1  # a ratio of two frames varies by some percent
_MUCH = 4.0  #: what takes so many times as long as none is timed once: its ratio needs no third digit

#: Times of none that edits may take, by how many; one of sampled rows has a bound of its own. And how much faster a
#: replay is to be than the render.
_GOALS, _ROWS_GOALS, _REPLAY_GOAL = {"1": 1.05, "8": 1.10, "64": 1.35}, {"1": 1.15}, 20.0
_BAKED = 8  #: different rows; more edits than that share them
#: Rows are baked from a picture no wider than that, and with this bound on S: falloffs of whole walls that double
#: light, from every pixel of a full picture, are 2 GB; so they are about as large as the paper's (7-9 MB).
_BAKED_WIDTH, _BAKED_EPSILON = 160, 0.1
_PILOT = 8192  #: places of the view that shares of hits are found from


class Shares(NamedTuple):
    """How much of the picture surfaces are, by path."""

    seen: dict[str, float]  #: of the view samples
    hit: dict[str, float]  #: of the gather rays


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """Every encoding by itself: what one has compiled or bound is no help to another."""
    encodings = ("object", "rows") if quick else ENCODINGS
    return [{"stage": stage, "encoding": encoding} for stage in stages for encoding in encodings]


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """Median times by number of edits, and their ratios to none."""
    snapshot = take_snapshot(open_stage(case["stage"]), width=effort.width, height=effort.height)
    frame = Frame(snapshot, lesser(quick))
    shares = shares_of(frame)
    stacks = {"none": EMPTY_STACK}
    is_many = case["encoding"] not in _FEWER
    counts = _QUICK_COUNTS if quick else _FEWER.get(case["encoding"], _COUNTS)
    for n in counts:
        stacks[str(n)] = stack_of(frame, shares, case["encoding"], n)
    if is_many:
        most = counts[-1]
        stacks[f"{most} apart"] = stack_of(frame, shares, case["encoding"], most, apart=True)
    for stack in stacks.values():
        warm(snapshot, lesser(quick), stack)
    frame.render(frame.field())  # which takes longer, as memory is new
    times = interleaved(frame, stacks, _QUICK_ROUNDS if quick else _ROUNDS)
    none = statistics.median(times["none"])
    found = {
        name: {
            "seconds": seconds,
            "ratio": statistics.median(a / b for a, b in zip(seconds, times["none"], strict=False)),
            **_covered(shares, stacks[name]),
        }
        for name, seconds in times.items()
    }
    for name, one in found.items():
        print(f"  {name:<10} {statistics.median(one['seconds']):8.3f} s  {one['ratio']:.3f}", flush=True)
    size = {"width": effort.width, "height": effort.height}
    return size | {"times": found, "replay": _replay(frame, stacks["1"], none, quick)}


def interleaved(frame: Frame, stacks: dict[str, EditStack], rounds: int) -> dict[str, list[float]]:
    """Times of each stack, one after the other in every round; of what takes much longer than "none", one time."""
    times: dict[str, list[float]] = {name: [] for name in stacks}
    for _ in range(rounds):
        for name, stack in stacks.items():
            if times[name] and times[name][0] > _MUCH * times["none"][0]:
                continue
            start = time.perf_counter()
            frame.render(frame.field(stack))
            times[name].append(time.perf_counter() - start)
    return times


def shares_of(frame: Frame) -> Shares:
    """What the camera sees, and what gather rays from there hit."""
    view = frame.view
    start = np.linspace(0, view.n - 1, min(_PILOT, view.n)).astype(np.int64)
    rays = trace_hemisphere(frame.snapshot, frame.tracer, take_points(view.points, start), start, 4, 1)
    return Shares(
        _share_by_path(frame, view.points.instance), _share_by_path(frame, rays.ends.instance[rays.ends.instance >= 0])
    )


def _share_by_path(frame: Frame, instance: I32) -> dict[str, float]:
    surface = frame.snapshot.geometry.instance_surface[instance]
    found: dict[str, float] = {}
    for path, count in zip(
        (s.path for s in frame.snapshot.surfaces), np.bincount(surface, minlength=len(frame.snapshot.surfaces)),
        strict=True,
    ):  # fmt: skip
        if count:
            found[path] = found.get(path, 0.0) + float(count) / max(len(instance), 1)
    return found


def stack_of(frame: Frame, shares: Shares, encoding: str, n: int, *, apart: bool = False) -> EditStack:
    """`n` edits in one encoding; `apart`, each has one receiver and one caster."""
    rng = np.random.default_rng([n, apart])
    edits = []
    for i in range(n):
        sides = [_one(share, rng) if apart else _enough(share, rng) for share in shares]
        if encoding == "rows" and i >= _BAKED:
            edits.append(replace(edits[i % _BAKED], path=f"/edit{i:02d}"))
            continue
        edits.append(_edit(frame, encoding, f"edit{i:02d}", sides[0], sides[1], rng))
    return EditStack("/Edits", tuple(edits))


def _edit(
    frame: Frame,
    encoding: str,
    name: str,
    receivers: list[str],
    casters: list[str],
    rng: np.random.Generator,
) -> Edit:
    color = tuple(float(x) for x in rng.uniform(0.5, 1.5, 3))
    if encoding == "vector":
        return one_edit(name, "receive", {"scale": color}, receivers, casters)
    if encoding in ("recipe", "rows"):
        edit = one_edit(name, "falloff", {"exponent": float(rng.uniform(0.5, 1.5))}, receivers, casters)
        return edit if encoding == "recipe" else _baked(frame, edit)
    edit = one_edit(name, "scale", {"gain": 1.2, "color": color}, receivers, casters)
    if encoding == "object":
        return edit
    # Brushes that cover all of the surfaces, and are nowhere constant: the scene is two of its radii wide.
    masks = {}
    for side, paths, points in (
        ("receiver_mask", receivers, frame.view.points),
        ("caster_mask", casters, frame.gather.points),
    ):
        x, y, z = points.position[int(rng.integers(len(points.position)))].tolist()
        masks[side] = paint_mask(frame.snapshot, paths, soft_sphere((x, y, z), 0.0, 3 * frame.snapshot.radius))
    payload = Payload(edit.operation, edit.parameters, **masks)
    return replace(edit, keys=(KeyedPayload(payload, 1.0),))


def _baked(frame: Frame, edit: Edit) -> Edit:
    """The edit as sampled rows alone."""
    camera = frame.snapshot.camera
    width = min(camera.width, _BAKED_WIDTH)
    smaller = replace(camera, width=width, height=max(1, camera.height * width // camera.width))
    snapshot = replace(frame.snapshot, camera=smaller)
    view = view_samples(snapshot, frame.tracer, samples_per_pixel=1)
    field = bind(at_full_amount(edit), snapshot)
    found = bake_field(field, view, frame.gather, snapshot, where=edit.path, epsilon=_BAKED_EPSILON)
    payload = Payload("baked", {}, rows=found.rows)
    return replace(edit, operation="baked", parameters={}, keys=(KeyedPayload(payload, 1.0),))


def _enough(share: dict[str, float], rng: np.random.Generator) -> list[str]:
    """Surfaces in random order until they have the least share; those of next to nothing are left out."""
    paths = [path for path, part in share.items() if part > 0.002] or list(share)
    chosen: list[str] = []
    for i in rng.permutation(len(paths)):
        chosen.append(paths[i])
        if sum(share[path] for path in chosen) >= LEAST_SHARE:
            break
    return chosen


def _one(share: dict[str, float], rng: np.random.Generator) -> list[str]:
    paths = list(share)
    weight: F64 = np.array([share[path] for path in paths])
    return [paths[int(rng.choice(len(paths), p=weight / weight.sum()))]]


def _covered(shares: Shares, stack: EditStack) -> dict[str, Any]:
    """Shares of receivers and casters: the least of any edit, and of all together."""
    if not stack.edits:
        return {}
    found = {}
    for side, share in zip(("receivers", "casters"), shares, strict=True):
        paths = [getattr(edit, side).paths for edit in stack.edits]
        each = [sum(share.get(path, 0.0) for path in some) for some in paths]
        found[side] = {"least": min(each), "together": sum(share.get(p, 0.0) for p in frozenset().union(*paths))}
    return {"shares": found}


def _replay(frame: Frame, stack: EditStack, render_seconds: float, quick: bool) -> dict[str, Any] | None:
    """Time of a changed amount from what one render kept."""
    again = replay(frame, stack)
    if again is None:
        return None
    seconds = []
    for i in range(2 if quick else 12):
        changed = replace(stack, edits=tuple(replace(edit, amount=0.3 + 0.05 * i) for edit in stack.edits))
        start = time.perf_counter()
        again(changed)
        seconds.append(time.perf_counter() - start)
    median = statistics.median(seconds[1:])
    return {"seconds": seconds, "median": median, "times_render": render_seconds / median}


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """Table for README: stages and encodings by rows, numbers of edits by columns."""
    done = [one for one in results if "result" in one]
    if not done:
        return []
    columns = list(dict.fromkeys(name for one in done for name in one["result"]["times"] if name != "none"))
    lines = [said_of_lesser(done[0]["result"]["width"], done[0]["result"]["height"]), ""]
    lines += ["| stage | edits | none | " + " | ".join(columns) + " | receivers, casters of each at least |"]
    lines.append("| --- | --- | ---: |" + " ---: |" * (len(columns) + 1))
    for one in done:
        times = one["result"]["times"]
        none = statistics.median(times["none"]["seconds"])
        cells = [f"{times[name]['ratio']:.3f}" if name in times else "" for name in columns]
        shares = [times[name]["shares"] for name in columns if name in times and "apart" not in name]
        least = [min(share[side]["least"] for share in shares) for side in ("receivers", "casters")]
        lines.append(
            f"| {one['case']['name']} | {one['case']['encoding']} | {none:.2f} s |"
            f" {' | '.join(cells)} | {100 * least[0]:.0f} %, {100 * least[1]:.0f} % |"
        )
    replays = [one for one in done if one["result"]["replay"]]
    lines += [""] + [
        f"{one['case']['name']}, {one['case']['encoding']}: a changed amount is replayed in"
        f" {one['result']['replay']['median']:.3f} s, {one['result']['replay']['times_render']:.0f} times as fast as"
        " the render."
        for one in replays
    ]
    return [*lines, "", *_goals(done)]


def _goals(done: list[dict[str, Any]]) -> list[str]:
    """Every encoding beside its bounds; recipes gather rays of their own and have none."""
    ratios, replays = [], []
    for one in done:
        encoding, result = one["case"]["encoding"], one["result"]
        bounds = {"rows": _ROWS_GOALS, "recipe": {}}.get(encoding, _GOALS)
        label = f"{one['case']['name']} {encoding}"
        ratios += [
            Goal(f"{n} {label}", result["times"][n]["ratio"], bound)
            for n, bound in bounds.items()
            if n in result["times"]
        ]
        if result["replay"]:
            replays.append(Goal(label, result["replay"]["times_render"], _REPLAY_GOAL))
    return [
        at_most("time with 1 / 8 / 64 edits over that with none (one of rows: 1.15),", ratios),
        "",
        at_least("times that a replay is faster than the render,", replays),
    ]
