// Smooth turn of a camera around a body, and the view of a camera relative to another one.

import * as THREE from "three";
import { listenToMoves } from "./clicks";
import type { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

/** Duration of a turn, s. */
const TURN_TIME = 1.2;

/** Position of a camera relative to its target: angle about the vertical, rad; height and horizontal distance, m. */
export interface Orbit {
  azimuth: number;
  height: number;
  distance: number;
}

function orbitOf({ x, y, z }: THREE.Vector3): Orbit {
  return { azimuth: Math.atan2(y, x), height: z, distance: Math.hypot(x, y) };
}

function offsetOf({ azimuth, height, distance }: Orbit): THREE.Vector3 {
  return new THREE.Vector3(distance * Math.cos(azimuth), distance * Math.sin(azimuth), height);
}

/** Return the view of a camera at `offset`, m, from its target, relative to a camera that looks along `forward`.
 * Lengths are in units of `height`, m. */
export function viewOf(offset: THREE.Vector3, forward: readonly number[], height: number): Orbit {
  const orbit = orbitOf(offset.clone().divideScalar(height));
  return { ...orbit, azimuth: orbit.azimuth - azimuthBehind(forward) };
}

/** Return the offset, m, of a camera with the given view (`viewOf`) from its target. */
export function offsetOfView(view: Orbit, forward: readonly number[], height: number): THREE.Vector3 {
  return offsetOf({ ...view, azimuth: view.azimuth + azimuthBehind(forward) }).multiplyScalar(height);
}

/** Return the angle about the vertical of the direction from the target to a camera that looks along `forward`. */
function azimuthBehind([x, y]: readonly number[]): number {
  return Math.atan2(-y!, -x!);
}

export class CameraTurn {
  /** True once the user has moved the camera. */
  isMovedByUser = false;
  /** Function that is called when the user moves the camera. */
  onMovedByUser: () => void = () => {};
  private turn: { from: Orbit; to: Orbit; shift: THREE.Vector3; target: THREE.Vector3; since: number } | undefined;

  constructor(
    private readonly camera: THREE.Camera,
    private readonly controls: OrbitControls,
    canvas: HTMLCanvasElement,
  ) {
    // The controls also report a click as the start of a movement.
    listenToMoves(canvas, () => {
      if (!controls.enabled) return;
      this.isMovedByUser = true;
      this.turn = undefined;
      this.onMovedByUser();
    });
  }

  get isActive(): boolean {
    return this.turn !== undefined;
  }

  /** Start to turn to the camera position `eye` that looks at `target`; a user who prefers reduced motion sees it at
   * once. */
  start(eye: THREE.Vector3, target: THREE.Vector3): void {
    const from = orbitOf(this.camera.position.clone().sub(this.controls.target));
    const to = orbitOf(eye.clone().sub(target));
    const angle = to.azimuth - from.azimuth;
    to.azimuth = from.azimuth + Math.atan2(Math.sin(angle), Math.cos(angle));
    const shift = target.clone().sub(this.controls.target);
    this.turn = { from, to, shift, target: this.controls.target.clone(), since: performance.now() / 1000 };
  }

  /** Move the camera; return true if it has moved. */
  advance(): boolean {
    if (this.turn === undefined) return false;
    const { from, to, shift, target, since } = this.turn;
    const isStill = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    const done = isStill ? 1 : Math.min((performance.now() / 1000 - since) / TURN_TIME, 1);
    const share = THREE.MathUtils.smoothstep(done, 0, 1);
    const between = (name: keyof Orbit): number => from[name] + share * (to[name] - from[name]);
    this.controls.target.copy(target).addScaledVector(shift, share);
    const orbit = { azimuth: between("azimuth"), height: between("height"), distance: between("distance") };
    this.camera.position.copy(this.controls.target).add(offsetOf(orbit));
    if (done >= 1) this.turn = undefined;
    return true;
  }
}
