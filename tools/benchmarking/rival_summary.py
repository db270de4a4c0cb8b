"""What the curves of the suite `rivals` say: tables, and ours over the others at equal time."""

from __future__ import annotations

from typing import Any

import numpy as np

from tools.benchmarking.goals import Goal, at_least, at_most

#: Seconds at which ours is held against the path tracer with its denoiser.
AT_SECONDS = (1, 4, 16, 64)

RAW, DENOISED = "mitsuba llvm", "mitsuba llvm + OIDN"
_MEASURES = {"rel_mse": "untrimmed", "rel_mse_trimmed": "trimmed"}

#: What error times time of the path tracer is to be over ours, on one stage and elsewhere, and our error at most
#: over the denoiser's.
_EFFICIENCY, _OTHER_EFFICIENCY, _OVER_DENOISED = {"cornell_box": 50.0}, 10.0, 0.5

#: Standard errors up to which an error is no more than the noise of the reference.
_DROWNED = 2.0

#: A curve is used this much beyond its ends; ours on and on, as a picture that is there stays there.
_SLACK = 1.1


def curves_of(results: list[dict[str, Any]]) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Points by stage and renderer, by time; the efforts of ours are one curve."""
    found: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for one in results:
        for name, points in one.get("result", {}).get("curves", {}).items():
            renderer = "ours" if name.startswith(("ours, cached", "ours, gathered")) else name
            found.setdefault(one["case"]["name"], {}).setdefault(renderer, []).extend(points)
    return {
        stage: {name: sorted(points, key=lambda point: point["seconds"]) for name, points in curves.items()}
        for stage, curves in found.items()
    }


def error_at(points: list[dict[str, Any]], measure: str, seconds: float, *, stays: bool = False) -> float | None:
    """Error after so many seconds, interpolated in the logarithms; None where the curve does not reach.

    A slower point with a larger error than a quicker one is left out: nobody would choose it. So are errors that the
    noise of the reference drowns, and all that comes after them is not known. With `stays` the last one holds for ever,
    and what is drowned counts as one standard error: for ours, whose efforts end before the time that all others are
    given, and which is to be better than the others.
    """
    known = [point for point in points if stays or _is_known(point, measure)]
    times, values = [], []
    for point in sorted(known, key=lambda point: point["seconds"]):
        value = max(point[measure], point["standard_error"])
        if not values or value < values[-1]:
            times.append(point["seconds"])
            values.append(value)
    last = np.inf if stays else max((point["seconds"] for point in known), default=0.0) * _SLACK
    if not times or not times[0] / _SLACK <= seconds <= last:
        return None
    return float(np.exp(np.interp(np.log(seconds), np.log(times), np.log(values))))


def _is_known(point: dict[str, Any], measure: str) -> bool:
    return bool(point[measure] > _DROWNED * point["standard_error"])


def comparison(curves: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Error times time of the path tracer over ours, and our error over the denoiser's, for one stage."""
    found: dict[str, Any] = {"efficiency": {}, "over_denoised": {}}
    ours = curves.get("ours", [])
    for measure in _MEASURES:
        raw = [point[measure] * point["seconds"] for point in curves.get(RAW, []) if point[measure] > 0]
        if raw:
            # Noise falls with time: the product is the same all along, and best known where it is smallest.
            product = float(np.exp(np.mean(np.log(raw[-4:]))))
            found["efficiency"][measure] = {
                point["label"]: product / (point[measure] * point["seconds"])
                for point in ours
                if _is_known(point, measure)
            }
        pairs = {
            seconds: (
                error_at(ours, measure, seconds, stays=True),
                error_at(curves.get(DENOISED, []), measure, seconds),
            )
            for seconds in AT_SECONDS
        }
        found["over_denoised"][measure] = {
            str(seconds): mine / its for seconds, (mine, its) in pairs.items() if mine is not None and its is not None
        }
    return found


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """Tables for README, and what was absent."""
    lines: list[str] = []
    for stage, curves in curves_of(results).items():
        mine = [one["result"] for one in results if one["case"]["name"] == stage and "result" in one]
        compared = comparison(curves)
        lines += [*_about(stage, mine), "", *_table(curves, compared), "", *_at_equal_time(compared), ""]
        lines += [*_goals(stage, compared), ""]
    return lines


