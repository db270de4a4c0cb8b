"""Say what is kept on disk for the next preview, and how large it is; --clear removes it.

Transports and what belongs to them are found again by their content: nothing
in the cache can be out of date, and all of it can be made again. When it
exceeds $ICHEAT_CACHE_SIZE (default 10G; 0 turns it off), what was used last
longest ago goes first. It lies below $ICHEAT_CACHE_DIR, else in the user's
cache folder, and so do compiled kernels, which --clear leaves alone.
"""

from __future__ import annotations

import argparse
import time

from icheat_usd.cli.options import add_json, aligned, file_size, print_json


def setup_parser(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--clear", action="store_true", help="remove everything but compiled kernels")
    parser.add_argument("--trim", metavar="SIZE", help="remove what was used last longest ago down to SIZE, such as 2G")
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.session.disk_cache import DiskCache, parse_size

    cache = DiskCache()
    freed = 0
    if options.clear:
        freed = cache.clear()
    elif options.trim is not None:
        freed = DiskCache(cache.folder, parse_size(options.trim, "--trim")).trim()
    found = cache.list()
    total = sum(info.bytes for info in found)
    if options.json:
        items = [
            {"kind": info.kind, "key": info.key, "bytes": info.bytes, "used": round(info.used, 3), **info.about}
            for info in found
        ]
        content = {"folder": str(cache.folder), "limit": cache.limit, "bytes": total, "freed": freed, "items": items}
        print_json(content)
        return 0
    now = time.time()
    rows = [
        [info.kind, file_size(info.bytes), _age(now - info.used), _what(dict(info.about)), info.key[:8]]
        for info in found
    ]
    print("\n".join(aligned(rows)), end="\n" if rows else "")
    if freed:
        print(f"freed {file_size(freed)}")
    limit = f"of at most {file_size(cache.limit)}" if cache.is_on else "and it is off (ICHEAT_CACHE_SIZE is 0)"
    print(f"{file_size(total)} {limit} in {cache.folder}")
    return 0


def _what(about: dict[str, object]) -> str:
    frame = about.get("frame")
    parts = [str(about.get("stage", "(unknown)")), str(about.get("camera", ""))]
    if "width" in about:
        parts.append(f"{about['width']}x{about['height']}")
    return " ".join([*parts, *([f"frame {frame:g}"] if isinstance(frame, float) else [])])


def _age(seconds: float) -> str:
    for unit, length in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit} ago"
    return "now"
