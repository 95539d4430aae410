"""Backdrop of an animation: a floor with a grid, one colour, or a captured scene, with the object's soft shadow
on it."""

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
from egs_warp.launching import empty, launch_rows
from egs_warp.render.projection import view_from_camera
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.render.shadow import MAX_BUMP, ContactShadow

STUDIO_FILE = Path(__file__).with_name("studio.json")
"""Settings of the plain floor and its sky, which films and the page (``web/client/src/ground.ts``) share.

The file holds the sRGB colours of the floor near the camera, of the horizon, of the sky, of the grid's lines, and of
what a captured scene does not contain (``surroundings``).
``clear`` and ``hazy`` are the depths at which the haze over the floor begins and is complete, relative to the depth of
the floor at the centre of the picture. ``min_slope`` is the smallest downward slope of the view from which that depth
is computed. ``sky_rise`` is the sine of the angle above the horizon at which the sky reaches its full colour.
"""
_EDGE_BLUR_FRACTION = 0.25
"""Standard deviation of the blur of the shadow mask, relative to the window of the median filter."""


@dataclass(frozen=True)
class Backdrop:
    """Background of an animation for one camera, and the part of it that receives the object's shadow."""

    unshadowed: wp.array
    """(H W,) vec3, background colour without the shadow."""
    shadow: ContactShadow
    strengths: list[wp.array] | None
    """(H W,) float32 each, strength of each shadow of ``shadow`` at every pixel; None without a shadow."""
    floor_depth: wp.array | None = None
    """(H W,) float32, z-depth of an opaque floor that hides what is below it, 0 where there is none; None if there is
    no such floor."""

    def shadow_opacity(self, body: GaussianCloud, centre: np.ndarray | None = None) -> wp.array:
        """Return the opacity (H, W) float32 of the shadow of ``body``, 0 to about 0.5; ``centre`` is as for
        ``ContactShadow.cover``."""
        camera = self.shadow.camera
        if self.strengths is None:
            return wp.zeros((camera.height, camera.width), dtype=wp.float32, device=self.shadow.device)
        return self.shadow.cover(body, self.strengths, centre).reshape((camera.height, camera.width))

    def background(self, body: GaussianCloud, centre: np.ndarray | None = None) -> wp.array:
        """Return the background (H, W) vec3 with the shadow of ``body``; ``centre`` is as for
        ``ContactShadow.cover``."""
        camera, device = self.shadow.camera, self.shadow.device
        shape = (camera.height, camera.width)
        if self.strengths is None:
            return self.unshadowed.reshape(shape)
        colour = empty(len(self.unshadowed), wp.vec3, device)
        cover = self.shadow.cover(body, self.strengths, centre)
        launch_rows(kernels.dim_kernel, len(colour), inputs=[self.unshadowed, cover], outputs=[colour], device=device)
        return colour.reshape(shape)


def studio_floor(ground: ContactShadow, *, cell: float, shadow: bool = True) -> Backdrop:
    """Return a pale floor with a grid, which turns gradually into a sky without a horizon line.

    Args:
        ground: the ground and its shadow.
        cell: spacing of the fine grid lines, world units; every fourth line is strong.
        shadow: False for no shadow.
    """
    camera, plane = ground.camera, ground.plane
    look = _look()
    slope = max(float(-camera.rotation[2] @ plane.normal), look["min_slope"])
    depth = abs(float(plane.heights(camera.centre))) / slope
    studio = kernels.Studio()
    studio.floor, studio.horizon = wp.vec3(*look["floor"]), wp.vec3(*look["horizon"])
    studio.sky, studio.line = wp.vec3(*look["sky"]), wp.vec3(*look["line"])
    studio.cell, studio.sky_rise = cell, look["sky_rise"]
    studio.clear_depth, studio.hazy_depth = look["clear"] * depth, look["hazy"] * depth
    colour = empty(len(ground.depth), wp.vec3, ground.device)
    launch_rows(
        kernels.studio_kernel,
        len(colour),
        inputs=[
            *(view_from_camera(camera), wp.vec3(*plane.normal.tolist())),
            *(ground.depth, ground.flat, ground.pixel, studio),
        ],
        outputs=[colour],
        device=ground.device,
    )
    return Backdrop(colour, ground, ground.strengths() if shadow else None, ground.depth)


def plain_colour(ground: ContactShadow, colour: tuple[float, float, float], *, shadow: bool = True) -> Backdrop:
    """Return a backdrop of one colour that shows only the shadow. Its ``shadow_opacity`` can be composited over another
    image."""
    colour_without_shadow = wp.full(len(ground.depth), wp.vec3(*colour), dtype=wp.vec3, device=ground.device)
    return Backdrop(colour_without_shadow, ground, ground.strengths() if shadow else None, ground.depth)


def captured_scene(
    scene: GaussianCloud,
    camera: Camera,
    plane: Plane,
    *,
    centre: np.ndarray,
    reach: float,
    blur_radius: float,
    height: float,
    body_reach: float | None = None,
    light: MainLight | None = None,
    shadow: bool = True,
) -> Backdrop:
    """Render the rest of a capture once. The shadow falls on the pixels at which the visible surface is near the plane.

    Args:
        scene: rest of the capture, world units.
        camera: camera.
        plane: ground.
        centre, reach: (3,) and radius of the disc that can be in shadow, world units.
        blur_radius, height, body_reach, light: as for ``ContactShadow``.
        shadow: False for no shadow.
    """
    import cv2

    surroundings = tuple(_look()["surroundings"])
    image, shape = render_gaussians(scene, camera, background=surroundings), (camera.height, camera.width)
    depth = np.where(image.alpha.numpy() > 0.5, image.depth.numpy(), 0.0).astype(np.float32)
    ground = ContactShadow(
        camera,
        plane,
        centre=centre,
        reach=reach,
        device=scene.device,
        blur_radius=blur_radius,
        height=height,
        body_reach=body_reach,
        depth=np.asarray(cv2.medianBlur(depth, 5)),
        light=light,
    )
    colour_without_shadow = wp.array(
        np.clip(image.colour.numpy(), 0.0, 1.0).reshape(-1, 3), dtype=wp.vec3, device=scene.device
    )
    if not shadow:
        return Backdrop(colour_without_shadow, ground, None)
    lift = ground.surface_height.numpy().reshape(shape) / (MAX_BUMP * reach)
    on_plane = np.clip(1.5 - np.where(lift > 0.0, lift, -0.5 * lift), 0.0, 1.0)
    on_plane *= ground.depth.numpy().reshape(shape) > 0.0
    # Smooth the mask: otherwise, specks that float in front of the floor would remain bright in the shadow, and the
    # edges of the mask would be hard.
    kernel = 2 * (max(camera.width, camera.height) // 40) + 1
    on_plane = np.asarray(cv2.medianBlur(np.rint(255.0 * on_plane).astype(np.uint8), kernel), np.float32) / 255.0
    on_plane = cv2.GaussianBlur(on_plane, (0, 0), _EDGE_BLUR_FRACTION * kernel)
    return Backdrop(colour_without_shadow, ground, ground.strengths(on_plane * image.alpha.numpy()))


def _look() -> dict[str, Any]:
    """Return the settings of ``STUDIO_FILE``."""
    return json.loads(STUDIO_FILE.read_text(encoding="utf-8"))
