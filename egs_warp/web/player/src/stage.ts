// Picture of a bundle on its ground.

import * as THREE from "three";
import type { Bodies } from "../../client/src/bodies";
import { viewCanvas } from "../../client/src/dom";
import { BACKGROUND, radiusOf } from "../../client/src/ground";
import { Stage } from "../../client/src/stage";
import type { Bundle, Camera } from "./bundle";
import { Creature } from "./creature";

const UP = new THREE.Vector3(0, 0, 1);
/** Camera for a bundle without one: its direction, and its distance in body heights. */
const DIRECTION = new THREE.Vector3(-0.5, 1, -0.25).normalize();
const DISTANCE = 4;

export class BundleStage extends Stage {
  readonly creature: Creature;
  protected readonly bodies: Bodies;
  /** True if the ground is the plane z = 0. */
  private readonly isFlat: boolean;
  /** Height of the ground, m. */
  private readonly groundHeight: number;
  /** Value of the attribute `background`. */
  private background = "";

  constructor(bundle: Bundle) {
    const { facts, bodies } = bundle;
    super(viewCanvas(facts.title ?? "creature"), {
      antialiased: bodies[0]?.antialiased ?? false,
      height: (facts.height ?? 1) * facts.metres_per_unit,
      // Later frames may not have arrived.
      radius: facts.metres_per_unit * radiusOf([bodies.flatMap(({ cage }) => cage?.frames[0] ?? [])]),
      // The ground and its shadow are in the axes of the bundle.
      light: facts.light,
    });
    this.creature = new Creature(bundle, { up: UP, shadows: this.ground.shadows });
    this.bodies = this.creature.bodies;
    if (this.bodies.hasMoving) this.ground.setCasters(this.bodies.casters());
    const isInPlace = new THREE.Matrix4().equals(this.placement());
    this.isFlat = isInPlace && facts.flat_ground === true;
    this.groundHeight = this.isFlat ? 0 : this.lowest();
    this.scene.add(this.creature.object);
    this.setBackground("");
    // A finger that moves up or down scrolls the page.
    this.canvas.style.touchAction = "pan-y";
    this.show(0);
    this.placeCamera(facts.camera);
  }

  get standPoint(): THREE.Vector3 {
    return this.box().getCenter(new THREE.Vector3()).setZ(this.groundHeight);
  }

  protected get hasOpaqueFloor(): boolean {
    if (this.mode === "immersive-ar") return this.isFlat;
    // If the page is visible behind the creature, the floor still hides splats, as in the studio.
    const isStudio = this.mode !== undefined || this.background === "" || this.background === "transparent";
    return isStudio && this.hasFloor;
  }

  /** True if the studio's floor fits the bundle, which then has flat ground and no scene. */
  private get hasFloor(): boolean {
    return this.isFlat && !this.bodies.hasStill;
  }

  protected showSurroundings(): void {
    const { mode, background, renderer } = this;
    const isInRoom = mode === "immersive-ar";
    const colour = mode === undefined ? background : "";
    this.ground.mesh.visible = colour === "" && this.hasFloor && !isInRoom;
    this.ground.shadowMesh.visible = isInRoom && this.isFlat;
    // A bundle that contains only a scene shows the scene even in augmented reality.
    this.bodies.showStill(!isInRoom || !this.bodies.hasMoving);
    if (colour === "transparent") renderer.setClearColor(0x000000, 0);
    else renderer.setClearColor(colour === "" ? BACKGROUND : new THREE.Color().setStyle(colour), 1);
  }

  /** Set the background: an empty text shows the studio, "transparent" shows nothing, any other value is a CSS
   * colour. */
  setBackground(colour: string): void {
    this.background = colour;
    this.showSurroundings();
    this.invalidate();
  }

  /** Show the state at a fractional frame index. */
  show(framePosition: number): void {
    this.creature.show(framePosition);
    this.moveShadows();
  }

  override resize(): void {
    super.resize();
    // Draw now, because resizing clears the canvas, which the browser may present before the next animation frame.
    if (this.hasImage && !this.headset.isPresenting) this.render();
  }

  private placement(): THREE.Matrix4 {
    this.creature.object.updateMatrixWorld();
    return this.creature.object.matrixWorld;
  }

  /** Box around the nodes of the bodies. */
  private box(): THREE.Box3 {
    return new THREE.Box3().setFromArray(this.creature.positions).applyMatrix4(this.placement());
  }

  /** Height of the lowest node, m; 0 without nodes. */
  private lowest(): number {
    const { positions } = this.creature;
    let lowest = positions.length > 0 ? Infinity : 0;
    const node = new THREE.Vector3();
    for (let k = 0; k < positions.length; k += 3) {
      lowest = Math.min(lowest, node.fromArray(positions, k).applyMatrix4(this.placement()).z);
    }
    return lowest;
  }

  private centre(): THREE.Vector3 {
    return this.box().getCenter(new THREE.Vector3());
  }

  /** Place the camera as in the film; it orbits the middle of the bodies. */
  private placeCamera(film: Camera | undefined): void {
    const centre = this.centre();
    const forward = film === undefined ? DIRECTION.clone() : new THREE.Vector3(...film.forward);
    const eye = centre.clone().addScaledVector(forward, -DISTANCE * this.height);
    if (film !== undefined) {
      this.fov = film.fov;
      eye.fromArray(film.position);
      forward.transformDirection(this.placement());
      eye.applyMatrix4(this.placement());
    }
    this.camera.position.copy(eye);
    this.controls.target.copy(eye).addScaledVector(forward, Math.max(centre.sub(eye).dot(forward), 1e-3));
    this.controls.update();
  }
}
