"""Gradients of the renderer, compared with finite differences of the float64 reference."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from tests.support.render_twin import render_twin

torch = pytest.importorskip("torch")
from egs_warp.render.autograd import render_torch  # noqa: E402

NAMES = ("means", "rotations", "log_scales", "opacity_logits", "sh")


def clear_scene(seed: int = 1) -> tuple[dict[str, np.ndarray], Camera]:
    """Return soft splats that are wider than the image, with well-separated depths and positive colours, so that they
    are far from any discontinuity of the renderer."""
    random = np.random.default_rng(seed)
    count = 7
    values = {
        "means": np.column_stack([random.uniform(-0.3, 0.3, (count, 2)), np.linspace(-0.5, 0.5, count)]),
        "rotations": random.normal(size=(count, 4)),
        "log_scales": random.uniform(0.1, 0.7, (count, 3)),
        "opacity_logits": random.uniform(-0.5, 0.5, count),
        "sh": random.normal(0, 0.15, (count, 16, 3)),
    }
    camera = Camera.look_at(np.array([0.2, -0.3, -3.0]), np.zeros(3), np.array([0, -1.0, 0]), width=21, height=18)
    return values, camera


def weights(camera: Camera) -> dict[str, np.ndarray]:
    random = np.random.default_rng(9)
    shape = (camera.height, camera.width)
    return {
        "colour": random.normal(size=(*shape, 3)),
        "alpha": random.normal(size=shape),
        "depth": random.normal(size=shape),
    }


def loss_of_twin(values: dict[str, np.ndarray], camera: Camera, **options: Any) -> float:
    picture = render_twin(values, camera, **options)
    return sum(float((w * picture[name]).sum()) for name, w in weights(camera).items())


def gradients(values: dict[str, np.ndarray], camera: Camera, device: str, **options: Any) -> dict[str, np.ndarray]:
    tensors = {
        name: torch.tensor(values[name], dtype=torch.float32, device=device, requires_grad=True) for name in NAMES
    }
    pose = {
        "rotation": torch.tensor(camera.rotation, device=device, requires_grad=True),
        "translation": torch.tensor(camera.translation, device=device, requires_grad=True),
    }
    image = render_torch(*tensors.values(), camera=camera, **pose, **options)
    loss = torch.stack(
        [
            (torch.tensor(w, dtype=torch.float32, device=device) * getattr(image, name)).sum()
            for name, w in weights(camera).items()
        ]
    ).sum()
    loss.backward()
    return {name: tensor.grad.double().cpu().numpy() for name, tensor in {**tensors, **pose}.items()}


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_match_finite_differences(device: str, antialiased: bool) -> None:
    values, camera = clear_scene()
    options = {"background": (0.2, 0.5, 0.9), "antialiased": antialiased}
    got = gradients(values, camera, device, **options)
    step = 1e-5
    for name in NAMES:
        expected = np.zeros_like(values[name])
        for index in np.ndindex(values[name].shape):
            sides = []
            for sign in (1, -1):
                moved = {k: v.copy() for k, v in values.items()}
                moved[name][index] += sign * step
                sides.append(loss_of_twin(moved, camera, **options))
            expected[index] = (sides[0] - sides[1]) / (2 * step)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(got[name], expected, atol=2e-4 * scale, err_msg=name)
    for name in ("rotation", "translation"):
        original = getattr(camera, name)
        expected = np.zeros_like(original)
        for index in np.ndindex(original.shape):
            sides = []
            for sign in (1, -1):
                moved = original.copy()
                moved[index] += sign * step
                sides.append(_loss_with_pose(values, camera, {name: moved}, options))
            expected[index] = (sides[0] - sides[1]) / (2 * step)
        np.testing.assert_allclose(got[name], expected, atol=2e-4 * np.abs(expected).max(), err_msg=name)


def _loss_with_pose(values: dict, camera: Camera, change: dict, options: dict) -> float:
    return loss_of_twin(values, replace(camera, **change), **options)


def many_splats(count: int = 800) -> tuple[dict[str, np.ndarray], Camera]:
    random = np.random.default_rng(2)
    values = {
        "means": random.uniform(-1, 1, (count, 3)),
        "rotations": random.normal(size=(count, 4)),
        "log_scales": random.normal(-2.5, 0.7, (count, 3)),
        "opacity_logits": random.normal(1.0, 2.0, count),
        "sh": random.normal(0, 0.3, (count, 4, 3)),
    }
    return values, Camera.look_at(np.array([0.2, -0.3, -3.0]), np.zeros(3), np.array([0, -1.0, 0]), width=90, height=70)


def test_directional_derivative_of_a_crowded_scene(device: str) -> None:
    """A step along the gradient changes the loss of the float64 reference as predicted, for hundreds of overlapping
    splats and pixels that are opaque before the last splat."""
    values, camera = many_splats(300)
    got = gradients(values, camera, device)
    random = np.random.default_rng(3)
    for name in ("log_scales", "sh", "opacity_logits"):
        direction = random.normal(size=values[name].shape)
        step = 2e-6
        sides = [loss_of_twin(values | {name: values[name] + sign * step * direction}, camera) for sign in (1, -1)]
        slope = (sides[0] - sides[1]) / (2 * step)
        expected = (got[name] * direction).sum()
        assert slope == pytest.approx(expected, rel=0.02, abs=0.02 * float(np.linalg.norm(got[name]))), name


def test_gradients_do_not_depend_on_threads_or_repeats() -> None:
    values, camera = many_splats()
    first = gradients(values, camera, "cpu", threads=1)
    for threads in (1, 2, 5):
        again = gradients(values, camera, "cpu", threads=threads)
        assert all(np.array_equal(first[name], again[name]) for name in first)


@pytest.mark.cuda
def test_cuda_gradients_match_the_cpu_and_repeat() -> None:
    values, camera = many_splats()
    first, again = (gradients(values, camera, "cuda:0") for _ in range(2))
    cpu = gradients(values, camera, "cpu")
    for name in NAMES:
        assert np.array_equal(first[name], again[name]), name
        scale = np.abs(cpu[name]).max()
        off = np.abs(first[name] - cpu[name]) / scale
        assert off.mean() < 1e-5, name
        assert off.max() < 2e-2, name


@pytest.mark.cuda
def test_work_is_queued_on_torchs_stream() -> None:
    """The image is rendered on torch's current stream, so inputs that are still being written on that stream at the
    time of the call are complete."""
    values, camera = many_splats()
    tensors = [torch.tensor(values[name], dtype=torch.float32, device="cuda") for name in NAMES]
    expected = render_torch(*tensors, camera=camera).colour
    torch.cuda.synchronize()
    side = torch.cuda.Stream()
    with torch.cuda.stream(side):
        moved = [torch.empty_like(tensor) for tensor in tensors]
        torch.cuda._sleep(50_000_000)
        for to, tensor in zip(moved, tensors, strict=True):
            to.copy_(tensor)
        got = render_torch(*moved, camera=camera).colour.clone()
    side.synchronize()
    assert torch.equal(got, expected)


def test_a_picture_without_gradients_has_the_same_bits(device: str) -> None:
    values, camera = many_splats()
    tensors = [torch.tensor(values[name], dtype=torch.float32, device=device) for name in NAMES]
    plain = render_torch(*tensors, camera=camera)
    recorded = render_torch(*(tensor.clone().requires_grad_() for tensor in tensors), camera=camera)
    with torch.no_grad():
        again = render_torch(*(tensor.clone().requires_grad_() for tensor in tensors), camera=camera)
    for name in ("colour", "alpha", "depth"):
        assert getattr(recorded, name).requires_grad and not getattr(again, name).requires_grad
        assert torch.equal(getattr(plain, name), getattr(recorded, name))
        assert torch.equal(getattr(plain, name), getattr(again, name))


def test_images_keep_the_memory_of_their_gradients(device: str) -> None:
    """Two images are rendered before the backward pass of either of them; memory that the gradients need is not
    reused."""
    values, camera = many_splats()
    nearer = replace(camera, translation=camera.translation - [0.0, 0.0, 0.8])

    def prepared(camera: Camera) -> tuple[list[Any], Any]:
        leaves = [torch.tensor(values[n], dtype=torch.float32, device=device, requires_grad=True) for n in NAMES]
        return leaves, render_torch(*leaves, camera=camera).colour.square().sum()

    def finished(leaves: list[Any], loss: Any) -> list[Any]:
        loss.backward()
        return [leaf.grad for leaf in leaves]

    alone = [finished(*prepared(camera)), finished(*prepared(nearer))]
    waiting = [prepared(camera), prepared(nearer)]
    together = [finished(*one) for one in reversed(waiting)][::-1]
    for one, other in zip(alone, together, strict=True):
        assert all(torch.equal(a, b) and a.abs().sum() > 0 for a, b in zip(one, other, strict=True))


def test_masked_tiles_show_the_background_and_have_no_gradient(device: str) -> None:
    """Gradients equal those of a loss without the masked tiles. The tiles have the same size as in gsplat's masks."""
    values, camera = many_splats()
    mask = np.random.default_rng(5).random((5, 6)) < 0.5
    pixels = torch.tensor(np.kron(mask, np.ones((16, 16), bool))[:70, :90], device=device)
    weight = torch.tensor(weights(camera)["colour"], dtype=torch.float32, device=device)

    def drawn(mask: np.ndarray | None, weight: Any) -> tuple[Any, list[Any]]:
        leaves = [torch.tensor(values[n], dtype=torch.float32, device=device, requires_grad=True) for n in NAMES]
        image = render_torch(*leaves, camera=camera, background=(0.2, 0.4, 0.6), mask=mask)
        (image.colour * weight).sum().backward()
        return image, [leaf.grad for leaf in leaves]

    part, part_gradients = drawn(mask, weight)
    whole, whole_gradients = drawn(None, weight * pixels[:, :, None])
    behind = torch.tensor([0.2, 0.4, 0.6], device=device)
    assert torch.equal(part.colour, torch.where(pixels[:, :, None], whole.colour, behind))
    assert torch.equal(part.alpha, whole.alpha * pixels) and torch.equal(part.depth, whole.depth * pixels)
    for one, other in zip(part_gradients, whole_gradients, strict=True):
        assert torch.equal(one, other) and one.abs().sum() > 0
    with pytest.raises(
        UserError, match=r"^mask: give 5 x 6 booleans, one for each tile of 16 x 16 pixels, not bool of"
    ):
        drawn(mask[:4], weight)


