"""Suite `errors`: every stage under the test lights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from tools.benchmarking.errors import ErrorSettings, measure_errors, overview
from tools.benchmarking.parts import Effort, Parts
from tools.benchmarking.test_lights import SETS, choose_lights, drag_to, with_lights

QUICK = ErrorSettings(
    pixels=60,
    rays=256,
    record_pixels=30,
    record_rays=128,
    noisy_pixels=3,
    noisy_rays=512,
    edit_pixels=30,
    hit_pixels=8,
    hit_rays=64,
    sheet_rays=16,
    bounce_rays=64,
    light_samples=4,
    n_bounces=3,
    tolerances=(0.1, 0.02),
    shares=(0.3,),
)


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """Every stage at the settings that frames are measured with, and in the mode for quality."""
    return [{"stage": stage, "quality": quality} for quality in ("LIVE", "LIVE_FINE") for stage in stages]


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """Errors of one stage."""
    parts = Parts(case["stage"], replace(effort, quality=case["quality"]))
    lights = choose_lights(parts.snapshot, parts.tracer, parts.view, SETS[case["lights"]])
    under = parts.under(with_lights(parts.snapshot, lights))
    settings = QUICK if quick else ErrorSettings()
    if case.get("pixels"):
        settings = settings.of_pixels(case["pixels"])
    if case["quality"] == "LIVE_FINE":  # what does not depend on the mode is measured once
        settings = replace(settings, hit_pixels=0, tolerances=(), shares=())
    drags = [drag_to(light, parts.tracer) for light in lights]
    found = measure_errors(under, settings, folder / case["quality"], drags)
    for light in lights:
        found["lights"][light.name]["what"] = light.note
    return found


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """Tables for README, one pair per quality."""
    lines: list[str] = []
    for chosen in dict.fromkeys(one["case"]["lights"] for one in results):
        lines += [
            f"Root mean square errors over that of the light (± standard error), {chosen} set of test lights.",
            "",
        ]
    for quality in dict.fromkeys(one["case"]["quality"] for one in results):
        some = [one for one in results if one["case"]["quality"] == quality]
        lines += [f"Quality {quality}:", "", *_tables(some), ""]
    return lines


def _tables(results: list[dict[str, Any]]) -> list[str]:
    lines = [
        "| stage, light | compression and interpolation | the same, dragged from rest | at rest | total"
        " | dragged from rest | at a first look | at rest | largest pixel | cells against true hits |",
        "| --- |" + " ---: |" * 9,
    ]
    found = {result["case"]["name"]: result["result"] for result in results if "result" in result}
    for stage, result in found.items():
        for name, light in result["lights"].items():
            lossy = light.get("interpolation_and_packing") or light.get("packing")
            hits = result.get("cells_against_true_hits", {}).get(name)
            lines.append(
                f"| {stage}, {name} | {_percent(lossy)} | {_percent(light.get('lossy_dragged'))} |"
                f" {_percent(light.get('lossy_at_rest'))} | {_percent(light['total'])} | {_percent(light['dragged'])} |"
                f" {_percent(light['while_moving'])} | {_percent(light['at_rest'])} |"
                f" {100 * light['total']['largest']:.0f} % | {_percent(hits)} |"
            )
    if found:
        figures = overview(found)
        lines.append(
            f"| median; worst | {_both(figures, 'interpolation_and_packing')} | {_both(figures, 'lossy_dragged')} |"
            f" {_both(figures, 'lossy_at_rest')} | {_both(figures, 'total')} | {_both(figures, 'dragged')} |"
            f" {_both(figures, 'while_moving')} | {_both(figures, 'at_rest')} | | |"
        )
    lines += [
        "",
        "| stage, edit | of the unedited light | error of the change | at rest |",
        "| --- | ---: | ---: | ---: |",
    ]
    for stage, result in found.items():
        for name, edit in result["edits"].items():
            lines.append(
                f"| {stage}, {name} | {100 * edit['of_unedited']:.1f} % | {_percent(edit['change'])} |"
                f" {_percent(edit['change_at_rest'])} |"
            )
    return lines


def _percent(error: dict[str, float] | None) -> str:
    return "" if error is None else f"{100 * error['rms']:.1f} ± {100 * error['standard_error']:.1f} %"


def _both(figures: dict[str, float], kind: str) -> str:
    if f"{kind}_median" not in figures:
        return ""
    return f"{100 * figures[f'{kind}_median']:.1f} %; {100 * figures[f'{kind}_worst']:.1f} %"
