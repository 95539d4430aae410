"""Inpainters that fill a hole in a picture: the protocol ``Inpainter`` and its implementations."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from egs_warp.errors import ArgumentError, UserError, did_you_mean
from egs_warp.inpainting.patch_synthesis import PatchSynthesis
from egs_warp.installation import install_command
from egs_warp.io.onnx import OnnxFile, read_onnx

_PAD = 8
"""The sides of LaMa's input picture must be multiples of this number of pixels."""
_MAX_UNIT_OUTPUT = 4.0
"""A network whose largest output exceeds this value uses the range 0 to 255 instead of 0 to 1."""


class Inpainter(Protocol):
    """An algorithm that fills a hole in a face-on picture of a plane."""

    def fill(
        self,
        image: np.ndarray,
        hole: np.ndarray,
        known: np.ndarray,
        shade: np.ndarray | None = None,
        *,
        progress: Callable[[float], None] = lambda done: None,
    ) -> np.ndarray:
        """Fill the hole and return the picture.

        Args:
            image: (H, W, 3) float32, 0 to 1.
            hole: (H, W) bool, the pixels to fill.
            known: (H, W) bool, pixels outside the hole at which ``image`` is valid.
            shade: (H, W) bool, shaded pixels, which should not be copied to lit parts of the hole.
            progress: Called with the finished fraction, 0 to 1. Methods that consist of a single step do not call it.

        Returns:
            (H, W, 3) float32, 0 to 1, equal to ``image`` outside ``hole``.
        """
        ...


class OpenCvMethod(enum.Enum):
    """Methods of ``cv2.inpaint``."""

    TELEA = "telea"
    """Fast marching (Telea 2004)."""
    NAVIER_STOKES = "ns"
    """Continuation of isophotes into the hole (Bertalmio et al. 2001)."""


@dataclass(frozen=True)
class OpenCvInpainter:
    """Inpainting with ``cv2.inpaint``. The result is smooth, which suits small holes and plain floors."""

    method: OpenCvMethod = OpenCvMethod.TELEA
    radius: float = 5.0
    """Radius of the neighbourhood of each pixel, in pixels."""

    def fill(
        self,
        image: np.ndarray,
        hole: np.ndarray,
        known: np.ndarray,
        shade: np.ndarray | None = None,
        *,
        progress: Callable[[float], None] = lambda done: None,
    ) -> np.ndarray:
        """Fill the hole; see ``Inpainter.fill``."""
        flag = cv2.INPAINT_TELEA if self.method is OpenCvMethod.TELEA else cv2.INPAINT_NS
        missing = (hole | ~known).astype(np.uint8)
        # ``cv2.inpaint`` accepts 16 bits only for single channels, and its fast marching rounds float32 pictures to
        # integers, so each channel is inpainted as uint16.
        coded = np.rint(65535.0 * np.clip(image, 0.0, 1.0)).astype(np.uint16)
        channels = [cv2.inpaint(np.ascontiguousarray(coded[..., k]), missing, self.radius, flag) for k in range(3)]
        return _pasted(image, hole, np.stack(channels, axis=-1).astype(np.float32) / np.float32(65535.0))


@dataclass(frozen=True)
class OnnxInpainter:
    """LaMa (Suvorov et al. 2022) or a compatible network, read from an ONNX file.

    The network takes a picture (1, 3, H, W) in 0 to 1 and a mask (1, 1, H, W) of the hole, and returns a picture (1, 3,
    H, W) in 0 to 1 or in 0 to 255. An ONNX file contains no code. OpenCV evaluates it on the CPU.
    """

    path: Path

    def fill(
        self,
        image: np.ndarray,
        hole: np.ndarray,
        known: np.ndarray,
        shade: np.ndarray | None = None,
        *,
        progress: Callable[[float], None] = lambda done: None,
    ) -> np.ndarray:
        """Fill the hole; see ``Inpainter.fill``. Raises ``UserError`` if the file is not an inpainting network."""
        file, network = self._load()
        picture, missing = _padded(image, hole, known)
        masks = [name for name in file.inputs if "mask" in name.lower()]
        mask_name = masks[0] if masks else file.inputs[1]
        picture_name = next(name for name in file.inputs if name != mask_name)
        try:
            network.setInput(picture, picture_name)
            network.setInput(missing, mask_name)
            values = np.asarray(network.forward(), np.float32)
        except cv2.error as error:
            raise _failed(self.path, error, "an ONNX file of LaMa with variable height and width") from error
        return _answer(self.path, values, image, hole, missing.shape[2:])

    def _load(self) -> tuple[OnnxFile, cv2.dnn.Net]:
        file = read_onnx(self.path)
        if len(file.inputs) != 2:
            raise UserError(
                f"{self.path}: the network takes {len(file.inputs)} inputs ({', '.join(file.inputs)}), expected a"
                " picture and a mask; give LaMa's ONNX file"
            )
        try:
            return file, cv2.dnn.readNetFromONNX(np.frombuffer(file.data, np.uint8))
        except cv2.error as error:
            raise UserError(
                f"{self.path}: OpenCV cannot read this network ({_last_line(error)}); export it as ONNX again"
            ) from error