def test_pixels_share_memory_and_bad_tensors_are_named() -> None:
    values, camera = clear_scene()
    tensors = [torch.tensor(values[name], dtype=torch.float32) for name in NAMES]
    image = render_torch(*tensors, camera=camera)
    twin = render_twin(values, camera)
    np.testing.assert_allclose(image.colour.numpy(), twin["colour"], atol=1e-5)
    assert image.visible().all()
    with pytest.raises(
        UserError, match=r"rotations is \(7, 3\) torch.float32 on cpu, expected \(7, 4\) float32 on cpu"
    ):
        render_torch(tensors[0], tensors[1][:, :3], *tensors[2:], camera=camera)
    with pytest.raises(UserError, match="rotation and translation together"):
        render_torch(*tensors, camera=camera, rotation=torch.eye(3))


def test_screen_positions_get_a_gradient_on_request(device: str) -> None:
    """A shift of all splats on the screen equals a shift of the principal point, so the sum of the splats' gradients
    equals the gradient of the camera."""
    values, camera = clear_scene()
    tensors = [torch.tensor(values[name], dtype=torch.float32, device=device, requires_grad=True) for name in NAMES]
    screen = torch.zeros((len(values["means"]), 2), device=device, requires_grad=True)
    image = render_torch(*tensors, camera=camera, screen=screen, background=(0.2, 0.5, 0.9))
    weight = torch.tensor(weights(camera)["colour"], dtype=torch.float32, device=device)
    (weight * image.colour).sum().backward()
    assert screen.grad is not None
    step = 1e-4
    for axis, name in enumerate(("cx", "cy")):
        sides = []
        for sign in (1, -1):
            moved = replace(camera, **{name: getattr(camera, name) + sign * step})
            picture = render_twin(values, moved, background=(0.2, 0.5, 0.9))
            sides.append(float((weights(camera)["colour"] * picture["colour"]).sum()))
        expected = (sides[0] - sides[1]) / (2 * step)
        assert float(screen.grad[:, axis].sum()) == pytest.approx(expected, rel=2e-3, abs=2e-3)


