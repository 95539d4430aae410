// The bodies of a creature or a world: splats that move with the nodes of their cages, and static splats.

import * as THREE from "three";
import { BodyShadows, type Shape } from "./body_shadows";
import { Cage, identityCage } from "./cage";
import type { Casters, Shadows } from "./shadow_map";
import { deformedSplats, type DeformedSplats, type Embedding, type Relighting, type SplatData } from "./splats";

/** A cage and the positions of its nodes over time. */
export interface CageTrack {
  rest: Float32Array;
  tets: Int32Array;
  embedding: Embedding;
  /** Shapes of the bodies, which shade each other; empty if they are unknown. */
  shapes: Shape[];
  /** Return the node positions of a frame. */
  positionsAt(frame: number): Float32Array;
}

export interface Body {
  splats: SplatData;
  /** Cage with which the splats move; undefined for static splats. */
  track?: CageTrack | undefined;
  /** Relighting of the splats by their normals; undefined if the colours do not change. */
  relighting?: Relighting | undefined;
}

interface BodiesOptions {
  /** Shadows that darken static splats near the ground. */
  shadows?: Shadows | undefined;
  /** True if the colour of a moving splat depends on the object to which it belongs. */
  hasMarks?: boolean;
  /** Unit vector upwards, in the axes of the splats. */
  up?: THREE.Vector3;
}

/** Approximate number of splats that cast the shadow, if there are more. With 100,000 of 498,000 splats, the
 * root-mean-square error of the shadow's opacity is 0.02. */
const MAX_CASTERS = 100_000;
/** Maximum number of splats of which the median size is computed. */
const SAMPLE = 4096;

interface MovingBody {
  track: CageTrack;
  splats: DeformedSplats;
  /** Part of `Bodies.positions` with the nodes of this body. */
  positions: Float32Array;
}

export class Bodies {
  readonly object = new THREE.Group();
  /** Positions of the nodes of all cages in the frame that is shown. */
  readonly positions: Float32Array;
  /** Cage of all moving bodies. */
  private readonly cage: Cage;
  private readonly bodyShadows: BodyShadows | undefined;
  private readonly moving: MovingBody[] = [];
  private readonly still: DeformedSplats[] = [];
  /** Moving splats, and the codes of their tetrahedra (`Embedding.meanTets`). */
  private readonly movingSplats: [SplatData, Int32Array][] = [];

  constructor(bodies: Body[], { shadows, hasMarks = false, up = new THREE.Vector3(0, 0, 1) }: BodiesOptions = {}) {
    const joint = concatenated(bodies.flatMap(({ track }) => track ?? []));
    this.positions = joint.rest.slice();
    this.cage = new Cage(joint.rest, joint.tets);
    if (joint.shapes.length > 1) this.bodyShadows = new BodyShadows(joint.shapes, joint.tets, this.cage, up);
    const { bodyShadows } = this;
    let [start, firstTet] = [0, 0];
    for (const { splats: data, track, relighting } of bodies) {
      if (track === undefined) {
        this.still.push(deformedSplats(data, identityCage(), { ...(shadows && { shadows }) }));
        continue;
      }
      const embedding = shiftedEmbedding(track.embedding, firstTet);
      const splats = deformedSplats(data, this.cage.texture, { embedding, hasMarks, relighting, bodyShadows });
      this.movingSplats.push([data, embedding.meanTets]);
      const positions = this.positions.subarray(start, start + track.rest.length);
      start += positions.length;
      firstTet += track.tets.length / 4;
      this.moving.push({ track, splats, positions });
    }
    for (const { generator } of [...this.moving.map(({ splats }) => splats), ...this.still]) this.object.add(generator);
  }

  /** Return the splats that cast shadows on the ground. */
  casters(): Casters {
    return { cage: this.cage.texture, ...casterPoints(this.movingSplats) };
  }

  get hasMoving(): boolean {
    return this.moving.length > 0;
  }

  get hasStill(): boolean {
    return this.still.length > 0;
  }

  /** Show the state at a fractional frame index of `count` frames; positions are interpolated linearly. */
  interpolate(framePosition: number, count: number): void {
    const at = Math.min(Math.max(framePosition, 0), count - 1);
    const fraction = at - Math.floor(at);
    for (const { track, positions } of this.moving) {
      const before = track.positionsAt(Math.floor(at));
      const after = track.positionsAt(Math.ceil(at));
      for (let k = 0; k < positions.length; k++) positions[k] = before[k]! + fraction * (after[k]! - before[k]!);
    }
    this.cage.update(this.positions);
    this.bodyShadows?.update(this.positions);
    this.update();
  }

