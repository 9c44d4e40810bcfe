"""A FeatureNet as an ONNX graph on rows [batch, n]: feature maps, networks, limits, all inside. Needs `onnx`."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from torch import nn

from nocl.nets import MLP, FeatureNet, Sine
from nocl.support.checks import Array
from nocl.support.store import write_bytes
from nocl.translate.instructions import expand, instructions

OPSET = 17
ELEMENT = {"float32": 1, "float64": 11}  # ONNX's numbers of the types
PLAIN = {  # operations on scalars that ONNX has as they are
    "OP_ADD": "Add", "OP_SUB": "Sub", "OP_MUL": "Mul", "OP_DIV": "Div", "OP_NEG": "Neg", "OP_EXP": "Exp",
    "OP_LOG": "Log", "OP_POW": "Pow", "OP_CONSTPOW": "Pow", "OP_SQRT": "Sqrt", "OP_INV": "Reciprocal", "OP_SIN": "Sin",
    "OP_COS": "Cos", "OP_TAN": "Tan", "OP_ASIN": "Asin", "OP_ACOS": "Acos", "OP_ATAN": "Atan", "OP_SINH": "Sinh",
    "OP_COSH": "Cosh", "OP_TANH": "Tanh", "OP_ASINH": "Asinh", "OP_ACOSH": "Acosh", "OP_ATANH": "Atanh",
    "OP_ERF": "Erf", "OP_FABS": "Abs", "OP_SIGN": "Sign", "OP_FLOOR": "Floor", "OP_CEIL": "Ceil", "OP_FMIN": "Min",
    "OP_FMAX": "Max", "OP_ASSIGN": "Identity", "OP_LIFT": "Identity"}
TRUTHS = {"OP_LT": "Less", "OP_LE": "LessOrEqual", "OP_EQ": "Equal"}
ACTIVATIONS: dict[type[nn.Module], str] = {Sine: "Sin", nn.Tanh: "Tanh", nn.ReLU: "Relu", nn.SiLU: "SiLU"}


def to_onnx(net: FeatureNet, path: str | Path, *, in_names: Sequence[str] | None = None,
            out_names: Sequence[str] | None = None, dtype: str = "float32") -> Path:
    """Write `net` as an ONNX file: inputs and output are rows [batch, n], a scalar argument [batch, 1].

    dtype: "float32", or "float64", for which not every runtime has all operations. Raises ValueError for a missing
    package and for operations that ONNX has not (atan2, remainders).
    """
    onnx = package("onnx")
    if type(net) is not FeatureNet:
        raise ValueError(f"to_onnx: got a {type(net).__name__}; expected a FeatureNet (of any other module "
                         "torch.onnx.export makes a graph)")
    if dtype not in ELEMENT:
        raise ValueError(f"to_onnx: dtype is {dtype!r}; expected one of {', '.join(ELEMENT)}")
    graph = _Graph(onnx, dtype)
    f, out = expand(net.inputs), expand(net.outputs)
    names, results = list(in_names or f.name_in()), list(out_names or out.name_out())
    args = [graph.columns(name, f.size1_in(i)) for i, name in enumerate(names)]
    answers = [graph.mlp(mlp, phi) for mlp, phi in zip(net.nets, graph.joined(f, args), strict=True)]
    width = [out.size1_in(f.n_in() + i) for i in range(len(answers))]
    split = [graph.columns(y, n) for y, n in zip(answers, width, strict=True)]
    for name, columns in zip(results, graph.joined(out, [*args, *split]), strict=True):
        graph.add("Identity", [columns], name)
    shapes = [(name, f.size1_in(i)) for i, name in enumerate(names)]
    ends = [(name, out.size1_out(i)) for i, name in enumerate(results)]
    return write_bytes(path, graph.model(shapes, ends).SerializeToString())


class Session:
    """An ONNX file under ONNX Runtime, one thread: float64 rows in, float64 rows out. Needs `onnxruntime`."""

    def __init__(self, path: str | Path) -> None:
        runtime = package("onnxruntime")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3  # errors: that a constant is not needed is no news
        self.session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        self.names = [i.name for i in self.session.get_inputs()]
        self.dtype = np.float64 if "double" in self.session.get_inputs()[0].type else np.float32

    def __call__(self, *args: Array) -> Array:
        """The first output [B, m] at rows of each input."""
        feed = {name: np.asarray(a, self.dtype) for name, a in zip(self.names, args, strict=True)}
        return np.asarray(self.session.run(None, feed)[0], dtype=np.float64)


def package(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ValueError(f"ONNX needs the package {name}, which cannot be imported ({error}): "
                         "pip install \"nocl[onnx]\"") from error


class _Graph:
    """Nodes and constants of a graph under construction; values go by their names."""

    def __init__(self, onnx: Any, dtype: str) -> None:
        self.onnx, self.real, self.element = onnx, np.dtype(dtype), ELEMENT[dtype]
        self.nodes: list[Any] = []
        self.constants: dict[tuple[str, tuple[int, ...], bytes], Any] = {}

    def add(self, op: str, inputs: Sequence[str], output: str | None = None, **attributes: Any) -> str:
        name = output or f"v{len(self.nodes)}_"
        self.nodes.append(self.onnx.helper.make_node(op, list(inputs), [name], **attributes))
        return name

    def constant(self, value: Any, integer: bool = False) -> str:
        array = np.asarray(value, np.int64 if integer else self.real)
        key = (str(array.dtype), array.shape, array.tobytes())
        if key not in self.constants:
            name = f"c{len(self.constants)}_"
            self.constants[key] = self.onnx.numpy_helper.from_array(array, name)
        name_of: str = self.constants[key].name
        return name_of

    def columns(self, name: str, n: int) -> list[str]:
        """The columns of [batch, n] as [batch, 1] each."""
        if n == 1:
            return [name]
        return [self.add("Gather", [name, self.constant([i], integer=True)], axis=1) for i in range(n)]

    def mlp(self, mlp: nn.Module, phi: str) -> str:
        if not isinstance(mlp, MLP):
            raise ValueError(f"to_onnx: a network is a {type(mlp).__name__}; expected a nocl.nets.MLP")
        y = phi
        for layer in mlp.body:
            if not isinstance(layer, nn.Linear):
                op = ACTIVATIONS[type(layer)]
                y = self.add("Mul", [y, self.add("Sigmoid", [y])]) if op == "SiLU" else self.add(op, [y])
            else:
                y = self.linear(layer, y)
        return y if mlp.skip is None else self.add("Add", [y, self.linear(mlp.skip, phi)])

    def linear(self, layer: nn.Linear, x: str) -> str:
        weights = [layer.weight] if layer.bias is None else [layer.weight, layer.bias]
        return self.add("Gemm", [x, *(self.constant(w.detach().cpu().numpy()) for w in weights)], transB=1)

    def joined(self, f: ca.Function, args: list[list[str]]) -> list[str]:
        """An SX function of columns, one name for each output [batch, n]."""
        work: dict[int, str] = {}
        outputs: list[dict[int, str]] = [{} for _ in range(f.n_out())]
        for i in instructions(f):
            if i.op == "OP_INPUT":
                work[i.out[0]] = args[i.args[0]][i.args[1]]
            elif i.op == "OP_OUTPUT":
                outputs[i.out[0]][i.out[1]] = work[i.args[0]]
            elif i.op == "OP_CONST":
                work[i.out[0]] = self.constant([[i.value]])
            else:
                work[i.out[0]] = self.scalar(i.op, [work[a] for a in i.args], f.name())
        zero = self.add("Mul", [args[0][0], self.constant([[0.0]])])  # constants need a batch dimension too
        return [self.concat([o[k] for k in range(f.nnz_out(j))], zero) for j, o in enumerate(outputs)]

    def concat(self, names: list[str], zero: str) -> str:
        fixed = {c.name for c in self.constants.values()}
        full = [self.add("Add", [n, zero]) if n in fixed else n for n in names]
        return full[0] if len(full) == 1 else self.add("Concat", full, axis=1)

    def scalar(self, op: str, args: list[str], owner: str) -> str:
        one = self.constant([[1.0]])
        if op in PLAIN:
            return self.add(PLAIN[op], args)
        if op in TRUTHS:
            return self.real_of(self.add(TRUTHS[op], args))
        match op:
            case "OP_NE":
                return self.real_of(self.add("Not", [self.add("Equal", args)]))
            case "OP_NOT":
                return self.real_of(self.add("Not", [self.truth(args[0])]))
            case "OP_AND" | "OP_OR":
                return self.real_of(self.add(op[3:].capitalize(), [self.truth(a) for a in args]))
            case "OP_IF_ELSE_ZERO":
                return self.add("Where", [self.truth(args[0]), args[1], self.constant([[0.0]])])
            case "OP_SQ":
                return self.add("Mul", [args[0], args[0]])
            case "OP_TWICE":
                return self.add("Add", [args[0], args[0]])
            case "OP_LOG1P":
                return self.add("Log", [self.add("Add", [args[0], one])])
            case "OP_EXPM1":
                return self.add("Sub", [self.add("Exp", args), one])
            case "OP_HYPOT":
                return self.add("Sqrt", [self.add("Add", [self.add("Mul", [a, a]) for a in args])])
        raise ValueError(f"to_onnx: {owner} contains {op}, which ONNX does not have: write the map without it")

    def truth(self, name: str) -> str:
        return self.add("Cast", [name], to=9)

    def real_of(self, name: str) -> str:
        return self.add("Cast", [name], to=self.element)

    def model(self, inputs: Sequence[tuple[str, int]], outputs: Sequence[tuple[str, int]]) -> Any:
        helper = self.onnx.helper
        ends = [[helper.make_tensor_value_info(name, self.element, ["batch", n]) for name, n in side]
                for side in (inputs, outputs)]
        graph = helper.make_graph(self.nodes, "nocl", *ends, list(self.constants.values()))
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8,
                                  producer_name="nocl")
        self.onnx.checker.check_model(model, full_check=True)
        return model
