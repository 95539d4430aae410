"""Evaluation of a network supplied by the user, on the CPU: with onnxruntime if it is installed, otherwise with OpenCV.

The file is first checked by ``read_onnx``: it contains no code, and references to other files are rejected.
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
    """A network loaded by ``load_network``."""

    path: Path
    inputs: tuple[str, ...]
    """Names of the inputs."""
    compute: Callable[[Inputs], list[np.ndarray]]
    """Function that computes all outputs in the order of the file. It raises errors of onnxruntime or OpenCV."""

    def run(self, inputs: Inputs, *, expected: str) -> list[np.ndarray]:
        """Compute all outputs, in the file's order. Raises ``UserError`` on failure; the message describes the
        ``expected`` file."""
        try:
            return [np.asarray(value) for value in self.compute(inputs)]
        # Errors of OpenCV and onnxruntime have no common base class.
        except Exception as error:
            shapes = ", ".join(f"{name} {value.shape}" for name, value in inputs.items())
            raise UserError(
                f"{self.path}: the network failed on {shapes} ({_last_line(error)}); give {expected}"
            ) from error


def load_network(path: Path) -> OnnxNetwork:
    """Load a network. Raises ``UserError`` if the file is not ONNX, or has operations that onnxruntime or OpenCV does
    not support."""
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
            f"{path}: onnxruntime cannot read this network ({_last_line(error)}); export it as ONNX again"
        ) from error
    return OnnxNetwork(path, file.inputs, lambda inputs: list(session.run(None, dict(inputs))))


def _by_opencv(path: Path, data: bytes) -> Callable[[Inputs], list[np.ndarray]]:
    import cv2

    try:
        network = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
        names = list(network.getUnconnectedOutLayersNames())
    except cv2.error as error:
        raise UserError(
            f"{path}: OpenCV cannot read this network ({_last_line(error)}); install onnxruntime, or export it again"
        ) from error

    def compute(inputs: Inputs) -> list[np.ndarray]:
        for name, value in inputs.items():
            network.setInput(np.ascontiguousarray(value), name)
        return list(network.forward(names))

    return compute


def _last_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[-1] if lines else type(error).__name__
