"""Files that nobody vouches for: each is refused with one sentence, reads nothing outside itself and stays small."""

from __future__ import annotations

import random
import shutil
import subprocess
import sys
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from icheat_usd.edits.model import Payload
from icheat_usd.errors import SidecarError
from icheat_usd.sidecar import Element, describe, list_elements, list_payloads, pack, read_history, read_payload, writer
from icheat_usd.sidecar.canonical import digest_of
from icheat_usd.sidecar.elements import encode_payload

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden" / "v0.1.0" / "every-element.icheat.h5"
SCALE = "e9e96689efb3cc041e93f5601e009346dd57a93b05bd8be32bcdda6ec4c6e3aa"
FULL = "3351bd16fb1a60144477abc51c4903b0c98505eb8c32861b65c5e26c20144934"
RECIPE = f"payloads/{SCALE}/recipe"


@pytest.fixture
def tampered(tmp_path: Path) -> Callable[[Callable[[h5py.File], object]], Path]:
    """Make a copy of the golden file and let a function have its way with it."""

    def tamper(change: Callable[[h5py.File], object]) -> Path:
        path = tmp_path / "tampered.icheat.h5"
        shutil.copyfile(GOLDEN, path)
        with h5py.File(path, "r+") as file:
            change(file)
        return path

    return tamper


Tamper = Callable[[Callable[[h5py.File], object]], Path]


def _replace(file: h5py.File, path: str, **dataset: object) -> None:
    del file[path]
    file.create_dataset(path, **dataset)


def _refused(path: Path, message: str, digest: str = SCALE) -> None:
    with pytest.raises(SidecarError, match=message) as caught:
        read_payload(path, digest, anchor="/World")
    text = str(caught.value)
    assert path.name in text and "\n" not in text
    assert ";" in text, "the message has no next step"


