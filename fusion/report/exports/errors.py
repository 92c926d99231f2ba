"""The error of exports."""

from __future__ import annotations

from fusion.errors import FusionError


class ExportError(FusionError):
    """Results that cannot be exported as asked for; the message says why and what to do."""
