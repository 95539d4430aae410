"""The soft shadow that Gaussians cast straight down on a plane, as one camera sees it."""

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

_LAYERS = ((0.0, 0.08, 0.02), (0.08, 0.3, 0.06), (0.3, 2.0, 0.13))
"""From and to this height over the plane, and the width of the blur, all in body heights."""
_LEAST_BLUR = 0.6
"""Texels."""
_TAPS = 4.0
"""Standard deviations that a blur reaches."""
_MAP = int(kernels.TEXELS)


def shadow_blur_radius(body: GaussianCloud) -> float:
    """World units: by how much the shadow of ``body`` is blurred to show none of its Gaussians, the median of their
    middle standard deviations."""
    return float(np.exp(np.median(np.median(body.log_scales.numpy(), axis=1))))


class ContactShadow:
    """The ground, and what a body takes of its light. Each Gaussian hides as much of it as its opacity and its broad
    side say; shadows of high ones are wider and paler.

    Arrays lie on the device that is told, a row of pixels after the other.
    """

    def __init__(
        self,
        camera: Camera,
        plane: Plane,
        *,
        centre: np.ndarray,
        reach: float,
        device: wp.Device,
        grain: float = 0.0,
        height: float = 0.0,
        depth: np.ndarray | None = None,
    ) -> None:
        """``centre`` (3,) and ``reach`` (world units) bound the part of the plane that can be in shadow; ``grain`` (see
        ``grain_of``) and ``height`` (world units) are the body's, 0 where only the ground is looked at; ``depth``
        (H, W) is the z-depth of the uneven ground that it falls on, 0 where that is the plane.
        """
        self.camera, self.device = camera, device
        edges = height * np.array([layer[:2] for layer in _LAYERS])
        self._layers = kernels.Layers()
        self._layers.low, self._layers.high = wp.vec3(*edges[:, 0].tolist()), wp.vec3(*edges[:, 1].tolist())
        texel, blurs = 2.0 * reach / _MAP, np.array([layer[2] for layer in _LAYERS])
        self._grain = _taps(np.full(len(_LAYERS), grain) / texel, device)
        self._blur = _taps(height * blurs / texel, device)
        count = camera.width * camera.height
        self.depth = empty(count, wp.float32, device)
        """(H W,) z-depth of the plane, 0 where a pixel's ray does not meet it from above."""
        self.flat = empty(count, wp.vec2, device)
        """(H W,) place on the plane along its ``tangents``, world units from the centre."""
        self.fade = empty(count, wp.float32, device)
        """(H W,) 1 around the centre, 0 from ``reach`` on and beside the plane."""
        self.pixel = empty(count, wp.float32, device)
        """(H W,) size of a pixel on the plane, world units."""
        self.lift = empty(count, wp.float32, device)
        """(H W,) height of the ground over the plane, world units."""
        self._texels = empty(count, wp.vec2, device)
        self._ground = _ground(plane, centre, reach)
        uneven = np.zeros(count) if depth is None else depth.ravel()
        seen = wp.array(uneven, dtype=wp.float32, device=device)
        self._rows(
            kernels.ground_kernel,
            count,
            [view_from_camera(camera), self._ground, wp.vec3(*(camera.centre - centre).tolist()), seen],
            [self.depth, self.flat, self.fade, self.pixel, self.lift, self._texels],
        )

    def cover(self, body: GaussianCloud, strength: wp.array) -> wp.array:
        """(H W,) float32, 0 to about 0.5 times ``strength`` (H W,): how much light the Gaussians of ``body`` take."""
        cover = empty(len(strength), wp.float32, self.device)
        self._rows(kernels.cover_kernel, len(strength), [self._shade(body), self._texels, strength], [cover])
        return cover

    def _shade(self, body: GaussianCloud) -> wp.array:
        """(texels, texels) float32 seen from above."""
        shape = (len(_LAYERS), _MAP, _MAP)
        hidden = zeros(shape, wp.int64, self.device)
        # One after the other on a CPU, whose threads may not add to one texel at once.
        launch_cached(
            kernels.hide_ground_kernel,
            body.count,
            inputs=[self._ground, self._layers, body.means, body.log_scales, body.opacity_logits],
            outputs=[hidden],
            device=self.device,
        )
        there, back = empty(shape, wp.float32, self.device), empty(shape, wp.float32, self.device)
        count = int(np.prod(shape))
        self._rows(kernels.hidden_shares_kernel, count, [hidden], [there])
        self._blurred(there, back, self._grain)
        self._rows(kernels.covered_kernel, count, [], [there])
        self._blurred(there, back, self._blur)
        shade = empty(shape[1:], wp.float32, self.device)
        # Far layers see more of the sky past the object, so they darken less.
        paleness = wp.vec3(*(0.5 - 1.4 * blur for _, _, blur in _LAYERS))
        self._rows(kernels.darkest_kernel, _MAP * _MAP, [there, paleness], [shade])
        return shade

    def _blurred(self, layers: wp.array, scratch: wp.array, taps: list[wp.array]) -> None:
        """Blur ``layers`` in place by the ``taps`` of each."""
        occupied = empty(len(_LAYERS) * _MAP, wp.bool, self.device)
        for source, target in ((layers, scratch), (scratch, layers)):
            self._rows(kernels.occupied_rows_kernel, len(occupied), [source], [occupied])
            self._rows(kernels.blur_kernel, source.size, [source, occupied, *taps], [target])

    def _rows(self, kernel: Any, count: int, inputs: list[Any], outputs: list[wp.array]) -> None:
        launch_rows(kernel, count, inputs=inputs, outputs=outputs, device=self.device)


def _taps(widths: np.ndarray, device: wp.Device) -> list[wp.array]:
    """Of blurs ``widths`` (layers,) texels wide the weights (layers, taps) from the middle on, and how many count."""
    sigmas = np.maximum(widths, _LEAST_BLUR)
    reach = np.minimum(np.ceil(_TAPS * sigmas), _MAP - 1).astype(np.int32)
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
