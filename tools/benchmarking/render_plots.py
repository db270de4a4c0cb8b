"""Plots of a report on the final gather; needs matplotlib, which only developers install."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot, ticker  # noqa: E402

from tools.benchmarking.rival_summary import curves_of  # noqa: E402

_MEASURES = {
    "rel_mse": "relMSE of the indirect image",
    "rel_mse_trimmed": "the same without 0.1 % of the pixels",
    "flip": "FLIP of the whole image",
}


def plot(report: dict[str, Any], folder: Path) -> list[Path]:
    """One image per stage of `rivals`, and one of `scale`."""
    written = []
    for stage, curves in curves_of(report["suites"].get("rivals", [])).items():
        written.append(folder / f"rivals_{stage}.png")
        _rivals(stage, curves, written[-1])
    points = [one["result"] for one in report["suites"].get("scale", []) if "result" in one]
    points = [point for point in points if point["what"] != "stage"]
    if points:
        written.append(folder / "scale.png")
        _scale(points, written[-1])
    return written


def _rivals(stage: str, curves: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Errors over time, both in logarithms."""
    figure, all_axes = pyplot.subplots(1, len(_MEASURES), figsize=(5 * len(_MEASURES), 4))
    for axes, (measure, label) in zip(all_axes, _MEASURES.items(), strict=True):
        for name, points in _lines(curves).items():
            shown = [(p["seconds"], p[measure]) for p in points if p[measure] is not None and p[measure] > 0]
            if shown:
                axes.loglog(*zip(*shown, strict=True), "o-", label=name, markersize=3, lw=1 + name.startswith("ours"))
        axes.set_xlabel("seconds")
        _plain_numbers(axes.xaxis)
        axes.set_title(label, fontsize=9)
        axes.grid(alpha=0.3, which="both")
    all_axes[0].legend(fontsize=7)
    figure.suptitle(stage, fontsize=10)
    _save(figure, path)


def _lines(curves: dict[str, list[dict[str, Any]]]) -> dict[str, list[dict[str, Any]]]:
    """Curves, ours with a line for each method: a line from one to the other would mean nothing."""
    found: dict[str, list[dict[str, Any]]] = {}
    for name, points in curves.items():
        for point in points:
            method = f"ours, {point['label'].split()[0]}" if name == "ours" else name
            found.setdefault(method, []).append(point)
    return found


def _scale(points: list[dict[str, Any]], path: Path) -> None:
    """Time and memory over each size."""
    kinds = list(dict.fromkeys(point["what"] for point in points))
    figure, all_axes = pyplot.subplots(1, len(kinds), figsize=(3.5 * len(kinds), 3.2), squeeze=False)
    for axes, kind in zip(all_axes[0], kinds, strict=True):
        some = sorted((point for point in points if point["what"] == kind), key=lambda point: point["size"])
        sizes = [point["size"] for point in some]
        axes.loglog(sizes, [point["render_seconds"] for point in some], "o-", label="render, s")
        axes.loglog(sizes, [point["load_seconds"] for point in some], "o-", label="load, s")
        axes.loglog(sizes, [point["peak_mib"] / 1024 for point in some], "o--", label="peak memory, GiB")
        axes.set_title(kind, fontsize=9)
        axes.set_xticks(sizes)
        axes.xaxis.set_minor_locator(ticker.NullLocator())
        axes.xaxis.set_major_formatter(ticker.EngFormatter(sep=""))
        _plain_numbers(axes.yaxis)
        axes.tick_params(labelsize=8)
        axes.tick_params(axis="x", rotation=30)
        axes.grid(alpha=0.3)
    all_axes[0][0].legend(fontsize=7)
    _save(figure, path)


def _plain_numbers(axis: Any) -> None:
    """0.5, 1, 2, 5, 10 in place of powers."""
    axis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(ticker.NullFormatter())


def _save(figure: Any, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