def _about(stage: str, found: list[dict[str, Any]]) -> list[str]:
    lines = []
    for known in (one["reference"] for one in found if "reference" in one):
        lights = "".join(
            f"; lights {what}: {', '.join(known[key])}"
            for key, what in (("lights_left_out", "left out"), ("lights_added", "added"))
            if known[key]
        )
        lines.append(
            f"**{stage}**, {known['triangles']:,} triangles, paths of up to {known['depth']} segments{lights}."
            f" Reference: {known['samples_per_half']} samples per pixel in each half, of a relative"
            f" noise of {known['noise']:.1e} together, {known['noise_trimmed']:.1e} of it in all but the worst"
            " 0.1 % of the pixels; errors are free of it."
        )
    for name, why in {name: why for one in found for name, why in one.get("absent", {}).items()}.items():
        lines.append(f"{name}: {why}.")
    for seconds in (one["compile_seconds"] for one in found if one.get("compile_seconds") is not None):
        lines.append(f"Compiling mitsuba's kernel took {seconds:.1f} s more, which are not in its times.")
    return lines


def _table(curves: dict[str, list[dict[str, Any]]], compared: dict[str, Any]) -> list[str]:
    lines = [
        "| renderer | effort | time | relMSE | trimmed | mean | FLIP | relMSE x time | times less than path tracer's |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    better = compared["efficiency"].get("rel_mse", {})
    for name, points in curves.items():
        for point in points:
            flip = "" if point["flip"] is None else f"{point['flip']:.4f}"
            gain = f"{better[point['label']]:.1f} x" if name == "ours" and point["label"] in better else ""
            lines.append(
                f"| {name} | {point['label']} | {point['seconds']:.2f} s | {point['rel_mse']:.5f}"
                f" ± {point['standard_error']:.5f} |"
                f" {point['rel_mse_trimmed']:.5f} | {100 * (point['mean_ratio'] - 1):+.2f} % | {flip} |"
                f" {point['rel_mse'] * point['seconds']:.4f} | {gain} |"
            )
    return lines


def _at_equal_time(compared: dict[str, Any]) -> list[str]:
    if not any(compared["over_denoised"].values()):
        return []
    lines = ["| our error over mitsuba + OIDN's | " + " | ".join(f"{seconds} s" for seconds in AT_SECONDS) + " |"]
    lines.append("| --- |" + " ---: |" * len(AT_SECONDS))
    for measure, name in _MEASURES.items():
        found = compared["over_denoised"][measure]
        cells = [f"{found[str(s)]:.2f}" if str(s) in found else "not reached" for s in AT_SECONDS]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def _goals(stage: str, compared: dict[str, Any]) -> list[str]:
    """Of all efforts but one: brute force is there to be compared with."""
    lines = []
    found = {name: gain for name, gain in compared["efficiency"].get("rel_mse", {}).items() if "brute" not in name}
    if found:
        bound = _EFFICIENCY.get(stage, _OTHER_EFFICIENCY)
        goals = [Goal(name, gain, bound) for name, gain in found.items()]
        lines.append(at_least("relMSE x time of the path tracer over ours,", goals))
    for measure, name in _MEASURES.items():
        over = compared["over_denoised"][measure]
        if over:
            goals = [Goal(f"{seconds} s:", value, _OVER_DENOISED) for seconds, value in over.items()]
            never = [f"{seconds} s" for seconds in AT_SECONDS if str(seconds) not in over]
            told = f" One of them has nothing after {', '.join(never)}." if never else ""
            lines += ["", at_most(f"our {name} error over mitsuba + OIDN's", goals) + told]
    return lines
