// The bodies of a creature or a world: splats that move with the nodes of their cages, and static splats.

import * as THREE from "three";
import { Cage, identityCage } from "./cage";
import { deformedSplats, type DeformedSplats, type Embedding, type Relighting, type SplatData } from "./splats";

/** A cage and the positions of its nodes over time. */
export interface CageTrack {
  rest: Float32Array;
  tets: Int32Array;
  embedding: Embedding;
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

/** Shadow that darkens static splats near the ground. */
export interface Shadow {
  texture: THREE.Texture;
  region: THREE.Vector4;
}

interface MovingBody {
  track: CageTrack;
  cage: Cage;
  splats: DeformedSplats;
  /** Part of `Bodies.positions` with the nodes of this body. */
  positions: Float32Array;
}

export class Bodies {
  readonly object = new THREE.Group();
  /** Positions of the nodes of all cages in the frame that is shown. */
  readonly positions: Float32Array;
  private readonly moving: MovingBody[] = [];
  private readonly still: DeformedSplats[] = [];

  /** With `hasMarks`, the colour of a moving splat depends on the object to which it belongs. */
  constructor(bodies: Body[], { shadow, hasMarks = false }: { shadow?: Shadow | undefined; hasMarks?: boolean } = {}) {
    const nodes = bodies.map(({ track }) => track?.rest.length ?? 0);
    this.positions = new Float32Array(nodes.reduce((sum, count) => sum + count, 0));
    let start = 0;
    for (const { splats: data, track, relighting } of bodies) {
      if (track === undefined) {
        this.still.push(deformedSplats(data, identityCage(), { ...(shadow && { shadow }) }));
        continue;
      }
      const cage = new Cage(track.rest, track.tets);
      const splats = deformedSplats(data, cage.texture, { embedding: track.embedding, hasMarks, relighting });
      const positions = this.positions.subarray(start, start + track.rest.length);
      positions.set(track.rest);
      start += positions.length;
      this.moving.push({ track, cage, splats, positions });
    }
    for (const { generator } of [...this.moving.map(({ splats }) => splats), ...this.still]) this.object.add(generator);
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
    for (const { track, cage, splats, positions } of this.moving) {
      const before = track.positionsAt(Math.floor(at));
      const after = track.positionsAt(Math.ceil(at));
      for (let k = 0; k < positions.length; k++) positions[k] = before[k]! + fraction * (after[k]! - before[k]!);
      cage.update(positions);
      splats.update();
    }
  }

  showMoving(visible: boolean): void {
    for (const { splats } of this.moving) splats.generator.visible = visible;
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
