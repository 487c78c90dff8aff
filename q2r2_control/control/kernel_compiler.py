"""Compile each kernel once, however many other kernels call it.

Numba optimises a function together with all functions that it calls, and translates it to machine code. It repeats this
work each time that a caller of the function is compiled. In a chain of eleven calls, the innermost function would
therefore be optimised eleven times. Here, a kernel that is compiled for another kernel is not optimised. Only a kernel
that Python calls is linked with all its parts. The result is optimised and translated as a whole.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.event import trigger_event
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature


class _PartLibrary(JITCodeLibrary):
    """The code of a kernel that is compiled as a part of another kernel.

    It is only linked into the other kernel, and never runs on its own.
    """

    def finalize(self) -> None:
        """Mark the library as complete. The whole kernel links, optimises and translates it."""
        self._raise_if_finalized()
        self._finalized = True

    def _get_module_for_linking(self) -> Any:
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage.name == "external":
                function.linkage = "linkonce_odr"  # Several whole kernels may link this function.
        return self._final_module

    def get_pointer_to_function(self, name: str) -> int:
        """Return no address, because there is no machine code."""
        return 0

    @property
    def codegen(self) -> Any:
        """This library itself. Numba stores a kernel's Python objects by a call of ``library.codegen.set_env``."""
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Do not store the Python objects, because no kernel reads them."""


class _WholeLibrary(JITCodeLibrary):
    """The code of a kernel that Python calls, with all of its parts."""

    _linking_libraries: list[Any]

    def finalize(self) -> None:
        """Link, optimise and translate all of the code."""
        libraries: dict[Any, None] = {}
        waiting = list(self._linking_libraries)
        while waiting:
            library = waiting.pop()
            if library not in libraries:
                libraries[library] = None
                if isinstance(library, _PartLibrary):
                    waiting += library._linking_libraries
        self._linking_libraries = list(libraries)
        super().finalize()

    def _optimize_final_module(self) -> None:
        # Numba itself optimises twice, because it finds some superfluous code that counts references only at the second
        # time.
        manager, builder = self._codegen._module_pass_manager()
        manager.run(self._final_module, builder)


class _WholeCompiler(Compiler):
    library_class: Any = _WholeLibrary

    def define_pipelines(self) -> Any:
        """Return Numba's passes, which write into a library of our class."""
        state = self.state
        state.library = self.library_class(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return super().define_pipelines()


class _PartCompiler(_WholeCompiler):
    library_class = _PartLibrary


class Kernel(CPUDispatcher):
    """A function that is compiled for each combination of argument types with which it is called."""

    # Number of whole kernels that are being compiled. While it is above 0, other kernels become parts.
    _being_compiled = 0

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options, pipeline_class=_WholeCompiler)
        self.parts: dict[tuple[Any, ...], Any] = {}  # Code that other kernels link, by the types of the arguments.
        self._wanted_as_part = False
        part_options = options | {"no_cpython_wrapper": True}
        numba_compiler = type(self._compiler)
        self._part_compiler = numba_compiler(function, self.targetdescr, part_options, {}, _PartCompiler)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return the template with which Numba types a call of this kernel. For a call by a kernel, a part suffices."""
        with global_compiler_lock:
            self._wanted_as_part = Kernel._being_compiled > 0
            return super().get_call_template(args, kws)

    @property
    def nopython_signatures(self) -> list[Any]:
        """The argument types for which this kernel has been compiled, called directly or from other kernels."""
        return [compiled.signature for compiled in (self.overloads | self.parts).values()]

    def get_overload(self, sig: Any) -> Any:
        """Return the part for ``sig`` while a calling kernel is compiled, otherwise the whole kernel."""
        with global_compiler_lock:
            part = self.parts.get(normalize_signature(sig)[0]) if Kernel._being_compiled else None
            return super().get_overload(sig) if part is None else part.entry_point

    def compile(self, sig: Any) -> Any:
        """Compile the kernel for one signature.

        It is compiled as a part if the compilation of another kernel needs this kernel, and otherwise as a whole.
        """
        with global_compiler_lock:
            as_part, self._wanted_as_part = self._wanted_as_part, False
            arguments, result = normalize_signature(sig)
            if as_part:
                return self._part(arguments, result).entry_point
            Kernel._being_compiled += 1
            try:
                return super().compile(sig)
            finally:
                Kernel._being_compiled -= 1

    def _part(self, arguments: Any, result: Any) -> Any:
        """Return the kernel's code as a part. It is compiled separately even if Python calls the kernel too.

        The optimised code of a whole kernel cannot serve as a part, because optimisation may have removed functions.
        """
        known = self.parts.get(tuple(arguments))
        if known is None:
            details = {"dispatcher": self, "args": arguments, "return_type": result}
            with trigger_event("numba:compile", data=details):
                known = self.parts[tuple(arguments)] = self._part_compiler.compile(arguments, result)
        return known
