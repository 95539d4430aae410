// A creature for any three.js scene: the bodies of a bundle as one object.

import { SparkRenderer } from "@sparkjsdev/spark";
import * as THREE from "three";
import { Bodies, type CageTrack } from "../../client/src/bodies";
import { outlineOf } from "../../client/src/body_shadows";
import type { Shadows } from "../../client/src/shadow_map";
import { splatRenderer } from "../../client/src/splat_renderer";
import { loadBundle, type Bundle, type BundleCage, type Facts } from "./bundle";

export class Creature {
  /** Group in metres, with `up` upwards; it can be moved, rotated or scaled like any other object. */
  readonly object: THREE.Group;
  readonly bodies: Bodies;

  constructor(
    readonly bundle: Bundle,
    { up = THREE.Object3D.DEFAULT_UP, shadows }: { up?: THREE.Vector3; shadows?: Shadows } = {},
  ) {
    const { facts } = bundle;
    const bodies = bundle.bodies.map(({ splats, cage, normals }) => {
      const relighting = facts.light && normals && { irradiance: facts.light.irradiance, normals };
      return { splats, track: cage && trackOf(cage), relighting };
    });
    this.bodies = new Bodies(bodies, { shadows, up: new THREE.Vector3(...facts.up) });
    this.object = this.bodies.object;
    this.object.name = facts.title ?? "creature";
    this.object.quaternion.setFromUnitVectors(new THREE.Vector3(...facts.up), up);
    this.object.scale.setScalar(facts.metres_per_unit);
    this.show(0);
  }

  /** Positions of the nodes of all cages in the frame that is shown, in the axes of the bundle. */
  get positions(): Float32Array {
    return this.bodies.positions;
  }

  get facts(): Facts {
    return this.bundle.facts;
  }

  /** Duration of the whole film, s. */
  get duration(): number {
    return (this.facts.frames - 1) / this.facts.rate;
  }

  /** Show the state at a time in seconds, or the last state that has arrived. */
  seek(seconds: number): void {
    this.show(seconds * this.facts.rate);
  }

  /** Show the state at a fractional frame index; positions are interpolated linearly. */
  show(framePosition: number): void {
    this.bodies.interpolate(framePosition, this.bundle.available);
  }
}

function trackOf({ rest, tets, surface, embedding, shape, frames }: BundleCage): CageTrack {
  const outline = outlineOf(surface, 0, rest.length / 3);
  const shapes = shape === undefined ? [] : [{ ...shape, outline, tets: [0, tets.length / 4] as [number, number] }];
  return { rest, tets, embedding, shapes, positionsAt: (frame) => frames[frame]! };
}

/** Load a bundle and add it to a three.js scene; resolves when the first frames of the bundle have arrived.
 *
 * If the scene has no `SparkRenderer`, one is added. An existing one must have been created with `covSplats: true`,
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
