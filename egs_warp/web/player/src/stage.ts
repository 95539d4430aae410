// Picture of a creature on its ground, on one canvas.

import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { element } from "../../client/src/dom";
import { fitCamera } from "../../client/src/fit_camera";
import { BACKGROUND, FLOOR_DEPTH, Ground } from "../../client/src/ground";
import { splatRenderer, type SplatRenderer } from "../../client/src/splat_renderer";
import type { Bundle, Camera } from "./bundle";
import { Creature, surfaceOf } from "./creature";

const UP = new THREE.Vector3(0, 0, 1);
/** Camera of a bundle that has none: its direction, its field of view in degrees, and its distance in body heights. */
const DIRECTION = new THREE.Vector3(-0.5, 1, -0.25).normalize();
const FOV = 30;
const DISTANCE = 4;

function pause(milliseconds: number): Promise<void> {
  return new Promise((resolve) => setTimeout(resolve, milliseconds));
}

export class Stage {
  readonly canvas: HTMLCanvasElement;
  readonly creature: Creature;
  readonly camera = new THREE.PerspectiveCamera();
  readonly controls: OrbitControls;
  private readonly renderer: THREE.WebGLRenderer;
  private readonly scene = new THREE.Scene();
  private readonly splatRenderer: SplatRenderer;
  private readonly ground: Ground;
  private readonly height: number;
  /** True if the floor of the studio fits the bundle: flat ground with nothing of a scene on it. */
  private readonly hasFloor: boolean;
  /** True if the floor hides what is below it, in the studio and where the page shows through. */
  private floorHides = false;
  private fov = FOV;
  private dirty = true;
  private isDisposed = false;

  constructor(bundle: Bundle) {
    const { facts, bodies } = bundle;
    this.canvas = element("canvas", { tabindex: "0", "aria-label": facts.title ?? "creature" });
    // Spark advises against multisampling, which does not improve splats.
    const context = { canvas: this.canvas, antialias: false, alpha: true };
    this.renderer = new THREE.WebGLRenderer({ ...context, powerPreference: "high-performance" });
    this.camera.up.copy(UP);
    this.height = (facts.height ?? 1) * facts.metres_per_unit;
    const nodeCount = bodies.reduce((sum, { cage }) => sum + (cage?.rest.length ?? 0) / 3, 0);
    this.ground = new Ground(surfaceOf(bundle), nodeCount, this.height);
    this.creature = new Creature(bundle, { up: UP, shadow: this.ground.shadow });
    // The ground and its shadow are in the axes of the bundle.
    const isInPlace = new THREE.Matrix4().equals(this.placement());
    this.hasFloor = isInPlace && facts.flat_ground === true && bodies.every(({ cage }) => cage !== undefined);
    this.splatRenderer = splatRenderer(this.renderer, bodies[0]?.antialiased ?? false, () => this.invalidate());
    this.scene.add(this.splatRenderer.spark, this.creature.object, this.ground.mesh);
    this.setBackground("");
    this.controls = new OrbitControls(this.camera, this.canvas);
    // A finger that moves up or down scrolls the page.
    this.canvas.style.touchAction = "pan-y";
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.12;
    this.controls.addEventListener("change", () => this.invalidate());
    this.show(0);
    this.placeCamera(facts.camera);
  }

  private placement(): THREE.Matrix4 {
    this.creature.object.updateMatrixWorld();
    return this.creature.object.matrixWorld;
  }

  /** Show the studio for an empty text, nothing behind the creature for "transparent", otherwise a colour of CSS. */
  setBackground(colour: string): void {
    this.ground.mesh.visible = colour === "" && this.hasFloor;
    this.floorHides = (colour === "" || colour === "transparent") && this.hasFloor;
    if (colour === "transparent") this.renderer.setClearColor(0x000000, 0);
    else this.renderer.setClearColor(colour === "" ? BACKGROUND : new THREE.Color().setStyle(colour), 1);
    this.invalidate();
  }

  /** Show the state at a fractional frame index. */
  show(framePosition: number): void {
    this.creature.show(framePosition);
    const centre = this.centre();
    if (this.creature.positions.length > 0) this.ground.cast(this.renderer, this.creature.positions, centre);
    this.invalidate();
  }

  invalidate(): void {
    this.dirty = true;
  }

  /** Middle of the box around the bodies. */
  private centre(): THREE.Vector3 {
    const box = new THREE.Box3().setFromArray(this.creature.positions);
    const centre = box.getCenter(new THREE.Vector3());
    return centre.applyMatrix4(this.placement());
  }

  /** Place the camera as in the film, and turn it about the middle of the bodies. */
  private placeCamera(film: Camera | undefined): void {
    const centre = this.centre();
    const forward = film === undefined ? DIRECTION.clone() : new THREE.Vector3(...film.forward);
    const eye = centre.clone().addScaledVector(forward, -DISTANCE * this.height);
    if (film !== undefined) eye.fromArray(film.position);
    if (film !== undefined) {
      this.fov = film.fov;
      forward.transformDirection(this.placement());
      eye.applyMatrix4(this.placement());
    }
    this.camera.position.copy(eye);
    this.controls.target.copy(eye).addScaledVector(forward, Math.max(centre.sub(eye).dot(forward), 1e-3));
    this.controls.update();
  }

  resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    fitCamera(this.camera, this.fov, width / height, this.height);
    // Resizing clears the canvas, which the browser may present before the next animation frame.
    this.render();
    this.invalidate();
  }

  /** True while the splats of the last image are being sorted. */
  get sorting(): boolean {
    return this.splatRenderer.spark.sorting;
  }

  /** Draw if something has changed; return true if an image was drawn. */
  draw(): boolean {
    this.controls.update();
    if (!this.dirty) return false;
    this.render();
    this.dirty = false;
    return true;
  }

  /** Draw after the splats are sorted for the current view. */
  async drawSorted(): Promise<void> {
    const { spark } = this.splatRenderer;
    for (let round = 0; round < 2 && !this.isDisposed; round++) {
      this.camera.updateMatrixWorld();
      this.render();
      await spark.update({ scene: this.scene, camera: this.camera });
      while (spark.sorting) await pause(5);
    }
    if (this.isDisposed) return;
    this.render();
    this.dirty = false;
  }

  private render(): void {
    const isOverFloor = this.floorHides && this.camera.position.z > 0;
    this.splatRenderer.floorDepth.value = isOverFloor ? FLOOR_DEPTH * this.height : 0;
    this.renderer.render(this.scene, this.camera);
  }

  /** Release the WebGL context, after the sort in progress: Spark cannot read from a lost context. */
  async dispose(): Promise<void> {
    const { spark } = this.splatRenderer;
    this.isDisposed = true;
    this.controls.dispose();
    while (spark.sorting || spark.sortDirty) await pause(10);
    spark.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }
}
