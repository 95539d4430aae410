"""Shadows that Gaussians cast on a plane, straight down or away from the main light, as seen by one camera."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.main_light import MainLight
from egs_warp.geometry.plane import Plane
from egs_warp.kernels.render import backdrop as kernels
from egs_warp.launching import empty, launch_cached, launch_rows, zeros
from egs_warp.render.projection import view_from_camera

SHADOW_FILE = Path(__file__).with_name("shadow.json")
"""Settings of the shadows, which films and the page (``web/client/src/shadow_map.ts``) share.

``layers`` are those of the shadow straight down: range of heights over the plane and standard deviation of the blur,
relative to the body height, and maximum opacity; higher layers block less of the sky, so they darken the ground less.
``cast_edges`` separate the layers of the main light's shadow, and ``cast_heights`` are the heights for which the widths
of their penumbras are computed, relative to the body height. ``penumbra`` is the standard deviation of a penumbra,
relative to half of its width; for a uniform disc, it is 0.5. ``min_sine`` is the minimum sine of the light's elevation
in the computation; it corresponds to about 10 degrees. ``min_blur`` (texels) and ``max_blur`` (body heights) limit the
standard deviations of the blurs; without the latter, that of a wide light low in the sky would be unlimited.
``blur_reach`` is the radius of a blur kernel, standard deviations. ``reach`` is the radius of the disc that can be in
shadow under a body that stays in its place, relative to the body height. ``max_bump`` is the height over the plane at
which a surface receives the shadow at half strength, relative to the radius of this disc; below the plane, the
corresponding depth is twice as large, because thin spots of a captured floor appear deeper.
"""
_SETTINGS = json.loads(SHADOW_FILE.read_text(encoding="utf-8"))
_LAYERS = [[layer[key] for key in ("low", "high", "blur", "opacity")] for layer in _SETTINGS["layers"]]
_CAST_EDGES, _CAST_HEIGHTS = _SETTINGS["cast_edges"], _SETTINGS["cast_heights"]
_PENUMBRA, _MIN_SINE = _SETTINGS["penumbra"], _SETTINGS["min_sine"]
_MIN_BLUR, _MAX_BLUR, _BLUR_REACH = (_SETTINGS[key] for key in ("min_blur", "max_blur", "blur_reach"))
SHADOW_REACH: float = _SETTINGS["reach"]
MAX_BUMP: float = _SETTINGS["max_bump"]
_MAP = int(kernels.TEXELS)


def shadow_blur_radius(body: GaussianCloud) -> float:
    """Return the blur radius, world units, that hides single Gaussians in the shadow of ``body``: the median of their
    middle standard deviations."""
    return float(np.exp(np.median(np.median(body.log_scales.numpy(), axis=1))))


class ShadowMap:
    """Shadow of a body on a disc of the plane, cast straight down or by the main light.

    In the shadow that is cast straight down, the contribution of a Gaussian depends on its opacity and on the area of
    its broad side, and the shadows of higher Gaussians are wider and paler. The shadow of the main light is displaced
    in the direction of the light, and only its penumbra is blurred.
    """

    def __init__(
        self,
        plane: Plane,
        *,
        centre: np.ndarray,
        reach: float,
        device: wp.Device,
        blur_radius: float = 0.0,
        height: float = 0.0,
        light: MainLight | None = None,
    ) -> None:
        """Create the shadow map.

        Args:
            plane: ground.
            centre, reach: centre (3,) and radius of the disc that can be in shadow, world units.
            device: device of the arrays.
            blur_radius: world units, blur radius of the body, see ``shadow_blur_radius``; 0 without a body.
            height: height of the body, world units; 0 without a body.
            light: main light, world axes; None casts straight down.
        """
        self.device = device
        self._plane, self._light = plane, light
        self.ground = _ground(plane, centre, reach, light)
        self._layers = kernels.Layers()
        self._texel = texel = 2.0 * reach / _MAP
        if light is None:
            edges, blurs, opacities = np.split(np.array(_LAYERS), [2, 3], axis=1)
            blurs = blurs.ravel()
            self._max_opacity = wp.vec3(*opacities.ravel().tolist())
        else:
            edges = np.column_stack([_CAST_EDGES[:-1], _CAST_EDGES[1:]])
            sine = max(float(light.direction @ plane.normal), _MIN_SINE)
            blurs = _PENUMBRA * np.tan(np.radians(light.half_angle)) / sine * np.array(_CAST_HEIGHTS)
            self._max_opacity = wp.vec3(1.0, 1.0, 1.0)
        self._layers.low = wp.vec3(*(height * edges[:, 0]).tolist())
        self._layers.high = wp.vec3(*(height * edges[:, 1]).tolist())
        self._grain = _taps(np.full(len(_LAYERS), blur_radius) / texel, device)
        self._blur = _taps(height * np.minimum(blurs, _MAX_BLUR) / texel, device)

    def shift_to(self, centre: np.ndarray) -> np.ndarray:
        """Return the displacement (2,) in whole texels that moves the centre of the map as close as possible to
        ``centre`` (3,). With whole texels, the texel grid stays fixed on the ground, so a moving shadow does not
        flicker."""
        away = np.array(self._plane.tangents()) @ (centre - np.array(self.ground.centre))
        return np.rint(away / self._texel)

    def of(self, body: GaussianCloud, shift: np.ndarray | None = None) -> wp.array:
        """Return the shadow (texels, texels) float32 of ``body`` on the plane, seen from above; 1 is full shadow. The
        map is displaced by ``shift`` (2,) texels."""
        ground = self.ground
        if shift is not None:
            centre = np.array(ground.centre) + self._texel * shift @ np.array(self._plane.tangents())
            ground = _ground(self._plane, centre, ground.reach, self._light)
        shape = (len(_LAYERS), _MAP, _MAP)
        coverage = zeros(shape, wp.int64, self.device)
        # Use one thread on a CPU, where concurrent additions to one texel are not atomic.
        launch_cached(
            kernels.coverage_kernel,
            body.count,
            inputs=[ground, self._layers, body.means, body.log_scales, body.opacity_logits],
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
        self._launch(kernels.combine_layers_kernel, _MAP * _MAP, [layers, self._max_opacity], [shade])
        return shade

    def texels(self, points: np.ndarray) -> np.ndarray:
        """Return the position (n, 2) in the map, in texels from its corner, of the shadow on ``points`` (n, 3)."""
        ground, away = self.ground, points - np.array(self.ground.centre)
        axes = np.array([ground.first, ground.second, ground.normal])
        flat = away @ axes.T
        across = flat[:, :2] - (flat[:, 2] + ground.rise)[:, None] * np.array(ground.slope)
        return 0.5 * _MAP * (across / ground.reach + 1.0)

    def cover(self, shade: wp.array, texels: wp.array, strength: wp.array, shift: np.ndarray | None = None) -> wp.array:
        """Return the values (n,) float32 of the shadow map ``shade``, displaced by ``shift`` (2,) texels, at ``texels``
        (n,) vec2, multiplied by ``strength`` (n,)."""
        cover = empty(len(strength), wp.float32, self.device)
        moved = wp.vec2() if shift is None else wp.vec2(*shift.tolist())
        self._launch(kernels.shadow_opacity_kernel, len(strength), [shade, texels, moved, strength], [cover])
        return cover

    def _blur_layers(self, layers: wp.array, scratch: wp.array, taps: list[wp.array]) -> None:
        """Blur ``layers`` in place, each with its own ``taps``."""
        occupied = empty(len(_LAYERS) * _MAP, wp.bool, self.device)
        for source, target in ((layers, scratch), (scratch, layers)):
            self._launch(kernels.occupied_rows_kernel, len(occupied), [source], [occupied])
            self._launch(kernels.blur_kernel, source.size, [source, occupied, *taps], [target])

    def _launch(self, kernel: Any, count: int, inputs: list[Any], outputs: list[wp.array]) -> None:
        launch_rows(kernel, count, inputs=inputs, outputs=outputs, device=self.device)


class ContactShadow:
    """The ground as one camera sees it, and the shadow of a body on it.

    Without a main light, the body casts one shadow, straight down. With a main light, this shadow is paler, and the
    shadow of the light is added. Arrays are on ``device``, in row-major order of the pixels.
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
        body_reach: float | None = None,
        depth: np.ndarray | None = None,
        light: MainLight | None = None,
    ) -> None:
        """Compute the ground point of every pixel.

        Args:
            camera: camera.
            plane: ground.
            centre, reach: centre (3,) and radius of the disc that can be in shadow, world units.
            device: device of the arrays.
            blur_radius: world units, blur radius of the body, see ``shadow_blur_radius``; 0 without a body.
            height: height of the body, world units; 0 without a body.
            body_reach: radius of a disc that contains the shadow straight below the body, world units. The map of that
                shadow then has this radius, and ``cover`` moves it with the body, so that the shadow is as sharp in a
                long motion as in a short one. None for one map of the whole disc.
            depth: (H, W) z-depth of the uneven ground that receives the shadow, 0 where the plane receives it.
            light: main light, world axes; None without one.
        """
        self.camera, self.plane, self.device = camera, plane, device
        count = camera.width * camera.height
        self.depth = empty(count, wp.float32, device)
        """(H W,) z-depth of the plane, 0 where a pixel's ray does not meet it from above."""
        self.flat = empty(count, wp.vec2, device)
        """(H W,) position on the plane along its ``tangents``, world units from the centre."""
        self.fade = empty(count, wp.float32, device)
        """(H W,) 1 around the centre, decreasing to 0 at the distance ``reach``; 0 farther away and outside the
        plane."""
        self.pixel = empty(count, wp.float32, device)
        """(H W,) size of a pixel on the plane, world units."""
        self.surface_height = empty(count, wp.float32, device)
        """(H W,) height of the ground over the plane, world units."""
        uneven = np.zeros(count) if depth is None else depth.ravel()
        self._surface_depth = wp.array(uneven, dtype=wp.float32, device=device)
        body = {"device": device, "blur_radius": blur_radius, "height": height}
        map_reach = reach if body_reach is None else min(body_reach, reach)
        self._moves = map_reach < reach
        maps = [ShadowMap(plane, centre=centre, reach=map_reach, **body)]
        fades = [reach]
        opacities = [1.0]
        if light is not None and light.shade > 0.0:
            # Relative to the centre of the disc, the map of the light's shadow is displaced by half of the displacement
            # of the shadow at body height, and its radius is larger by the same length.
            half = 0.5 * height * _slope(plane, light)
            moved = centre - np.stack(plane.tangents(), axis=1) @ half
            fades.append(reach + float(np.linalg.norm(half)))
            maps.append(ShadowMap(plane, centre=moved, reach=fades[-1], light=light, **body))
            opacities = [1.0 - light.shade, light.shade]
        outputs = [self.depth, self.flat, self.fade, self.pixel, self.surface_height]
        self._receivers = []
        for one, fade, opacity in zip(maps, fades, opacities, strict=True):
            texels = self._on_ground(one, fade, outputs)
            self._receivers.append(_Receiver(one, texels, outputs[2], opacity))
            outputs = [empty(len(output), output.dtype, device) for output in outputs]

    def strengths(self, surface: np.ndarray | None = None) -> list[wp.array]:
        """Return the strength (H W,) float32 of each shadow. ``surface`` (H, W) is the fraction of each pixel that
        receives shadow; with None, the whole plane receives shadow."""
        received = np.ones(len(self.depth), np.float32) if surface is None else surface.ravel().astype(np.float32)
        return [
            wp.array(np.float32(one.opacity) * received * one.fade.numpy(), dtype=wp.float32, device=self.device)
            for one in self._receivers
        ]

    def cover(self, body: GaussianCloud, strengths: list[wp.array], centre: np.ndarray | None = None) -> wp.array:
        """Return the opacity (H W,) float32 of the shadows of ``body``, given the ``strengths`` of each shadow.
        ``centre`` (3,) is the centre of the body; it is required if ``body_reach`` was given."""
        shifts: list[np.ndarray | None] = [None] * len(self._receivers)
        if self._moves:
            assert centre is not None, "a shadow map with body_reach requires the centre of the body"
            shifts[0] = self._receivers[0].shadow_map.shift_to(centre)
        covers = [
            one.shadow_map.cover(one.shadow_map.of(body, shift), one.texels, strength, shift)
            for one, strength, shift in zip(self._receivers, strengths, shifts, strict=True)
        ]
        for other in covers[1:]:
            launch_rows(kernels.join_covers_kernel, len(other), inputs=[other], outputs=[covers[0]], device=self.device)
        return covers[0]

    def _on_ground(self, shadow_map: ShadowMap, fade_reach: float, outputs: list[wp.array]) -> wp.array:
        """Compute the ground of every pixel into ``outputs``; return its position (H W,) vec2 in the map. The shadow
        has faded at the distance ``fade_reach``."""
        camera, count = self.camera, len(self.depth)
        texels = empty(count, wp.vec2, self.device)
        ground = shadow_map.ground
        launch_rows(
            kernels.ground_kernel,
            count,
            inputs=[
                view_from_camera(camera),
                ground,
                wp.vec3(*(camera.centre - np.array(ground.centre)).tolist()),
                fade_reach,
                self._surface_depth,
            ],
            outputs=[*outputs, texels],
            device=self.device,
        )
        return texels