@dataclass(frozen=True)
class TorchScriptInpainter:
    """LaMa or a compatible network, read from a TorchScript file. Loading the file runs the program in it: use trusted
    files only."""

    path: Path
    device: str = "cpu"
    """PyTorch device on which the network runs."""

    def fill(
        self,
        image: np.ndarray,
        hole: np.ndarray,
        known: np.ndarray,
        shade: np.ndarray | None = None,
        *,
        progress: Callable[[float], None] = lambda done: None,
    ) -> np.ndarray:
        """Fill the hole; see ``Inpainter.fill``. Raises ``UserError`` if the file is not an inpainting network."""
        torch, network = self._load()
        picture, missing = _padded(image, hole, known)
        try:
            with torch.no_grad():
                answer = network(torch.from_numpy(picture).to(self.device), torch.from_numpy(missing).to(self.device))
            values = np.asarray(answer.detach().cpu().numpy(), np.float32)
        # TorchScript raises plain RuntimeErrors of many lines, and AttributeError if the output is not a tensor.
        except (RuntimeError, AttributeError, TypeError) as error:
            raise _failed(self.path, error, "LaMa's TorchScript file") from error
        return _answer(self.path, values, image, hole, missing.shape[2:])

    def _load(self) -> tuple[Any, Any]:
        if not self.path.is_file():
            raise UserError(f"{self.path}: no such file; give the TorchScript file of an inpainting network")
        try:
            import torch
        except ImportError as error:
            raise UserError(f"{self.path}: a network needs PyTorch; {install_command('torch')}") from error
        try:
            return torch, torch.jit.load(str(self.path), map_location=self.device).eval()
        except (RuntimeError, ValueError) as error:
            raise UserError(
                f"{self.path}: not a TorchScript file; save the network with torch.jit.save and give that file"
            ) from error


def inpainter_by_name(name: str, *, seed: int = 0, device: str = "cpu", trust: bool = False) -> Inpainter:
    """Create an inpainter from its name: ``patch``, ``telea``, ``ns``, or the path of a network's file, which is loaded
    to check it.

    Loading a TorchScript file runs the program in it, so such a file is rejected unless ``trust`` is set. Raises
    ``UserError`` for other names.
    """
    if name == "patch":
        return PatchSynthesis(seed=seed, device=device)
    if name in (method.value for method in OpenCvMethod):
        return OpenCvInpainter(OpenCvMethod(name))
    path = Path(name)
    # Report an unsuitable file now, not minutes later when the hole is filled.
    if path.suffix in (".pt", ".pth", ".ts"):
        if not trust:
            advice = (
                "loading a TorchScript file runs the program in it; give an ONNX file, or say that you trust this one"
            )
            raise ArgumentError("inpainter", advice, value=name, check=("trust",))
        script = TorchScriptInpainter(path, device="cuda" if device.startswith("cuda") else "cpu")
        script._load()
        return script
    if path.suffix == ".onnx" or path.is_file():
        network = OnnxInpainter(path)
        network._load()
        return network
    near = did_you_mean(name, ("patch", *(method.value for method in OpenCvMethod)))
    raise ArgumentError("inpainter", "give patch, telea, ns or an ONNX file (.onnx)", value=f"{name}{near}")


def _padded(image: np.ndarray, hole: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the picture (1, 3, H, W) and the mask of missing pixels (1, 1, H, W), float32, padded to multiples of
    ``_PAD``."""
    rows, columns = hole.shape
    pad = ((0, -rows % _PAD), (0, -columns % _PAD))
    missing = np.pad(hole | ~known, pad, mode="symmetric").astype(np.float32)
    picture = np.pad(np.where(known[..., None], image, 0.0), (*pad, (0, 0)), mode="symmetric").astype(np.float32)
    return np.ascontiguousarray(picture.transpose(2, 0, 1)[None]), missing[None, None]


def _failed(path: Path, error: Exception, advice: str) -> UserError:
    return UserError(
        f"{path}: the network failed on an image (1, 3, H, W) and a mask (1, 1, H, W) ({_last_line(error)});"
        f" give {advice}"
    )


def _last_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[-1] if lines else type(error).__name__


def _answer(path: Path, values: np.ndarray, image: np.ndarray, hole: np.ndarray, padded: tuple[int, ...]) -> np.ndarray:
    if values.shape != (1, 3, *padded) or not np.isfinite(values).all():
        raise UserError(
            f"{path}: the network returned shape {values.shape} or non-finite values; expected finite values of shape"
            f" {(1, 3, *padded)}; give the TorchScript file of LaMa"
        )
    rows, columns = hole.shape
    filled = values[0].transpose(1, 2, 0)[:rows, :columns]
    # Some exports of LaMa use the range 0 to 255.
    return _pasted(image, hole, filled / np.float32(255.0) if filled.max() > _MAX_UNIT_OUTPUT else filled)


def _pasted(image: np.ndarray, hole: np.ndarray, filled: np.ndarray) -> np.ndarray:
    return np.where(hole[..., None], np.clip(filled, 0.0, 1.0), image).astype(np.float32)
