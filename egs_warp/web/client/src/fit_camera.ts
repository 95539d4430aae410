// Field of view and depth range of a camera for the shape of its window.

import type * as THREE from "three";

/** Show the vertical field of view `fov`, degrees, of a square film, in which a body of `height` is seen. In a window
 * that is taller than wide, `fov` is the horizontal field of view. */
export function fitCamera(camera: THREE.PerspectiveCamera, fov: number, aspect: number, height: number): void {
  const half = Math.tan((Math.PI * fov) / 360) / Math.min(aspect, 1);
  camera.fov = (360 / Math.PI) * Math.atan(half);
  camera.aspect = aspect;
  camera.near = 0.02 * height;
  camera.far = 400 * height;
  camera.updateProjectionMatrix();
}
