"""Collects findings while a stage is read: one per prim and feature."""

from __future__ import annotations

from collections.abc import Iterable

from icheat_usd.scene import Finding


class Reporter:
    """Remembers the first message for each prim and feature, in order."""

    def __init__(self) -> None:
        self._findings: dict[tuple[str, str], Finding] = {}

    def __call__(self, prim: object, feature: str, message: str) -> None:
        path = str(prim.GetPath()) if hasattr(prim, "GetPath") else str(prim)  # a prim, or a path already
        self._findings.setdefault((path, feature), Finding(path, feature, message))

    def extend(self, findings: Iterable[Finding]) -> None:
        for finding in findings:
            self._findings.setdefault((finding.prim, finding.feature), finding)

    def findings(self) -> tuple[Finding, ...]:
        return tuple(self._findings.values())
