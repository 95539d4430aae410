"""Files and pictures of the objects of a scene and of its obstacles, for visual checks."""

from __future__ import annotations

import numpy as np

from egs_warp.assets.surface import quaternions_from_normals
from egs_warp.geometry.body_frame import GROUND
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud, concatenate, with_degree
from egs_warp.inpainting.picture import before_and_after
from egs_warp.io.run_folder import RunFolder
from egs_warp.io.video import contact_sheet, write_png
from egs_warp.pipelines.obstacle_cloud import make_obstacles
from egs_warp.pipelines.pictures import picture_cameras, plane_picture, segmentation_picture
from egs_warp.pipelines.prepare_scene import PreparedScene
from egs_warp.pipelines.scene_obstacles import SceneObstacles
from egs_warp.pipelines.surroundings import Surroundings
from egs_warp.render.rasteriser import render_gaussians

OBSTACLE_PICTURE = "obstacles.png"
"""Name of the picture of ground and obstacles."""
_SIDE = 480
_GROUND_COLOUR, _LOWER_COLOUR = np.array([0.20, 0.75, 0.30]), np.array([0.90, 0.25, 0.20])
"""sRGB colours of the ground, and of lower ground beyond its edge."""
_LOWER = 0.15
"""Depth below z = 0 below which the ground is drawn in the second colour, relative to the depth of the floor."""
_OVERLAY = 0.55
"""Opacity of ground and obstacles in the picture of the scene."""


def write_object(name: str, scene: PreparedScene, run: RunFolder) -> None:
    """Write ``object.ply``, ``plane.json`` and pictures of an object into its folder.

    Args:
        name: Name of the object and of its folder.
        scene: The prepared object.
        run: Folder of the run.
    """
    place = run.folder(name)
    place.mkdir(exist_ok=True)
    scene.write(place, has_background=False)
    centre, size = scene.located.centre, scene.located.size
    cameras = picture_cameras(scene.plane, centre, size)
    whole = concatenate(*_alike(scene.object, scene.background_with_hole))
    pictures = {
        "plane.png": plane_picture(whole, [scene.plane], cameras, centre=centre, size=size),
        "segment.png": segmentation_picture(whole, scene.object, scene.background_with_hole, cameras),
    }
    if scene.filled is not None:
        pictures["filled.png"] = before_and_after(scene.filled)
    for file, picture in pictures.items():
        write_png(place / file, picture)


def obstacle_picture(obstacles: SceneObstacles, surroundings: Surroundings) -> np.ndarray:
    """Return views (H, W, 3) uint8 of the scene without the objects. Over them are drawn the ground (green), lower
    ground beyond its edge (red) and the solids (grey)."""
    scene = surroundings.cloud
    reach = 0.35 * float(np.linalg.norm((obstacles.high - obstacles.low)[:2]))
    middle = 0.5 * (obstacles.low + obstacles.high) * [1.0, 1.0, 0.0]
    cameras = ring_cameras(GROUND, middle, reach, count=4, elevations=(20.0, 45.0), size=_SIDE)
    solids = make_obstacles(obstacles.solids, obstacles.low, obstacles.high, device=str(scene.device))
    overlay = _ground_cloud(obstacles, str(scene.device))
    if solids is not None:
        overlay = concatenate(overlay, solids.cloud)
    frames = [_overlaid(scene, overlay, camera) for camera in cameras]
    labels = ["green: ground, red: below its edge, grey: obstacles", *[""] * (len(frames) - 1)]
    return contact_sheet(frames, 2, labels)


def _overlaid(scene: GaussianCloud, overlay: GaussianCloud, camera: Camera) -> np.ndarray:
    below = render_gaussians(scene, camera, background=(1.0, 1.0, 1.0)).colour.numpy()
    above = render_gaussians(overlay, camera, background=(0.0, 0.0, 0.0))
    share = _OVERLAY * above.alpha.numpy()[..., None]
    mixed = below * (1.0 - share) + _OVERLAY * above.colour.numpy()
    return np.rint(np.clip(mixed, 0.0, 1.0) * 255.0).astype(np.uint8)


def _ground_cloud(obstacles: SceneObstacles, device: str) -> GaussianCloud:
    """Return flat Gaussians on the ground."""
    low, high = obstacles.low, obstacles.high
    if obstacles.ground is not None:
        nodes, spacing = obstacles.ground.nodes(), obstacles.ground.spacing
    else:
        spacing = float((high - low)[:2].max()) / 100.0
        x, y = np.meshgrid(np.arange(low[0], high[0], spacing), np.arange(low[1], high[1], spacing))
        nodes = np.stack([x, y, np.zeros_like(x)], axis=-1)
    along_x, along_y = np.gradient(nodes[..., 2], spacing)
    slopes = np.stack([along_y, along_x], axis=-1)
    normals = np.concatenate([-slopes, np.ones((*slopes.shape[:2], 1))], axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = nodes.reshape(-1, 3)
    depth = np.clip(points[:, 2] / (_LOWER * low[2]), 0.0, 1.0)[:, None]
    colours = (1.0 - depth) * _GROUND_COLOUR + depth * _LOWER_COLOUR
    # A checkerboard with fields of 4 x 4 nodes makes slopes visible.
    rows, columns = np.indices(nodes.shape[:2])
    colours = colours * np.where((rows // 4 + columns // 4) % 2, 0.75, 1.0).reshape(-1, 1)
    return GaussianCloud.from_numpy(
        points,
        quaternions_from_normals(normals, np.zeros(len(normals))),
        np.log(np.full((len(points), 1), spacing) * [0.6, 0.6, 0.05]),
        np.full(len(points), 3.0),
        ((colours - 0.5) / SH_BAND_0)[:, None],
        device=device,
    )


def _alike(*clouds: GaussianCloud) -> list[GaussianCloud]:
    """Return the clouds reduced to the lowest of their SH degrees."""
    degree = min(cloud.sh_degree for cloud in clouds)
    return [with_degree(cloud, degree) for cloud in clouds]
