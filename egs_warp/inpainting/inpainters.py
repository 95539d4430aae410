"""What can fill a hole in a picture: one small protocol and three that keep it."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from egs_warp.errors import UserError
from egs_warp.inpainting.patch_synthesis import PatchSynthesis

_PAD = 8
"""LaMa takes pictures whose sides are multiples of this."""


class Inpainter(Protocol):
    """Fills a hole in a picture of a plane seen face-on."""

    def fill(self, image: np.ndarray, hole: np.ndarray, known: np.ndarray) -> np.ndarray:
        """(H, W, 3) float32, 0 to 1, that equals ``image`` outside ``hole``.

        ``image`` (H, W, 3) float32 is to be trusted where ``known`` (H, W) and not ``hole`` (H, W, both bool).
        """
        ...


class OpenCvMethod(enum.Enum):
    """What ``cv2.inpaint`` offers."""

    TELEA = "telea"
    """Fast marching (Telea 2004)."""
    NAVIER_STOKES = "ns"
    """Isophotes carried into the hole (Bertalmio et al. 2001)."""


@dataclass(frozen=True)
class OpenCvInpainter:
    """``cv2.inpaint``: smooth, so for small holes or plain floors."""

    method: OpenCvMethod = OpenCvMethod.TELEA
    radius: float = 5.0
    """Pixels around each one that are looked at."""

    def fill(self, image: np.ndarray, hole: np.ndarray, known: np.ndarray) -> np.ndarray:
        """As ``Inpainter.fill``."""
        flag = cv2.INPAINT_TELEA if self.method is OpenCvMethod.TELEA else cv2.INPAINT_NS
        missing = (hole | ~known).astype(np.uint8)
        # One channel at a time it takes 16 bits; of float32 pictures its fast marching rounds to whole numbers.
        coded = np.rint(65535.0 * np.clip(image, 0.0, 1.0)).astype(np.uint16)
        channels = [cv2.inpaint(np.ascontiguousarray(coded[..., k]), missing, self.radius, flag) for k in range(3)]
        return _pasted(image, hole, np.stack(channels, axis=-1).astype(np.float32) / np.float32(65535.0))


@dataclass(frozen=True)
class TorchScriptInpainter:
    """LaMa (Suvorov et al. 2022), or any network that takes (1, 3, H, W) in 0 to 1 and a (1, 1, H, W) mask of the hole
    and returns (1, 3, H, W) in 0 to 1, as a TorchScript file of the user's."""

    path: Path
    device: str = "cpu"
    """Of torch."""

    def fill(self, image: np.ndarray, hole: np.ndarray, known: np.ndarray) -> np.ndarray:
        """As ``Inpainter.fill``. Raises ``UserError`` for a file that is no such network."""
        torch, network = self._load()
        rows, columns = hole.shape
        pad = ((0, -rows % _PAD), (0, -columns % _PAD))
        missing = np.pad(hole | ~known, pad, mode="symmetric").astype(np.float32)
        picture = np.pad(np.where(known[..., None], image, 0.0), (*pad, (0, 0)), mode="symmetric").astype(np.float32)
        try:
            with torch.no_grad():
                answer = network(
                    torch.from_numpy(picture.transpose(2, 0, 1)[None]).to(self.device),
                    torch.from_numpy(missing[None, None]).to(self.device),
                )
            values = np.asarray(answer.detach().cpu().numpy(), np.float32)
        # TorchScript raises plain RuntimeErrors of many lines; AttributeError when the answer is no tensor.
        except (RuntimeError, AttributeError, TypeError) as error:
            reason = str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__
            raise UserError(
                f"{self.path}: the network failed on an image (1, 3, H, W) and a mask (1, 1, H, W) ({reason});"
                " give LaMa's TorchScript file"
            ) from error
        if values.shape != (1, 3, *missing.shape) or not np.isfinite(values).all():
            raise UserError(
                f"{self.path}: the network returned shape {values.shape} or values that are not finite,"
                f" expected {(1, 3, *missing.shape)}; give LaMa's TorchScript file"
            )
        return _pasted(image, hole, values[0].transpose(1, 2, 0)[:rows, :columns])

    def _load(self) -> tuple[Any, Any]:
        if not self.path.is_file():
            raise UserError(f"{self.path}: no such file; give the TorchScript file of an inpainting network")
        try:
            import torch
        except ImportError as error:
            raise UserError(f"{self.path}: a network needs PyTorch; install egs-warp[torch]") from error
        try:
            return torch, torch.jit.load(str(self.path), map_location=self.device).eval()
        except (RuntimeError, ValueError) as error:
            raise UserError(
                f"{self.path}: not a TorchScript file; save the network with torch.jit.save and give that"
            ) from error


def inpainter_by_name(name: str, *, seed: int = 0, device: str = "cpu") -> Inpainter:
    """``patch``, ``telea``, ``ns`` or the path of a TorchScript file, which is tried.
    Raises ``UserError`` for anything else.
    """
    if name == "patch":
        return PatchSynthesis(seed=seed, device=device)
    if name in (method.value for method in OpenCvMethod):
        return OpenCvInpainter(OpenCvMethod(name))
    if Path(name).suffix in (".pt", ".pth", ".ts") or Path(name).is_file():
        network = TorchScriptInpainter(Path(name), device="cuda" if device.startswith("cuda") else "cpu")
        # A wrong file is told now, not after the minutes that come before the filling.
        network._load()
        return network
    raise UserError(f"--inpainter {name}: give patch, telea, ns or a TorchScript file (.pt)")


def _pasted(image: np.ndarray, hole: np.ndarray, filled: np.ndarray) -> np.ndarray:
    return np.where(hole[..., None], np.clip(filled, 0.0, 1.0), image).astype(np.float32)
