// Grid on the ground, arrows for the up direction and the front of the picked object, and handles by which they are
// dragged.

import * as THREE from "three";
import type { GroundGrid, PickState, Vector } from "./pick_news";
import { WideLines } from "./wide_lines";

export type Handle = "up" | "front" | "ground";

/** Colours of the handles; components are sRGB values, which the shader writes unchanged. */
const COLOURS: Record<Handle, Vector> = {
  up: [0.5, 0.82, 0.72],
  front: [1, 0.76, 0.29],
  ground: [0.86, 0.89, 0.94],
};
/** Lengths in sizes of the object. */
const GRID_HALF = 0.8;
const GRID_LINES = 9;
/** Number of segments in a grid line on uneven ground. */
const GRID_SEGMENTS = 32;
const REACH: Record<Handle, number> = { up: 0.95, front: 0.85, ground: 0.9 };
/** Half of a handle's cross, relative to the size of the object. */
const MARK_SIZE = 0.03;
const HEAD_SIZE = 0.09;

export class PickGizmos {
  readonly group = new THREE.Group();
  readonly normal = new THREE.Vector3(0, 0, 1);
  readonly anchor = new THREE.Vector3();
  readonly front = new THREE.Vector3(1, 0, 0);
  size = 1;
  /** Uneven ground, which moves with the plane; null if the ground is flat or has not been measured. */
  ground: GroundGrid | null = null;
  private active = 0;
  private hasFront = false;
  private readonly grid = new WideLines(1.5, 0.55, 10, { hasRim: false });
  private readonly arrows = new WideLines(4, 1, 12);

  constructor() {
    this.group.add(this.grid.object, this.arrows.object);
  }

  /** Offset d of the ground n.x + d = 0. */
  get offset(): number {
    return -this.normal.dot(this.anchor);
  }

  show(state: PickState): void {
    const normal = new THREE.Vector3(state.plane[0], state.plane[1], state.plane[2]);
    // Heights that were measured for another object, or over another plane, are not valid.
    if (state.active !== this.active || normal.distanceTo(this.normal) > 1e-6) this.ground = null;
    this.active = state.active;
    this.normal.copy(normal);
    this.anchor.set(...state.anchor);
    this.size = state.size;
    if (state.front !== null) this.showFront(state.front);
    this.draw();
  }

  /** Show the measured ground; null means that the ground is flat. */
  showGround(ground: GroundGrid | null): void {
    this.ground = ground;
    this.draw();
  }

  /** Return the height of the ground over its plane at `point`, interpolated bilinearly between the nodes. */
  private heightAt(point: THREE.Vector3): number {
    const { ground } = this;
    if (ground === null) return 0;
    const arm = point.clone().sub(new THREE.Vector3(...ground.origin));
    const last = ground.count - 1;
    const [x, y] = [ground.first, ground.second].map((axis) =>
      Math.min(Math.max(arm.dot(new THREE.Vector3(...axis)) / ground.spacing, 0), last),
    ) as [number, number];
    const [column, row] = [Math.min(Math.floor(x), last - 1), Math.min(Math.floor(y), last - 1)];
    const at = (r: number, c: number): number => ground.heights[r * ground.count + c] ?? 0;
    const [s, t] = [x - column, y - row];
    const near = (1 - s) * at(row, column) + s * at(row, column + 1);
    return (1 - t) * near + t * ((1 - s) * at(row + 1, column) + s * at(row + 1, column + 1));
  }

  /** Show the given or estimated front; null hides the arrow until there is one. */
  showFront(front: Vector | null): void {
    this.hasFront = front !== null;
    if (front !== null) this.front.set(...front);
    this.draw();
  }

  /** Return the positions of the handles. */
  handles(): Map<Handle, THREE.Vector3> {
    const { anchor, size } = this;
    const at = (direction: THREE.Vector3, handle: Handle): THREE.Vector3 =>
      anchor.clone().addScaledVector(direction, REACH[handle] * size);
    const ahead = this.ahead();
    const found = new Map<Handle, THREE.Vector3>();
    found.set("up", at(this.normal, "up"));
    found.set("ground", at(ahead.clone().cross(this.normal), "ground"));
    if (this.hasFront) found.set("front", at(ahead, "front"));
    return found;
  }

