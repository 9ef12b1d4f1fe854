"""Guard of loading a model: its file is one plain graph with its own weights, of bounded size.

onnxruntime follows a tensor into a side file, and a graph into graphs within it, which may run for ever. The walk
covers the fields that lead to them and to the operators. Source: onnx.proto, IR version 10 to 13; Protocol Buffers.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from edge.errors import ModelError
from firmware_bridge.in_place import read_bounded

MOST_BYTES: Final = 1 << 28  # largest file: a hundred times the largest bundled model
MOST_FIELDS: Final = 1 << 20  # most fields, some seconds of walking
MOST_NODES: Final = 5000  # most operators; onnxruntime goes over all of them repeatedly
_NAMES: Final = """
Abs Add And ArgMax AveragePool BatchNormalization Cast Ceil Clip Concat Constant ConstantOfShape Conv ConvInteger
ConvTranspose Cos DepthToSpace DequantizeLinear Div DynamicQuantizeLinear Einsum Elu Equal Erf Exp Expand Flatten Floor
Gather GatherElements Gelu Gemm GlobalAveragePool GlobalMaxPool Greater GreaterOrEqual GridSample GroupNormalization
HardSigmoid HardSwish Identity InstanceNormalization LayerNormalization LeakyRelu Less LessOrEqual Log LogSoftmax
MatMul MatMulInteger Max MaxPool Mean Min Mish Mul Neg Not Or PRelu Pad Pow QLinearConv QLinearMatMul QuantizeLinear
Reciprocal ReduceL2 ReduceMax ReduceMean ReduceMin ReduceSum ReduceSumSquare Relu Reshape Resize Round Selu Shape
Sigmoid Sign Sin Slice Softmax Softplus Softsign SpaceToDepth Split Sqrt Squeeze Sub Sum Tanh Tile Transpose Unsqueeze
Where
"""
OPERATORS: Final = frozenset(_NAMES.split())  # as docs/formats.md lists them: no loop, nothing random, no text
_VARINT_BYTES: Final = 10
_VARINT, _FIXED64, _LENGTH, _FIXED32 = 0, 1, 2, 5
_FIXED_BYTES: Final = {_FIXED64: 8, _FIXED32: 4}

_SIDE_FILE: Final = "keeps its weights in a side file, expected one file"
_NESTED: Final = "has graphs within its graph, expected one plain graph"
_BROKEN: Final = "not a model that onnxruntime can load: damaged, or not an ONNX file"
_SPARSE: Final = "has sparse weights, expected plain ones"

_Message = Mapping[int, "_Message | str"]  # number of a field -> the message that it holds, or the reason to refuse it
_LOCATION: Final = 14
_OPERATOR: Final = 4
_DOMAIN: Final = 7
_TENSOR: Final[_Message] = {13: _SIDE_FILE}
_ATTRIBUTE: Final[_Message] = {5: _TENSOR, 6: _NESTED, 10: _TENSOR, 11: _NESTED, 22: _SPARSE, 23: _SPARSE}
_NODE: Final[_Message] = {5: _ATTRIBUTE}
_GRAPH: Final[_Message] = {1: _NODE, 5: _TENSOR, 15: _SPARSE}
_MODEL: Final[_Message] = {7: _GRAPH, 20: _NESTED, 25: _NESTED}


class _Field(NamedTuple):
    """Field of a message: its number and wire type, its value if it is a number, and the range of its content."""

    number: int
    wire: int
    value: int
    start: int
    end: int


def read_model(path: Path) -> bytes:
    """Return an ONNX file's content, for onnxruntime to load from memory, or raise a ModelError."""
    try:
        content = read_bounded(path, MOST_BYTES)
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        check_plain(content)
    except ModelError as error:
        raise ModelError(f"{path}: {error}: export it again") from error
    return content


def check_plain(content: bytes) -> None:
    """Raise a ModelError for all files but one plain graph of OPERATORS with its weights."""
    waiting: list[tuple[_Message, int, int]] = [(_MODEL, 0, len(content))]
    fields = nodes = 0
    while waiting:
        message, start, end = waiting.pop()
        nodes += message is _NODE
        if nodes > MOST_NODES:
            raise ModelError(f"has more than {MOST_NODES} operators, expected a smaller graph")
        for field in _fields(content, start, end):
            fields += 1
            if fields > MOST_FIELDS:
                raise ModelError(f"has more than {MOST_FIELDS} fields, expected a smaller graph")
            kind = message.get(field.number)
            if isinstance(kind, str):
                raise ModelError(kind)
            if kind is not None and field.wire == _LENGTH:
                waiting.append((kind, field.start, field.end))
            if message is _TENSOR and field.number == _LOCATION and (field.wire != _VARINT or field.value):
                raise ModelError(_SIDE_FILE)
            if message is _NODE:
                text = content[field.start : field.end][:40].decode(errors="replace")
                if field.number == _OPERATOR and text not in OPERATORS:
                    raise ModelError(f"has operator {text!r}, expected only those that docs/formats.md lists")
                if field.number == _DOMAIN and text not in ("", "ai.onnx"):
                    raise ModelError(f"has an operator of domain {text!r}, expected ONNX's own alone")


def _fields(content: bytes, position: int, end: int) -> Iterator[_Field]:
    while position < end:
        tag, position = _varint(content, position, end, 5)
        number, wire = tag >> 3, tag & 7
        value = 0
        if wire == _VARINT:
            start = position
            value, position = _varint(content, position, end, _VARINT_BYTES)
        elif wire == _LENGTH:
            length, start = _varint(content, position, end, _VARINT_BYTES)
            position = start + length
        elif wire in _FIXED_BYTES:
            start = position
            position += _FIXED_BYTES[wire]
        else:
            raise ModelError(_BROKEN)
        if number == 0 or tag >= 1 << 32 or position > end:
            raise ModelError(_BROKEN)
        yield _Field(number, wire, value, start, position)


def _varint(content: bytes, position: int, end: int, most_bytes: int) -> tuple[int, int]:
    """Return a number and the position after it; bits beyond 64 are refused by the limits on its meaning."""
    value = 0
    for shift in range(0, 7 * most_bytes, 7):
        if position >= end:
            break
        byte = content[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
    raise ModelError(_BROKEN)
