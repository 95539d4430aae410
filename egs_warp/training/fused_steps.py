"""Steps of a training run that launch Warp kernels only and never wait for the GPU, so that they can be CUDA graphs.

The steps equal those of ``AutogradSteps`` up to rounding and the random numbers of the noise. The kernels besides those
of the renderer and of the loss are in ``egs_warp/kernels/training/fused_step.py``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.kernels.render.backward import project_backward_into_view_kernel
from egs_warp.kernels.render.projection import View, project_into_view_kernel
from egs_warp.kernels.training.fused_step import (
    PARTS,
    SUMS,
    TONE_ENTRIES,
    StepPlan,
    begin_step_kernel,
    check_capacity_kernel,
    end_step_kernel,
    shift_tones_kernel,
    sum_parts_kernel,
    sum_pixels_kernel,
    tone_step_kernel,
    update_sh_kernel,
    update_shapes_kernel,
)
from egs_warp.launching import available_threads, empty, grow_capacity, launch_cached, launch_rows, zeros
from egs_warp.render.autograd import torch_stream
from egs_warp.render.backward import composite_backward
from egs_warp.render.compositing import Background, RenderedImage, composite
from egs_warp.render.projection import ProjectedGaussians, view_from_camera
from egs_warp.render.rasteriser import translate_failed_allocation
from egs_warp.render.tiles import TILE_SIDE, PairBuffers, pair_buffers, sort_pairs
from egs_warp.training.exposure import REGULARIZATION, TYPICAL_OFFSET, ExposureModel
from egs_warp.training.gaussian_tensors import MIN_LOG_SCALE
from egs_warp.training.photo_loss import LossArrays, PhotoLoss
from egs_warp.training.planned_step import PlannedStep
from egs_warp.training.relocation import FAINT, Population
from egs_warp.training.training_view import TrainingView

_HEADROOM = 1.25
"""Ratio of the capacity of the tile lists to the largest number of pairs of any step so far."""
_FIRST_PAIRS = 4
"""Number of pairs for each Gaussian that are expected before the first step."""
_MAX_PAIRS = 2**30
MAX_GROUPS = 8
"""Maximum number of groups of photos of equal size, because each has tile lists and other arrays of its own."""
_SUM_THREADS = 8192
"""Number of threads that sum over the pixels of an image."""
_SHAPES = ("means", "rotations", "log_scales", "opacity_logits")
_TYPES = {"means": wp.vec3, "rotations": wp.vec4, "log_scales": wp.vec3, "opacity_logits": wp.float32}


class FusedSteps:
    """Steps of Adam on photos with exposures.

    ``run`` changes copies of the SH coefficients; call ``store`` before the population is used otherwise.
    """

    def __init__(
        self,
        views: Sequence[TrainingView],
        factors: set[int],
        population: Population,
        tones: ExposureModel,
        *,
        background: tuple[float, float, float],
        ssim_weight: float,
        antialiased: bool,
        relocating: bool,
        max_steps: int,
        seed: int,
        threads: int | None,
    ) -> None:
        self._population, self._tones = population, tones
        self._antialiased, self._relocating, self._seed = antialiased, relocating, seed
        self._torch_device = population.tensors["means"].device
        self._device = wp.device_from_torch(self._torch_device)
        self._threads = threads or available_threads()
        self._loss = PhotoLoss(ssim_weight, str(self._torch_device), threads)
        largest = max((view.camera for view in views), key=lambda camera: camera.width * camera.height)
        self._photos = f"{len(views)} photos of up to {largest.width} x {largest.height} pixels"
        with self._translate_failed_allocation():
            self._groups, self._places = _groups_of(views, factors, background, self._device)
        self._gaussians: _Gaussians | None = None
        self._programs: dict[tuple[int, int], _Program] = {}
        self._capture_stream: wp.Stream | None = None
        self._is_loaded = False
        self._next_step = 0
        self._plans = zeros(max_steps, StepPlan, self._device)
        self._losses = zeros(max_steps, wp.float32, self._device)
        self._cursor, self._is_blocked = zeros(1, wp.int32, self._device), zeros(1, wp.int32, self._device)
        self._max_pairs = zeros(1, wp.int64, self._device)
        self._change = zeros(int(TONE_ENTRIES), wp.float32, self._device)
        self._sums = zeros((int(SUMS), _SUM_THREADS), wp.float32, self._device)
        self._parts = zeros((int(SUMS), int(PARTS)), wp.float32, self._device)
        self._tone_arrays = [_array(t, wp.float32, len(views), 12) for t in (tones.offsets, tones.first, tones.second)]

    def run(self, plans: Sequence[PlannedStep]) -> list[float]:
        """Take the steps, at most ``max_steps``, and return their losses.

        Raises:
            UserError: a Gaussian is not finite, or the pairs of Gaussians and tiles are too many or do not fit into the
                memory.
        """
        with torch_stream(self._torch_device), self._translate_failed_allocation():
            self._load()
            self._upload(plans)
            done = 0
            while True:
                for plan in plans[done:]:
                    self._launch(plan)
                done = int(self._cursor.numpy()[0])
                if done == len(plans):
                    break
                # The lists of this step were too small, so neither this step nor the next ones changed anything.
                self._enlarge(plans[done])
            self._next_step = plans[-1].step + 1
            return self._losses.numpy()[: len(plans)].tolist()

    def store(self) -> None:
        """Copy the SH coefficients and their moments to the tensors of the population."""
        if not self._is_loaded or self._gaussians is None:
            return
        self._is_loaded = False
        for combined, parts in zip(self._gaussians.sh, self._sh_parts(), strict=True):
            parts[0].copy_(combined[:, :1])
            parts[1].copy_(combined[:, 1:])
        self._population.set_step_count(self._next_step)

    def _translate_failed_allocation(self) -> AbstractContextManager[None]:
        """Convert a failed allocation to a ``UserError`` about this training run."""
        needed = f"finetune: {len(self._population.tensors['means'])} Gaussians and {self._photos}"
        return translate_failed_allocation(self._device, needed, "train with smaller or fewer photos, fewer Gaussians")

    def _sh_parts(self) -> list[list[torch.Tensor]]:
        """Return band 0 and the higher bands of the coefficients, of the first, and of the second moments."""
        names = ("sh_band_0", "sh_rest")
        tensors = [self._population.tensors[name].detach() for name in names]
        moments = [self._population.moments(name) for name in names]
        return [tensors, [pair[0] for pair in moments], [pair[1] for pair in moments]]

    def _load(self) -> None:
        """Copy the SH coefficients and their moments from the population, and prepare for its number of Gaussians."""
        if self._is_loaded:
            return
        population = self._population
        if self._gaussians is None or self._gaussians.version != population.version:
            # The old arrays are released first.
            self._programs.clear()
            self._gaussians = None
            tensors = [t for name in _SHAPES for t in (population.tensors[name].detach(), *population.moments(name))]
            coefficients = 1 + population.tensors["sh_rest"].shape[1]
            self._gaussians = _Gaussians(tensors, coefficients, population.version, self._device)
        for combined, parts in zip(self._gaussians.sh, self._sh_parts(), strict=True):
            torch.cat(parts, dim=1, out=combined)
        self._is_loaded = True

    def _upload(self, plans: Sequence[PlannedStep]) -> None:
        """Upload the plans of the next steps."""
        struct: Any = StepPlan
        rows: Any = np.zeros(len(plans), dtype=struct.numpy_dtype())
        for row, plan in zip(rows, plans, strict=True):
            steps = plan.step + 1
            row["view"], row["picture"] = plan.view, self._places[plan.factor, plan.view][1]
            row["backdrop"] = plan.background
            for name, rate in plan.rates.items():
                row[name] = rate
            row["first_bias"], row["second_bias"] = 1 - 0.9**steps, math.sqrt(1 - 0.999**steps)
            row["tone_rate"], row["tone_bias"] = plan.tone_rate, plan.tone_bias
            row["noise"] = self._population.noise_size(plan.rates["means"]) if self._relocating else 0.0
            row["seed"] = (1_000_003 * self._seed + plan.step) % 2**31
        source = wp.array(rows, dtype=StepPlan, device="cpu")
        wp.copy(self._plans, source, count=len(plans))
        for counter in (self._cursor, self._is_blocked, self._max_pairs):
            counter.zero_()

    def _launch(self, plan: PlannedStep) -> None:
        """Queue one step: as a CUDA graph from the second step with the same shapes on."""
        number = self._places[plan.factor, plan.view][0]
        group = self._groups[number]
        assert self._gaussians is not None
        if group.buffers is None:
            self._allocate_lists(group, _FIRST_PAIRS * self._gaussians.count)
        program = self._programs.setdefault((number, plan.coefficients), _Program())
        if program.graph is not None:
            wp.capture_launch(program.graph)
        elif program.has_run and self._device.is_cuda:
            # CUDA cannot capture PyTorch's default stream.
            stream = self._capture_stream = self._capture_stream or wp.Stream(self._device)
            with (
                wp.ScopedStream(stream, sync_enter=False),
                wp.ScopedCapture(stream=stream, force_module_load=False) as capture,
            ):
                self._queue(group, plan.coefficients)
            program.graph = capture.graph
            wp.capture_launch(program.graph)
        else:
            self._queue(group, plan.coefficients)
            program.has_run = True

    def _enlarge(self, plan: PlannedStep) -> None:
        """Enlarge the tile lists of the step that could not be taken, or raise ``UserError`` if that is impossible."""
        pairs = int(self._max_pairs.numpy()[0])
        if not 0 <= pairs < _MAX_PAIRS:
            raise UserError(
                f"finetune: at step {plan.step} a Gaussian is not finite, or there are too many pairs of Gaussians and"
                " tiles; lower the rates or check the views"
            )
        self._allocate_lists(self._groups[self._places[plan.factor, plan.view][0]], int(_HEADROOM * pairs))
        self._is_blocked.zero_()

    def _allocate_lists(self, group: _Group, pairs: int) -> None:
        """Allocate the tile lists of ``group``, and release those of the groups with other resolutions."""
        for number, other in enumerate(self._groups):
            if other is group or other.factor != group.factor:
                other.buffers = other.moments = None
                # Their graphs contain the addresses of these arrays.
                for key in [key for key in self._programs if key[0] == number]:
                    del self._programs[key]
        tiles = -(-group.camera.width // TILE_SIDE) * -(-group.camera.height // TILE_SIDE)
        group.buffers = pair_buffers(max(pairs, 1), tiles, self._device, for_gradients=True)
        group.moments = empty((grow_capacity(max(pairs, 1)), 3), wp.vec4, self._device)

    def _queue(self, group: _Group, coefficients: int) -> None:
        """Launch the kernels of one step. Nothing here depends on the values of arrays."""
        gaussians, buffers = self._gaussians, group.buffers
        assert gaussians is not None and buffers is not None and group.moments is not None
        camera, view, count = group.camera, view_from_camera(group.camera), gaussians.count
        pixels, capacity = camera.width * camera.height, len(buffers.gaussians)
        options: dict[str, Any] = {"device": self._device, "threads": self._threads}
        control = [self._plans, self._cursor, self._is_blocked]
        offsets, first, second = self._tone_arrays
        launch_rows(
            begin_step_kernel,
            pixels,
            inputs=[
                *(self._plans, self._cursor, group.views, offsets),
                *(group.photos, group.alphas, group.weights),
            ],
            outputs=[
                *(group.view, group.loss.tone, group.backdrop),
                *(group.loss.image, group.loss.image_alpha, group.loss.weight),
            ],
            **options,
        )
        shapes = [gaussians.shapes[name][0] for name in _SHAPES]
        sh, by_sh, flat_by_sh = gaussians.trained(coefficients)
        projected, by_shapes = gaussians.projected, gaussians.shape_gradients
        launch_rows(
            project_into_view_kernel,
            count,
            inputs=[group.view, int(self._antialiased), *shapes, sh],
            outputs=[projected.ellipse, projected.falloff, projected.colour_depth, projected.slot_end],
            **options,
        )
        wp.utils.array_scan(projected.slot_end, projected.slot_end, inclusive=True)
        launch_cached(
            check_capacity_kernel,
            1,
            inputs=[capacity, projected.slot_end],
            outputs=[self._is_blocked, self._max_pairs],
            device=self._device,
        )
        lists = sort_pairs(projected, view, buffers, capacity)
        image = composite(projected, lists, view, background=group.background, threads=self._threads, onto=group.image)
        scratch = self._loss.launch(group.loss, camera.height, camera.width).arrays
        launch_rows(
            sum_pixels_kernel,
            _SUM_THREADS,
            inputs=[
                *(_SUM_THREADS, scratch["by_toned"], scratch["front"], scratch["off"], scratch["similarity"]),
            ],
            outputs=[self._sums],
            **options,
        )
        launch_rows(sum_parts_kernel, int(SUMS) * int(PARTS), inputs=[self._sums], outputs=[self._parts], **options)
        composite_backward(
            *(view, projected, lists, image, group.moments),
            colour_gradient=group.colour_gradient,
            alpha_gradient=group.alpha_gradient,
            depth_gradient=None,
            threads=self._threads,
        )
        launch_rows(
            project_backward_into_view_kernel,
            count,
            inputs=[
                *(group.view, int(self._antialiased), *shapes, sh),
                *(projected.slot_end, group.moments, self._is_blocked),
            ],
            outputs=[*by_shapes, by_sh],
            **options,
        )
        launch_rows(
            tone_step_kernel,
            int(TONE_ENTRIES) + 1,
            inputs=[
                *(*control, self._parts, pixels, self._loss.ssim_weight, REGULARIZATION, TYPICAL_OFFSET, offsets),
            ],
            outputs=[first, second, self._change, self._losses],
            **options,
        )
        launch_rows(shift_tones_kernel, offsets.size, inputs=[*control, self._change], outputs=[offsets], **options)
        penalties = self._population.penalty_weights() if self._relocating else (0.0, 0.0)
        launch_rows(
            update_shapes_kernel,
            count,
            inputs=[*control, *penalties, MIN_LOG_SCALE, FAINT, *by_shapes],
            outputs=[array for name in _SHAPES for array in gaussians.shapes[name]],
            **options,
        )
        launch_rows(
            update_sh_kernel,
            3 * coefficients * count,
            inputs=[*control, 3 * coefficients, 3 * gaussians.coefficients, flat_by_sh],
            outputs=gaussians.flat_sh,
            **options,
        )
        launch_cached(end_step_kernel, 1, inputs=[self._is_blocked], outputs=[self._cursor], device=self._device)


@dataclass
class _Program:
    """The kernels of a step with given shapes."""

    has_run: bool = False
    """True if the kernels have run, so that they are compiled."""
    graph: Any = None


@dataclass
class _Group:
    """Photos of one size, which share the arrays of a step."""

    factor: int
    camera: Camera
    """Camera of one of the photos; only the image size and the depth range are used."""
    background: Background
    """Background of the render."""
    views: wp.array
    """(photos,) View."""
    photos: wp.array
    """(photos, H * W) vec3."""
    alphas: wp.array | None
    """(photos, H * W) float32."""
    weights: wp.array | None
    """(photos, H * W) float32."""
    view: wp.array
    """(1,) View of the current step."""
    backdrop: wp.array
    """(1,) vec3."""
    image: RenderedImage
    loss: LossArrays
    colour_gradient: wp.array
    """(H, W) vec3."""
    alpha_gradient: wp.array | None
    """(H, W) float32."""
    buffers: PairBuffers | None = None
    """Tile lists of the current step."""
    moments: wp.array | None = None
    """(capacity, 3) vec4, sums of the gradients of the pixels for each pair."""


def count_groups(views: Sequence[TrainingView]) -> int:
    """Return the number of groups at full resolution."""
    return len({_shape_of(view) for view in views})


def _shape_of(view: TrainingView) -> tuple[int, int, float, float, bool]:
    """Return what the photos of a group have in common."""
    camera = view.camera
    return camera.width, camera.height, camera.near, camera.far, view.alpha is not None


def _groups_of(
    views: Sequence[TrainingView], factors: set[int], background: tuple[float, float, float], device: wp.Device
) -> tuple[list[_Group], dict[tuple[int, int], tuple[int, int]]]:
    """Upload the photos. Return the groups, and the group and the place in it by factor and view."""
    members: dict[Any, list[TrainingView]] = {}
    places: dict[tuple[int, int], tuple[int, int]] = {}
    for factor in sorted(factors):
        for number, full in enumerate(views):
            view = full.reduced(factor)
            key = (factor, *_shape_of(view))
            group = members.setdefault(key, [])
            places[factor, number] = list(members).index(key), len(group)
            group.append(view)
    return [_group_of(key[0], group, background, device) for key, group in members.items()], places


def _group_of(
    factor: int, views: list[TrainingView], background: tuple[float, float, float], device: wp.Device
) -> _Group:
    """Upload photos of one size and allocate the arrays of a step."""
    camera, has_alpha = views[0].camera, views[0].alpha is not None
    shape, pixels = (camera.height, camera.width), camera.height * camera.width

    def upload(images: list[np.ndarray], dtype: Any) -> wp.array:
        target = empty((len(images), pixels), dtype, device)
        for row, image in enumerate(images):
            values = np.ascontiguousarray(image, np.float32).reshape(pixels, *image.shape[2:])
            wp.copy(target, wp.array(values, dtype=dtype, device="cpu"), dest_offset=row * pixels, count=pixels)
        return target

    def flat(dtype: Any) -> wp.array:
        return empty(pixels, dtype, device)

    alphas = upload([view.alpha for view in views if view.alpha is not None], wp.float32) if has_alpha else None
    weights = None
    if any(view.weight is not None for view in views):
        ones = np.ones(shape, np.float32)
        weights = upload([ones if view.weight is None else view.weight for view in views], wp.float32)
    image = RenderedImage(*(empty(shape, dtype, device) for dtype in (wp.vec3, wp.float32, wp.float32)))
    backdrop = zeros(1, wp.vec3, device)
    loss = LossArrays(
        *(image.colour.flatten(), image.alpha.flatten(), zeros(int(TONE_ENTRIES), wp.float32, device)),
        *(flat(wp.vec3), flat(wp.float32) if has_alpha else None),
        *(None if weights is None else flat(wp.float32), backdrop if has_alpha else None),
        *(flat(wp.vec3), flat(wp.float32) if has_alpha else None),
    )
    return _Group(
        factor=factor,
        camera=camera,
        # A photo with alpha is compared over the background, with a colour map that applies to the object only.
        background=Background(wp.vec3() if has_alpha else wp.vec3(*background)),
        views=wp.array([view_from_camera(view.camera) for view in views], dtype=View, device=device),
        photos=upload([view.image for view in views], wp.vec3),
        alphas=alphas,
        weights=weights,
        view=zeros(1, View, device),
        backdrop=backdrop,
        image=image,
        loss=loss,
        colour_gradient=loss.by_colour.reshape(shape),
        alpha_gradient=None if loss.by_alpha is None else loss.by_alpha.reshape(shape),
    )


class _Gaussians:
    """Arrays of the Gaussians under training. Those of the shapes share the memory of the population's tensors."""

    def __init__(self, tensors: list[torch.Tensor], coefficients: int, version: int, device: wp.Device) -> None:
        self._tensors, self.version = tensors, version
        """``version`` is that of the population to which the tensors belong."""
        self.count, self.coefficients, self._device = len(tensors[0]), coefficients, device
        arrays = [
            _array(tensor, _TYPES[name], self.count)
            for tensor, name in zip(tensors, (name for name in _SHAPES for _ in range(3)), strict=True)
        ]
        self.shapes = {name: arrays[3 * i : 3 * i + 3] for i, name in enumerate(_SHAPES)}
        """Attribute, first and second moments, by name."""
        self.shape_gradients = [empty(self.count, _TYPES[name], device) for name in _SHAPES]
        count = self.count
        shape = (count, coefficients, 3)
        self.sh = [torch.zeros(shape, device=tensors[0].device) for _ in range(3)]
        """SH coefficients, first and second moments, (n, K, 3) each."""
        self.flat_sh = [_array(tensor, wp.float32, tensor.numel()) for tensor in self.sh]
        self.projected = ProjectedGaussians(
            *(empty(count, dtype, device) for dtype in (wp.vec4, wp.vec2, wp.vec4, wp.int64)), count_slots=lambda: 0
        )
        self._by_sh = empty((count, coefficients), wp.vec3, device)
        self._trained: dict[int, tuple[wp.array, wp.array, wp.array]] = {}

    def trained(self, coefficients: int) -> tuple[wp.array, wp.array, wp.array]:
        """Return the first ``coefficients`` SH coefficients (n, coefficients) vec3, their gradients, and the gradients
        as floats. All are views of arrays that remain allocated, because CUDA graphs contain their addresses."""
        if coefficients not in self._trained:
            address, device = self.sh[0].data_ptr(), self._device
            strides = (12 * self.coefficients, 12)
            sh = wp.array(ptr=address, dtype=wp.vec3, shape=(self.count, coefficients), strides=strides, device=device)
            self._trained[coefficients] = (
                sh,
                wp.array(ptr=self._by_sh.ptr, dtype=wp.vec3, shape=(self.count, coefficients), device=device),
                wp.array(ptr=self._by_sh.ptr, dtype=wp.float32, shape=3 * self.count * coefficients, device=device),
            )
        return self._trained[coefficients]


def _array(tensor: torch.Tensor, dtype: Any, *shape: int) -> wp.array:
    """View the contiguous ``tensor`` as a Warp array, without a copy."""
    device = wp.device_from_torch(tensor.device)
    return wp.array(ptr=tensor.data_ptr(), dtype=dtype, shape=shape, device=device)
