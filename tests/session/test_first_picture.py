"""The first picture of a live session waits for no kernel that it does not use."""

from __future__ import annotations

import json
import subprocess
import sys

from icheat_usd.resources import resource_path

#: Says which modules have compiled kernels when the first picture is there; the background is held until then.
CHILD = """
import json, os, sys, threading
from dataclasses import replace
from icheat_usd.session import LiveSession
from icheat_usd.session.quality import LIVE
seen = threading.Event()
quality = replace(LIVE, n_gather=512, record_rays=64)
with LiveSession.open(sys.argv[1], width=24, height=18, quality=quality) as live:
    live.listen(lambda event: event.kind == "better" and (seen.wait(60) or os._exit(3)))  # frames do not wait for it
    assert live.frame().any()
    used = [
        f"{name.rpartition('.')[2]}.{kernel}"
        for name, module in list(sys.modules.items())
        if name.startswith("icheat_usd.kernels.")
        for kernel, function in vars(module).items()
        if getattr(function, "signatures", None) and function.py_func.__module__ == name
    ]
    print(json.dumps(used), flush=True)
    os._exit(0)  # what would come next is compiled, where it has to be, for those who need it
"""

#: Placing records, packing, their products and what is left at rest come later, in the background.
LATER = {"records", "packing", "packed", "large_terms", "residuals", "nearest"}


def test_the_first_picture_needs_only_the_kernels_that_it_uses() -> None:
    stage = resource_path("sample_stages/cornell_box/shot.usda")
    child = subprocess.run([sys.executable, "-c", CHILD, str(stage)], capture_output=True, text=True, timeout=600)
    assert child.returncode == 0, child.stderr
    used = json.loads(child.stdout)
    assert any(name.startswith("gather_rows.") for name in used)
    assert not [name for name in used if name.split(".")[0] in LATER]
