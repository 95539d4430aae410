"""Pictures of the page and of the player, and their likeness to pictures of this package."""

from __future__ import annotations

import base64
import io
from typing import Any

import numpy as np
from PIL import Image

BACKGROUND = (0xB9 / 255.0, 0xBE / 255.0, 0xC6 / 255.0)
"""Colour behind the bodies on the page if the ground is hidden."""
STAGE = "egs.viewers[0]"
"""JavaScript expression of the first view of the page."""


def picture_of(page: Any, stage: str = STAGE) -> np.ndarray:
    """Return the canvas (H, W, 3) of the JavaScript expression ``stage``, a ``Stage`` of the page, with values from 0
    to 1, after its splats are sorted."""
    text = page.evaluate(
        f"""async () => {{
            const stage = {stage};
            await stage.drawSorted();
            return stage.canvas.toDataURL("image/png").split(",")[1];
        }}"""
    )
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(text))).convert("RGB"), np.float64) / 255.0


def psnr_on_body(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the PSNR, dB, of ``theirs`` (H, W, 3) where ``ours`` differs from its background, the first pixel."""
    body = np.abs(ours - ours[0, 0]).max(axis=-1) > 0.02
    assert 0.02 < body.mean() < 0.9
    return float(-10.0 * np.log10(((ours - theirs)[body] ** 2).mean()))
