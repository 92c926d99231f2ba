"""Every error of the package about its input is an InterferometryError, so that a caller recognises it by class."""

from __future__ import annotations

import importlib
import pkgutil

import interferometry
from interferometry.errors import InterferometryError


def test_every_error_class_has_the_base_of_the_package() -> None:
    names = [module.name for module in pkgutil.walk_packages(interferometry.__path__, "interferometry.")]
    classes = {
        value
        for name in names
        for value in vars(importlib.import_module(name)).values()
        if isinstance(value, type) and issubclass(value, Exception) and value.__module__.startswith("interferometry")
    }
    assert {"CompensationError", "DriftDataError", "DriftModelError", "LaserFormatError"} <= {
        c.__name__ for c in classes
    }
    assert all(issubclass(error, InterferometryError) for error in classes)
    assert issubclass(InterferometryError, ValueError)