@pytest.mark.parametrize(
    "case", ["none visible", "covers all", "one pixel", "inside", "opaque", "clear", "tiny", "flat"]
)
def test_degenerate_scenes_have_finite_gradients(device: str, case: str) -> None:
    """Scenes without a visible splat give exactly zero gradients. Degenerate scenes give finite ones, also in the
    antialiased mode, which divides by the area."""
    values, camera = clear_scene()
    values = {name: value.copy() for name, value in values.items()}
    if case == "none visible":
        values["means"] += 100.0 * camera.rotation[2] * np.array([-1.0])
    elif case == "covers all":
        values["log_scales"] += 6.0
    elif case == "one pixel":
        camera = replace(camera, width=1, height=1, cx=0.5, cy=0.5)
    elif case == "inside":
        values["means"][3] = camera.centre + 0.02 * camera.rotation[2]
    elif case == "opaque":
        values["opacity_logits"][:] = 100.0
    elif case == "clear":
        values["opacity_logits"][:] = -100.0
    elif case == "tiny":
        values["log_scales"][:] = -10.0
    elif case == "flat":
        values["log_scales"][:, 2] = -15.0
    for antialiased in (False, True):
        got = gradients(values, camera, device, antialiased=antialiased)
        for name, value in got.items():
            assert np.isfinite(value).all(), (name, antialiased)
            if case in ("none visible", "clear"):
                assert not value.any(), (name, antialiased)
