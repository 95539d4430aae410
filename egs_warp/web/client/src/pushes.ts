// Pushes: away from whoever looks, along the ground, on all of the creature or around a place that is hit.

import * as THREE from "three";
import type { Marks } from "./marks";
import { floatsOf } from "./packets";
import type { LiveSource } from "./source";
import type { Stage } from "./stage";

/** Seconds for which a ring shows where it was. */
const SEEN = 0.35;

export class Pushes {
  /** m sqrt(g H). */
  strength = 0.15;
  private readonly rest: Float32Array;
  private hit: { where: () => THREE.Vector3; since: number } | undefined;

  constructor(
    private readonly stage: Stage,
    private readonly source: LiveSource,
    private readonly marks: Marks,
  ) {
    this.rest = floatsOf(source.header, "rest");
  }

  /** Around the height of `node` in the standing creature; without it, all of it alike. */
  push(node?: number): void {
    const { x, y } = this.away().multiplyScalar(this.strength);
    const height = node === undefined ? {} : { height: this.heightOf(node) };
    this.source.send({ type: "push", x, y, z: 0, ...height });
    const where = () => (node === undefined ? this.stage.middle : this.stage.node(node));
    this.hit = { where, since: performance.now() / 1000 };
  }

  /** Lets the ring grow and go. */
  tick(): void {
    if (this.hit === undefined) return;
    const age = (performance.now() / 1000 - this.hit.since) / SEEN;
    if (age < 1) this.marks.showPush(this.hit.where(), age, this.stage.camera);
    else {
      this.hit = undefined;
      this.marks.showPush();
    }
    this.stage.invalidate();
  }

  /** Where the eye looks along the ground; from straight above, what is up in the picture. */
  private away(): THREE.Vector3 {
    const { camera } = this.stage;
    const flat = (way: THREE.Vector3): THREE.Vector3 => way.setZ(0);
    const ahead = flat(camera.getWorldDirection(new THREE.Vector3()));
    const way = ahead.length() > 0.05 ? ahead : flat(new THREE.Vector3(0, 1, 0).applyQuaternion(camera.quaternion));
    return way.normalize();
  }

  private heightOf(node: number): number {
    return Math.min(Math.max(this.rest[3 * node + 2]! / this.source.header.facts.height, 0), 1);
  }
}