def test_what_is_no_sidecar_is_refused_by_name(tmp_path: Path) -> None:
    _refused(tmp_path / "gone.icheat.h5", "there is no such sidecar file")
    _refused(tmp_path, "there is no such sidecar file")
    for content in (b"", b"#usda 1.0\n", b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n" + bytes(500)):
        (tmp_path / "x.icheat.h5").write_bytes(content)
        _refused(tmp_path / "x.icheat.h5", "not an HDF5 file, or cut short")
    with h5py.File(tmp_path / "other.icheat.h5", "w") as file:
        file["data"] = 1
    _refused(tmp_path / "other.icheat.h5", "an HDF5 file, but no icheat sidecar")


def test_a_payload_that_is_not_there_is_an_error_that_lists_those_that_are() -> None:
    for digest in ("0" * 64, "../payloads", "", "x" * 500, SCALE.upper()):
        with pytest.raises(SidecarError, match=f"no payload .*holds {FULL[:12]}, {SCALE[:12]}:"):
            read_payload(GOLDEN, digest, anchor="/World")


def test_every_truncation_is_refused(tmp_path: Path) -> None:
    whole = GOLDEN.read_bytes()
    for length in range(0, len(whole), 503):
        (tmp_path / "cut.icheat.h5").write_bytes(whole[:length])
        _refused(tmp_path / "cut.icheat.h5", "cut short|damaged", FULL)


def test_changed_bytes_are_refused_or_change_nothing() -> None:
    whole, random_ = GOLDEN.read_bytes(), random.Random(5)
    refused = 0
    for _ in range(120):
        changed = bytearray(whole)
        for _ in range(random_.choice((1, 1, 4))):
            changed[random_.randrange(len(changed))] ^= 1 << random_.randrange(8)
        try:
            # The digest of what was read is compared with the name: no error means nothing changed.
            read_payload(bytes(changed), FULL, anchor="/World")
        except SidecarError:
            refused += 1
        for look in (list_payloads, list_elements, describe):
            try:
                look(bytes(changed))
            except SidecarError:
                pass
    assert 20 < refused < 120


def test_a_changed_value_is_found_by_the_digest(tampered: Tamper) -> None:
    def change(file: h5py.File) -> None:
        file[RECIPE]["parameters/amount"][...] = 2.5

    _refused(tampered(change), f"payload {SCALE[:12]} is damaged: its contents have digest")


def test_a_newer_format_asks_for_an_update(tampered: Tamper) -> None:
    _refused(tampered(lambda f: f.attrs.modify("format-version", 2)), "sidecar format 2, .*; update icheat_usd")


def test_an_element_of_a_newer_version_names_itself_and_the_next_step(tmp_path: Path) -> None:
    for name, later in (
        ("recipe", Element("recipe", 2, {})),
        ("receiver-mask", Element("texture-mask", 4, {"a": np.zeros(3)})),
    ):
        elements = encode_payload(Payload("scale", {}), anchor="/World") | {name: later}
        digest = digest_of(elements)
        path = tmp_path / f"{name}.icheat.h5"
        with h5py.File(path, "w") as file:
            writer.fill_root(file, {digest: elements}, [])
        _refused(path, f"element '{name}' is {later.type} version {later.version}.*; update icheat_usd", digest)
        if later.datasets:
            packed, _ = pack([path], tmp_path / "packed.icheat.h5")
            assert {info.version for info in list_elements(packed) if info.element == name} == {later.version}


@pytest.mark.parametrize("place", ["payloads", f"payloads/{SCALE}", RECIPE, f"{RECIPE}/operation"])
@pytest.mark.parametrize("kind", ["soft", "external"])
def test_links_are_never_followed(place: str, kind: str, tampered: Tamper, tmp_path: Path) -> None:
    def link(file: h5py.File) -> None:
        file.move(place, "elsewhere")
        # The external target is a folder: if anything tried to open it, the message would be another.
        file[place] = h5py.SoftLink("/elsewhere") if kind == "soft" else h5py.ExternalLink(str(tmp_path), place)

    path = tampered(link)
    _refused(path, "is a soft or external link, which sidecars must not have")
    with pytest.raises(SidecarError, match="soft or external link"):
        list_elements(path)


def test_rings_of_hard_links_end(tampered: Tamper) -> None:
    def ring(file: h5py.File) -> None:
        group = file[RECIPE]
        for name in "abcdefgh":
            group[name] = group

    path = tampered(ring)
    _refused(path, "objects or 8 levels|more than one name")
    with pytest.raises(SidecarError, match="objects or 8 levels|more than one name"):
        list_elements(path)


def test_one_object_is_not_listed_under_many_names(tampered: Tamper) -> None:
    """A file of some megabytes could name one dataset 10^14 times."""

    def multiply(file: h5py.File) -> None:
        payloads = file["payloads"]
        for number in range(300):
            payloads[f"{number:064x}"] = payloads[SCALE]
            payloads[SCALE][f"element{number}"] = payloads[SCALE]["recipe"]
            payloads[SCALE]["recipe"][f"dataset{number}"] = payloads[SCALE]["recipe/operation"]

    path = tampered(multiply)
    for look in (list_elements, describe):
        with pytest.raises(SidecarError, match="more than one name"):
            look(path)
    _refused(path, "more than one name")


def test_history_is_bounded_as_a_whole(tampered: Tamper) -> None:
    def multiply(file: h5py.File) -> None:
        entry = file["history/000000"]
        _replace(file, "history/000000/why", data=np.array(b"x" * (1 << 20)))
        for number in range(1, 400):
            file["history"][f"{number:06d}"] = entry

    path = tampered(multiply)
    tracemalloc.start()
    with pytest.raises(SidecarError, match="more than the .* left of the limit"):
        read_history(path)
    assert tracemalloc.get_traced_memory()[1] < 64 << 20
    tracemalloc.stop()
    assert read_payload(path, SCALE, anchor="/World").operation == "scale"


def test_values_in_other_files_are_not_read(tampered: Tamper, tmp_path: Path) -> None:
    secret = tmp_path / "secret.bin"
    secret.write_bytes(np.float64(2.0).tobytes())

    def external(file: h5py.File) -> None:
        _replace(
            file,
            f"{RECIPE}/parameters/amount",
            shape=(1,),
            dtype="<f8",
            external=[(str(secret), 0, h5py.h5f.UNLIMITED)],
        )

    _refused(tampered(external), "takes its values from other files")

    def virtual(file: h5py.File) -> None:
        layout = h5py.VirtualLayout(shape=(1,), dtype="<f8")
        layout[0] = h5py.VirtualSource(str(GOLDEN), f"{RECIPE}/parameters/amount", shape=())
        del file[RECIPE]["parameters/amount"]
        file.create_virtual_dataset(f"{RECIPE}/parameters/amount", layout)

    _refused(tampered(virtual), "takes its values from other files")


def test_filters_other_than_the_three_are_refused(tampered: Tamper) -> None:
    def lzf(file: h5py.File) -> None:
        _replace(file, f"{RECIPE}/parameters/amount", data=np.zeros(100), compression="lzf")

    _refused(tampered(lzf), r"uses HDF5 filters \[32000\]; only shuffle, deflate and fletcher32")

    def plug_in(file: h5py.File) -> None:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((8,))
        plist.set_filter(32099, h5py.h5z.FLAG_OPTIONAL, (1, 2))
        del file[RECIPE]["parameters/amount"]
        space = h5py.h5s.create_simple((8,))
        group = file[RECIPE]["parameters"].id
        h5py.h5d.create(group, b"amount", h5py.h5t.IEEE_F64LE, space, plist).write_direct_chunk((0,), bytes(64))

    _refused(tampered(plug_in), r"uses HDF5 filters \[32099\]")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros(3, [("a", "f4"), ("b", "i4")]), "which sidecars must not"),
        (np.array([np.nan]), "holds NaN"),
        (np.zeros(2, np.complex64), "which sidecars must not"),
        (h5py.Empty("f8"), "has no values"),
    ],
)
def test_types_that_payloads_do_not_have_are_refused(values: object, message: str, tampered: Tamper) -> None:
    _refused(tampered(lambda file: _replace(file, f"{RECIPE}/parameters/amount", data=values)), message)


