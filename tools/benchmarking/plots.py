"""Plots of a report; needs matplotlib, which only developers install."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot, ticker  # noqa: E402

from tools.benchmarking.growth import points_of  # noqa: E402

#: What a plot of growth shows: its names in the report.
_GROWING = {"frame of a light's colour": "frame_seconds", "build": "transport_seconds", "peak memory": "peak_mib"}


def plot(report: dict[str, Any], folder: Path) -> list[Path]:
    """One image per suite that has something to show."""
    makers = {"errors": _curve, "growth": _growth}
    written = []
    for name, maker in makers.items():
        results = [one for one in report["suites"].get(name, []) if "result" in one]
        if results:
            path = folder / f"{name}.png"
            if maker(results, path):
                written.append(path)
    return written


def _curve(results: list[dict[str, Any]], path: Path) -> bool:
    """Error against the speed of a frame with everything in it, by each setting."""
    curves = {one["case"]["name"]: one["result"]["curve"] for one in results if one["result"].get("curve")}
    if not curves:
        return False
    figure, all_axes = pyplot.subplots(1, len(curves), figsize=(5.5 * len(curves), 4), squeeze=False)
    for axes, (name, points) in zip(all_axes[0], curves.items(), strict=True):
        for k, by in enumerate(dict.fromkeys(point["by"] for point in points)):
            some = [point for point in points if point["by"] == by]
            speed = [1 / point["whole_seconds"] for point in some]
            for what, style in (("total_worst", "s:"), ("total", "o-"), ("packing", "o--")):
                label = f"{what.replace('_', ', ')}, by {by}"
                axes.plot(speed, [100 * point[what] for point in some], style, color=f"C{k}", label=label)
            for x, point in zip(speed, some, strict=True):
                place = (x, 100 * point["total"])
                axes.annotate(f"{100 * point['setting']:g} %", place, (3, 4), textcoords="offset points", fontsize=6)
        axes.set_title(f"{name}: median over the lights, and worst", fontsize=9)
        axes.set_xlabel("frames per second, all products with two threads")
        axes.set_ylabel("relative RMS error, %")
        axes.set_yscale("log")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=6)
    _save(figure, path)
    return True


def _growth(results: list[dict[str, Any]], path: Path) -> bool:
    """Time of a frame and memory over each size, relative to the smallest."""
    points = points_of(results)
    kinds = list(dict.fromkeys(point["what"] for point in points))
    figure, all_axes = pyplot.subplots(1, len(kinds), figsize=(3 * len(kinds), 3.2), squeeze=False)
    for axes, kind in zip(all_axes[0], kinds, strict=True):
        some = [point for point in points if point["what"] == kind]
        sizes = [point["size"] for point in some]
        # A panel without a build has the same colours.
        for k, (name, key) in enumerate(_GROWING.items()):
            values = [point[key] for point in some if key in point]
            if len(values) < len(sizes):
                continue
            axes.plot(sizes, [value / values[0] for value in values], "o-", color=f"C{k}", label=name)
        axes.set_title(kind, fontsize=9)
        axes.set_ylim(bottom=0)
        # 1,000,000 beside 1,050,000 would be one black bar.
        axes.xaxis.set_major_locator(ticker.MaxNLocator(4))
        axes.xaxis.set_major_formatter(ticker.EngFormatter(sep=""))
        axes.grid(alpha=0.3)
    all_axes[0][0].set_ylabel("over that of the smallest")
    all_axes[0][0].legend(fontsize=7)
    _save(figure, path)
    return True


def _save(figure: Any, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
