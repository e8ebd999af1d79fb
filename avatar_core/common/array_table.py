"""Named tuples of arrays, handed to compiled code by one address.

By value, numba takes a tuple of n arrays apart into 7 n numbers at every call and puts it together
again in every function: with the 150 arrays of a step, that was most of what it compiled. An
:class:`ArrayTable` writes where each array lies, its shape and its strides into a table once;
compiled code gets the table's address and reads, of the arrays that it names, what it needs.
Attributes read as those of the tuple do. What is read never changes, and the compiler is told so:
it reads it before a loop, not within.

A tuple may hold None for another tuple. Compiled code then finds a table whose ``on`` is False,
with empty arrays of the types that a tuple ``like`` it has: one compiled function serves both.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import typeof, types
from numba.core.imputils import impl_ret_untracked
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    NativeValue,
    infer_getattr,
    lower_getattr_generic,
    models,
    register_model,
    typeof_impl,
    unbox,
)
from numba.np.arrayobj import make_array, populate_array

_WORD = ir.IntType(64)


class ArrayTable:
    """Where the arrays of a named tuple lie, and those of the tuples in it.

    arrays : the tuple, kept alive; its members are arrays, or such tuples, or None. All None: a
        table that is off.
    like : a tuple of the same kind without any None, for the types of what is None; not needed
        where nothing is
    numba_type : TableType
    address : of the table, for compiled code

    Raises
    ------
    TypeError
        For an array that is not contiguous, or of another type than in ``like``.
    """

    def __init__(self, arrays: Any, like: Any = None) -> None:
        self.arrays = arrays
        self.numba_type = TableType.of(arrays if like is None else like)
        self._words = np.array(_words(self.numba_type, arrays), np.int64)
        self.address = int(self._words.ctypes.data)


class TableType(types.Type):
    """Names and numba types of a table's members, and where the words of each begin.

    The first word of a table is whether it is on. Compiled code writes to no constant, so that
    arrays that may not be written are of the same type as others.
    """

    def __init__(self, kind: str, members: dict[str, Any]) -> None:
        self.members = members
        self.start, self.n_words = {}, 1
        for name, of in members.items():
            self.start[name] = self.n_words
            self.n_words += _n_words(of)
        super().__init__(f"{kind}({', '.join(f'{name}={of}' for name, of in members.items())})")

    @classmethod
    def of(cls, arrays: Any) -> TableType:
        """Of a named tuple."""
        return cls(type(arrays).__name__, {k: _type_of(v) for k, v in arrays._asdict().items()})


def _type_of(member: Any) -> Any:
    if isinstance(member, np.ndarray):
        return types.Array(typeof(member).dtype, member.ndim, "C")
    return TableType.of(member)


def _n_words(of: Any) -> int:
    return of.n_words if isinstance(of, TableType) else 1 + 2 * int(of.ndim)


def _words(of: Any, member: Any) -> list[int]:
    if member is None:
        return [0] * _n_words(of)
    if isinstance(member, np.ndarray):
        if _type_of(member) != of or not member.flags.c_contiguous:
            raise TypeError(f"{member.dtype} {member.shape} of strides {member.strides} for {of}")
        return [member.ctypes.data, *member.shape, *member.strides]
    words = [1]
    for name, value in member._asdict().items():
        words += _words(of.members[name], value)
    return words


@typeof_impl.register(ArrayTable)
def _typeof(table: ArrayTable, _: Any) -> TableType:
    return table.numba_type


@register_model(TableType)
class _Address(models.PrimitiveModel):
    def __init__(self, manager: Any, of: TableType) -> None:
        super().__init__(manager, of, _WORD.as_pointer())


@unbox(TableType)
def _unboxed(of: TableType, table: Any, c: Any) -> NativeValue:
    number = c.pyapi.object_getattr_string(table, "address")
    address = c.pyapi.long_as_ulonglong(number)
    c.pyapi.decref(number)
    return NativeValue(c.builder.inttoptr(address, _WORD.as_pointer()))


@infer_getattr
class _Members(AttributeTemplate):
    key = TableType

    def generic_resolve(self, of: TableType, name: str) -> Any:  # type: ignore[override]
        return types.boolean if name == "on" else of.members.get(name)


@lower_getattr_generic(TableType)
def _read(context: Any, builder: Any, of: TableType, table: Any, name: str) -> Any:
    if name == "on":
        return builder.icmp_signed("!=", _load_constant(builder, table), _WORD(0))
    first = builder.gep(table, [_WORD(of.start[name])], inbounds=True)
    member = of.members[name]
    return first if isinstance(member, TableType) else _array(context, builder, member, first)


def _array(context: Any, builder: Any, of: Any, first: Any) -> Any:
    """An array from its words: where it lies, its shape, its strides."""
    array = make_array(of)(context, builder)
    words = [builder.bitcast(first, array.data.type.as_pointer())]
    words += [builder.gep(first, [_WORD(i)], inbounds=True) for i in range(1, _n_words(of))]
    data, *numbers = (_load_constant(builder, word) for word in words)
    size = context.get_abi_sizeof(context.get_data_type(of.dtype))
    populate_array(
        array,
        data=data,
        shape=numbers[: of.ndim],
        strides=numbers[of.ndim :],
        itemsize=context.get_constant(types.intp, size),
        meminfo=None,
    )
    return impl_ret_untracked(context, builder, of, array._getvalue())


def _load_constant(builder: Any, word: Any) -> Any:
    """What lies there for as long as the code runs."""
    value = builder.load(word)
    value.set_metadata("invariant.load", builder.module.add_metadata([]))
    return value
