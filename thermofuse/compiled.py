"""Functions that numba compiles, for every package: kept where a folder can be written, in memory where none can."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from functools import update_wrapper
from threading import RLock
from typing import Any

_log = logging.getLogger(__name__)

#: Tells this process, and those that it starts, that it was said.
_SAID = "THERMOFUSE_COMPILES_IN_MEMORY"
#: Threads that call the first kernels together wait until one has made all of them known to numba.
_LOCK = RLock()


class _Kernel:
    """A function that is compiled when it is called: loading numba takes a fifth of the time of a command that calls none."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._function, self._options, self._compiled = function, options, None
        update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        with _LOCK:
            compiled = self._compile()
        return compiled(*arguments)

    def _compile(self) -> Any:
        """The compiled function, and so those that it may call, which numba must know."""
        if self._compiled is None:
            self._compiled, known = _compiled(self._function, **self._options), self._function.__globals__
            known |= {name: one._compile() for name, one in list(known.items()) if isinstance(one, _Kernel)}
        return self._compiled


def _compiled(function: Callable[..., Any], **options: Any) -> Any:
    import numba

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


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a function that numba compiles: once where there is a folder that it can write to, else in every process."""
    return lambda function: _Kernel(function, options)
