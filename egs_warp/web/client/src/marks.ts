// What the user's hand and the creature's aim look like: where it goes, which way it faces, what pulls at it.

import * as THREE from "three";
import { Strokes } from "./strokes";

const ACCENT = new THREE.Color(0x7fd1b8);
const PULL = new THREE.Color(0xffc24a).toArray();

export class Marks {
  readonly group = new THREE.Group();
  private readonly goal: THREE.Mesh;
  private readonly facing: THREE.Mesh;
  private readonly spring = new Strokes(2.5, 0.95, 16);

  constructor(private readonly height: number) {
    const flat = (opacity: number): THREE.MeshBasicMaterial =>
      new THREE.MeshBasicMaterial({ color: ACCENT, transparent: true, opacity, depthWrite: false, side: THREE.DoubleSide });
    this.goal = new THREE.Mesh(new THREE.RingGeometry(0.1 * height, 0.14 * height, 48), flat(0.85));
    const chevron = new THREE.Shape();
    for (const [k, [x, y]] of [[0, 0.13], [0.17, 0], [0, -0.13], [0.05, 0]].entries()) {
      if (k === 0) chevron.moveTo(x! * height, y! * height);
      else chevron.lineTo(x! * height, y! * height);
    }
    this.facing = new THREE.Mesh(new THREE.ShapeGeometry(chevron), flat(0.7));
    for (const mark of [this.goal, this.facing]) {
      mark.renderOrder = -5;
      mark.position.z = 0.002 * height;
      mark.visible = false;
      this.group.add(mark);
    }
    this.group.add(this.spring.object);
  }

  showGoal(goal: [number, number] | null): void {
    this.goal.visible = goal !== null;
    if (goal !== null) this.goal.position.set(goal[0], goal[1], this.goal.position.z);
  }

  /** A chevron on the ground ahead of `middle`. */
  showFacing(middle: THREE.Vector3, [x, y]: [number, number], reach: number): void {
    this.facing.visible = true;
    this.facing.position.set(middle.x + reach * x, middle.y + reach * y, this.facing.position.z);
    this.facing.rotation.z = Math.atan2(y, x);
  }

  /** From where the body is held to the hand; without both, none. */
  showSpring(held?: THREE.Vector3, hand?: THREE.Vector3): void {
    if (held === undefined || hand === undefined) {
      this.spring.set([], []);
      return;
    }
    const ring: number[] = [];
    const radius = 0.015 * this.height;
    for (let k = 0; k < 16; k++) {
      for (const j of [k, k + 1]) {
        const angle = (Math.PI * j) / 8;
        ring.push(hand.x + radius * Math.cos(angle), hand.y + radius * Math.sin(angle), hand.z);
      }
    }
    const points = [...held.toArray(), ...hand.toArray(), ...ring];
    this.spring.set(points, Array.from({ length: points.length }, (_, k) => PULL[k % 3]!));
  }
}
