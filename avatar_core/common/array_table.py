"""Named tuples of arrays: declared once, allocated, and handed to compiled code by one address.

    Contact = kind("Contact", force=array("T"), normal=array("T 3"))      # T tools
    contact = allocate(Contact, {"T": 2})
    table = ArrayTable(contact)

By value, numba splits a tuple of n arrays into 7 n numbers at every call and rebuilds it in every
function. With the 150 arrays of a step, that was most of what it compiled. An :class:`ArrayTable`
writes address, shape and strides of each array into a table once. Compiled code gets the table's
address and reads only the arrays that it names. Their attributes read like those of the tuple. The
table never changes, and the compiler is told so: it reads the table before a loop, not within.

A member of a kind may be another kind, and None in a tuple of the kind. Compiled code then finds a
table whose ``on`` is False: one compiled function serves both.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
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


class Declared(NamedTuple):
    """Declaration of an array: its dimensions by name or number, its type and its first value."""

    shape: tuple[str, ...]
    dtype: np.dtype[Any]
    start: float


def array(shape: str, dtype: Any = np.float64, start: float = 0.0) -> Declared:
    """Declare an array, e.g. ``array("T 3")``; compiled code knows its type and dimensions."""
    return Declared(tuple(shape.split()), np.dtype(dtype), start)


def kind(name: str, **members: Any) -> Any:
    """Return a named tuple of arrays, and of other kinds, which may be None in it."""
    tuple_of: Any = namedtuple(name, members)  # type: ignore[misc]
    return type(name, (tuple_of,), {"__slots__": (), "members": members})


def allocate(of: Any, sizes: Mapping[str, int], **given: Any) -> Any:
    """Return a tuple of a kind with all arrays at their first value, except those given.

    Parameters
    ----------
    sizes : Mapping[str, int]
        Sizes of the dimensions that have names.
    given : ndarray or tuple
        Members with other values; nested kinds are None unless given.
    """

    def made(name: str, member: Any) -> Any:
        if name in given or not isinstance(member, Declared):
            return given.get(name)
        shape = [int(size) if size.isdigit() else sizes[size] for size in member.shape]
        return np.full(shape, member.start, member.dtype)

    return of(*(made(name, member) for name, member in of.members.items()))


def sizes_of(arrays: Any) -> dict[str, int]:
    """Return the dimensions of a tuple's arrays by name."""
    pairs = (
        zip(member.shape, getattr(arrays, name).shape, strict=True)
        for name, member in arrays.members.items()
        if isinstance(member, Declared)
    )
    return {name: size for pair in pairs for name, size in pair}


def restart(arrays: Any, kept: Iterable[str] = ()) -> None:
    """Set all arrays to their first value, except the members to be kept; nested tuples too."""
    for name, member in arrays.members.items():
        value = getattr(arrays, name)
        if name in kept or value is None:
            continue
        if isinstance(member, Declared):
            value[...] = member.start
        else:
            restart(value)


def flat(arrays: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """Return all arrays by name, as "distance" or "friction.coefficients"."""
    found: dict[str, np.ndarray] = {}
    for name, value in arrays._asdict().items():
        if isinstance(value, np.ndarray):
            found[prefix + name] = value
        elif value is not None:
            found |= flat(value, f"{prefix}{name}.")
    return found


def gathered(of: Any, arrays: Mapping[str, np.ndarray], prefix: str = "") -> Any:
    """Return the tuple of a kind from named arrays, the inverse of :func:`flat`.

    A kind with no array is None.
    """
    if prefix and not any(name.startswith(prefix) for name in arrays):
        return None
    return of(
        *(
            arrays[prefix + name]
            if isinstance(member, Declared)
            else gathered(member, arrays, f"{prefix}{name}.")
            for name, member in of.members.items()
        )
    )


class ArrayTable:
    """Table of the addresses, shapes and strides of a tuple's arrays, nested tuples included.

    Parameters
    ----------
    arrays : tuple
        The tuple, kept alive.

    Attributes
    ----------
    address : int
        Address of the table, for compiled code.

    Raises
    ------
    TypeError
        If an array is not contiguous, or has another type than declared.
    """

    def __init__(self, arrays: Any) -> None:
        self.arrays = arrays
        self.numba_type = TableType(type(arrays))
        self._words = np.array(_words(self.numba_type, arrays), np.int64)
        self.address = int(self._words.ctypes.data)


class TableType(types.Type):
    """Numba type of a table: names and types of a kind's members, and where each begins.

    The first word of a table says whether it is on. Read-only and writable arrays have the same
    type, because compiled code writes to no constant.
    """

    def __init__(self, of: Any) -> None:
        self.members = {name: _type_of(member) for name, member in of.members.items()}
        self.start, self.n_words = {}, 1
        for name, member in self.members.items():
            self.start[name] = self.n_words
            self.n_words += _n_words(member)
        members = ", ".join(f"{name}={member}" for name, member in self.members.items())
        super().__init__(f"{of.__name__}({members})")


def _type_of(member: Any) -> Any:
    if isinstance(member, Declared):
        return types.Array(from_dtype(member.dtype), len(member.shape), "C")
    return TableType(member)


def _n_words(of: Any) -> int:
    return of.n_words if isinstance(of, TableType) else 1 + 2 * int(of.ndim)


def _words(of: Any, member: Any) -> list[int]:
    if member is None:
        return [0] * _n_words(of)
    if isinstance(member, np.ndarray):
        fits = from_dtype(member.dtype) == of.dtype and member.ndim == of.ndim
        if not fits or not member.flags.c_contiguous:
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
    """Return an array from its words: where it lies, its shape, its strides."""
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
    """Load a word that does not change as long as the code runs."""
    value = builder.load(word)
    value.set_metadata("invariant.load", builder.module.add_metadata([]))
    return value
