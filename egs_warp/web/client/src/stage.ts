// Picture of splats on their ground, on one canvas: renderer, camera, and the decision when an image is drawn.

import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import type { Bodies } from "./bodies";
import { CameraTurn } from "./camera_turn";
import { fitCamera, type Margins } from "./fit_camera";
import { BACKGROUND, FLOOR_DEPTH, Ground } from "./ground";
import { Headset } from "./headset";
import type { MainLight } from "./packets";
import { releaseSharedObjects, splatRenderer, type SplatRenderer } from "./splat_renderer";

export interface StageOptions {
  /** True if the capture was trained with antialiasing. */
  antialiased: boolean;
  /** Height of the body, m. */
  height: number;
  /** Radius of a ball around all bodies, m (`radiusOf`). */
  radius: number;
  /** Main light of the capture; undefined if it is not clear. */
  light?: MainLight | undefined;
}

const NO_WEBGL2 =
  "This browser has no WebGL2, which is needed to draw the splats. " +
  "Enable hardware acceleration in its settings or use another browser.";

function pause(milliseconds: number): Promise<void> {
  return new Promise((resolve) => setTimeout(resolve, milliseconds));
}

export abstract class Stage {
  readonly renderer: THREE.WebGLRenderer;
  readonly scene = new THREE.Scene();
  readonly camera = new THREE.PerspectiveCamera();
  readonly controls: OrbitControls;
  readonly ground: Ground;
  readonly headset: Headset;
  /** Turn of the camera to another view. */
  readonly turn: CameraTurn;
  /** Height of the body, m. */
  readonly height: number;
  /** Vertical field of view of the film, degrees. */
  protected fov = 30;
  /** Magnification in a window that is higher than wide. */
  protected portraitZoom = 1;
  /** Mode of the headset's session; undefined on the page. */
  protected mode: XRSessionMode | undefined;
  private readonly splatRenderer: SplatRenderer;
  /** Fraction of the canvas resolution along each side; reduced on slow machines. */
  private resolution = 1;
  /** Parts of the canvas that panels cover. */
  private margins: Margins = { top: 0, bottom: 0 };
  private dirty = true;
  /** True if the bodies have moved since their shadows were rendered. */
  private isShadowStale = true;
  /** True once an image was drawn. */
  protected hasImage = false;
  private isDisposed = false;

  constructor(
    readonly canvas: HTMLCanvasElement,
    { antialiased, height, radius, light }: StageOptions,
  ) {
    this.height = height;
    // Spark advises against multisampling, which does not improve splats.
    const attributes: WebGLContextAttributes = { antialias: false, alpha: true, powerPreference: "high-performance" };
    const context = canvas.getContext("webgl2", attributes);
    if (context === null) throw new Error(NO_WEBGL2);
    this.renderer = new THREE.WebGLRenderer({ canvas, context });
    this.renderer.setClearColor(BACKGROUND, 1);
    this.camera.up.set(0, 0, 1);
    this.ground = new Ground(height, radius, light);
    this.splatRenderer = splatRenderer(this.renderer, antialiased, () => this.invalidate());
    this.scene.add(this.splatRenderer.spark, this.ground.mesh, this.ground.shadowMesh);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.12;
    this.controls.addEventListener("change", () => this.invalidate());
    this.turn = new CameraTurn(this.camera, this.controls, canvas);
    this.headset = new Headset(this);
  }

  protected abstract readonly bodies: Bodies;

  /** Point of the ground under the middle of the body, in the axes of the scene. */
  abstract get standPoint(): THREE.Vector3;

  /** True if a floor at z = 0 hides what is below it. */
  protected abstract get hasOpaqueFloor(): boolean;

  /** Show the surroundings for `mode`. In augmented reality, they consist only of the shadow on the real floor. */
  protected abstract showSurroundings(): void;

  /** Switch to the surroundings for a headset, or back to those of the page. */
  setMode(mode: XRSessionMode | undefined): void {
    this.mode = mode;
    this.ground.shadowMesh.visible = mode === "immersive-ar";
    this.showSurroundings();
    this.resize();
    this.invalidate();
  }

  invalidate(): void {
    this.dirty = true;
  }

  resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    // During a session, a headset sets the size and the projection.
    if (width === 0 || height === 0 || this.headset.isPresenting) return;
    this.renderer.setPixelRatio(this.resolution * Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.fit();
  }

  /** Move the picture clear of panels that cover the top or the bottom of the canvas. */
  setMargins(margins: Margins): void {
    if (margins.top === this.margins.top && margins.bottom === this.margins.bottom) return;
    this.margins = margins;
    if (!this.headset.isPresenting) this.fit();
  }

  private fit(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    fitCamera(this.camera, this.fov, { width, height, ...this.margins }, this.height, this.portraitZoom);
    this.invalidate();
  }

  /** Reduce the resolution by a quarter, but not below one half. */
  reduceResolution(): void {
    this.setResolution(Math.max(this.resolution - 0.25, 0.5));
  }

  /** Set the fraction of the canvas resolution along each side. */
  setResolution(fraction: number): void {
    if (fraction === this.resolution) return;
    this.resolution = fraction;
    this.resize();
  }

  /** True while the splats of the last image are being sorted. */
  get sorting(): boolean {
    return this.splatRenderer.spark.sorting;
  }

  /** Draw if something has changed; return true if an image was drawn. */
  draw(): boolean {
    if (this.headset.isPresenting) this.headset.update();
    else {
      if (this.turn.advance()) this.invalidate();
      this.controls.update();
      if (!this.dirty) return false;
    }
    this.render();
    // This image contains the regenerated splats; Spark calls invalidate() again when they have been sorted.
    this.dirty = false;
    return true;
  }

  /** Draw after the splats have been sorted for the current view. */
  async drawSorted(): Promise<void> {
    const { spark } = this.splatRenderer;
    // Spark ignores an update that changes the number of splats during a sort.
    while (spark.sorting) await pause(5);
    if (this.isDisposed) return;
    this.camera.updateMatrixWorld();
    // Colours depend on the direction from the camera.
    this.bodies.update();
    this.castShadows();
    await spark.update({ scene: this.scene, camera: this.camera });
    while (spark.sorting) await pause(5);
    if (this.isDisposed) return;
    this.render();
    this.dirty = false;
  }

  /** Render the shadows again in the next image. */
  protected moveShadows(): void {
    this.isShadowStale = true;
    this.invalidate();
  }

  /** Render the shadows of bodies that have moved, if anything that receives them is visible. */
  private castShadows(): void {
    const { positions, isStillVisible } = this.bodies;
    if (!this.isShadowStale || positions.length === 0 || !(this.ground.isVisible || isStillVisible)) return;
    this.isShadowStale = false;
    const middle = new THREE.Box3().setFromArray(positions).getCenter(new THREE.Vector3());
    this.ground.cast(this.renderer, positions, middle);
  }

  protected render(): void {
    this.castShadows();
    const isAbove = this.headset.isPresenting || this.camera.position.z > 0;
    this.splatRenderer.floorDepth.value = this.hasOpaqueFloor && isAbove ? FLOOR_DEPTH * this.height : 0;
    this.renderer.render(this.scene, this.camera);
    this.hasImage = true;
  }

  /** Release the WebGL context after the current sort has finished, because Spark cannot read from a lost context. */
  async dispose(): Promise<void> {
    const { spark } = this.splatRenderer;
    this.isDisposed = true;
    await this.headset.dispose();
    this.renderer.setAnimationLoop(null);
    this.controls.dispose();
    while (spark.sorting || spark.sortDirty) await pause(10);
    spark.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
    releaseSharedObjects();
  }
}
