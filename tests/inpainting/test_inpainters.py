"""Inpainters by OpenCV, ONNX and TorchScript with the same protocol, and their error messages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from egs_warp.errors import UserError
from egs_warp.inpainting.inpainters import OpenCvInpainter, OpenCvMethod, TorchScriptInpainter, inpainter_by_name
from egs_warp.inpainting.patch_synthesis import PatchSynthesis
from tests.support import onnx

# LaMa is published as TorchScript, for which torch prints a deprecation warning.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


class MeanOfTheKnown(torch.nn.Module):
    """Minimal network with the interface of LaMa: it fills the hole with the mean colour of the other pixels."""

    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        mean = (image * (1 - mask)).sum(dim=(2, 3), keepdim=True) / (1 - mask).sum(dim=(2, 3), keepdim=True)
        return image * (1 - mask) + mean * mask


def holed() -> tuple[np.ndarray, np.ndarray]:
    """Return an image of 37 x 45 pixels, which needs padding, red on the left and blue on the right, with a hole at its
    border."""
    image = np.zeros((37, 45, 3), np.float32)
    image[:, :22, 0], image[:, 22:, 2] = 0.8, 0.6
    hole = np.zeros((37, 45), bool)
    hole[10:20, 15:30] = True
    return np.where(hole[..., None], 0.0, image).astype(np.float32), hole


def traced(module: torch.nn.Module, path: Path) -> Path:
    save_traced(module, (torch.rand(1, 3, 40, 48), torch.ones(1, 1, 40, 48)), path)
    return path


def save_traced(module: torch.nn.Module, inputs: tuple[torch.Tensor, ...], path: Path) -> None:
    script = torch.jit.trace(module, inputs)
    assert isinstance(script, torch.jit.ScriptModule)
    script.save(str(path))


def test_torchscript_gets_padded_images(tmp_path: Path) -> None:
    image, hole = holed()
    inpainter = inpainter_by_name(str(traced(MeanOfTheKnown(), tmp_path / "mean.pt")), trust=True)
    filled = inpainter.fill(image, hole, ~hole)
    assert np.array_equal(filled[~hole], image[~hole])
    values = np.unique(filled[hole].round(5), axis=0)
    assert len(values) == 1 and values[0, 1] == 0.0
    padded = np.pad(image, ((0, 3), (0, 3), (0, 0)), mode="symmetric")
    outside = ~np.pad(hole, ((0, 3), (0, 3)), mode="symmetric")
    assert values[0] == pytest.approx(padded[outside].mean(axis=0), abs=1e-5)


@pytest.mark.parametrize("method", OpenCvMethod)
def test_opencv_continues_flat_colour_exactly(method: OpenCvMethod) -> None:
    image, hole = holed()
    image[:] = np.where(hole[..., None], 0.0, [0.123, 0.456, 0.789])
    filled = OpenCvInpainter(method).fill(image, hole, ~hole)
    # The values are not rounded to 8 bits.
    assert filled[hole] == pytest.approx(np.tile([0.123, 0.456, 0.789], (hole.sum(), 1)), abs=1e-4)


def test_names(tmp_path: Path) -> None:
    assert isinstance(inpainter_by_name("patch"), PatchSynthesis)
    assert inpainter_by_name("ns") == OpenCvInpainter(OpenCvMethod.NAVIER_STOKES)
    with pytest.raises(UserError, match="inpainter lama: give patch, telea, ns or an ONNX file"):
        inpainter_by_name("lama")
    with pytest.raises(UserError, match=r"gone\.pt: no such file; give the TorchScript file"):
        inpainter_by_name(str(tmp_path / "gone.pt"), trust=True)
    with pytest.raises(UserError, match=r"gone\.onnx: no such file"):
        inpainter_by_name(str(tmp_path / "gone.onnx"))


def test_bad_networks(tmp_path: Path) -> None:
    image, hole = holed()
    text = tmp_path / "text.pt"
    text.write_text("weights")
    with pytest.raises(UserError, match=r"text\.pt: not a TorchScript file; save the network with torch\.jit\.save"):
        TorchScriptInpainter(text).fill(image, hole, ~hole)

    class Half(torch.nn.Module):
        def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
            return image[:, :, ::2] * mask[:, :, ::2]

    with pytest.raises(UserError, match=r"returned shape \(1, 3, 20, 48\) .* values of shape \(1, 3, 40, 48\)"):
        TorchScriptInpainter(traced(Half(), tmp_path / "half.pt")).fill(image, hole, ~hole)

    class One(torch.nn.Module):
        def forward(self, image: torch.Tensor) -> torch.Tensor:
            return image

    save_traced(One(), (torch.rand(1, 3, 8, 8),), tmp_path / "one.pt")
    with pytest.raises(UserError, match=r"one\.pt: the network failed on an image") as caught:
        TorchScriptInpainter(tmp_path / "one.pt").fill(image, hole, ~hole)
    assert "\n" not in str(caught.value)


def grey_paint(*, external: str | None = None, gain: float = 1.0) -> bytes:
    """Return an ONNX network that fills the hole with the colour (0.25, 0.5, 0.75) times ``gain``. With ``external``,
    the colour is in a separate file of that name."""
    names = ("batch", "height", "width")
    return onnx.model(
        [
            onnx.node("Sub", ["one", "mask"], ["keep"]),
            onnx.node("Mul", ["image", "keep"], ["kept"]),
            onnx.node("Mul", ["colour", "mask"], ["painted"]),
            onnx.node("Add", ["kept", "painted"], ["sum"]),
            onnx.node("Mul", ["sum", "gain"], ["output"]),
        ],
        [
            onnx.tensor("one", [1, 1, 1, 1], [1.0]),
            onnx.tensor("gain", [1, 1, 1, 1], [gain]),
            onnx.tensor("colour", [1, 3, 1, 1], [0.25, 0.5, 0.75], external=external),
        ],
        [onnx.value("mask", [names[0], 1, *names[1:]]), onnx.value("image", [names[0], 3, *names[1:]])],
        [onnx.value("output", [names[0], 3, *names[1:]])],
    )


@pytest.mark.parametrize("gain", [1.0, 255.0])
def test_an_onnx_network_fills_the_hole(gain: float, tmp_path: Path) -> None:
    (tmp_path / "grey.onnx").write_bytes(grey_paint(gain=gain))
    image, hole = holed()
    filled = inpainter_by_name(str(tmp_path / "grey.onnx")).fill(image, hole, ~hole)
    assert np.array_equal(filled[~hole], image[~hole])
    assert filled[hole] == pytest.approx(np.tile([0.25, 0.5, 0.75], (hole.sum(), 1)), abs=1e-6)


def test_onnx_external_data_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV itself would open such files, relative to the working folder."""
    (tmp_path / "secret").write_bytes(np.array([9, 9, 9], np.float32).tobytes())
    (tmp_path / "grey.onnx").write_bytes(grey_paint(external="secret"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"grey\.onnx: some of its numbers are in other files, which are not read"):
        inpainter_by_name("grey.onnx")


def test_bad_onnx_files(tmp_path: Path) -> None:
    for data, said in (
        (b"weights", "not an ONNX file"),
        (b"", "not an ONNX file of a network with inputs"),
        (onnx.model([], [], [onnx.value("image", [1, 3, 8, 8])], []), r"takes 1 inputs \(image\)"),
        (grey_paint()[:-40], "not an ONNX file"),
        (grey_paint().replace(b"Sub", b"Sob"), "OpenCV cannot read this network"),
    ):
        (tmp_path / "bad.onnx").write_bytes(data)
        with pytest.raises(UserError, match=rf"bad\.onnx: .*{said}") as caught:
            inpainter_by_name(str(tmp_path / "bad.onnx"))
        assert "\n" not in str(caught.value)


def test_a_torchscript_file_is_not_loaded_unless_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[object] = []
    monkeypatch.setattr(torch.jit, "load", loaded.append)
    path = traced(MeanOfTheKnown(), tmp_path / "mean.pt")
    # Whatever the name of a file is, it does not reach torch if its content is not ONNX.
    disguised = path.with_suffix(".net")
    disguised.write_bytes(path.read_bytes())
    with pytest.raises(
        UserError, match=r"loading a TorchScript file runs the program in it; give an ONNX file, or say"
    ):
        inpainter_by_name(str(path))
    with pytest.raises(UserError, match=r"mean\.net: not an ONNX file"):
        inpainter_by_name(str(disguised))
    assert loaded == []
