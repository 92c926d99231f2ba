"""Base class of the errors of this package."""

from __future__ import annotations


class InterferometryError(ValueError):
    """Input that cannot be used; the message names the place, the value and the remedy.

    Every error that this package raises about its input is of this class or a subclass.
    """
