"""Shortcuts through private parts of numba that halve the time to compile, hence the bound of its version."""

from typing import Any

from numba import _dynfunc  # type: ignore[attr-defined]
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.typed_passes import InlineOverloads, IRLegalization, NopythonRewrites
from numba.core.types import BaseFunction
from numba.core.untyped_passes import InlineClosureLikes


class _PartCode(JITCodeLibrary):
    """The code of a function that is linked into those that call it, as numba translated it."""

    def _optimize_final_module(self) -> None:
        """Leave it to the callers."""

    def _finalize_final_module(self) -> None:
        self._finalized = True


class LoopCompiler(Compiler):
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


def resolve_once(once: bool) -> None:
    """Whether numba looks up what an operator does with some types once, not at each use, which takes a sixth."""
    _FUNCTION.get_call_type = _resolved_once if once else _resolve


def _resolved_once(function: Any, context: Any, args: Any, kws: Any) -> Any:
    """As `get_call_type` of a function of numba's, whose answer for each kind of arguments is kept."""
    key = function, context, tuple(args), tuple(kws.items())
    if key not in _RESOLVED:
        _RESOLVED[key] = _resolve(function, context, args, kws)
    return _RESOLVED[key]


def stamp(dispatcher: Any, source: Any) -> None:
    """Compile again where `source` is not as it was, or the types that a kept loop takes are gone or elsewhere."""
    kept = dispatcher._cache._cache_file
    kept._source_stamp, load = source, kept._load_index

    def loaded() -> Any:
        try:
            return load()
        except (ImportError, AttributeError):
            return {}

    kept._load_index = loaded
