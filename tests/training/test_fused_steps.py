"""Training steps without autograd, which equal those with autograd."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud
from egs_warp.kernels.render.projection import View
from egs_warp.kernels.training.fused_step import (
    StepPlan,
    begin_step_kernel,
    check_capacity_kernel,
    update_shapes_kernel,
)
from egs_warp.launching import launch_rows, zeros
from egs_warp.render.projection import view_from_camera
from tests.support.training_views import ball, ring

torch = pytest.importorskip("torch")
from egs_warp.training import fused_steps  # noqa: E402
from egs_warp.training.finetune import (  # noqa: E402
    Densification,
    FinetuneOptions,
    FinetuneResult,
    LearningRates,
    finetune,
    render_views,
)
from egs_warp.training.fused_steps import FusedSteps  # noqa: E402
from egs_warp.training.training_view import TrainingView  # noqa: E402

OPTIONS = FinetuneOptions(
    iterations=230,
    background=(0.2, 0.3, 0.4),
    densification=Densification.RELOCATION,
    max_gaussians=90,
    sh_steps=20,
    fit_exposure=True,
)


def pictures(kind: str) -> list[TrainingView]:
    """Return six views: opaque ones of one size or of two, weighted ones of two sizes, or ones with alpha."""
    random = np.random.default_rng(4)
    cloud = GaussianCloud.from_numpy(**ball(60), device="cpu")
    views = render_views(cloud, ring(6, 40))
    if kind == "two sizes":
        views[5] = render_views(cloud, ring(6, 33))[5]
    if kind == "weighted":
        views[3:] = render_views(cloud, ring(6, 33))[3:]
        views[1] = replace(views[1], weight=random.uniform(size=views[1].image.shape[:2]).astype(np.float32).round(1))
    if kind == "cut out":
        views = [replace(v, alpha=random.uniform(0.5, 1, v.image.shape[:2]).astype(np.float32)) for v in views]
    return views


def train(views: list[TrainingView], options: FinetuneOptions, device: str) -> FinetuneResult:
    return finetune(GaussianCloud.from_numpy(**ball(60, seed=5), device=device), views, options=options)


@pytest.mark.parametrize("kind", ["opaque", "weighted", "cut out"])
def test_the_steps_equal_those_of_autograd(kind: str, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without noise, whose random numbers differ, the losses, the exposures and the clouds agree up to rounding. The
    training has three degrees of SH, and ends before the first relocation."""
    monkeypatch.setattr("egs_warp.training.relocation._JITTER", 0.0)
    options = replace(OPTIONS, iterations=60)
    views = pictures(kind)
    results = []
    for devices in ((), ("cpu", "cuda")):
        monkeypatch.setattr("egs_warp.training.finetune._FUSED_ON", devices)
        results.append(train(views, options, device))
    slow, fast = results
    np.testing.assert_allclose(fast.losses, slow.losses, rtol=2e-3)
    assert fast.tones is not None and slow.tones is not None
    np.testing.assert_allclose(fast.tones, slow.tones, atol=2e-3)
    for name in ARRAYS:
        difference = np.abs(getattr(fast.cloud, name).numpy() - getattr(slow.cloud, name).numpy())
        assert np.median(difference, axis=0).max() < 1e-4, name


