"""Compiled code from numba's cache, without what only compiling needs.

Before it loads anything, numba imports all that it can compile (SciPy's linear algebra among it), and of each function
it reads the intermediate code too, for those that may yet be compiled with it. Of a small job these were a quarter of
the time. Here both wait until a function has to be compiled. It takes the place of methods that numba does not promise:
where one is missing, numba's own way stays. Tried with numba 0.58, 0.60, 0.61, 0.63, 0.65 and 0.68.
"""

from __future__ import annotations

from typing import Any


def load_lightly(dispatcher: Any) -> None:
    """Let what numba made of a function load its cached code so; as numba does it where this numba is another."""
    cache: Any = getattr(dispatcher, "_cache", None)
    if not all(
        hasattr(cache, name)
        for name in ("load_overload", "_load_overload", "_guard_against_spurious_io_errors")
    ):
        return  # not cached, or another numba
    try:
        from llvmlite.binding import parse_bitcode
        from numba.core.codegen import CPUCodeLibrary, JitEngine
        from numba.core.runtime import rtsys
    except ImportError:
        return
    parts = ("_get_module_for_linking", "_finalize_final_module", "_set_compiled_object")
    if not (
        all(hasattr(CPUCodeLibrary, part) for part in parts) and hasattr(JitEngine, "_load_defined_symbols")
    ):
        return

    def library_of(codegen: Any, state: Any) -> Any:
        """A library whose code is ready to run and whose intermediate code is parsed when it is linked into another."""
        name, kind, data = state
        if kind != "object":
            return type(codegen).unserialize_library(codegen, state)
        code, intermediate = data
        library = codegen.create_library(name)
        library.enable_object_caching()
        library._set_compiled_object(code)
        library._finalize_final_module()
        ordinary = library._get_module_for_linking

        def linkable() -> Any:
            if library._shared_module is None:
                library._shared_module = parse_bitcode(intermediate)
                codegen._engine._load_defined_symbols(library._shared_module)
            return ordinary()

        library._get_module_for_linking = linkable
        # Which names it has is read from the intermediate code otherwise; what is asked for is there.
        library.get_pointer_to_function = codegen._engine.get_function_address
        return library

    def load(sig: Any, target: Any) -> Any:
        rtsys.initialize(target)  # what counts who holds an array is compiled, too
        codegen = target.codegen()
        # The lock of numba's compiler is held.
        codegen.unserialize_library = lambda state: library_of(codegen, state)
        try:
            with cache._guard_against_spurious_io_errors():
                found = cache._load_overload(sig, target)
        finally:
            del codegen.unserialize_library
        if found is None:
            target.refresh()
        return found

    cache.load_overload = load
