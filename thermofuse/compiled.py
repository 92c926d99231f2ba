"""Functions that numba compiles, for every package: kept where a folder can be written, in memory where none can."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from typing import Any

_log = logging.getLogger(__name__)

#: Tells this process, and those that it starts, that it was said.
_SAID = "THERMOFUSE_COMPILES_IN_MEMORY"


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a function that numba compiles: once where there is a folder that it can write to, else in every process."""
    import numba

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError as error:
            if "no locator" not in str(error):  # for lack of a folder
                raise
            if not os.environ.get(_SAID):
                os.environ[_SAID] = "1"
                _log.warning(
                    "no folder can be written in which compiled functions are kept, so that every command compiles them again (up to half "
                    "a minute); let NUMBA_CACHE_DIR name one"
                )
            return numba.njit(**options)(function)

    return compiled