@dataclass(frozen=True)
class _Receiver:
    """Pixels that receive the shadow of one shadow map."""

    shadow_map: ShadowMap
    texels: wp.array
    """(H W,) vec2, position of each pixel in the map."""
    fade: wp.array
    """(H W,) float32, 1 around the centre of the map, 0 at its edge."""
    opacity: float
    """Opacity of full shadow."""


def _taps(widths: np.ndarray, device: wp.Device) -> list[wp.array]:
    """Return the weights (layers, taps) of Gaussian blurs of ``widths`` (layers,) texels, starting at the centre of the
    kernel, and the number of taps of each blur."""
    sigmas = np.maximum(widths, _MIN_BLUR)
    reach = np.minimum(np.ceil(_BLUR_REACH * sigmas), _MAP - 1).astype(np.int32)
    taps = np.exp(-0.5 * (np.arange(reach.max() + 1) / sigmas[:, None]) ** 2)
    taps *= np.arange(taps.shape[1]) <= reach[:, None]
    taps /= 2.0 * taps.sum(axis=1, keepdims=True) - taps[:, :1]
    return [wp.array(taps, wp.float32, device=device), wp.array(reach, wp.int32, device=device)]


def _slope(plane: Plane, light: MainLight | None) -> np.ndarray:
    """Return the displacement (2,) towards the light, along the plane's tangents, per unit of height over the plane."""
    if light is None:
        return np.zeros(2)
    sine = max(float(light.direction @ plane.normal), _MIN_SINE)
    return np.array(plane.tangents()) @ light.direction / sine


def _ground(plane: Plane, centre: np.ndarray, reach: float, light: MainLight | None) -> Any:
    ground = kernels.Ground()
    first, second = plane.tangents()
    ground.normal, ground.first, ground.second = (wp.vec3(*axis.tolist()) for axis in (plane.normal, first, second))
    ground.centre = wp.vec3(*np.asarray(centre, float).tolist())
    ground.slope = wp.vec2(*_slope(plane, light).tolist())
    ground.rise, ground.reach = float(plane.heights(centre)), reach
    return ground
