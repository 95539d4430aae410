// Adjustment of a camera's field of view and depth range to the aspect ratio of its window.

import type * as THREE from "three";

/** Set the field of view to `fov`, degrees, which is that of a square film, and the depth range for a body of `height`.
 * `fov` is the vertical field of view or, in a window that is taller than wide, the horizontal one. */
export function fitCamera(camera: THREE.PerspectiveCamera, fov: number, aspect: number, height: number): void {
  const half = Math.tan((Math.PI * fov) / 360) / Math.min(aspect, 1);
  camera.fov = (360 / Math.PI) * Math.atan(half);
  camera.aspect = aspect;
  camera.near = 0.02 * height;
  camera.far = 400 * height;
  camera.updateProjectionMatrix();
}