def test_steps_follow_a_population_that_grows(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a relocation that adds Gaussians, the steps change the new tensors."""
    monkeypatch.setattr("egs_warp.training.finetune._FUSED_ON", ("cpu", "cuda"))
    load, counts = FusedSteps._load, []

    def checked(steps: FusedSteps) -> None:
        load(steps)
        assert steps._gaussians is not None
        assert steps._gaussians._tensors[0].data_ptr() == steps._population.tensors["means"].data_ptr()
        counts.append(steps._gaussians.count)

    monkeypatch.setattr(FusedSteps, "_load", checked)
    train(pictures("opaque"), replace(OPTIONS, iterations=130), device)
    assert counts[0] == 60 < counts[-1]


@pytest.mark.parametrize("kind", ["opaque", "two sizes"])
def test_lists_that_are_too_small_are_enlarged_and_no_step_is_lost(
    kind: str, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first step exceeds lists for one pair, and the first step with a closer view the enlarged lists; each size of
    the photos has its own lists. The result equals that with lists that suffice."""
    monkeypatch.setattr("egs_warp.training.finetune._FUSED_ON", ("cpu", "cuda"))
    monkeypatch.setattr("egs_warp.training.finetune._UNSEEN_STEPS", {"cpu": 7, "cuda": 7})
    options = replace(OPTIONS, iterations=30)
    views = pictures(kind)
    views[2] = replace(views[2], camera=replace(views[2].camera, fx=3 * views[2].camera.fx, fy=3 * views[2].camera.fy))
    roomy = train(views, options, device)
    enlarged: list[int] = []
    enlarge = FusedSteps._enlarge
    monkeypatch.setattr(fused_steps, "_FIRST_PAIRS", 0)
    monkeypatch.setattr(fused_steps, "_HEADROOM", 1.0)
    monkeypatch.setattr(FusedSteps, "_enlarge", lambda self, plan: (enlarged.append(plan.step), enlarge(self, plan)))
    tight = train(views, options, device)
    assert enlarged[0] == 0 and 1 < len(enlarged) < 5
    assert np.array_equal(tight.losses, roomy.losses)
    for name in ARRAYS:
        assert np.array_equal(getattr(tight.cloud, name).numpy(), getattr(roomy.cloud, name).numpy()), name


def test_a_step_after_a_blocked_one_reads_only_its_own_photos_and_does_not_count(device: str) -> None:
    """The plan is that of the blocked step, whose photo is the fifth of its size; of this size, there is one photo."""
    struct: Any = StepPlan
    plans: Any = np.zeros(1, dtype=struct.numpy_dtype())
    plans["picture"] = 4
    view = view_from_camera(ring(1, 4)[0])
    photo = np.random.default_rng(0).uniform(size=(1, 3, 3)).astype(np.float32)
    alpha = photo[:, :, 0]
    view_out = zeros(1, View, device)
    photo_out = wp.zeros(3, dtype=wp.vec3, device=device)
    alpha_out, weight_out = (wp.zeros(3, dtype=wp.float32, device=device) for _ in range(2))
    launch_rows(
        begin_step_kernel,
        3,
        inputs=[
            wp.array(plans, dtype=StepPlan, device=device),
            wp.zeros(1, dtype=wp.int32, device=device),
            wp.array([view], dtype=View, device=device),
            wp.zeros((1, 12), dtype=wp.float32, device=device),
            wp.array(photo, dtype=wp.vec3, device=device),
            *(wp.array(alpha, dtype=wp.float32, device=device) for _ in range(2)),
        ],
        outputs=[
            *(view_out, wp.zeros(12, dtype=wp.float32, device=device), wp.zeros(1, dtype=wp.vec3, device=device)),
            *(photo_out, alpha_out, weight_out),
        ],
        device=wp.get_device(device),
    )
    assert view_out.numpy()[0]["width"] == 4 and np.array_equal(photo_out.numpy(), photo[0])
    assert np.array_equal(alpha_out.numpy(), alpha[0]) and np.array_equal(weight_out.numpy(), alpha[0])
    for is_blocked, counted in ((1, 3), (0, 9)):
        blocked = wp.full(1, is_blocked, dtype=wp.int32, device=device)
        max_pairs = wp.full(1, 3, dtype=wp.int64, device=device)
        slot_end = wp.full(1, 9, dtype=wp.int64, device=device)
        wp.launch(check_capacity_kernel, 1, inputs=[5, slot_end], outputs=[blocked, max_pairs], device=device)
        assert blocked.numpy()[0] == 1 and max_pairs.numpy()[0] == counted


def test_a_new_sh_band_leaves_the_arrays_of_earlier_graphs_allocated(device: str) -> None:
    """The gradients of one band and of two start at the same address."""
    where = "cuda" if device != "cpu" else "cpu"
    tensors = [torch.zeros(shape, device=where) for shape in ((5, 3), (5, 4), (5, 3), (5,)) for _ in range(3)]
    gaussians = fused_steps._Gaussians(tensors, 4, 0, wp.get_device(device))
    band, bands = gaussians.trained(1), gaussians.trained(4)
    assert gaussians.trained(1) is band
    assert len({array.ptr for arrays in (band, bands) for array in arrays[1:]}) == 1
    assert band[1].shape == (5, 1) and bands[2].shape == (60,)


def test_photos_of_many_sizes_are_trained_with_autograd(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("egs_warp.training.finetune._FUSED_ON", ("cpu", "cuda"))
    monkeypatch.setattr("egs_warp.training.finetune.FusedSteps", None)
    options = replace(OPTIONS, iterations=2)
    monkeypatch.setattr("egs_warp.training.finetune.MAX_GROUPS", 1)
    assert np.isfinite(train(pictures("two sizes"), options, device).losses).all()
    with pytest.raises(TypeError):
        train(pictures("opaque"), options, device)


@pytest.mark.parametrize("function", ["empty", "pair_buffers"])
def test_photos_that_do_not_fit_into_the_memory_are_reported(
    function: str, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both when the photos are uploaded and when the tile lists are allocated."""

    def no_memory(*_: object, **__: object) -> None:
        raise RuntimeError("Failed to allocate 123 bytes")

    monkeypatch.setattr("egs_warp.training.finetune._FUSED_ON", ("cpu", "cuda"))
    monkeypatch.setattr(fused_steps, function, no_memory)
    message = "^finetune: 60 Gaussians and 6 photos of up to 40 x 40 pixels do not fit into the memory of .*; train"
    with pytest.raises(UserError, match=message):
        train(pictures("two sizes"), replace(OPTIONS, iterations=2), device)


def test_a_gaussian_that_is_not_finite_is_reported(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("egs_warp.training.finetune._FUSED_ON", ("cpu", "cuda"))
    options = replace(OPTIONS, iterations=30, rates=LearningRates(means=1e39))
    with pytest.raises(UserError, match="finetune: at step 1 a Gaussian is not finite"):
        train(pictures("opaque"), options, device)


def test_the_noise_equals_that_of_mcmc(device: str) -> None:
    """The displacements of faint Gaussians have the covariance of ``Population.jitter``, and those of consecutive steps
    and of neighbours are independent."""
    count, size, scales = 20_000, 0.3, np.array([0.8, 0.3, 0.1])
    struct: Any = StepPlan
    plans: Any = np.zeros(2, dtype=struct.numpy_dtype())
    plans["noise"], plans["seed"], plans["first_bias"], plans["second_bias"] = size, (7, 8), 1.0, 1.0
    types = {"means": wp.vec3, "rotations": wp.vec4, "log_scales": wp.vec3, "opacity_logits": wp.float32}
    zeros = {name: [wp.zeros(count, dtype=dtype, device=device) for _ in range(4)] for name, dtype in types.items()}
    zeros["rotations"][0].fill_(wp.vec4(1.0, 0.0, 0.0, 0.0))
    zeros["log_scales"][0].fill_(wp.vec3(*np.log(scales)))
    zeros["opacity_logits"][0].fill_(float(np.log(0.005 / 0.995)))
    moved = []
    for step in range(2):
        zeros["means"][0].zero_()
        cursor = wp.full(1, step, dtype=wp.int32, device=device)
        blocked = wp.zeros(1, dtype=wp.int32, device=device)
        launch_rows(
            update_shapes_kernel,
            count,
            inputs=[
                *(wp.array(plans, dtype=StepPlan, device=device), cursor, blocked, 0.0, 0.0, -10.0, 0.005),
                *(arrays[3] for arrays in zeros.values()),
            ],
            outputs=[array for arrays in zeros.values() for array in arrays[:3]],
            device=wp.get_device(device),
        )
        moved.append(zeros["means"][0].numpy().astype(float) / (0.5 * size * scales**2))
    tolerance = 5 * np.sqrt(2 / count)
    for unit in moved:
        np.testing.assert_allclose(unit.T @ unit / count, np.eye(3), atol=tolerance)
        np.testing.assert_allclose(unit[1:].T @ unit[:-1] / count, 0.0, atol=tolerance)
    np.testing.assert_allclose(moved[0].T @ moved[1] / count, 0.0, atol=tolerance)
