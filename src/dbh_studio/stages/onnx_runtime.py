"""A trained model in onnxruntime: on what it runs, and how it is asked.

The processor always works. A graphics card is used where the installed onnxruntime knows it; if it then fails, the
model goes on, once and for good, on the processor, and says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dbh_studio.errors import FileMissingError, MalformedFileError, MissingComponentError, ModelError
from dbh_studio.io.models.manifest import ModelSpec, Signature
from dbh_studio.io.models.signature import signature_problems
from dbh_studio.settings import ModelRunSettings

_CPU = "CPUExecutionProvider"
# Best first. An allow-list: a plain build also lists providers that send pictures to a server.
_PROVIDERS = {
    "cuda": "CUDAExecutionProvider",
    "directml": "DmlExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
    "cpu": _CPU,
}
_TITLES = {
    "CUDAExecutionProvider": "NVIDIA graphics card (CUDA)",
    "DmlExecutionProvider": "graphics card (DirectML)",
    "CoreMLExecutionProvider": "Apple's accelerators (Core ML)",
    _CPU: "processor",
}
_OPTIONS: dict[str, dict[str, str]] = {"CoreMLExecutionProvider": {"ModelFormat": "MLProgram"}}


@dataclass(frozen=True)
class Port:
    """One input or output of a graph, as it declares it.

    Attributes:
        name: As in the graph.
        dtype: numpy's name, or onnxruntime's where numpy has none.
        shape: Its lengths; None where the graph leaves one open.
    """

    name: str
    dtype: str
    shape: tuple[int | None, ...]


class Graph:
    """An opened model file.

    Args:
        path: The ``.onnx`` file; weights in a file of their own lie beside it.
        settings: On what it runs.

    Attributes:
        path: As given.
        inputs: By name.
        outputs: By name.
        provider: What it runs on, one of onnxruntime's names.
        notes: What the person should know, such as that a graphics card failed.

    Raises:
        FileMissingError: There is no such file.
        MalformedFileError: onnxruntime cannot run it, or its data file is missing.
        MissingComponentError: onnxruntime is not installed, or it does not know the provider asked for.
    """

    def __init__(self, path: Path, settings: ModelRunSettings = ModelRunSettings()) -> None:  # noqa: B008 - frozen
        self.path = Path(path)
        self._settings = settings
        self.notes: tuple[str, ...] = ()
        self._open(choose_provider(settings))
        self.inputs = _ports(self._session.get_inputs())
        self.outputs = _ports(self._session.get_outputs())

    def run(self, feed: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Outputs by name.

        Args:
            feed: Inputs by name, in the precision the graph declares or another; what it does not ask for is left out.

        Returns:
            Half precision comes back as float32.

        Raises:
            ModelError: It failed on the processor too: too little memory, most of the time.
        """
        wanted = {name: _cast(value, self.inputs[name]) for name, value in feed.items() if name in self.inputs}
        names = list(self.outputs)
        try:
            answers = self._session.run(names, wanted)
        # onnxruntime's exceptions have no common class of their own.
        except Exception as error:
            if self.provider == _CPU:
                raise self._failed(error) from error
            reason = _first_line(error)
            self.notes += (f"The {_TITLES[self.provider]} failed ({reason}); {self.path.name} runs on the processor.",)
            self._open(_CPU)
            return self.run(feed)
        return {
            name: value.astype(np.float32) if value.dtype == np.float16 else value
            for name, value in zip(names, answers, strict=True)
        }

    def problems(self, wanted: Signature) -> tuple[str, ...]:
        """Why this graph does not take and give what its family must; empty where it does."""
        return signature_problems(self._session, wanted)

    def _open(self, provider: str) -> None:
        runtime = _onnxruntime()
        if not self.path.is_file():
            raise FileMissingError(self.path, "There is no such file.", "Fetch the model again.")
        options = runtime.SessionOptions()
        options.log_severity_level = 4  # what is wrong is raised as well
        options.intra_op_num_threads = self._settings.threads
        options.inter_op_num_threads = 1
        # The arena keeps the peak of every picture; without it a third less memory at nearly the same speed.
        options.enable_cpu_mem_arena = not self._settings.low_memory
        if provider == "DmlExecutionProvider":
            options.enable_mem_pattern = False  # DirectML refuses it
        chosen: list[Any] = [(provider, _OPTIONS.get(provider, {}))]
        if provider != _CPU:
            chosen.append((_CPU, {}))
        try:
            self._session = runtime.InferenceSession(str(self.path), options, providers=chosen)
        # onnxruntime's exceptions have no common class of their own.
        except Exception as error:
            if isinstance(error, MemoryError):
                raise self._failed(error) from error
            if provider != _CPU:
                self.notes += (f"The {_TITLES[provider]} cannot run {self.path.name} ({_first_line(error)}).",)
                self._open(_CPU)
                return
            raise MalformedFileError(
                self.path, f"This is no model onnxruntime can run ({_first_line(error)}).", "Fetch it again."
            ) from error
        # onnxruntime leaves a provider out without an error where its libraries are missing.
        self.provider = self._session.get_providers()[0]
        if self.provider != provider:
            self.notes += (f"The {_TITLES[provider]} is not ready; {self.path.name} runs on the processor.",)

    def _failed(self, error: Exception) -> ModelError:
        return ModelError(
            f"{self.path.name} could not be run ({_first_line(error)}).",
            "Close other programs if memory is short, choose a smaller model, or switch 'Save memory' on.",
        )


