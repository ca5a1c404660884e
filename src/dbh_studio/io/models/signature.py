"""What a graph takes and gives, and whether that is what its family must: asked before it is trusted with a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dbh_studio.errors import MalformedFileError, MissingComponentError
from dbh_studio.io.models.manifest import Signature, Tensor

_DTYPES = {
    "tensor(float)": "float32",
    "tensor(float16)": "float16",
    "tensor(double)": "float64",
    "tensor(int64)": "int64",
    "tensor(int32)": "int32",
    "tensor(bool)": "bool",
    "tensor(uint8)": "uint8",
}
_FLOATS = ("float32", "float16")


def open_graph(path: Path, *, optimise: bool = True) -> Any:
    """An onnxruntime session on the processor.

    Raises:
        MissingComponentError: onnxruntime is not installed.
        MalformedFileError: The file is no graph onnxruntime can run, or its data file is missing.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise MissingComponentError(
            f"Models cannot run: onnxruntime is missing ({error}).", "`dbh-studio doctor` says how to install it."
        ) from error
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # what is wrong is raised as well
    # The arena keeps the peak of every picture; without it a third less memory at the same speed.
    options.enable_cpu_mem_arena = False
    if not optimise:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    # onnxruntime's exceptions have no common class of their own.
    except Exception as error:
        if isinstance(error, MemoryError):
            raise
        reason = str(error).strip().splitlines()[0][:300] if str(error).strip() else type(error).__name__
        raise MalformedFileError(
            path, f"This is no model onnxruntime can run ({reason}).", "Fetch it again."
        ) from error


def signature_problems(session: Any, wanted: Signature) -> tuple[str, ...]:
    """Why this graph is not of the family; empty where it is.

    Args:
        session: An onnxruntime session.
        wanted: What the family takes and gives.
    """
    inputs, outputs = session.get_inputs(), session.get_outputs()
    problems = [*_problems("input", inputs, wanted.inputs), *_problems("output", outputs, wanted.outputs)]
    known = {tensor.name for tensor in wanted.inputs}
    extra = [value.name for value in inputs if value.name not in known]
    if extra:
        problems.append(f"it wants inputs nobody will give: {', '.join(extra)}")
    return tuple(problems)


def _problems(kind: str, found: Sequence[Any], wanted: Sequence[Tensor]) -> list[str]:
    by_name = {value.name: value for value in found}
    problems = []
    for tensor in wanted:
        value = by_name.get(tensor.name)
        if value is None:
            problems.append(f"it has no {kind} {tensor.name} (it has {', '.join(by_name) or 'none'})")
            continue
        dtype = _DTYPES.get(value.type, value.type)
        if dtype != tensor.dtype and not (tensor.dtype == "float" and dtype in _FLOATS):
            problems.append(f"the {kind} {tensor.name} is {dtype}, not {tensor.dtype}")
        problem = _shape_problem(value.shape, tensor)
        if problem:
            problems.append(f"the {kind} {tensor.name} {problem}")
    return problems


def _shape_problem(shape: Any, tensor: Tensor) -> str:
    """A length the graph leaves open is no contradiction, but where it must be fixed."""
    declared = [n if isinstance(n, int) and n > 0 else None for n in (shape or [])]
    written = " x ".join("?" if n is None else str(n) for n in declared)
    wanted = " x ".join("?" if n is None else str(n) for n in tensor.shape)
    if tensor.is_fixed and len(declared) == len(tensor.shape) and None in declared[1:]:  # the batch may be open
        return f"is {written}: a graph that leaves the sides open gives wrong boxes; it must be {wanted}"
    if not declared and not tensor.is_fixed:
        return ""  # some exports do not declare the shape of their outputs
    if len(declared) != len(tensor.shape):
        return f"is {written or 'of unknown shape'}, not {wanted}"
    if any(n is not None and m is not None and n != m for n, m in zip(declared, tensor.shape, strict=True)):
        return f"is {written}, not {wanted}"
    return ""