  showMoving(visible: boolean): void {
    for (const { splats } of this.moving) splats.generator.visible = visible;
  }

  get isStillVisible(): boolean {
    return this.still.some(({ generator }) => generator.visible);
  }

  showStill(visible: boolean): void {
    for (const { generator } of this.still) generator.visible = visible;
  }

  /** Brighten the moving splats of the object `active`; see `DeformedSplats.mark`. */
  mark(labels: Uint8Array, active: number): void {
    for (const { splats } of this.moving) splats.mark(labels, active);
  }

  /** Regenerate the moving splats in the next image. */
  update(): void {
    for (const { splats } of this.moving) splats.update();
  }
}

/** Return the nodes at rest, the tetrahedra and the shapes of several cages, numbered as in one cage. */
function concatenated(tracks: CageTrack[]): { rest: Float32Array; tets: Int32Array; shapes: Shape[] } {
  const total = (key: "rest" | "tets"): number => tracks.reduce((sum, track) => sum + track[key].length, 0);
  const [rest, tets] = [new Float32Array(total("rest")), new Int32Array(total("tets"))];
  const shapes: Shape[] = [];
  let [nodes, corners] = [0, 0];
  for (const track of tracks) {
    rest.set(track.rest, 3 * nodes);
    tets.set(track.tets.map((node) => node + nodes), corners);
    for (const shape of track.shapes) {
      const [first, count] = shape.tets;
      const outline = shape.outline.map((node) => node + nodes);
      shapes.push({ ...shape, outline, tets: [first + corners / 4, count] });
    }
    nodes += track.rest.length / 3;
    corners += track.tets.length;
  }
  return { rest, tets, shapes };
}

/** Return the embedding in a cage of which the tetrahedra from `firstTet` on are those of `embedding`. */
function shiftedEmbedding(embedding: Embedding, firstTet: number): Embedding {
  if (firstTet === 0) return embedding;
  const meanTets = embedding.meanTets.map((code) => (code < 0 ? code - firstTet : code + firstTet));
  const arms = embedding.arms.map((value, k) => (k % 15 < 6 ? value + firstTet : value));
  return { ...embedding, meanTets, arms };
}

/** Return the points of splats with the codes of their tetrahedra (`Embedding.meanTets`), and their median size. If
 * there are many splats, every n-th is returned with n times its area. */
function casterPoints(bodies: [SplatData, Int32Array][]): { geometry: THREE.BufferGeometry; grain: number } {
  const total = bodies.reduce((sum, [, codes]) => sum + codes.length, 0);
  const stride = Math.max(Math.round(total / MAX_CASTERS), 1);
  const count = bodies.reduce((sum, [, codes]) => sum + Math.ceil(codes.length / stride), 0);
  const [means, casters, sizes] = [new Float32Array(3 * count), new Float32Array(2 * count), new Float32Array(count)];
  let at = 0;
  for (const [{ means: own, scales, opacities }, codes] of bodies) {
    for (let k = 0; k < codes.length; k += stride) {
      const [a, b, c] = [scales[3 * k]!, scales[3 * k + 1]!, scales[3 * k + 2]!];
      const [low, high] = [Math.min(a, b), Math.max(a, b)];
      const middle = Math.max(low, Math.min(high, c));
      const code = codes[k]!;
      for (let axis = 0; axis < 3; axis++) means[3 * at + axis] = own[3 * k + axis]!;
      casters[2 * at] = stride * 2 * Math.PI * middle * Math.max(high, c) * opacities[k]!;
      casters[2 * at + 1] = code < 0 ? -1 - code : code;
      sizes[at++] = middle;
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(means, 3));
  geometry.setAttribute("caster", new THREE.BufferAttribute(casters, 2));
  return { geometry, grain: sampledMedian(sizes) };
}

/** Return the median of a sample of `values` at equal distances; 0 without values. */
function sampledMedian(values: Float32Array): number {
  const stride = Math.ceil(values.length / SAMPLE);
  const sample = values.filter((_, k) => k % stride === 0).sort();
  return sample[Math.floor(sample.length / 2)] ?? 0;
}
