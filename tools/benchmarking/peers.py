"""Suite `peers`: the product of a frame beside scipy, MKL and the speed of reading, same matrix, same run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tools.benchmarking.kernels import measure_product
from tools.benchmarking.parts import Effort, Parts


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """Every stage."""
    return [{"stage": stage} for stage in stages]


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """The transport of the preview times the stage's own light."""
    parts = Parts(case["stage"], effort)
    found = measure_product(parts.packed, parts.lights.total(), rounds=1 if quick else 21)
    for timing in found["timings"]:
        print(f"  {timing['name']:<52} {timing['threads']} threads {1000 * timing['median_s']:8.2f} ms", flush=True)
    return found


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """Tables for README: two threads and one, times over ours, and what reading as many bytes takes."""
    found = [(one["case"]["name"], one["result"]) for one in results if "result" in one]
    if not found:
        return []
    keys = dict.fromkeys((t["name"], t["threads"]) for _, result in found for t in result["timings"])
    lines = ["| product, threads | " + " | ".join(name for name, _ in found) + " |"]
    lines.append("| --- |" + " ---: |" * len(found))
    for name, threads in keys:
        cells = [_cell(result, name, threads) for _, result in found]
        lines.append(f"| {name}, {threads} | " + " | ".join(cells) + " |")
    lines.append("")
    for stage, result in found:
        if not result["timings"]:
            continue
        for summary in result["summary"]:
            peer = ""
            if "best_peer" in summary:
                peer = f"; {summary['times_best_peer']:.1f} times as fast as the best peer, {summary['best_peer']}"
            lines.append(
                f"{stage}, threads {summary['threads']}: {100 * summary['share_of_read_speed']:.0f} % of the speed of"
                f" reading ({summary['read_GB/s']:.0f} GB/s){peer}."
            )
        part = f", every {result['every_tile']}th tile" if result["every_tile"] > 1 else ""
        off = ", ".join(f"{name} {value:.1e}" for name, value in result["difference"].items())
        lines.append(f"{stage}: {result['entries'] / 1e6:.0f} million entries{part}; ours differs by {off}.")
    return lines


def _cell(result: dict[str, Any], name: str, threads: int) -> str:
    for timing in result["timings"]:
        if timing["name"] == name and timing["threads"] == threads:
            low, high = timing["quartiles_s"]
            return (
                f"{1000 * timing['median_s']:.2f} ms ({1000 * low:.2f}-{1000 * high:.2f}),"
                f" {timing['bytes'] / 2**20:.0f} MiB"
            )
    return ""
