"""Networks that compute masks: inputs, outputs and invalid files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.io import onnx_network
from egs_warp.io.onnx_network import Inputs, OnnxNetwork
from egs_warp.segmentation.mask_model import OnnxClickModel, SalientModel
from tests.support import onnx
from tests.support.click_network import alike

NAMES = ("batched_images", "batched_point_coords", "batched_point_labels")


@pytest.fixture(params=["OpenCV", "onnxruntime"])
def program(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of each of the two programs that evaluate networks in turn, if it is installed."""
    if request.param == "onnxruntime":
        pytest.importorskip("onnxruntime")
    else:
        # An entry of None in ``sys.modules`` makes the import fail.
        monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    return request.param


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def halves() -> np.ndarray:
    """Return an image of 60 x 90 pixels, red to the left of column 30 and blue to the right."""
    picture = np.zeros((60, 90, 3), np.float32)
    picture[:, :30, 0], picture[:, 30:, 2] = 0.8, 0.6
    return picture


@pytest.mark.parametrize(("u", "red"), [(10.5, True), (70.5, False)])
def test_a_click_becomes_the_mask_of_its_colour(program: str, tmp_path: Path, u: float, red: bool) -> None:
    """The mask has the size of the image and is exact at the edge; the black padding does not belong to it."""
    model = OnnxClickModel.read(written(tmp_path / "alike.onnx", alike()))
    assert model.names == NAMES
    mask = model.mask(halves(), np.array([[u, 40.5], [45.0, 5.0]]), np.array([True, False]))
    assert mask.shape == (60, 90) and mask.dtype == bool
    expected = (np.arange(90) < 30) == red
    assert (mask[:, :29] == expected[:29]).all() and (mask[:, 31:] == expected[31:]).all()


def answering(*outputs: np.ndarray) -> tuple[OnnxClickModel, list[Inputs]]:
    """Return a model whose network returns these outputs, and a list that collects its inputs."""
    given: list[Inputs] = []

    def compute(inputs: Inputs) -> list[np.ndarray]:
        given.append(inputs)
        return list(outputs)

    return OnnxClickModel(OnnxNetwork(Path("model.onnx"), NAMES, compute), NAMES), given


def test_inputs_of_the_network_and_selection_of_the_best_mask() -> None:
    masks = np.full((1, 1, 3, 256, 256), -1.0, np.float32)
    masks[0, 0, 1, :, :128] = 1.0
    model, given = answering(masks, np.array([[[0.2, 0.9, 0.5]]], np.float32))
    mask = model.mask(halves(), np.array([[9.0, 6.0]]), np.array([True]))
    # The left half of the square covers columns 0 to 45 of 90.
    assert mask[:, :44].all() and not mask[:, 46:].any()
    picture, points, labels = (given[0][name] for name in NAMES)
    assert picture.shape == (1, 3, 1024, 1024) and picture.dtype == points.dtype == labels.dtype == np.float32
    assert picture[0, 0, 300, 100] == pytest.approx(0.8) and not picture[:, :, 700:].any()
    scale = 1024 / 90
    np.testing.assert_allclose(points[0, 0, 0], [9.0 * scale, 6.0 * scale], rtol=1e-6)
    assert labels[0, 0].tolist() == [1.0, -1.0, -1.0, -1.0, -1.0, -1.0]
    first, _ = answering(masks)
    assert not first.mask(halves(), np.array([[9.0, 6.0]]), np.array([True])).any()
    many, given = answering(masks)
    many.mask(halves(), np.arange(16.0).reshape(8, 2), np.arange(8) % 2 == 0)
    assert given[0][NAMES[2]][0, 0].tolist() == [1.0, 0.0, 1.0, 0.0, 1.0, 0.0]


@pytest.mark.parametrize(
    "wrong", [np.zeros((1, 1, 64, 64)), np.full((1, 1, 1, 8, 8), np.nan), np.zeros((1, 1, 0, 8, 8))]
)
def test_invalid_masks_are_refused(wrong: np.ndarray) -> None:
    model, _ = answering(wrong)
    with pytest.raises(UserError, match=r"model\.onnx: the network returned shape .* expected masks \(1, 1, k, h, w\)"):
        model.mask(halves(), np.array([[9.0, 6.0]]), np.array([True]))


def test_files_that_are_no_such_network(program: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"text\.onnx: not an ONNX file"):
        OnnxClickModel.read(written(tmp_path / "text.onnx", b"weights"))
    two = onnx.model(
        [onnx.node("Add", ["image", "mask"], ["sum"])],
        [],
        [onnx.value("image", [1, 3, 8, 8]), onnx.value("mask", [1, 1, 8, 8])],
        [onnx.value("sum", [1, 3, 8, 8])],
    )
    with pytest.raises(UserError, match=r"two\.onnx: the network takes image, mask; give a network that takes a pict"):
        OnnxClickModel.read(written(tmp_path / "two.onnx", two))
    unknown = alike().replace(b"MatMul", b"MatMuX")
    with pytest.raises(UserError, match=rf"unknown\.onnx: ({program} cannot read this network|the network failed on)"):
        OnnxClickModel.read(written(tmp_path / "unknown.onnx", unknown)).mask(
            halves(), np.array([[9.0, 6.0]]), np.array([True])
        )


def test_a_network_that_fails_is_a_one_line_error() -> None:
    def compute(inputs: Inputs) -> list[np.ndarray]:
        raise RuntimeError("long\nstory\nout of shape")

    model = OnnxClickModel(OnnxNetwork(Path("model.onnx"), NAMES, compute), NAMES)
    with pytest.raises(
        UserError,
        match=r"model\.onnx: the network failed on batched_images \(1, 3, 1024, 1024\), .*\(out of shape\); give a",
    ) as error:
        model.mask(halves(), np.array([[9.0, 6.0]]), np.array([True]))
    assert "\n" not in str(error.value)


def test_saliency_is_normalised_to_its_range() -> None:
    """The output is scaled as in the training of the network: its minimum is background, its maximum is object."""
    answer = np.full((1, 1, 320, 320), 0.1, np.float32)
    answer[..., :160, :] = 0.4
    given: list[Inputs] = []

    def compute(inputs: Inputs) -> list[np.ndarray]:
        given.append(inputs)
        return [answer, answer * 0.0]

    mask = SalientModel(OnnxNetwork(Path("u2netp.onnx"), ("input.1",), compute)).mask(halves())
    assert mask[:29].all() and not mask[31:].any()
    values = given[0]["input.1"]
    assert values.shape == (1, 3, 320, 320) and values.dtype == np.float32
    # The red value of 0.8 is the maximum of the image and is scaled to 1.
    np.testing.assert_allclose(
        values[0, :, 10, 10], (np.array([1.0, 0.0, 0.0]) - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225], rtol=1e-5
    )


def test_a_missing_saliency_network_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        UserError, match=r"no network for proposing an object is installed; click .* or install one: .*salient"
    ):
        SalientModel.installed()


def test_onnx_files_are_checked_before_they_are_loaded(program: str, tmp_path: Path) -> None:
    """Tensors in external files are refused."""
    data = onnx.model(
        [onnx.node("Mul", ["image", "much"], ["out"])],
        [onnx.tensor("much", [1], [2.0], external="../secret")],
        [onnx.value("image", [1])],
        [onnx.value("out", [1])],
    )
    with pytest.raises(UserError, match=r"far\.onnx: some of its numbers are in other files, which are not read"):
        onnx_network.load_network(written(tmp_path / "far.onnx", data))
