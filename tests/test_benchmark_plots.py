"""Plots of the benchmark say with a colour what a line is, in every panel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pyplot = pytest.importorskip("matplotlib.pyplot")


def test_what_grows_has_one_colour_in_all_panels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tools.benchmarking import plots

    built = [
        {"what": "triangles", "size": n, "frame_seconds": 0.1 * n, "transport_seconds": 3 * n, "peak_mib": 100 + n}
        for n in (1, 2)
    ]
    edits = [{"what": "edits", "size": n, "frame_seconds": 0.1 * n, "peak_mib": 100 * n * n} for n in (1, 2)]
    drawn: list[Any] = []
    monkeypatch.setattr(plots.pyplot, "close", drawn.append)
    report = {"suites": {"growth": [{"result": {"points": built + edits}}]}}
    assert plots.plot(report, tmp_path) == [tmp_path / "growth.png"]

    of_triangles, of_edits = drawn[0].axes
    legend = [text.get_text() for text in of_triangles.get_legend().get_texts()]
    colours = {line.get_color(): name for name, line in zip(legend, of_triangles.lines, strict=True)}
    ends = {colours[line.get_color()]: line.get_ydata()[-1] for line in of_edits.lines}
    assert ends == {"frame of a light's colour": 2, "peak memory": 4}
    pyplot.close(drawn[0])
