"""Baked light of the built-in scenes: ambient occlusion and a soft key light, by rays against the scene's own
triangles.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def fibonacci_cosine_direction(index: int, count: int, turn: float) -> wp.vec3:
    """Return direction ``index`` of ``count`` cosine-distributed directions about +z. ``turn`` (rad) rotates the
    pattern about z.
    """
    u = (float(index) + 0.5) / float(count)
    angle = 2.39996323 * float(index) + turn
    radius = wp.sqrt(u)
    return wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), wp.sqrt(1.0 - u))


@wp.kernel
def bake_light_kernel(
    # In:
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    up: wp.vec3,
    ground_height: float,
    ground_is_solid: int,
    reach: float,
    light_direction: wp.vec3,
    light_softness: float,
    ambient_rays: int,
    light_rays: int,
    # Out:
    sky_out: wp.array[float],
    ground_out: wp.array[float],
    light_out: wp.array[float],
):
    """Compute the ambient occlusion and the visible fraction of the key light at each point.

    Args:
        mesh: the scene's triangles.
        points: points on the surface, scene units.
        normals: surface normals at the points.
        up: unit vector opposite to gravity.
        ground_height: height of the ground along ``up``.
        ground_is_solid: 1 if rays end at the ground.
        reach: length of the ambient rays, and the distance over which the object above darkens the ground, scene units.
        light_direction: direction towards the key light.
        light_softness: tangent of the half-angle of the key light's disc.
        ambient_rays, light_rays: number of rays for each point.
        sky_out: cosine-weighted fraction of the hemisphere in which the sky is visible.
        ground_out: cosine-weighted fraction of the hemisphere in which lit ground is visible.
        light_out: visible fraction of the key light.
    """
    i = wp.tid()
    n = wp.normalize(normals[i])
    helper = wp.where(wp.abs(n[2]) < 0.9, wp.vec3(0.0, 0.0, 1.0), wp.vec3(1.0, 0.0, 0.0))
    t = wp.normalize(wp.cross(helper, n))
    b = wp.cross(n, t)
    # Rays start above the surface, because triangles cut the corners of creases.
    start = points[i] + n * (reach * 0.018)
    height = wp.dot(points[i], up) - ground_height
    turn = float(i) * 1.7

    sky = wp.float32(0.0)
    ground = wp.float32(0.0)
    for k in range(ambient_rays):
        local = fibonacci_cosine_direction(k, ambient_rays, turn)
        direction = t * local[0] + b * local[1] + n * local[2]
        rise = wp.dot(direction, up)
        length = float(reach)
        to_ground = wp.float32(1.0e9)
        if ground_is_solid == 1 and rise < -1.0e-4:
            to_ground = wp.max(height, 0.0) / (-rise)
            length = wp.min(length, to_ground)
        if not wp.mesh_query_ray_anyhit(mesh, start, direction, length):
            if to_ground < 1.0e8:
                ground += wp.min(to_ground / reach, 1.0)
            else:
                sky += 1.0
    sky_out[i] = sky / float(ambient_rays)
    ground_out[i] = ground / float(ambient_rays)

    light = wp.normalize(light_direction)
    light_t = wp.normalize(wp.cross(wp.vec3(0.31, 0.17, -0.93), light))
    light_b = wp.cross(light, light_t)
    visible = wp.float32(0.0)
    for k in range(light_rays):
        radius = light_softness * wp.sqrt((float(k) + 0.5) / float(light_rays))
        angle = 2.39996323 * float(k) + turn
        direction = wp.normalize(light + light_t * (radius * wp.cos(angle)) + light_b * (radius * wp.sin(angle)))
        if wp.dot(direction, n) > 0.0 and not wp.mesh_query_ray_anyhit(mesh, start, direction, 1.0e4 * reach):
            visible += 1.0
    light_out[i] = visible / float(light_rays)
