// Pushes that act along the ground and away from the camera, on the whole creature or around the height of a clicked
// point.

import * as THREE from "three";
import type { Gizmos } from "./gizmos";
import { floatsOf } from "./packets";
import type { LiveSource } from "./frame_source";
import type { Viewer } from "./viewer";

/** Duration of one growth of the ring, s. The ring grows again and again until the push has acted. */
const RING_TIME = 0.5;
/** Time after which a push of a running simulation is given up, s: the connection may have lost it. */
const MAX_WAITING_TIME = 60;
/** Time for which the page says that a push has acted, s. */
const NEWS_TIME = 1.5;

export class PushTool {
  /** Impulse of a push, in units of body mass times sqrt(g H). */
  strength = 0.15;
  private readonly rest: Float32Array;
  private lastPush: { where: () => THREE.Vector3; since: number; acted?: number } | undefined;
  /** Time at which the last push is given up, s. */
  private deadline = 0;

  constructor(
    private readonly viewer: Viewer,
    private readonly source: LiveSource,
    private readonly marks: Gizmos,
  ) {
    this.rest = floatsOf(source.header, "rest");
  }

  /** Push the creature around the height of `node` in the rest pose, or as a whole if no node is given. */
  push(node?: number): void {
    const { x, y } = this.pushDirection().multiplyScalar(this.strength);
    const height = node === undefined ? {} : { height: this.heightOf(node) };
    this.source.send({ type: "push", x, y, z: 0, ...height });
    const where = () => (node === undefined ? this.viewer.centreOfMass : this.viewer.nodePosition(node));
    this.lastPush = { where, since: performance.now() / 1000 };
    this.deadline = this.lastPush.since + MAX_WAITING_TIME;
  }

  /** Forget a push that will not act. */
  cancel(): void {
    if (!this.isWaiting) return;
    this.lastPush = undefined;
    this.marks.showPush();
    this.viewer.invalidate();
  }

  /** Show that the push has acted: its effect is in the images that follow. */
  showEffect(): void {
    const now = performance.now() / 1000;
    if (this.lastPush !== undefined) this.lastPush = { ...this.lastPush, since: now, acted: now };
  }

  /** True if a push has not acted yet. */
  get isWaiting(): boolean {
    return this.lastPush !== undefined && this.lastPush.acted === undefined;
  }

  /** Text about the last push; empty if there was none recently. */
  get news(): string {
    if (this.lastPush === undefined) return "";
    return this.isWaiting ? "pushing\u2026" : "pushed";
  }

  /** Animate the ring, and remove it at the end. While the session is paused, a push waits. */
  tick(isPaused: boolean): void {
    const now = performance.now() / 1000;
    if (isPaused) this.deadline = now + MAX_WAITING_TIME;
    if (now > this.deadline) this.cancel();
    if (this.lastPush === undefined) return;
    const { where, since, acted } = this.lastPush;
    const age = (now - since) / RING_TIME;
    if (acted === undefined) this.marks.showPush(where(), age % 1, this.viewer.camera);
    else if (age < 1) this.marks.showPush(where(), age, this.viewer.camera);
    else this.marks.showPush();
    if (acted !== undefined && now - acted > NEWS_TIME) this.lastPush = undefined;
    this.viewer.invalidate();
  }

  /** Return the horizontal viewing direction of the camera or, if it looks straight down, the up direction of the
   * image. */
  private pushDirection(): THREE.Vector3 {
    const { camera } = this.viewer;
    const flat = (direction: THREE.Vector3): THREE.Vector3 => direction.setZ(0);
    const ahead = flat(camera.getWorldDirection(new THREE.Vector3()));
    if (ahead.length() > 0.05) return ahead.normalize();
    return flat(new THREE.Vector3(0, 1, 0).applyQuaternion(camera.quaternion)).normalize();
  }

  private heightOf(node: number): number {
    return Math.min(Math.max(this.rest[3 * node + 2]! / this.source.header.facts.height, 0), 1);
  }
}
