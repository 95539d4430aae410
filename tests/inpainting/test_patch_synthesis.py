"""Patch synthesis: graph cuts compared with brute force, continuation of repeating textures, and blending across
seams."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.inpainting.offset_labels import _cut, labelled_sources
from egs_warp.inpainting.patch_synthesis import PatchSynthesis, poisson_blend
from egs_warp.training.metrics import psnr
from tests.support.floors import pattern


def picture(size: int = 128, texel: float = 0.0125) -> np.ndarray:
    """Return a pattern with a period of 32 pixels."""
    line = (np.arange(size) + 0.5) * texel
    return pattern(*np.meshgrid(line, line)).astype(np.float32)


def round_hole(size: int, middle: tuple[int, int], radius: float) -> np.ndarray:
    rows, columns = np.mgrid[:size, :size]
    return np.hypot(rows - middle[0], columns - middle[1]) < radius


def test_cut_is_the_optimum() -> None:
    """In small random problems, no labelling has a lower cost than that of the graph cut."""
    random = np.random.default_rng(3)
    for _ in range(30):
        unary = random.integers(-9, 10, 7)
        p, q = np.array(list(itertools.combinations(range(7), 2)))[random.choice(21, 11, replace=False)].T
        pairwise = random.integers(0, 8, 11)
        every = np.array(list(itertools.product([False, True], repeat=7)))
        costs = every @ unary + ((~every[:, p] & every[:, q]) * pairwise).sum(axis=1)
        found = _cut(unary, p, q, pairwise)
        assert found @ unary + ((~found[p] & found[q]) * pairwise).sum() == costs.min()


def test_labels_point_to_similar_known_texels() -> None:
    """In a periodic image, each texel of the hole gets a known source texel whose colour differs by less than 0.02."""
    image = picture()
    hole = round_hole(128, (70, 60), 13)
    known = np.ones_like(hole)
    known[:, 110:] = False
    is_source = ~cv2.dilate((hole | ~known).astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    sources = labelled_sources(np.where(hole[..., None], 0.0, image), hole, known, is_source, shift_limit=0.02)
    at = sources[hole]
    assert is_source[at[:, 0], at[:, 1]].all()
    assert np.abs(image[at[:, 0], at[:, 1]] - image[hole]).max() < 0.02


def test_a_repeating_texture_is_continued(device: str) -> None:
    """The PSNR is at least 40 dB and 15 dB above OpenCV's; nothing outside the hole changes; results are
    deterministic. The reported progress rises to 1."""
    image = picture()
    hole = round_hole(128, (70, 60), 17) | round_hole(128, (20, 100), 6)
    holed = np.where(hole[..., None], 0.0, image).astype(np.float32)
    reported: list[float] = []
    filled = PatchSynthesis(device=device).fill(holed, hole, ~hole, progress=reported.append)
    smooth = cv2.inpaint(np.rint(255 * holed).astype(np.uint8), hole.astype(np.uint8), 5, cv2.INPAINT_TELEA) / 255.0
    assert psnr(filled[hole], image[hole]) > max(40.0, psnr(smooth[hole], image[hole]) + 15.0)
    assert np.array_equal(filled[~hole], image[~hole])
    assert np.array_equal(filled, PatchSynthesis(device=device).fill(holed, hole, ~hole))
    assert reported == sorted(reported)
    assert reported[0] < 0.6
    assert reported[-1] == pytest.approx(1.0)


def test_an_illumination_gradient_leaves_no_seam() -> None:
    """For a texture under a gradient of illumination, the PSNR exceeds 30 dB, and the error at the rim is less than a
    tenth of the range of the illumination."""
    fade = np.linspace(-0.1, 0.1, 128, dtype=np.float32)[None, :, None]
    image = 0.7 * picture() + 0.15 + fade
    hole = round_hole(128, (64, 64), 15)
    filled = PatchSynthesis().fill(np.where(hole[..., None], 0.0, image).astype(np.float32), hole, ~hole)
    assert psnr(filled[hole], image[hole]) > 30.0
    rim = hole & ~cv2.erode(hole.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert np.abs(filled - image)[rim].max() < 0.02


def test_blending_keeps_gradients_and_removes_steps() -> None:
    """A copied region that is 0.1 too bright is corrected from its rim inwards; where sources and votes agree, nothing
    changes."""
    image = picture().astype(np.float64)
    image[:, 64:] += 0.1
    hole = round_hole(128, (64, 32), 9)
    rows, columns = np.mgrid[:128, :128]
    sources = np.stack([rows, np.minimum(columns + 64, 127)], axis=-1)
    wrong = image.copy()
    wrong[hole] += 0.1
    melded = poisson_blend(wrong, hole, np.ones_like(hole), sources)
    assert np.abs(melded - image)[hole].max() < 0.035
    assert np.abs(melded - image)[hole].mean() < 0.3 * 0.1
    same = np.stack([(rows + 32) % 128, columns], axis=-1)
    assert np.abs(poisson_blend(image, hole, np.ones_like(hole), same) - image).max() < 1e-9


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
def test_no_patch_of_a_distant_texture(seed: int) -> None:
    """A hole in an unevenly lit pale sheet on dark boards, with little of the sheet left around it, gets no dark patch;
    a crack that runs through a hole in the boards is continued."""
    random = np.random.default_rng(seed)
    image = np.full((128, 128, 3), (0.42, 0.36, 0.33)) + random.normal(0.0, 0.02, (128, 128, 1))
    image[:, 108:111] = 0.1
    light = cv2.GaussianBlur(random.normal(0.0, 1.0, (128, 128, 1)), (0, 0), 6.0)[..., None]
    sheet = np.zeros((128, 128), bool)
    sheet[22:106, 20:96] = True
    image[sheet] = ((0.8, 0.85, 0.95) + 0.3 * light)[sheet]
    image = np.clip(image, 0.0, 1.0).astype(np.float32)
    hole = round_hole(128, (62 + int(random.integers(-4, 5)), 56), 28) | round_hole(128, (64, 114), 7)
    filled = PatchSynthesis(seed=seed).fill(np.where(hole[..., None], 0.0, image).astype(np.float32), hole, ~hole)
    assert (filled[hole & sheet] > 0.6).all()
    assert (filled[57:71, 109] < 0.25).all()


def test_an_image_without_source_patches() -> None:
    """The hole covers the image except for a few columns."""
    hole = np.ones((40, 40), bool)
    hole[:, :3] = False
    with pytest.raises(UserError, match="no piece of 7 x 7 texels is known around the hole; make the hole smaller"):
        PatchSynthesis().fill(np.zeros((40, 40, 3), np.float32), hole, ~hole)


@pytest.mark.slow
def test_shaded_texels_are_not_copied():
    """One side of the hole is in shade; without the mask of shaded texels, the filled hole would be darker."""
    rows, columns = np.indices((96, 96))
    hole = np.hypot(rows - 48, columns - 48) < 14
    shade = (columns < 44) & (np.abs(rows - 48) < 24) & ~hole
    threads = 0.6 + 0.1 * np.sin(rows) * np.sin(columns)
    image = np.repeat((threads * np.where(shade, 0.7, 1.0))[..., None], 3, axis=-1).astype(np.float32)
    image[hole] = 0.0

    def brightness(shade: np.ndarray | None) -> float:
        filled = PatchSynthesis().fill(image, hole, ~hole, shade)
        assert np.array_equal(filled[~hole], image[~hole])
        return float(filled[hole].mean())

    assert brightness(shade) > brightness(None) + 0.02
    # If nearly all texels are shaded, there is no other source to copy from.
    assert brightness(~hole) == pytest.approx(brightness(None), abs=1e-6)
