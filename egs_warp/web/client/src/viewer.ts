// Viewer of one run on one canvas: splats, overlays, ground and camera.

import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { Cage, identityCage } from "./cage";
import { splatRenderer, type SplatRenderer } from "./splat_renderer";
import { fitCamera } from "./fit_camera";
import { BACKGROUND, FLOOR_DEPTH, Ground } from "./ground";
import { Overlays, type Layer } from "./overlays";
import { bytesOf, embeddingOf, floatsOf, indicesOf, splatsOf, type Frame } from "./packets";
import type { FrameSource } from "./frame_source";
import { deformedSplats, type DeformedSplats } from "./splats";

/** Fraction of the picture that the body or its run fills in the views front, side and top. */
const FILL = 0.86;
/** Height by which the ground must change before a following camera changes its height, in body heights. */
const GROUND_CHANGE = 0.02;
/** Fraction of a change of the ground's height by which a following camera moves in one image. */
const RISE_PER_FRAME = 0.1;
/** Half of the height that a view of the body alone shows, in body heights. */
const HALF_VIEW_HEIGHT = 1;
export type Preset = "film" | "front" | "side" | "top";
export type LayerToggle = Layer | "splats" | "scene" | "ground";

export class Viewer {
  readonly renderer: THREE.WebGLRenderer;
  readonly camera = new THREE.PerspectiveCamera();
  readonly controls: OrbitControls;
  /** True if the camera follows the centre of mass. */
  follow = false;
  /** Fraction of the canvas resolution along each side; reduced on slow machines. */
  private resolution = 1;
  private readonly scene = new THREE.Scene();
  private readonly splatRenderer: SplatRenderer;
  private readonly cage: Cage;
  private readonly splats: DeformedSplats;
  private readonly background: DeformedSplats | undefined;
  private readonly overlays: Overlays;
  private readonly ground: Ground;
  private readonly masses: Float32Array;
  /** Bounds of the body over the run. */
  private readonly bounds: THREE.Box3;
  /** Middle of the body in the first frame. */
  private readonly startCentre: THREE.Vector3;
  private readonly positions: Float32Array;
  private readonly currentCentre = new THREE.Vector3();
  /** Height of the ground under the body that the camera follows, m. */
  private groundHeight = 0;
  private filmFov = 30;
  private dirty = true;

