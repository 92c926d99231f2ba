"""The error that every fault of input in this package is."""

from __future__ import annotations


class FusionError(ValueError):
    """Input that cannot be used; the message names the place, the value and the remedy.

    Every error that this package raises about its input is a subclass, so that a caller recognises all of them by class.
    """
