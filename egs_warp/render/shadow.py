"""Soft shadow that Gaussians cast straight down on a plane, as one camera sees it."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.kernels.render import backdrop as kernels
from egs_warp.launching import empty, launch_cached, launch_rows, zeros
from egs_warp.render.projection import view_from_camera

_LAYERS = ((0.0, 0.1, 0.035), (0.1, 0.35, 0.08), (0.35, 2.0, 0.16))
"""Height range over the plane and blur width of each layer, relative to the body height."""
_MIN_BLUR = 0.6
"""Smallest standard deviation of a blur, texels."""
_BLUR_REACH = 4.0
"""Radius of a blur kernel, standard deviations."""
_MAP = int(kernels.TEXELS)


def shadow_blur_radius(body: GaussianCloud) -> float:
    """Return the blur radius, world units, that hides single Gaussians in the shadow of ``body``: the median of their
    middle standard deviations."""
    return float(np.exp(np.median(np.median(body.log_scales.numpy(), axis=1))))


class ContactShadow:
    """The ground as one camera sees it, and the shadow of a body on it.

    The shadow of a Gaussian depends on its opacity and on the area of its broad side; shadows of higher Gaussians are
    wider and paler. Arrays are on ``device``, in row-major order of the pixels.
    """

    def __init__(
        self,
        camera: Camera,
        plane: Plane,
        *,
        centre: np.ndarray,
        reach: float,
        device: wp.Device,
        blur_radius: float = 0.0,
        height: float = 0.0,
        depth: np.ndarray | None = None,
    ) -> None:
        """Compute the ground point of every pixel.

        Args:
            camera: camera.
            plane: ground.
            centre, reach: (3,) and radius of the disc that can be in shadow, world units.
            device: device of the arrays.
            blur_radius: world units, blur radius of the body, see ``shadow_blur_radius``; 0 without a body.
            height: height of the body, world units; 0 without a body.
            depth: (H, W) z-depth of the uneven ground that receives the shadow, 0 where the plane receives it.
        """
        self.camera, self.plane, self.device = camera, plane, device
        edges = height * np.array([layer[:2] for layer in _LAYERS])
        self._layers = kernels.Layers()
        self._layers.low, self._layers.high = wp.vec3(*edges[:, 0].tolist()), wp.vec3(*edges[:, 1].tolist())
        texel, blurs = 2.0 * reach / _MAP, np.array([layer[2] for layer in _LAYERS])
        self._grain = _taps(np.full(len(_LAYERS), blur_radius) / texel, device)
        self._blur = _taps(height * blurs / texel, device)
        count = camera.width * camera.height
        self.depth = empty(count, wp.float32, device)
        """(H W,) z-depth of the plane, 0 where a pixel's ray does not meet it from above."""
        self.flat = empty(count, wp.vec2, device)
        """(H W,) position on the plane along its ``tangents``, world units from the centre."""
        self.fade = empty(count, wp.float32, device)
        """(H W,) 1 around the centre, 0 from ``reach`` on and outside the plane."""
        self.pixel = empty(count, wp.float32, device)
        """(H W,) size of a pixel on the plane, world units."""
        self.surface_height = empty(count, wp.float32, device)
        """(H W,) height of the ground over the plane, world units."""
        self._texels = empty(count, wp.vec2, device)
        self._ground = _ground(plane, centre, reach)
        uneven = np.zeros(count) if depth is None else depth.ravel()
        surface_depth = wp.array(uneven, dtype=wp.float32, device=device)
        self._launch(
            kernels.ground_kernel,
            count,
            [view_from_camera(camera), self._ground, wp.vec3(*(camera.centre - centre).tolist()), surface_depth],
            [self.depth, self.flat, self.fade, self.pixel, self.surface_height, self._texels],
        )

    def cover(self, body: GaussianCloud, strength: wp.array) -> wp.array:
        """Return (H W,) float32, the opacity of the shadow of ``body``: 0 to about 0.5, times ``strength`` (H W,)."""
        cover = empty(len(strength), wp.float32, self.device)
        self._launch(kernels.shadow_opacity_kernel, len(strength), [self._shade(body), self._texels, strength], [cover])
        return cover

    def _shade(self, body: GaussianCloud) -> wp.array:
        """Return the shadow map (texels, texels) float32, seen from above."""
        shape = (len(_LAYERS), _MAP, _MAP)
        coverage = zeros(shape, wp.int64, self.device)
        # Use one thread on a CPU, where concurrent additions to one texel are not atomic.
        launch_cached(
            kernels.coverage_kernel,
            body.count,
            inputs=[self._ground, self._layers, body.means, body.log_scales, body.opacity_logits],
            outputs=[coverage],
            device=self.device,
        )
        layers, scratch = empty(shape, wp.float32, self.device), empty(shape, wp.float32, self.device)
        count = int(np.prod(shape))
        self._launch(kernels.unpack_coverage_kernel, count, [coverage], [layers])
        self._blur_layers(layers, scratch, self._grain)
        self._launch(kernels.opacity_kernel, count, [], [layers])
        self._blur_layers(layers, scratch, self._blur)
        shade = empty(shape[1:], wp.float32, self.device)
        # Higher layers block less of the sky, so they darken less.
        max_opacity = wp.vec3(*(0.5 - 1.5 * blur for _, _, blur in _LAYERS))
        self._launch(kernels.combine_layers_kernel, _MAP * _MAP, [layers, max_opacity], [shade])
        return shade

    def _blur_layers(self, layers: wp.array, scratch: wp.array, taps: list[wp.array]) -> None:
        """Blur ``layers`` in place by the ``taps`` of each."""
        occupied = empty(len(_LAYERS) * _MAP, wp.bool, self.device)
        for source, target in ((layers, scratch), (scratch, layers)):
            self._launch(kernels.occupied_rows_kernel, len(occupied), [source], [occupied])
            self._launch(kernels.blur_kernel, source.size, [source, occupied, *taps], [target])

    def _launch(self, kernel: Any, count: int, inputs: list[Any], outputs: list[wp.array]) -> None:
        launch_rows(kernel, count, inputs=inputs, outputs=outputs, device=self.device)


def _taps(widths: np.ndarray, device: wp.Device) -> list[wp.array]:
    """Return the weights (layers, taps) of Gaussian blurs of ``widths`` (layers,) texels, from the centre on, and the
    number of taps of each."""
    sigmas = np.maximum(widths, _MIN_BLUR)
    reach = np.minimum(np.ceil(_BLUR_REACH * sigmas), _MAP - 1).astype(np.int32)
    taps = np.exp(-0.5 * (np.arange(reach.max() + 1) / sigmas[:, None]) ** 2)
    taps *= np.arange(taps.shape[1]) <= reach[:, None]
    taps /= 2.0 * taps.sum(axis=1, keepdims=True) - taps[:, :1]
    return [wp.array(taps, wp.float32, device=device), wp.array(reach, wp.int32, device=device)]


def _ground(plane: Plane, centre: np.ndarray, reach: float) -> Any:
    ground = kernels.Ground()
    first, second = plane.tangents()
    ground.normal, ground.first, ground.second = (wp.vec3(*axis.tolist()) for axis in (plane.normal, first, second))
    ground.centre = wp.vec3(*np.asarray(centre, float).tolist())
    ground.rise, ground.reach = float(plane.heights(centre)), reach
    return ground
