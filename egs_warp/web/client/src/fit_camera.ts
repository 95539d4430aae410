// Field of view and depth range of a camera for the aspect ratio of its window.

import type * as THREE from "three";

/** Set the vertical field of view to `fov`, degrees, the value of a square film, and the depth range for a body of
 * `height`. In a window that is taller than wide, `fov` is the horizontal field of view. */
export function fitCamera(camera: THREE.PerspectiveCamera, fov: number, aspect: number, height: number): void {
  const half = Math.tan((Math.PI * fov) / 360) / Math.min(aspect, 1);
  camera.fov = (360 / Math.PI) * Math.atan(half);
  camera.aspect = aspect;
  camera.near = 0.02 * height;
  camera.far = 400 * height;
  camera.updateProjectionMatrix();
}