  constructor(
    readonly canvas: HTMLCanvasElement,
    readonly source: FrameSource,
  ) {
    const { header } = source;
    // Spark advises against multisampling, which does not improve splats.
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, powerPreference: "high-performance" });
    this.renderer.setClearColor(BACKGROUND, 1);
    this.camera.up.set(0, 0, 1);
    this.masses = floatsOf(header, "node_mass");
    const rest = floatsOf(header, "rest");
    this.positions = new Float32Array(rest);
    this.cage = new Cage(rest, indicesOf(header, "tets"));
    this.splats = deformedSplats(splatsOf(header, "splats"), this.cage.texture, {
      embedding: embeddingOf(header),
      hasMarks: header.facts.picking ?? false,
      ...(header.facts.light && {
        irradiance: header.facts.light.irradiance,
        normals: bytesOf(header, "splats_normals"),
      }),
    });
    this.splatRenderer = splatRenderer(this.renderer, header.facts.antialiased, () => this.invalidate());
    this.scene.add(this.splatRenderer.spark, this.splats.generator);
    this.overlays = new Overlays(header, (frame) => this.computeCentre(frame.positions));
    this.scene.add(this.overlays.group);
    this.bounds = this.runBounds();
    const [start] = source.frames as [Frame];
    this.startCentre = new THREE.Box3().setFromArray(start.positions).getCenter(new THREE.Vector3());
    this.ground = new Ground(indicesOf(header, "surface"), rest.length / 3, header.facts.height, header.facts.light);
    if (header.arrays.has("scene_means")) {
      const { shadow } = this.ground;
      this.background = deformedSplats(splatsOf(header, "scene"), identityCage(), { shadow });
      this.scene.add(this.background.generator);
    }
    this.ground.mesh.visible = this.background === undefined;
    this.scene.add(this.ground.mesh);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.12;
    this.controls.zoomToCursor = true;
    this.controls.addEventListener("change", () => this.invalidate());
    this.preset("film");
    this.show(0);
  }

  get hasScene(): boolean {
    return this.background !== undefined;
  }

  invalidate(): void {
    this.dirty = true;
  }

  setLayerVisible(layer: LayerToggle, visible: boolean): void {
    if (layer === "splats") this.splats.generator.visible = visible;
    else if (layer === "ground") this.ground.mesh.visible = visible;
    else if (layer === "scene") {
      if (this.background !== undefined) this.background.generator.visible = visible;
    } else this.overlays.show(layer, visible);
    this.invalidate();
  }

  /** Show the run at a fractional frame index; positions are interpolated linearly. */
  show(framePosition: number): void {
    const { frames } = this.source;
    const at = Math.min(framePosition, frames.length - 1);
    const before = frames[Math.floor(at)] as Frame;
    const after = frames[Math.min(Math.floor(at) + 1, frames.length - 1)] as Frame;
    const fraction = at - Math.floor(at);
    for (let k = 0; k < this.positions.length; k++) {
      this.positions[k] = before.positions[k]! + fraction * (after.positions[k]! - before.positions[k]!);
    }
    this.cage.update(this.positions);
    this.splats.update();
    this.overlays.update(fraction < 0.5 ? before : after, this.positions, frames);
    const centre = this.computeCentre(this.positions);
    if (this.follow) this.followBody(centre, before);
    this.currentCentre.copy(centre);
    this.ground.cast(this.renderer, this.positions, centre);
    this.invalidate();
  }

  /** Move with the body along the ground, and up or down only with the ground that carries it: the camera does not
   * follow a jump. */
  private followBody(centre: THREE.Vector3, frame: Frame): void {
    const moved = centre.clone().sub(this.currentCentre).setZ(0);
    if (frame.contacts.length > 0) {
      let lowest = Infinity;
      for (let k = 2; k < this.positions.length; k += 3) lowest = Math.min(lowest, this.positions[k]!);
      // Pressed soles and small bumps do not count as a change of the ground's height.
      const rise = lowest - this.groundHeight;
      const threshold = GROUND_CHANGE * this.source.header.facts.height;
      moved.z = RISE_PER_FRAME * Math.sign(rise) * Math.max(Math.abs(rise) - threshold, 0);
      this.groundHeight += moved.z;
    }
    this.camera.position.add(moved);
    this.controls.target.add(moved);
  }

  preset(name: Preset): void {
    const { camera, height } = this.source.header.facts;
    this.filmFov = camera.fov;
    // Where the camera follows, it shows the body; elsewhere, its whole run.
    const isFollowing = this.follow || this.source.isOpen;
    const box = isFollowing ? new THREE.Box3().setFromArray(this.positions) : this.bounds;
    const centre = box.getCenter(new THREE.Vector3());
    if (name === "film") {
      const eye = new THREE.Vector3(...camera.position);
      const forward = new THREE.Vector3(...camera.forward);
      const shift = isFollowing ? centre.clone().sub(this.startCentre).setZ(0) : new THREE.Vector3();
      eye.add(shift);
      this.setCamera(eye, eye.clone().addScaledVector(forward, Math.max(centre.clone().sub(eye).dot(forward), 1e-3)));
    } else {
      const direction = this.direction(name);
      const half = Math.tan((Math.PI * camera.fov) / 360);
      const distance = isFollowing ? (HALF_VIEW_HEIGHT * height) / half : this.distanceToShow(box, direction, half);
      this.setCamera(centre.clone().addScaledVector(direction, distance), centre);
    }
    this.groundHeight = 0;
    this.resize();
  }

  /** Return the unit vector from the body to the camera of a view; the body may have turned since the start. */
  private direction(name: Exclude<Preset, "film">): THREE.Vector3 {
    const [ahead, left] = this.source.header.facts.front;
    const yaw = this.yaw();
    const front = new THREE.Vector3(ahead, left, 0).applyAxisAngle(this.camera.up, yaw);
    // The side is the left: the front is at the left of the picture.
    const side = new THREE.Vector3(-left, ahead, 0).applyAxisAngle(this.camera.up, yaw);
    if (name === "top") return front.multiplyScalar(-1e-3).setZ(1).normalize();
    return (name === "front" ? front : side).setZ(0.12).normalize();
  }

  /** Return the angle about the vertical by which the body has turned since it was at rest, in radians. */
  private yaw(): number {
    const { positions, masses } = this;
    const rest = floatsOf(this.source.header, "rest");
    const [before, now] = [this.computeCentre(rest), this.computeCentre(positions)];
    let [cosine, sine] = [0, 0];
    masses.forEach((mass, k) => {
      const [x, y] = [rest[3 * k]! - before.x, rest[3 * k + 1]! - before.y];
      const [u, v] = [positions[3 * k]! - now.x, positions[3 * k + 1]! - now.y];
      cosine += mass * (x * u + y * v);
      sine += mass * (x * v - y * u);
    });
    return Math.atan2(sine, cosine);
  }

  /** Return the distance from the centre of `box` at which a camera in `direction` shows all of it. */
  private distanceToShow(box: THREE.Box3, direction: THREE.Vector3, half: number): number {
    const right = new THREE.Vector3().crossVectors(this.camera.up, direction).normalize();
    const up = new THREE.Vector3().crossVectors(direction, right);
    const size = box.getSize(new THREE.Vector3()).multiplyScalar(0.5);
    let distance = 0;
    for (let k = 0; k < 8; k++) {
      const corner = new THREE.Vector3(k & 1 ? 1 : -1, k & 2 ? 1 : -1, k & 4 ? 1 : -1).multiply(size);
      const beside = Math.max(Math.abs(corner.dot(right)), Math.abs(corner.dot(up)));
      distance = Math.max(distance, corner.dot(direction) + beside / (FILL * half));
    }
    return distance;
  }

  setCamera(eye: THREE.Vector3, target: THREE.Vector3): void {
    this.camera.position.copy(eye);
    this.controls.target.copy(target);
    this.controls.update();
    this.invalidate();
  }

  /** Copy the camera of another viewer. */
  copyCamera(from: Viewer): void {
    this.camera.position.copy(from.camera.position);
    this.controls.target.copy(from.controls.target);
    this.camera.lookAt(this.controls.target);
    this.invalidate();
  }

  resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.renderer.setPixelRatio(this.resolution * Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    fitCamera(this.camera, this.filmFov, width / height, this.source.header.facts.height);
    this.invalidate();
  }

  /** Reduce the resolution by a quarter, to no less than one half. */
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
    this.controls.update();
    if (!this.dirty) return false;
    this.render();
    // This image contains the regenerated splats; Spark calls invalidate() again once they are sorted.
    this.dirty = false;
    return true;
  }

  /** Draw after the splats are sorted for the current view. */
  async drawSorted(): Promise<void> {
    const { spark } = this.splatRenderer;
    for (let round = 0; round < 2; round++) {
      this.camera.updateMatrixWorld();
      this.splats.update();
      this.render();
      await spark.update({ scene: this.scene, camera: this.camera });
      while (spark.sorting) await new Promise((resolve) => setTimeout(resolve, 5));
    }
    this.dirty = false;
    this.render();
  }

  private render(): void {
    const { facts } = this.source.header;
    const isOverFloor = facts.flat && this.ground.mesh.visible && this.camera.position.z > 0;
    const hasSceneInView = this.background?.generator.visible ?? false;
    this.splatRenderer.floorDepth.value = isOverFloor && !hasSceneInView ? FLOOR_DEPTH * facts.height : 0;
    this.renderer.render(this.scene, this.camera);
  }

  /** Return a PNG image of the current view. */
  screenshot(): Promise<Blob> {
    // The canvas keeps its content only until the browser has presented it.
    this.render();
    return new Promise((resolve, reject) => {
      const finish = (blob: Blob | null): void => {
        if (blob === null) reject(new Error("the browser returned no image"));
        else resolve(blob);
      };
      this.canvas.toBlob(finish, "image/png");
    });
  }

  /** Light up the splats of the object `active`; `labels` has the number of the object of each splat, 0 for none. */
  mark(labels: Uint8Array, active: number): void {
    this.splats.mark(labels, active);
    this.invalidate();
  }

  /** Add an object to the scene. */
  add(object: THREE.Object3D): void {
    this.scene.add(object);
    this.invalidate();
  }

  /** Return the ray from the camera through a window position. */
  ray(clientX: number, clientY: number): THREE.Ray {
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [(clientX - box.left) / box.width, (clientY - box.top) / box.height];
    const ndc = new THREE.Vector2(2 * x - 1, 1 - 2 * y);
    const raycaster = new THREE.Raycaster();
    this.camera.updateMatrixWorld();
    raycaster.setFromCamera(ndc, this.camera);
    return raycaster.ray;
  }

  /** Return the visible surface point at a window position and the nearest node, if the body is there. */
  pick(clientX: number, clientY: number): { node: number; point: THREE.Vector3 } | undefined {
    const ray = this.ray(clientX, clientY);
    const surface = indicesOf(this.source.header, "surface");
    const corner = (k: number): THREE.Vector3 => this.nodePosition(surface[k] as number);
    const nearest = { distance: Infinity, node: -1, point: new THREE.Vector3() };
    const hit = new THREE.Vector3();
    for (let k = 0; k < surface.length; k += 3) {
      const corners = [corner(k), corner(k + 1), corner(k + 2)] as const;
      if (ray.intersectTriangle(...corners, false, hit) === null) continue;
      const distance = hit.distanceTo(ray.origin);
      if (distance >= nearest.distance) continue;
      const distances = corners.map((one) => one.distanceTo(hit));
      nearest.distance = distance;
      nearest.node = surface[k + distances.indexOf(Math.min(...distances))] as number;
      nearest.point.copy(hit);
    }
    return nearest.node < 0 ? undefined : { node: nearest.node, point: nearest.point };
  }

  /** Return the ground point at a window position, unless there is none or it is too far away. */
  groundPoint(clientX: number, clientY: number): THREE.Vector3 | undefined {
    const ground = new THREE.Plane(new THREE.Vector3(0, 0, 1), 0);
    const point = this.ray(clientX, clientY).intersectPlane(ground, new THREE.Vector3());
    if (point === null || point.distanceTo(this.centreOfMass) > 40 * this.source.header.facts.height) return undefined;
    return point;
  }

  /** Return the current position of a node. */
  nodePosition(index: number): THREE.Vector3 {
    return new THREE.Vector3().fromArray(this.positions, 3 * index);
  }

  /** Current centre of mass. */
  get centreOfMass(): THREE.Vector3 {
    return this.currentCentre.clone();
  }

  private computeCentre(positions: Float32Array): THREE.Vector3 {
    const sum = new THREE.Vector3();
    let total = 0;
    this.masses.forEach((mass, k) => {
      total += mass;
      sum.x += mass * positions[3 * k]!;
      sum.y += mass * positions[3 * k + 1]!;
      sum.z += mass * positions[3 * k + 2]!;
    });
    return sum.divideScalar(total);
  }

  private runBounds(): THREE.Box3 {
    const box = new THREE.Box3();
    for (const frame of this.source.frames) {
      for (let k = 0; k < frame.positions.length; k += 3) {
        box.expandByPoint(new THREE.Vector3().fromArray(frame.positions, k));
      }
    }
    return box;
  }
}