  /** Return the direction of the front along the ground. */
  private ahead(): THREE.Vector3 {
    const ahead = this.front.clone().projectOnPlane(this.normal);
    if (ahead.length() > 1e-3) return ahead.normalize();
    return new THREE.Vector3(1, 0, 0).projectOnPlane(this.normal).normalize();
  }

  /** Move a handle so that it follows `ray`. */
  drag(handle: Handle, ray: THREE.Ray): void {
    const { anchor, size, normal } = this;
    if (handle === "up") {
      const nearest = new THREE.Vector3();
      const sphere = new THREE.Sphere(anchor, REACH.up * size);
      // If the ray misses the sphere, the nearest point of the ray gives the direction.
      if (ray.intersectSphere(sphere, nearest) === null) ray.closestPointToPoint(anchor, nearest);
      const direction = nearest.sub(anchor);
      if (direction.length() > 1e-6) normal.copy(direction.normalize());
    } else if (handle === "front") {
      const ground = new THREE.Plane(normal, this.offset);
      const point = ray.intersectPlane(ground, new THREE.Vector3());
      const direction = point?.sub(anchor).projectOnPlane(normal);
      if (direction !== undefined && direction.length() > 1e-6) this.front.copy(direction.normalize());
    } else {
      const start = this.handles().get("ground") as THREE.Vector3;
      // The target is the point, on the line through the handle along the normal, that is nearest to the ray.
      const across = ray.direction.dot(normal);
      const between = start.clone().sub(ray.origin);
      const scale = 1 - across * across;
      const shift = across * between.dot(ray.direction) - between.dot(normal);
      if (scale > 1e-3) anchor.addScaledVector(normal, shift / scale);
    }
    this.draw();
  }

  private draw(): void {
    const { anchor, normal, size } = this;
    const ahead = this.ahead();
    const side = ahead.clone().cross(normal);
    const half = GRID_HALF * size;
    const lines: number[] = [];
    const point = (x: number, y: number): THREE.Vector3 => {
      const flat = anchor.clone().addScaledVector(ahead, x).addScaledVector(side, y);
      return flat.addScaledVector(normal, this.heightAt(flat));
    };
    const segments = this.ground === null ? 1 : GRID_SEGMENTS;
    for (let k = 0; k < GRID_LINES; k++) {
      const at = half * ((2 * k) / (GRID_LINES - 1) - 1);
      for (let n = 0; n < segments; n++) {
        const [begin, end] = [n, n + 1].map((m) => half * ((2 * m) / segments - 1)) as [number, number];
        lines.push(...point(at, begin).toArray(), ...point(at, end).toArray());
        lines.push(...point(begin, at).toArray(), ...point(end, at).toArray());
      }
    }
    this.grid.set(lines, lines.map((_, k) => COLOURS.ground[k % 3]!));
    const arrows: number[] = [];
    const colours: number[] = [];
    const add = (handle: Handle, ...segments: THREE.Vector3[]): void => {
      for (const end of segments) {
        arrows.push(...end.toArray());
        colours.push(...COLOURS[handle]);
      }
    };
    const handles = this.handles();
    for (const handle of ["up", "front"] as const) {
      const tip = handles.get(handle);
      if (tip === undefined) continue;
      const along = tip.clone().sub(anchor).normalize();
      add(handle, anchor, tip);
      // Draw four barbs, so that the head is visible from every side.
      for (const aside of [side, handle === "up" ? ahead : normal]) {
        for (const sign of [1, -1]) {
          const barb = tip.clone().addScaledVector(along, -HEAD_SIZE * size);
          add(handle, tip, barb.addScaledVector(aside, 0.6 * sign * HEAD_SIZE * size));
        }
      }
    }
    const handle = handles.get("ground") as THREE.Vector3;
    const arm = (direction: THREE.Vector3, length: number): THREE.Vector3 =>
      handle.clone().addScaledVector(direction, length * size);
    const [low, high] = [arm(normal, -2 * MARK_SIZE), arm(normal, 2 * MARK_SIZE)];
    const ends = [low, high].flatMap((end, k) =>
      [1, -1].flatMap((sign) => {
        const inward = end.clone().addScaledVector(normal, (k === 0 ? 1 : -1) * MARK_SIZE * size);
        return [end, inward.addScaledVector(ahead, sign * MARK_SIZE * size)];
      }),
    );
    add("ground", low, high, ...ends);
    this.arrows.set(arrows, colours);
  }
}
