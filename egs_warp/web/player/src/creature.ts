// A creature for any three.js scene: the bodies of a bundle as one object.

import { SparkRenderer } from "@sparkjsdev/spark";
import * as THREE from "three";
import { Cage, identityCage } from "../../client/src/cage";
import { splatRenderer } from "../../client/src/splat_renderer";
import { deformedSplats, type DeformedSplats } from "../../client/src/splats";
import { loadBundle, type Bundle, type BundleCage, type Facts } from "./bundle";

interface MovingBody {
  source: BundleCage;
  cage: Cage;
  splats: DeformedSplats;
  /** Part of `positions` with the nodes of this body. */
  positions: Float32Array;
}

/** Shadow that darkens static splats near the ground. */
export interface Shadow {
  texture: THREE.Texture;
  region: THREE.Vector4;
}

export class Creature {
  /** Metres, with `up` upwards; move, rotate or scale it as any other object. */
  readonly object = new THREE.Group();
  /** Positions of the nodes of all cages in the frame that is shown, in the axes of the bundle. */
  readonly positions: Float32Array;
  private readonly bodies: MovingBody[] = [];

  constructor(
    readonly bundle: Bundle,
    { up = THREE.Object3D.DEFAULT_UP, shadow }: { up?: THREE.Vector3; shadow?: Shadow } = {},
  ) {
    const { facts } = bundle;
    this.object.name = facts.title ?? "creature";
    this.object.quaternion.setFromUnitVectors(new THREE.Vector3(...facts.up), up);
    this.object.scale.setScalar(facts.metres_per_unit);
    const cages = bundle.bodies.flatMap(({ cage }) => cage ?? []);
    this.positions = new Float32Array(cages.reduce((sum, { rest }) => sum + rest.length, 0));
    let start = 0;
    for (const { splats: data, cage: source } of bundle.bodies) {
      if (source === undefined) {
        this.object.add(deformedSplats(data, identityCage(), { ...(shadow && { shadow }) }).generator);
        continue;
      }
      const cage = new Cage(source.rest, source.tets);
      const splats = deformedSplats(data, cage.texture, { embedding: source.embedding });
      const positions = this.positions.subarray(start, start + source.rest.length);
      start += positions.length;
      this.bodies.push({ source, cage, splats, positions });
      this.object.add(splats.generator);
    }
    this.show(0);
  }

  get facts(): Facts {
    return this.bundle.facts;
  }

  /** Duration of the whole film, s. */
  get duration(): number {
    return (this.facts.frames - 1) / this.facts.rate;
  }

  /** Show the state at a time in seconds, or the last one that has arrived. */
  seek(seconds: number): void {
    this.show(seconds * this.facts.rate);
  }

  /** Show the state at a fractional frame index; positions are interpolated linearly. */
  show(framePosition: number): void {
    const at = Math.min(Math.max(framePosition, 0), this.bundle.available - 1);
    const fraction = at - Math.floor(at);
    for (const { source, cage, splats, positions } of this.bodies) {
      const before = source.frames[Math.floor(at)]!;
      const after = source.frames[Math.ceil(at)]!;
      for (let k = 0; k < positions.length; k++) positions[k] = before[k]! + fraction * (after[k]! - before[k]!);
      cage.update(positions);
      splats.update();
    }
  }
}

/** Return the triangles of the surfaces of all cages, whose nodes are numbered as in `Creature.positions`. */
export function surfaceOf(bundle: Bundle): Int32Array {
  const triangles: number[] = [];
  let first = 0;
  for (const { cage } of bundle.bodies) {
    if (cage === undefined) continue;
    for (const node of cage.surface) triangles.push(first + node);
    first += cage.rest.length / 3;
  }
  return new Int32Array(triangles);
}

/** Load a bundle and add it to a three.js scene; resolves when its first frames have arrived.
 *
 * A scene without a `SparkRenderer` receives one. One that is there must have been created with `covSplats: true`,
 * because the cage shears splats. */
export async function addCreature(
  scene: THREE.Scene,
  renderer: THREE.WebGLRenderer,
  address: string,
): Promise<Creature> {
  const creature = new Creature(await loadBundle(address));
  let spark: SparkRenderer | undefined;
  scene.traverse((object) => {
    if (object instanceof SparkRenderer) spark = object;
  });
  if (spark === undefined) {
    const antialiased = creature.bundle.bodies[0]?.antialiased ?? false;
    scene.add(splatRenderer(renderer, antialiased, () => {}).spark);
  } else if (!spark.covSplats) {
    throw new Error("the SparkRenderer of this scene has to be created with covSplats: true");
  }
  scene.add(creature.object);
  return creature;
}
