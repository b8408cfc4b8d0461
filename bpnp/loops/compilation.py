"""How loops on the CPU are compiled, and where the result is kept."""

import gc
import inspect
import logging
import os
import time
from collections.abc import Callable
from typing import Any

import numba
from numba.core import event
from numba.core.dispatcher import Dispatcher

from bpnp.loops import shortcuts
from bpnp.loops.parallel import Clock

# Of `fastmath`: sums in any order, but NaN and infinity keep their meaning, for they mark a lost pose or sample.
FAST = {"reassoc", "contract", "arcp", "nsz"}
_FILES: dict[Any, set[str]] = {}  # of each compiled function: its own, and those of the functions that these call


def compiler(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator: compile at the first call, keep the result on disk, and hold no lock while it runs.

    It is kept beside the source or, where that cannot be written to, in the user's cache folder (`NUMBA_CACHE_DIR`
    names another one); where neither can, each process compiles again. So it is after a change of the function's file,
    or of this one, or of another with functions that its file calls or records of constants that it reads, which numba
    does not look at. A function is compiled without the wrappers that a type checker puts around it on import.
    options: of `numba.njit`. A division by zero is infinite, as in C. No wrapper for function pointers is made: that
    would be a tenth of the time. Counting references is a fifth, which `_nrt=False` leaves out of a function that
    allocates nothing. One that only compiled ones call has no wrapper for Python (`no_cpython_wrapper`; a call from
    there ends the process), and is optimised and kept with its callers alone, which saves another quarter.
    """
    part = "no_cpython_wrapper" in options
    options |= {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    options["pipeline_class"] = shortcuts.LoopCompiler

    def compiled(function: Callable[..., Any]) -> Any:
        function = inspect.unwrap(function)
        known = function.__globals__.values()
        files = {__file__, inspect.getfile(function)}.union(*(_FILES[x] for x in known if isinstance(x, Dispatcher)))
        files |= {inspect.getfile(type(x)) for x in known if isinstance(x, tuple) and hasattr(x, "_fields")}
        try:
            dispatcher: Any = numba.njit(function, cache=not part, **options)
            if not part:
                stats = [os.stat(file) for file in sorted(files)]
                shortcuts.stamp(dispatcher, [(stat.st_mtime, stat.st_size) for stat in stats])
        except RuntimeError:  # numba finds no folder for its cache
            dispatcher = numba.njit(function, **options)
        _FILES[dispatcher] = files
        return dispatcher

    return compiled


class _Compilation(event.Listener):
    """Logs one line when the first of this package's functions is compiled, for it takes seconds.

    Meanwhile Python's collector of cycles rests, which would find nothing, operators are looked up once, and the clock
    of deadlines stands still. numba compiles one function at a time, whatever the thread, and those that it calls
    within.
    """

    made, depth, collected, begun = False, 0, False, 0.0

    def on_start(self, event: event.Event) -> None:
        if not _is_ours(event):
            return
        if not self.made:
            self.made = True
            logging.getLogger(__name__).warning("compiling bpnp's loops, which takes some seconds once an installation")
        if not self.depth:
            self.begun = time.monotonic()
            self.collected = gc.isenabled()
            gc.disable()
            shortcuts.resolve_once(True)
        self.depth += 1

    def on_end(self, event: event.Event) -> None:
        if _is_ours(event):
            self.depth -= 1
            if not self.depth:
                Clock.compiling += time.monotonic() - self.begun
                shortcuts.resolve_once(False)
                if self.collected:
                    gc.enable()


def _is_ours(event: event.Event) -> bool:
    return event.data["dispatcher"].py_func.__module__.startswith("bpnp.")


event.register("numba:compile", _Compilation())
