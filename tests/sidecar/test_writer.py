"""Write-once: no name twice, nothing half-written, nothing left behind."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import h5py
import pytest

from icheat_usd.edits.model import Payload
from icheat_usd.errors import SidecarError
from icheat_usd.sidecar import History, list_payloads, pack, read_history, read_payload, write_payloads, writer

ROOT = Path(__file__).parents[2]


def _payload(amount: float) -> Payload:
    return Payload("scale", {"amount": amount})


def test_each_write_takes_the_next_name_beside_the_layer_and_changes_no_file(tmp_path: Path) -> None:
    layer = tmp_path / "shot.010.usda"
    first, (digest,) = write_payloads(layer, [_payload(1.0)], anchor="/World")
    before = first.read_bytes()
    second, _ = write_payloads(layer, [_payload(2.0)], anchor="/World")
    assert (first.name, second.name) == ("shot.010.v001.icheat.h5", "shot.010.v002.icheat.h5")
    assert first.read_bytes() == before
    first.unlink()
    third, _ = write_payloads(layer, [_payload(3.0)], anchor="/World")
    assert third.name == "shot.010.v003.icheat.h5"
    assert sorted(path.name for path in tmp_path.iterdir()) == [second.name, third.name]


def test_a_named_file_is_made_once(tmp_path: Path) -> None:
    target = tmp_path / "final.icheat.h5"
    file, digests = write_payloads(target, [_payload(1.0), _payload(1.0), _payload(2.0)], anchor="/World")
    assert file == target and digests[0] == digests[1] != digests[2]
    assert list_payloads(target) == tuple(sorted(set(digests)))
    with pytest.raises(SidecarError, match="never overwritten"):
        write_payloads(target, [_payload(3.0)], anchor="/World")
    assert list_payloads(target) == tuple(sorted(set(digests)))


def test_the_same_payloads_are_the_same_bytes_in_any_order(tmp_path: Path) -> None:
    one, _ = write_payloads(tmp_path / "a.usda", [_payload(1.0), _payload(2.0)], anchor="/World")
    two, _ = write_payloads(tmp_path / "b.usda", [_payload(2.0), _payload(1.0)], anchor="/World")
    assert one.read_bytes() == two.read_bytes()


def test_processes_that_write_at_once_get_different_names(tmp_path: Path) -> None:
    code = (
        "import sys; from icheat_usd.edits.model import Payload; from icheat_usd.sidecar import write_payloads\n"
        "sys.stdin.readline()\n"
        "for i in range(15):\n"
        "    print(write_payloads(sys.argv[1], [Payload('scale', {'amount': float(i)})], anchor='/W')[0])"
    )
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(tmp_path / "shot.usda")],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    for process in processes:  # both have imported everything and wait for this line
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    names = [name for process in processes for name in process.communicate(timeout=60)[0].split()]
    assert len(names) == len(set(names)) == 30
    assert sorted(names) == [str(tmp_path / f"shot.v{i:03d}.icheat.h5") for i in range(1, 31)]
    for name in names:
        (digest,) = list_payloads(name)
        read_payload(name, digest, anchor="/W")


@pytest.mark.parametrize("links", [True, False])
def test_a_writer_that_was_overtaken_takes_the_next_name(
    links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = [tmp_path / f"shot.v{i:03d}.icheat.h5" for i in (1, 2)]
    for path in taken:
        path.write_text("of the faster writer")

    def listed_before(folder: Path) -> list[str]:
        return []

    def refused(*_: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "listdir", listed_before)
    if not links:
        monkeypatch.setattr(os, "link", refused)
    file, (digest,) = write_payloads(tmp_path / "shot.usda", [_payload(1.0)], anchor="/World")
    assert file.name == "shot.v003.icheat.h5" and list_payloads(file) == (digest,)
    assert {path.read_text() for path in taken} == {"of the faster writer"}


@pytest.mark.parametrize("where", ["fill", "flush", "name"])
def test_an_interrupted_write_leaves_nothing(where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    target = {"fill": (writer, "fill_root"), "flush": (writer, "_flush"), "name": (os, "link")}[where]
    monkeypatch.setattr(*target, interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_payloads(tmp_path / "shot.usda", [_payload(1.0)], anchor="/World")
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_writer_left_is_removed_by_the_next(tmp_path: Path) -> None:
    code = (
        "import os, signal; from icheat_usd.edits.model import Payload; from icheat_usd.sidecar import writer\n"
        "writer._flush = lambda path: os.kill(os.getpid(), signal.SIGKILL)\n"
        "import sys; writer.write_payloads(sys.argv[1], [Payload('scale', {})], anchor='/W')"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "shot.usda")], cwd=ROOT, check=False, timeout=60)
    (left,) = tmp_path.iterdir()
    assert left.name.endswith(".icheat-tmp")
    ours = tmp_path / left.name.replace(left.name.split(".")[-3], str(os.getpid()))
    ours.touch()  # a writer that is still at work
    file, _ = write_payloads(tmp_path / "shot.usda", [_payload(1.0)], anchor="/World")
    assert sorted(tmp_path.iterdir()) == sorted([file, ours])


def test_without_hard_links_names_are_still_taken_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    first, (digest,) = write_payloads(tmp_path / "shot.usda", [_payload(1.0)], anchor="/World")
    second, _ = write_payloads(tmp_path / "shot.usda", [_payload(2.0)], anchor="/World")
    assert (first.name, second.name) == ("shot.v001.icheat.h5", "shot.v002.icheat.h5")
    assert read_payload(first, digest, anchor="/World").parameters == {"amount": 1.0}
    assert sorted(tmp_path.iterdir()) == [first, second]


def test_a_full_disk_is_one_clear_error_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(writer, "_flush", full)
    with pytest.raises(SidecarError, match="cannot write a sidecar in .*No space left"):
        write_payloads(tmp_path / "shot.usda", [_payload(1.0)], anchor="/World")
    assert list(tmp_path.iterdir()) == []


def test_missing_and_unwritable_folders_are_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(SidecarError, match="there is no folder"):
        write_payloads(tmp_path / "nowhere" / "shot.usda", [_payload(1.0)], anchor="/World")
    if Path("/proc/self").is_dir():  # not even root may write there
        with pytest.raises(SidecarError, match="cannot write a sidecar in '/proc'"):
            write_payloads("/proc/shot.usda", [_payload(1.0)], anchor="/World")
    with pytest.raises(SidecarError, match="no payloads to write"):
        write_payloads(tmp_path / "shot.usda", [], anchor="/World")


def test_the_umask_decides_who_may_read_a_sidecar(tmp_path: Path) -> None:
    old = os.umask(0o027)
    try:
        file, _ = write_payloads(tmp_path / "shot.usda", [_payload(1.0)], anchor="/World")
    finally:
        os.umask(old)
    assert file.stat().st_mode & 0o777 == 0o640


def test_packing_merges_payloads_and_history_and_verifies_what_it_reads(tmp_path: Path) -> None:
    who = History(who="ann", why="warmer", when="2026-01-02")
    one, (a, b) = write_payloads(tmp_path / "a.usda", [_payload(1.0), _payload(2.0)], anchor="/World", history=who)
    two, (_, c) = write_payloads(tmp_path / "b.usda", [_payload(2.0), _payload(3.0)], anchor="/World")
    packed, digests = pack([one, two], tmp_path / "all.icheat.h5")
    assert digests == sorted({a, b, c}) == list(list_payloads(packed))
    assert read_history(packed) == (History("ann", "warmer", "2026-01-02", (a, b)),)
    assert read_payload(packed, c, anchor="/World").parameters == {"amount": 3.0}
    with h5py.File(two, "r+") as file:
        file["payloads"][c]["recipe/parameters/amount"][...] = 4.0
    with pytest.raises(SidecarError, match="damaged"):
        pack([one, two], tmp_path / "again.icheat.h5")
    assert not (tmp_path / "again.icheat.h5").exists()
