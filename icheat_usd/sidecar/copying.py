"""New files from old ones: `pack` merges, `upgrade` stores in the newest versions. What they read stays as it is."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import h5py

from icheat_usd.errors import SidecarError
from icheat_usd.sidecar.canonical import Element, digest_of
from icheat_usd.sidecar.elements import decode_payload
from icheat_usd.sidecar.guarded import MAX_PAYLOAD_BYTES, open_sidecar, read_elements
from icheat_usd.sidecar.reader import History, list_aliases, list_payloads, read_history
from icheat_usd.sidecar.registry import SLOTS, check_known, upgraded
from icheat_usd.sidecar.writer import fill_root, make_file, write_payload

Files = Sequence[str | os.PathLike[str]]


def pack(
    files: Files,
    out: str | os.PathLike[str],
    *,
    only: Collection[str] | None = None,
    history: History | None = None,
    published: bool = False,
) -> tuple[Path, list[str]]:
    """Merge the payloads of several files into one new file, elements of unknown types included.

    Parameters
    ----------
    files : sequence of path
        Read and verified; left as they are.
    out : path
        As `beside` of `write_payloads`.
    only : collection of str, optional
        Digests to take, old ones that a file keeps as aliases included; all by default.
    history : History, optional
        An entry to add about the new file itself.
    published : bool
        Mark the file as one that `icheat gc` spares, and make it read-only.

    Returns
    -------
    (Path, list of str)
        The new file and the digests in it, sorted.

    Raises
    ------
    SidecarError
        As `read_payload` for what is read and `write_payloads` for what is
        written; or `only` names a payload that no file has.
    """
    return _copy(files, out, only, history, published, lambda elements, where: dict(elements))


def upgrade(
    files: Files, out: str | os.PathLike[str], *, history: History | None = None
) -> tuple[Path, Mapping[str, str]]:
    """Merge the payloads of several files into one new file, every element in its newest version.

    An element that changes changes the payload's digest. The file keeps the
    old digest as an alias, so that stages that pin it still find the payload.

    Returns
    -------
    (Path, mapping of str to str)
        The new file, and the new digest of each old one, unchanged ones included.

    Raises
    ------
    SidecarError
        As `pack`; or an element is newer than this version of the package, or cannot be decoded.
    """
    renamed: dict[str, str] = {}

    def newest(elements: Mapping[str, Element], where: str) -> dict[str, Element]:
        for name, element in elements.items():
            check_known(name, element.type, element.version, where)
        after = {name: upgraded(element) if name in SLOTS else element for name, element in elements.items()}
        # What cannot be decoded must not get a new name that says it is sound.
        decode_payload(after, anchor="/", where=where)
        renamed[digest_of(elements)] = digest_of(after)
        return after

    file, _ = _copy(files, out, None, history, False, newest)
    return file, renamed


def _copy(
    files: Files,
    out: str | os.PathLike[str],
    only: Collection[str] | None,
    history: History | None,
    published: bool,
    change: Callable[[Mapping[str, Element], str], dict[str, Element]],
) -> tuple[Path, list[str]]:
    sources, aliases, entries = _contents([os.fspath(file) for file in files])
    if only is not None:
        if missing := sorted(set(only) - sources.keys() - aliases.keys()):
            raise SidecarError(f"{os.fspath(out)}: no file has the payload {missing[0]}; name the file that has it")
        aliases = {old: new for old, new in aliases.items() if old in only}
        wanted = set(only) | set(aliases.values())
        sources = {digest: file for digest, file in sources.items() if digest in wanted}
    if not sources:
        raise SidecarError(f"{os.fspath(out)}: there are no payloads to pack; name files that hold some")
    entries = _about(entries, sources.keys() | aliases.keys())
    if history is not None:
        entries.append(replace(history, payloads=tuple(sorted(sources))))
    written: list[str] = []

    def fill(root: h5py.Group) -> None:
        renamed: dict[str, str] = {}
        payloads = root.create_group("payloads")
        # One payload in memory at a time.
        for digest, file in sorted(sources.items()):
            with open_sidecar(file, file) as source:
                elements = read_elements(source, digest, file, MAX_PAYLOAD_BYTES)
            elements = change(elements, f"{file}: payload {digest[:12]}")
            renamed[digest] = digest_of(elements)
            if renamed[digest] not in payloads:
                write_payload(payloads, renamed[digest], elements)
                written.append(renamed[digest])
        old = {digest: new for digest, new in renamed.items() if digest not in payloads}
        old |= {alias: renamed[target] for alias, target in aliases.items() if alias not in payloads}
        fill_root(root, {}, entries, old, published=published)

    return make_file(Path(out), fill, mode=0o444 if published else None), sorted(written)


def _contents(files: Sequence[str]) -> tuple[dict[str, str], dict[str, str], list[History]]:
    """Which file has each payload, the aliases whose payload some file has, and all history, oldest first."""
    sources: dict[str, str] = {}
    aliases: dict[str, str] = {}
    entries: list[History] = []
    for file in files:
        for digest in list_payloads(file):
            sources.setdefault(digest, file)
        for old, new in list_aliases(file).items():
            aliases.setdefault(old, new)
        entries.extend(entry for entry in read_history(file) if entry not in entries)
    aliases = {old: new for old, new in aliases.items() if old not in sources and new in sources}
    return sources, aliases, sorted(entries, key=lambda entry: entry.when)


def _about(entries: Sequence[History], digests: Collection[str]) -> list[History]:
    """What the entries say about these payloads; entries about none are left out."""
    kept = [replace(e, payloads=tuple(digest for digest in e.payloads if digest in digests)) for e in entries]
    return [entry for entry in kept if entry.payloads]
