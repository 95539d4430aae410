"""Backward pass of the projection by SIMD lanes on a CPU, compared with the kernel for one Gaussian, and the sums of
moments and the segments of long tile lists on a GPU."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from egs_warp.geometry.camera import Camera
from egs_warp.kernels.render.backward import project_backward_kernel
from egs_warp.kernels.render.backward_cpu import project_backward_block_kernel
from egs_warp.kernels.render.moments import FEW_SLOTS, LANES, add_moments_kernel
from egs_warp.kernels.render.projection_cpu import BLOCK
from egs_warp.render.projection import view_from_camera

torch = pytest.importorskip("torch")
from egs_warp.render.autograd import render_torch  # noqa: E402


@pytest.mark.parametrize(("antialiased", "coefficients"), [(0, 1), (1, 16)])
def test_lanes_equal_the_kernel_for_one_gaussian(antialiased: int, coefficients: int) -> None:
    """The moments of 1003 Gaussians are random; a third of the Gaussians reach no tile."""
    random, count = np.random.default_rng(5), 1003
    slot_end = np.cumsum(random.integers(0, 3, count))

    def array(values: np.ndarray, dtype: type = wp.float32) -> wp.array:
        return wp.array(values, dtype=dtype, device="cpu")

    rotations = random.normal(size=(count, 4))
    rotations[:9] = 0.0
    inputs = [
        array(random.uniform(-2, 2, (count, 3)), wp.vec3),
        array(rotations, wp.vec4),
        array(random.normal(-2.5, 0.7, (count, 3)), wp.vec3),
        array(random.normal(0.0, 3.0, count)),
        array(random.normal(0, 0.4, (count, coefficients, 3)), wp.vec3),
        array(slot_end, wp.int64),
        array(random.normal(size=(slot_end[-1], 3, 4)), wp.vec4),
    ]
    eye, up = np.array([0.3, -0.4, -5.0]), np.array([0, -1.0, 0])
    view = view_from_camera(Camera.look_at(eye, np.zeros(3), up, width=67, height=45))
    results = []
    launches = (project_backward_kernel, count, [None]), (project_backward_block_kernel, -(-count // int(BLOCK)), [])
    for kernel, rows, is_blocked in launches:
        outputs = [wp.empty_like(values) for values in inputs[:5]]
        wp.launch(kernel, rows, inputs=[0, view, antialiased, *inputs, *is_blocked], outputs=outputs, device="cpu")
        results.append([values.numpy() for values in outputs])
    for expected, got in zip(*results, strict=True):
        scale = np.abs(expected.reshape(count, -1)).max(axis=1)
        error = np.abs(got - expected).reshape(count, -1).max(axis=1)
        assert (error <= 1e-4 * scale + 1e-6).all()
        assert (scale > 0).any() and (scale == 0).any()


@pytest.mark.cuda
def test_warps_add_the_moments_of_large_gaussians() -> None:
    """A GPU writes the sum over the slots of a Gaussian that has many to the first of them, and changes no others."""
    random, count, device = np.random.default_rng(6), 1003, "cuda:0"
    slots = random.integers(0, 40, count)
    slots[:5] = 3000
    slot_end = np.cumsum(slots)
    moments = random.normal(size=(slot_end[-1], 3, 4)).astype(np.float32)
    on_device = wp.array(moments, dtype=wp.vec4, device=device)
    warps = -(-count // int(LANES))
    wp.launch(
        add_moments_kernel,
        warps * int(LANES),
        inputs=[warps, wp.array(slot_end, dtype=wp.int64, device=device)],
        outputs=[on_device],
        device=device,
    )
    expected = moments.copy()
    for start, end in zip(slot_end - slots, slot_end, strict=True):
        if end - start > int(FEW_SLOTS):
            expected[start] = moments[start:end].sum(axis=0, dtype=np.float64)
    np.testing.assert_allclose(on_device.numpy(), expected, atol=1e-4)


@pytest.mark.cuda
@pytest.mark.parametrize("opacity_logit", [-6.0, -2.0])
def test_segments_of_long_lists_give_the_gradients_of_a_cpu(opacity_logit: float) -> None:
    """A tile with thousands of splats is divided into segments, which start from the checkpoints of the forward pass;
    of opaque splats, most lie behind the end of compositing."""
    random, count = np.random.default_rng(7), 5000
    camera = Camera(30, 20, 40.0, 40.0, 15.0, 10.0, np.eye(3), np.zeros(3))
    attributes = [
        np.column_stack([random.uniform(-0.3, 0.3, (count, 2)), random.uniform(1.0, 2.0, count)]),
        random.normal(size=(count, 4)),
        random.uniform(-4.0, -2.0, (count, 3)),
        random.normal(opacity_logit, 0.5, count),
        random.normal(size=(count, 1, 3)),
    ]
    weights = random.normal(size=(20, 30, 5))

    def gradients(device: str) -> list[np.ndarray]:
        inputs = [torch.tensor(value, dtype=torch.float32, device=device).requires_grad_() for value in attributes]
        means, rotations, log_scales, opacity_logits, sh = inputs
        picture = render_torch(means, rotations, log_scales, opacity_logits, sh, camera)
        by_channel = torch.tensor(weights, dtype=torch.float32, device=device)
        channels = torch.cat([picture.colour, picture.alpha[..., None], picture.depth[..., None]], dim=2)
        (channels * by_channel).sum().backward()
        return [tensor.grad.cpu().numpy() for tensor in inputs]

    for expected, got in zip(gradients("cpu"), gradients("cuda:0"), strict=True):
        assert np.abs(got - expected).max() <= 1e-2 * np.abs(expected).max()
        assert np.linalg.norm(got - expected) <= 2e-3 * np.linalg.norm(expected)
