"""Errors a user can act on: one sentence that names the place, what was expected and the next step."""

from __future__ import annotations


class IcheatError(Exception):
    """Base of every error this package raises on purpose; its text is shown to the user as it is."""


class StageError(IcheatError):
    """A stage, prim or attribute cannot be used."""


class EditError(IcheatError):
    """An edit, its stack or one of its parameters cannot be used."""


class SidecarError(IcheatError):
    """A sidecar file or one of its elements is missing, damaged, foreign or too new."""


class ImageError(IcheatError):
    """An image or colour configuration cannot be read or written."""


class SettingsError(IcheatError):
    """A choice of how to render is unknown or out of range."""


class SampleSetMismatch(IcheatError):
    """Arrays that belong to different sample sets were combined."""
