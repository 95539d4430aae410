"""A network of the user's, computed: by onnxruntime where that is installed, else by OpenCV; on the CPU.

The file is read by ``read_onnx`` first: it carries no code, and what it needs of other files is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.io.onnx import read_onnx

Inputs = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class OnnxNetwork:
    """What ``load_network`` has read."""

    path: Path
    inputs: tuple[str, ...]
    """Names of what it is given."""
    compute: Callable[[Inputs], list[np.ndarray]]
    """All outputs, in the file's order. Raises what the program behind it raises."""

    def run(self, given: Inputs, *, wanted: str) -> list[np.ndarray]:
        """All outputs, in the file's order. Raises ``UserError`` where it fails; ``wanted`` says what to give
        instead.
        """
        try:
            return [np.asarray(value) for value in self.compute(given)]
        # OpenCV and onnxruntime have errors of their own, which share no base class.
        except Exception as error:
            shapes = ", ".join(f"{name} {value.shape}" for name, value in given.items())
            raise UserError(
                f"{self.path}: the network failed on {shapes} ({_last_line(error)}); give {wanted}"
            ) from error


def load_network(path: Path) -> OnnxNetwork:
    """Raises ``UserError`` for a file that is no ONNX, or whose operations the program at hand does not know."""
    file = read_onnx(path)
    try:
        import onnxruntime  # type: ignore[import-not-found]
    except ImportError:
        return OnnxNetwork(path, file.inputs, _by_opencv(path, file.data))
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(file.data, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise UserError(
            f"{path}: onnxruntime does not know this network ({_last_line(error)}); export it as ONNX again"
        ) from error
    return OnnxNetwork(path, file.inputs, lambda given: list(session.run(None, dict(given))))


def _by_opencv(path: Path, data: bytes) -> Callable[[Inputs], list[np.ndarray]]:
    import cv2

    try:
        network = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
        names = list(network.getUnconnectedOutLayersNames())
    except cv2.error as error:
        raise UserError(
            f"{path}: OpenCV does not know this network ({_last_line(error)}); install onnxruntime, or export it again"
        ) from error

    def compute(given: Inputs) -> list[np.ndarray]:
        for name, value in given.items():
            network.setInput(np.ascontiguousarray(value), name)
        return list(network.forward(names))

    return compute


def _last_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[-1] if lines else type(error).__name__
