"""The cache of what is expensive: whole or not there, noticed when damaged, forgotten when too large."""

from __future__ import annotations

import os
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from icheat_usd.errors import IcheatError
from icheat_usd.session import parts
from icheat_usd.session.disk_cache import DiskCache, Shelf, size_limit
from icheat_usd.transport import Lobe, SparseRows, Transport


def to_bytes(value: object) -> bytes:
    file = BytesIO()
    parts.write(file, value)
    return file.getvalue()


def transport() -> Transport:
    columns = np.array([0, 2, 1], np.int32)
    base = SparseRows(np.array([0, 2, 3], np.int64), columns, np.array([0.25, 0.5, 1], np.float32), 3)
    edge = SparseRows(base.indptr, columns, np.array([0.1, 0.2, 0.3], np.float32), 3)
    tint = np.ones((2, 3), np.float32)
    return Transport((Lobe("base", base, tint), Lobe("edge", edge, tint)), np.arange(2, dtype=np.int32), None, 64, 7)


def test_a_value_comes_back_with_its_types_bits_and_shared_arrays() -> None:
    again = parts.read(BytesIO(to_bytes({"transport": transport(), "rest": (None, True, 1.5, "x", [np.int64(3)])})))
    found, kept = again["transport"], transport()
    assert isinstance(found, Transport) and found.interpolation is None and found.seed == 7
    assert found.lobes[0].rows.indices is found.lobes[1].rows.indices  # receivers of both lobes are grouped by this
    for here, there in zip(found.lobes, kept.lobes, strict=True):
        np.testing.assert_array_equal(here.rows.weights, there.rows.weights)
    assert again["rest"] == (None, True, 1.5, "x", [3]) and again["rest"][4][0].dtype == np.int64


def test_what_is_no_table_is_refused_in_both_directions() -> None:
    with pytest.raises(TypeError, match="Path cannot be kept"):
        to_bytes(Path("x"))
    with pytest.raises(TypeError, match="objects"):
        to_bytes(np.array([object()]))
    evil = to_bytes(SparseRows.empty(1, 1)).replace(b"icheat_usd.transport.sparse:SparseRows", b"x" * 38)
    with pytest.raises(ValueError, match="no part of a cache"):
        parts.read(BytesIO(evil))


def a_shelf(folder: Path, key: str = "abc", limit: int = 10**6) -> Shelf:
    return DiskCache(folder, limit).shelf("transport", key, {"stage": "shot.usda"})


@pytest.mark.parametrize("harm", ["cut short", "one bit", "empty", "swapped"])
def test_a_damaged_part_is_noticed_dropped_and_can_be_made_again(tmp_path: Path, harm: str) -> None:
    shelf = a_shelf(tmp_path)
    shelf.save("rows-0", transport())
    shelf.save("rows-1", SparseRows.empty(2, 2))
    (file,) = shelf.folder.glob("rows-0-*.npz")
    content = bytearray(file.read_bytes())
    if harm == "one bit":
        content[len(content) // 2] ^= 1
    file.write_bytes({"cut short": content[:-9], "empty": b"", "one bit": content}.get(harm, to_bytes(3)))
    assert shelf.load("rows-0") is None
    assert not file.exists()
    assert shelf.load("rows-1").n_rows == 2
    shelf.save("rows-0", transport())
    assert isinstance(shelf.load("rows-0"), Transport)


def test_a_write_that_is_killed_leaves_nothing_that_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shelf = a_shelf(tmp_path)
    shelf.save("first", 1)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        shelf.save("second", 2)
    monkeypatch.undo()
    assert shelf.names() == ("first",)
    assert (shelf.load("first"), shelf.load("second")) == (1, None)


def test_a_part_is_replaced_and_dropped_by_name(tmp_path: Path) -> None:
    shelf = a_shelf(tmp_path)
    shelf.save("part", 1)
    shelf.save("part", 2)
    shelf.save("part-2", 3)
    assert shelf.names() == ("part", "part-2") and shelf.load("part") == 2
    shelf.drop("part")
    assert shelf.load("part") is None and shelf.load("part-2") == 3


def test_what_was_used_last_longest_ago_goes_first(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path, 10**6)
    block = np.zeros(1000, np.uint8)
    for age, key in ((300, "a"), (200, "b"), (100, "c")):
        shelf = cache.shelf("view", key, {"stage": key})
        shelf.save("whole", block)
        os.utime(shelf.folder, (1e9 - age, 1e9 - age))
    assert cache.shelf("view", "a").load("whole") is not None  # used now
    smaller = DiskCache(tmp_path, sum(info.bytes for info in cache.list()) - 1)
    assert smaller.trim() > 0
    assert {info.key for info in cache.list()} == {"a", "c"}
    newest = cache.list()[0]
    assert (newest.kind, newest.key, newest.about) == ("view", "a", {"stage": "a"})
    assert cache.clear() > 0 and cache.list() == ()


def test_a_limit_of_zero_keeps_nothing(tmp_path: Path) -> None:
    shelf = a_shelf(tmp_path, limit=0)
    shelf.save("whole", 1)
    assert shelf.load("whole") is None and not any(tmp_path.iterdir())


@pytest.mark.parametrize(("text", "size"), [("0", 0), ("500M", 5 * 10**8), ("1.5 GB", 15 * 10**8), ("20g", 2 * 10**10)])
def test_the_limit_is_read_from_the_environment(text: str, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ICHEAT_CACHE_SIZE", text)
    assert size_limit() == size


def test_a_limit_that_is_no_size_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ICHEAT_CACHE_SIZE", "much")
    with pytest.raises(IcheatError, match="ICHEAT_CACHE_SIZE is 'much'"):
        size_limit()


def test_a_whole_is_written_behind_ones_back_and_whoever_looks_waits_for_it(tmp_path: Path) -> None:
    shelf = a_shelf(tmp_path)
    shelf.save("piece-0", transport())
    for value in (np.arange(4_000_000), np.arange(5_000_000)):  # the second waits for the first
        shelf.keep_whole(value)
    assert a_shelf(tmp_path).names() == ("whole",)
    np.testing.assert_array_equal(a_shelf(tmp_path).load("whole"), np.arange(5_000_000))


def test_what_goes_wrong_behind_ones_back_is_told_to_whoever_looks(tmp_path: Path) -> None:
    shelf = a_shelf(tmp_path)
    shelf.save("piece-0", 1)
    shelf.keep_whole(object())
    with pytest.raises(TypeError):
        shelf.names()
    assert shelf.names() == ("piece-0",)  # told once, and nothing is lost
