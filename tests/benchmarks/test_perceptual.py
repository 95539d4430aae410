"""FLIP compared with the values of the reference implementation."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
import torch
from scipy import ndimage

from tests.support.scripts import BENCHMARKS, module_of


@pytest.fixture
def perceptual(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("perceptual")


def noise(seed: int, width: float) -> np.ndarray:
    picture = ndimage.gaussian_filter(np.random.default_rng(seed).uniform(size=(96, 128, 3)), (width, width, 0.0))
    return ((picture - picture.min()) / np.ptp(picture)).astype(np.float32)


# Mean errors by flip-evaluator 1.7, the reference implementation of Andersson et al., for the same image pairs at its
# default of 67.02 pixels per degree: two images of noise, two images of patches, a blurred image, a slightly brightened
# one, and black and white.
PICTURES = {
    "noise": (noise(0, 0.0), noise(1, 0.0), 0.4408529),
    "patches": (noise(0, 3.0), noise(1, 3.0), 0.6401296),
    "blur": (noise(0, 1.0), ndimage.gaussian_filter(noise(0, 1.0), (1.0, 1.0, 0.0)), 0.1468333),
    "light": (noise(0, 3.0), np.clip(noise(0, 3.0) + 0.02, 0.0, 1.0), 0.1207072),
    "black and white": (np.zeros((64, 64, 3), np.float32), np.ones((64, 64, 3), np.float32), 0.9673452),
}


@pytest.mark.parametrize("name", PICTURES)
def test_flip_equals_the_reference_implementation(perceptual: ModuleType, name: str) -> None:
    """The tolerance is 5e-5 because the reference is in single precision."""
    target, picture, theirs = PICTURES[name]
    assert perceptual.flip_error(torch.tensor(picture), torch.tensor(target)) == pytest.approx(theirs, abs=5e-5)


def test_flip_of_a_picture_and_itself_is_nothing(perceptual: ModuleType) -> None:
    picture = torch.tensor(noise(0, 1.0))
    assert perceptual.flip_error(picture, picture) == 0.0