def available_providers() -> tuple[str, ...]:
    """Settings' names of what the installed onnxruntime can run models on, best first; empty where it is missing."""
    try:
        present = _onnxruntime().get_available_providers()
    except MissingComponentError:
        return ()
    return tuple(name for name, provider in _PROVIDERS.items() if provider in present)


def choose_provider(settings: ModelRunSettings) -> str:
    """onnxruntime's name of what a model will run on.

    Raises:
        MissingComponentError: The provider asked for is not in the installed onnxruntime.
    """
    present = available_providers()
    if settings.provider == "auto":
        return _PROVIDERS[present[0]] if present else _CPU
    provider = _PROVIDERS[settings.provider]
    if present and settings.provider not in present:
        raise MissingComponentError(
            f"The installed onnxruntime cannot use the {_TITLES[provider]}; it can use: {', '.join(present)}.",
            "Choose auto, or install the onnxruntime package made for it.",
        )
    return provider


def choose_model(specs: Sequence[ModelSpec], settings: ModelRunSettings, *, name: str = "") -> ModelSpec | None:
    """Which of the models that are there is used; None where there is none that may be.

    Args:
        specs: Of one purpose, the first choice first, as `ModelStore.ready` gives them.
        settings: The precision asked for. ``auto`` takes half precision first on a graphics card, and the full one on a
            processor, which is slower with the half; what 8 bits cost in accuracy is not known, so they come last.
        name: Take this one, whatever its precision.
    """
    if name:
        return next((spec for spec in specs if spec.name == name), None)
    if settings.precision != "auto":
        return next((spec for spec in specs if spec.precision == settings.precision), None)
    order = ("float32", "float16", "int8")
    if choose_provider(settings) != _CPU:
        order = ("float16", "float32", "int8")
    default = next((spec for spec in specs if spec.is_default), None)
    families = [spec for spec in specs if default is None or spec.family == default.family] or list(specs)
    ranked = sorted(families, key=lambda spec: order.index(spec.precision) if spec.precision in order else len(order))
    return ranked[0] if ranked else None


def not_of_family(graph: Graph, problems: Sequence[str], family: str) -> ModelError:
    """The error of a graph that would give wrong answers, or none."""
    return ModelError(
        f"{graph.path.name} cannot be used as {family}: {'; '.join(problems)}.",
        "Use one of the models that `dbh-studio models list` shows, or an export with the same inputs and outputs.",
    )


def _onnxruntime() -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise MissingComponentError(
            f"Models cannot run: onnxruntime is missing ({error}).", "`dbh-studio doctor` says how to install it."
        ) from error
    return onnxruntime


def _ports(values: Sequence[Any]) -> dict[str, Port]:
    dtypes = {"tensor(float)": "float32", "tensor(double)": "float64"}
    ports = {}
    for value in values:
        dtype = dtypes.get(value.type, value.type.removeprefix("tensor(").removesuffix(")"))
        shape = tuple(n if isinstance(n, int) and n > 0 else None for n in value.shape or ())
        ports[value.name] = Port(value.name, dtype, shape)
    return ports


def _cast(value: NDArray[Any], port: Port) -> NDArray[Any]:
    return np.ascontiguousarray(value, dtype=np.dtype(port.dtype))


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:300] if lines else type(error).__name__