def test_variable_length_text_is_refused(tampered: Tamper) -> None:
    # A list of references to one long text would unfold without bound.
    change = {"data": ["scale"] * 4, "dtype": h5py.string_dtype()}
    _refused(tampered(lambda file: _replace(file, f"{RECIPE}/operation", **change)), "which sidecars must not")

    def attribute(file: h5py.File) -> None:
        file[RECIPE].attrs["element-type"] = "recipe"

    _refused(tampered(attribute), "'element-type' is no short text or integer")


def test_a_payload_that_declares_more_than_the_limit_is_refused_before_it_is_read(tampered: Tamper) -> None:
    def huge(file: h5py.File) -> None:
        _replace(file, f"{RECIPE}/parameters/amount", shape=(1 << 40,), dtype="f8", chunks=(1 << 16,))

    tracemalloc.start()
    _refused(tampered(huge), "declares 8,796,093,022,208 bytes, more than .* raise limit_bytes")
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()

    def chunk(file: h5py.File) -> None:
        _replace(file, f"{RECIPE}/parameters/amount", shape=(8,), dtype="f8", chunks=(1 << 28,), maxshape=(None,))

    _refused(tampered(chunk), "has chunks of 2,147,483,648 bytes")
    with pytest.raises(SidecarError, match="more than the .* left of the limit"):
        read_payload(GOLDEN, FULL, anchor="/World", limit_bytes=5000)
    assert read_payload(GOLDEN, FULL, anchor="/World", limit_bytes=8000).operation == "hsv"


def test_a_decompression_bomb_does_not_unfold(tampered: Tamper) -> None:
    packer = zlib.compressobj(9)
    bomb = b"".join(packer.compress(bytes(1 << 20)) for _ in range(512)) + packer.flush()
    assert len(bomb) < 600_000  # unfolds to 512 MiB

    def plant(file: h5py.File) -> None:
        _replace(file, f"{RECIPE}/parameters/amount", shape=(1 << 20,), dtype="u1", chunks=(1 << 20,), compression=1)
        file[RECIPE]["parameters/amount"].id.write_direct_chunk((0,), bomb)

    path = tampered(plant)
    tracemalloc.start()
    _refused(path, "unfolds to more than it declares")
    assert tracemalloc.get_traced_memory()[1] < 16 << 20
    tracemalloc.stop()


def test_names_in_a_file_do_not_reach_the_terminal_raw(tampered: Tamper) -> None:
    def name(file: h5py.File) -> None:
        file.move(RECIPE, f"payloads/{SCALE}/\x1b[2Jrecipe\n")

    path = tampered(name)
    _refused(path, "is damaged")
    assert "\\u001b[2Jrecipe\\u000a" in describe(path) and "\x1b" not in describe(path)


def test_missing_chunks_are_damage_and_not_zeros(tampered: Tamper) -> None:
    def hole(file: h5py.File) -> None:
        _replace(file, f"{RECIPE}/parameters/amount", shape=(100,), dtype="f8", chunks=(10,))
        file[RECIPE]["parameters/amount"][:50] = 1.0

    _refused(tampered(hole), "stores 5 of 10 chunks")


def test_reading_stays_within_the_stated_memory(tmp_path: Path) -> None:
    """Peak memory in a fresh process, libraries included: about twice the payload and two chunks."""
    path = tmp_path / "large.icheat.h5"
    shutil.copyfile(GOLDEN, path)
    with h5py.File(path, "r+") as file:
        _replace(
            file,
            f"{RECIPE}/parameters/amount",
            data=np.zeros((64, 1 << 20), np.uint8),
            chunks=(1, 1 << 20),
            compression="gzip",
        )
    code = (
        "import resource, sys\n"
        "from icheat_usd.sidecar import read_payload\n"
        "from icheat_usd.errors import SidecarError\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try: read_payload(sys.argv[1], sys.argv[2], anchor='/W')\n"
        "except SidecarError as problem: assert 'is damaged' in str(problem), problem\n"
        "print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)"
    )
    command = [sys.executable, "-c", code, str(path), SCALE]
    grown = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=60).stdout
    assert int(grown) < 2 * 64 + 16, f"{grown} MiB for a payload of 64 MiB"
