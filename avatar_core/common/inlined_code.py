"""Parts of compiled functions are optimised where they are inlined, and nowhere else.

numba optimises every function by itself and makes machine code of it, then does so again wherever
the function is inlined: with a call tree ten deep, the innermost parts ten times over. Of a part
that is never called as a function, only its intermediate code is needed. The step of a scene
compiles in about half the time so.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler

_ENVIRONMENT = "_ZN08NumbaEnv"  # how numba's names of a function's environment begin


class _Intermediate(JITCodeLibrary):
    """Intermediate code of a part, and no machine code."""

    def _optimize_final_module(self) -> None:
        """Left to the library that this is linked into."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        # numba writes a function's environment into machine code that is loaded.
        self._loaded = llvm.parse_assembly(self._environments())
        self._codegen._add_module(self._loaded)
        self._finalized = True

    def _environments(self) -> str:
        module = self._codegen._create_empty_module(f"{self.name}.environments")
        for variable in self._final_module.global_variables:
            if variable.name.startswith(_ENVIRONMENT):
                pointer = ir.IntType(8).as_pointer()
                found = ir.GlobalVariable(module, pointer, name=variable.name)
                found.linkage, found.initializer = "common", pointer(None)
        return str(module)

    def serialize_using_object_code(self) -> tuple[str, str, tuple[bytes, bytes]]:
        """What numba keeps on disk; it loads the environments and links the rest."""
        self._ensure_finalized()
        environments = self._codegen._tm.emit_object(self._loaded)
        return self.name, "object", (environments, self._get_module_for_linking().as_bitcode())


class InlinedCode(Compiler):
    """numba's pipeline for a function that is compiled into others only."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.state.library = _Intermediate(self.state.targetctx.codegen(), "inlined")
