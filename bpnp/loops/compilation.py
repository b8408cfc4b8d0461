"""How loops on the CPU are compiled, and where the result is kept.

The second half takes shortcuts through private parts of numba that halve the time to compile, hence the bound of its
version.
"""

import gc
import inspect
import logging
import os
import time
from collections.abc import Callable
from typing import Any

import numba
from numba import _dynfunc  # type: ignore[attr-defined]
from numba.core import event
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.dispatcher import Dispatcher
from numba.core.typed_passes import InlineOverloads, IRLegalization, NopythonRewrites
from numba.core.types import BaseFunction
from numba.core.untyped_passes import InlineClosureLikes

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
    options["pipeline_class"] = _LoopCompiler

    def compiled(function: Callable[..., Any]) -> Any:
        function = inspect.unwrap(function)
        known = function.__globals__.values()
        files = {__file__, inspect.getfile(function)}.union(*(_FILES[x] for x in known if isinstance(x, Dispatcher)))
        files |= {inspect.getfile(type(x)) for x in known if isinstance(x, tuple) and hasattr(x, "_fields")}
        try:
            dispatcher: Any = numba.njit(function, cache=not part, **options)
            if not part:
                stats = [os.stat(file) for file in sorted(files)]
                _stamp(dispatcher, [(stat.st_mtime, stat.st_size) for stat in stats])
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
            _resolve_once(True)
        self.depth += 1

    def on_end(self, event: event.Event) -> None:
        if _is_ours(event):
            self.depth -= 1
            if not self.depth:
                Clock.compiling += time.monotonic() - self.begun
                _resolve_once(False)
                if self.collected:
                    gc.enable()


def _is_ours(event: event.Event) -> bool:
    return event.data["dispatcher"].py_func.__module__.startswith("bpnp.")


class _PartCode(JITCodeLibrary):
    """The code of a function that is linked into those that call it, as numba translated it."""

    def _optimize_final_module(self) -> None:
        """Leave it to the callers."""

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _LoopCompiler(Compiler):
    """Compiles a loop, or a part of one, which gets no machine code of its own."""

    def __init__(self, typing: Any, target: Any, code: Any, args: Any, result: Any, flags: Any, *rest: Any) -> None:
        if flags.no_cpython_wrapper:
            code = _PartCode(target.codegen(), "part")
            code.enable_object_caching()
        super().__init__(typing, target, code, args, result, flags, *rest)
        if flags.no_cpython_wrapper:
            self.state.targetctx.get_executable = _without_machine_code

    def define_pipelines(self) -> Any:
        """Without the passes for closures, inlined functions and expressions of arrays, which the loops lack, and for
        the end of each variable's life, which matters where references are counted."""
        (pipeline,) = super().define_pipelines()
        unused: set[Any] = {InlineClosureLikes, InlineOverloads, NopythonRewrites}
        if not self.state.flags.nrt:
            unused.add(IRLegalization)
        pipeline.passes = [entry for entry in pipeline.passes if entry[0] not in unused]
        pipeline.finalize()
        return [pipeline]


def _without_machine_code(library: Any, description: Any, environment: Any) -> Any:
    """What stands for the function among numba's; `Compiler` gives each compilation a copy of the target."""
    return _dynfunc.make_function(description.lookup_module(), description.qualname, "", 0, environment, (library,))


_FUNCTION: Any = BaseFunction  # of numba, or an operator
_resolve = _FUNCTION.get_call_type
_RESOLVED: dict[Any, Any] = {}


def _resolve_once(once: bool) -> None:
    """Whether numba looks up what an operator does with some types once, not at each use, which takes a sixth."""
    _FUNCTION.get_call_type = _resolved_once if once else _resolve


def _resolved_once(function: Any, context: Any, args: Any, kws: Any) -> Any:
    """As `get_call_type` of a function of numba's, whose answer for each kind of arguments is kept."""
    key = function, context, tuple(args), tuple(kws.items())
    if key not in _RESOLVED:
        _RESOLVED[key] = _resolve(function, context, args, kws)
    return _RESOLVED[key]


def _stamp(dispatcher: Any, source: Any) -> None:
    """Compile again where `source` is not as it was, or the types that a kept loop takes are gone or elsewhere."""
    kept = dispatcher._cache._cache_file
    kept._source_stamp, load = source, kept._load_index

    def loaded() -> Any:
        try:
            return load()
        except (ImportError, AttributeError):
            return {}

    kept._load_index = loaded


event.register("numba:compile", _Compilation())
