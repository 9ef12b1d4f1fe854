"""Pickles of numpy arrays, dicts, lists, numbers and strings, read without executing any code.

A pickle names functions to be called. Here no name is imported at all: the few that a pickled array needs stand for
classes of this module, which check their arguments and accept only bytes, shapes and plain number types. numpy's own
classes are not used, because they trust their input. Any other name ends the reading before a call.
"""

import io
import pickle
import pickletools
import re
from collections.abc import Callable, Mapping
from math import prod
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.bounded_read import read_up_to

BROKEN: Final = (
    pickle.UnpicklingError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    OverflowError,
    EOFError,
    MemoryError,
    RecursionError,
)
"""Exceptions that the unpickler raises on a broken pickle."""

MOST_BYTES: Final = 1 << 30
_KEEPING: Final = frozenset({"PUT", "BINPUT", "LONG_BINPUT"})
_NEEDED: Final = (
    "PROTO FRAME STOP MARK POP POP_MARK MEMOIZE GET BINGET LONG_BINGET GLOBAL STACK_GLOBAL REDUCE BUILD NONE NEWTRUE "
    "NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT STRING BINSTRING SHORT_BINSTRING UNICODE "
    "BINUNICODE SHORT_BINUNICODE BINUNICODE8 BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8 EMPTY_TUPLE TUPLE TUPLE1 "
    "TUPLE2 TUPLE3 EMPTY_LIST LIST APPEND APPENDS EMPTY_DICT DICT SETITEM SETITEMS"
)
_OPERATIONS: Final = _KEEPING | frozenset(_NEEDED.split())
_PLAIN_CODE: Final = re.compile(r"[biuf][0-9]{1,2}|U[1-9][0-9]{0,5}|O8?")


def load_plain(file: BinaryIO) -> Any:
    """Load the next pickled object of a file; arrays in it are to be read with `plain_value`.

    Raises:
        pickle.UnpicklingError: a name that no array needs, or an invalid array; broken ones raise any of BROKEN.
        OSError: it cannot be read, or is larger than MOST_BYTES.
    """
    content = read_up_to(file, MOST_BYTES)
    _check_operations(content)
    return plain_value(_PlainUnpickler(io.BytesIO(content)).load())


def _check_operations(content: bytes) -> None:
    """Refuse operations that allocate memory by a stated size: lengths beyond the end, distant places in the memo."""
    for count, (operation, argument, _) in enumerate(pickletools.genops(content), 1):
        if operation.name not in _OPERATIONS:
            raise pickle.UnpicklingError(f"the operation {operation.name}, which no array needs")
        if operation.name in _KEEPING and int(argument or 0) > count:
            raise pickle.UnpicklingError(f"a value kept in place {argument} before {count} operations")


def plain_value(value: Any) -> Any:
    """Return an array itself, a list for an array of objects, and any other value unchanged."""
    return value.value if isinstance(value, _Array) else value


class _Dtype:
    """Replacement for `numpy.dtype`: numbers, strings and objects, in either byte order."""

    def __init__(self, code: object, *_: object) -> None:
        if not isinstance(code, str) or not _PLAIN_CODE.fullmatch(code):
            raise pickle.UnpicklingError(f"an array of type {code!r}, expected plain numbers")
        self.type = np.dtype(object) if code.startswith("O") else np.dtype(code)

    def __setstate__(self, state: object) -> None:
        # Version, byte order, three parts for compound types only, sizes and flags; numpy would trust all of it.
        if not isinstance(state, tuple) or len(state) != 8 or any(part is not None for part in state[2:5]):
            raise pickle.UnpicklingError("an array of a compound type, expected plain numbers")
        if state[1] in ("<", ">"):
            self.type = self.type.newbyteorder(state[1])


class _Array:
    """Replacement for `numpy.ndarray`: an array of its own numbers, or the list of its objects."""

    def __init__(self) -> None:
        self.value: NDArray[Any] | list[Any] | None = None

    def __setstate__(self, state: object) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise pickle.UnpicklingError("an array in an unknown state")
        _, shape, dtype, fortran, content = state
        self.fill(content, dtype, shape, "F" if fortran else "C")

    def fill(self, content: object, dtype: object, shape: object, order: object) -> "_Array":
        """Set the bytes, or the list of objects, of an array of this type and shape."""
        if not isinstance(dtype, _Dtype) or not isinstance(shape, tuple) or order not in ("C", "F"):
            raise pickle.UnpicklingError("an array without type, shape and order")
        if not all(isinstance(length, int) and length >= 0 for length in shape):
            raise pickle.UnpicklingError(f"an array of shape {shape}")
        objects = dtype.type == np.dtype(object)
        if not isinstance(content, list if objects else (bytes, bytearray)):
            raise pickle.UnpicklingError(f"an array of {dtype.type} made of a {type(content).__name__}")
        found = len(content) if objects else len(content) / dtype.type.itemsize
        if found != prod(shape):
            raise pickle.UnpicklingError(f"an array of shape {shape} made of {found:g} values")
        self.value = (
            content if isinstance(content, list) else np.ndarray(shape, dtype.type, bytes(content), order=order)
        )
        return self


def _reconstruct(kind: object, *_: object) -> _Array:
    if kind is not _NDARRAY:
        raise pickle.UnpicklingError(f"an array of class {kind!r}")
    return _Array()


def _from_buffer(content: object, dtype: object, shape: object, order: object) -> _Array:
    return _Array().fill(content, dtype, shape, order)


def _scalar(dtype: object, content: object) -> int | float | bool | str:
    made = _Array().fill(content, dtype, (1,), "C").value
    if not isinstance(made, np.ndarray):
        raise pickle.UnpicklingError("a number made of an object")
    return made[0].item()


def _encode(text: object, codec: object) -> bytes:
    """Return bytes as protocols before 3 write them, which use the latin1 codec only."""
    if codec != "latin1" or not isinstance(text, str):
        raise pickle.UnpicklingError(f"bytes in {codec!r}, expected latin1")
    return text.encode("latin1")


class _Name:
    """Value of a name in a pickle: it can be called, and has no other operation."""

    __slots__ = ("_make",)

    def __init__(self, make: Callable[..., object]) -> None:
        self._make = make

    def __call__(self, *arguments: object) -> object:
        return self._make(*arguments)

    def __setstate__(self, state: object) -> None:
        raise pickle.UnpicklingError("a function with a state")


def _not_called(*_: object) -> None:
    raise pickle.UnpicklingError("numpy.ndarray called by name")


_NDARRAY: Final = _Name(_not_called)
_NAMES: Final[Mapping[tuple[str, str], _Name]] = {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): _Name(_Dtype),
    ("_codecs", "encode"): _Name(_encode),
    # numpy's inner package was called core before numpy 2.
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _Name(_reconstruct) for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _Name(_scalar) for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _Name(_from_buffer) for core in ("core", "_core")},
}


class _PlainUnpickler(pickle.Unpickler):
    """Unpickler that resolves only the names above and imports nothing."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        try:
            return _NAMES[module_name, global_name]
        except KeyError:
            raise pickle.UnpicklingError(
                f"its pickle names {module_name}.{global_name}, which no array needs; nothing of it was run"
            ) from None
