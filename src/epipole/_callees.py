"""How kernels are compiled that other kernels call.

Numba optimises every function and makes machine code of it, together with all that it calls. With six levels of calls
the innermost function goes through LLVM six times. Here a callee stays what Numba's lowering has made of it and is
linked so into its callers; what Python calls is optimised and translated once, with everything below it.
"""

from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags
from numba.core.compiler_machinery import register_pass
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering


class Kernel(CPUDispatcher):
    """A compiled function; to kernels that call it, it shows its other side, the callee."""

    def __init__(self, py_func: Any, targetoptions: dict[str, Any]) -> None:
        super().__init__(py_func, {}, targetoptions, _KernelCompiler)
        self.callee = _Callee(py_func, {}, {**targetoptions, "no_cpython_wrapper": True}, CalleeCompiler)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """What typing a call of this function asks for."""
        return self.callee.get_call_template(args, kws)

    def get_overload(self, sig: Any) -> Any:
        """What lowering a call of this function asks for."""
        return self.callee.get_overload(sig)


class _Callee(CPUDispatcher):
    """The function as kernels see it: compiled while one of them is, without the clocks and locks of Numba's own."""

    _compiler: Any

    def compile(self, sig: Any) -> Any:
        """The key of the library for these types of arguments."""
        arguments = tuple(sig)
        compiled: Any = self.overloads.get(arguments)
        if compiled is None:
            compiled = self._compiler.compile(arguments, None)
            self.add_overload(compiled)
        return compiled.entry_point


class _Flags(Flags):
    """Compiler options that are compared as they stand; Numba's look all their defaults up, 100,000 times a minute."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        return type(other) is _Flags and self._values == other._values

    def __hash__(self) -> int:
        return hash(frozenset(self._values))


class _KernelCompiler(Compiler):
    """Numba's compiler."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.state.flags = _Flags(self.state.flags)


class CalleeCompiler(_KernelCompiler):
    """Numba's passes but for the lowering."""

    def define_pipelines(self) -> list[Any]:
        """Passes that end with a library to be linked."""
        (pipeline,) = super().define_pipelines()
        pipeline.passes = [
            (_CalleeLowering if step is NativeLowering else step, what) for step, what in pipeline.passes
        ]
        pipeline.finalize()
        return [pipeline]


@register_pass(mutates_CFG=True, analysis_only=False)
class _CalleeLowering(NativeLowering):
    """Lowers a typed function into a library that is only linked."""

    _name = "callee_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower without an address to call; what stands in its place is the key by which callers find the library."""
        state.library = _LinkedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        state.library.finalize()
        key = object().__sizeof__  # any builtin method will do that is like no other
        state.targetctx.insert_user_function(key, state.cr.fndesc, [state.library])
        state.cr = state.cr._replace(cfunc=key)
        return True


class _LinkedLibrary(JITCodeLibrary):
    """The code of a callee and of all it calls, neither optimised nor translated."""

    def _optimize_final_module(self) -> None:
        """Leave it to the library that this one is linked into."""

    def _finalize_final_module(self) -> None:
        """Make no machine code."""
        self._finalize_dynamic_globals()
        self._finalized = True
