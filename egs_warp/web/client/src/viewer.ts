// Viewer of one run on one canvas: splats, overlays, ground and camera.

import * as THREE from "three";
import { Bodies, type Body } from "./bodies";
import { Overlays, type Layer } from "./overlays";
import { bytesOf, embeddingOf, floatsOf, indicesOf, shapesOf, splatsOf } from "./packets";
import type { BodyPart, FilmCamera, Frame } from "./packets";
import { offsetOfView, type Orbit } from "./camera_turn";
import type { FrameSource } from "./frame_source";
import { radiusOf } from "./ground";
import { Stage } from "./stage";

/** Fraction of the picture that the body, or its whole run, fills in the front, side and top views. */
const FILL = 0.86;
/** Minimum change of the ground's height, in body heights, at which a following camera changes its height. */
const GROUND_CHANGE = 0.02;
/** Fraction of a change of the ground's height by which a following camera moves per image. */
const RISE_PER_FRAME = 0.1;
/** Maximum distance, in body heights, between the box of a body and the points at which contacts support it. */
const CONTACT_DISTANCE = 0.05;
/** Distance between a body in the air and the top of the picture, as a fraction of half of the picture's height. */
const TOP_MARGIN = 0.06;
/** Half of the height that a following camera shows of a wide body, relative to the horizontal diagonal of its box, as
 * in egs_warp/web/preview.py. */
const WIDE = 0.6;
/** Maximum magnification of a live session in a window that is higher than wide. */
const MAX_LIVE_ZOOM = 1.4;
/** Offset of the marks of selected bodies (`egsMarked`). */
const SELECTED = 256;
export type Preset = "film" | "front" | "side" | "top";
export type LayerToggle = Layer | "splats" | "scene" | "ground";

export class Viewer extends Stage {
  /** View that was chosen last; undefined once the camera was turned away from it. */
  chosenView: Preset | undefined;
  /** Function that is called when `chosenView` has changed. */
  onChosenView: () => void = () => {};
  protected readonly bodies: Bodies;
  private readonly overlays: Overlays;
  private readonly masses: Float32Array;
  /** Bounds of the body over the whole run. */
  private readonly bounds: THREE.Box3;
  /** Middle of the body at the start of the run or of the live session. */
  private readonly startCentre: THREE.Vector3;
  private readonly currentCentre = new THREE.Vector3();
  /** Frame that is shown, or that precedes the interpolated positions. */
  private frame: Frame;
  /** Selected body of a world; undefined if none is selected, or for a run with one body. */
  private body: number | undefined;
  private isFollowing = false;
  /** Height of the ground under the body that the camera follows, m. */
  private groundHeight = 0;
  /** Height by which a following camera is raised for a body in the air, m. */
  private lift = 0;
  /** True for each of the layers ground and scene that is shown. */
  private readonly layers = { ground: true, scene: true };

  constructor(
    canvas: HTMLCanvasElement,
    readonly source: FrameSource,
  ) {
    const { header } = source;
    const { antialiased, height, light } = header.facts;
    const rest = floatsOf(header, "rest");
    const radius = radiusOf(source.frames.map(({ positions }) => [positions]));
    super(canvas, { antialiased, height, radius, light });
    this.masses = floatsOf(header, "node_mass");
    const positionsAt = (frame: number): Float32Array => source.frames[frame]!.positions;
    const [tets, embedding, shapes] = [indicesOf(header, "tets"), embeddingOf(header), shapesOf(header)];
    const track = { rest, tets, embedding, shapes, positionsAt };
    const relighting = light && { irradiance: light.irradiance, normals: bytesOf(header, "splats_normals") };
    const bodies: Body[] = [{ splats: splatsOf(header, "splats"), track, relighting }];
    if (header.arrays.has("scene_means")) bodies.push({ splats: splatsOf(header, "scene") });
    const hasMarks = header.facts.picking ?? header.facts.bodies !== undefined;
    this.bodies = new Bodies(bodies, { shadows: this.ground.shadows, hasMarks });
    // Before the object is separated, the splats of the run include the captured ground.
    const { preparing, picking } = header.facts;
    if (!(preparing || picking)) this.ground.setCasters(this.bodies.casters());
    this.overlays = new Overlays(header, (frame) => this.computeCentre(frame.positions));
    this.scene.add(this.bodies.object, this.overlays.group);
    this.bounds = this.runBounds();
    const [start] = source.frames as [Frame];
    this.frame = start;
    // The first frame of a page that is opened later shows the creature elsewhere.
    this.startCentre =
      header.facts.start === undefined
        ? new THREE.Box3().setFromArray(start.positions).getCenter(new THREE.Vector3())
        : new THREE.Vector3(...header.facts.start);
    // The first view is centred on the body where it is now.
    this.bodies.interpolate(0, source.frames.length);
    // The camera of a live session follows the body, which needs less space at its sides unless it is wide.
    if (header.facts.preparing || header.facts.motions !== undefined) this.portraitZoom = this.liveZoom();
    this.layers.ground = !this.hasScene;
    this.showSurroundings();
    this.controls.zoomToCursor = true;
    this.turn.onMovedByUser = () => this.setChosenView(undefined);
    this.preset("film");
    this.show(0);
  }

  /** True if the camera follows the centre of mass. */
  get follow(): boolean {
    return this.isFollowing;
  }

  set follow(on: boolean) {
    this.isFollowing = on;
    // A camera that stays where it is has not been raised.
    if (!on) this.lift = 0;
  }

  get hasScene(): boolean {
    return this.bodies.hasStill;
  }

  get standPoint(): THREE.Vector3 {
    return this.centreOfMass.setZ(0);
  }

  protected get hasOpaqueFloor(): boolean {
    const { layers, mode } = this;
    const isFloorShown = mode === "immersive-ar" || (layers.ground && !(this.hasScene && layers.scene));
    return this.source.header.facts.flat && isFloorShown;
  }

  protected showSurroundings(): void {
    const isInRoom = this.mode === "immersive-ar";
    this.ground.mesh.visible = this.layers.ground && !isInRoom;
    this.bodies.showStill(this.layers.scene && !isInRoom);
  }

  setLayerVisible(layer: LayerToggle, visible: boolean): void {
    if (layer === "splats") this.bodies.showMoving(visible);
    else if (layer === "ground" || layer === "scene") {
      this.layers[layer] = visible;
      this.showSurroundings();
    } else this.overlays.show(layer, visible);
    this.invalidate();
  }

  /** Show the run at a fractional frame index; positions are interpolated linearly. */
  show(framePosition: number): void {
    const { frames } = this.source;
    const at = Math.min(framePosition, frames.length - 1);
    this.frame = frames[Math.floor(at)] as Frame;
    this.bodies.interpolate(at, frames.length);
    this.overlays.update(frames[Math.round(at)] as Frame, this.positions, frames);
    const centre = this.computeCentre(this.positions);
    if (this.follow) this.followBody(centre);
    this.currentCentre.copy(centre);
    this.moveShadows();
  }

  /** Bodies of a world; undefined for a run with one body. */
  get parts(): BodyPart[] | undefined {
    return this.source.header.facts.bodies;
  }

  /** Return the index of the body of a world to which a node belongs. */
  bodyOf(node: number): number {
    return this.parts?.findIndex(({ nodes: [first, count] }) => node >= first && node < first + count) ?? 0;
  }

  /** Select a body of a world: brighten it, follow it, and show its centre of mass. */
  select(body: number | undefined): void {
    const { parts } = this;
    if (parts === undefined) return;
    this.body = body;
    const labels = new Uint8Array(Math.max(...parts.map(({ splats: [first, count] }) => first + count)));
    parts.forEach(({ splats: [first, count] }, k) => labels.fill(k + 1, first, first + count));
    this.mark(labels, body === undefined ? -1 : SELECTED + body + 1);
    this.overlays.resetPath();
    this.groundHeight = this.heightOfGround(this.followedPositions());
    this.currentCentre.copy(this.computeCentre(this.positions));
  }

  private get positions(): Float32Array {
    return this.bodies.positions;
  }

  /** Move with the body along the ground. The camera moves up or down with the ground that supports the body, and with
   * a body in the air only as far as needed to keep it in the picture. */
  private followBody(centre: THREE.Vector3): void {
    const moved = centre.clone().sub(this.currentCentre).setZ(0);
    const followed = this.followedPositions();
    const isSupported = this.isSupported(followed);
    if (isSupported) {
      moved.z = RISE_PER_FRAME * groundChange(lowestOf(followed) - this.groundHeight, this.height);
      this.groundHeight += moved.z;
    }
    moved.z -= this.lift;
    this.camera.position.add(moved);
    this.lift = isSupported ? 0 : this.neededLift();
    this.camera.position.z += this.lift;
    this.controls.target.add(moved).z += this.lift;
  }

  /** Return the height, m, by which the camera must rise so that the followed body is not cut off at the top: at most
   * the distance between the body and the ground. */
  private neededLift(): number {
    const { camera } = this;
    const box = new THREE.Box3().setFromArray(this.followedPositions());
    const clearance = box.min.z - this.groundHeight;
    if (clearance <= 0 || this.headset.isPresenting) return 0;
    camera.updateMatrixWorld();
    const elements = camera.projectionMatrix.elements;
    const slope = (1 - TOP_MARGIN + elements[9]!) / elements[5]!;
    const up = new THREE.Vector3().setFromMatrixColumn(camera.matrixWorld, 1);
    const forward = camera.getWorldDirection(new THREE.Vector3());
    let lift = 0;
    for (let k = 0; k < 8; k++) {
      const corner = new THREE.Vector3(
        k & 1 ? box.max.x : box.min.x,
        k & 2 ? box.max.y : box.min.y,
        k & 4 ? box.max.z : box.min.z,
      ).sub(camera.position);
      const above = corner.dot(up) - slope * corner.dot(forward);
      lift = Math.max(lift, above / Math.max(up.z - slope * forward.z, 1e-3));
    }
    return Math.min(lift, clearance);
  }

  /** Node positions of the body that the camera follows: the selected one of a world, or else all. */
  private followedPositions(): Float32Array {
    const part = this.body === undefined ? undefined : this.parts?.[this.body];
    if (part === undefined) return this.positions;
    const [first, count] = part.nodes;
    return this.positions.subarray(3 * first, 3 * (first + count));
  }

  preset(name: Preset): void {
    const { camera } = this.source.header.facts;
    this.fov = camera.fov;
    // A following camera shows the body; otherwise the camera shows its whole run.
    const isFollowing = this.follow || this.source.isOpen;
    const box = isFollowing ? new THREE.Box3().setFromArray(this.positions) : this.bounds;
    const centre = box.getCenter(new THREE.Vector3());
    this.lift = 0;
    // The height of the ground under all bodies of a world; the selected one may stand on another one.
    const ground = isFollowing ? this.heightOfGround(this.positions) : 0;
    this.groundHeight = isFollowing ? this.heightOfGround(this.followedPositions()) : 0;
    // The camera follows a body in the air from the view of a body on the ground.
    const { preparing, picking } = this.source.header.facts;
    if (isFollowing && !(preparing || picking)) centre.z -= Math.max(box.min.z - ground, 0);
    if (name === "film") {
      const shift = isFollowing ? centre.clone().sub(this.startCentre).setZ(ground) : new THREE.Vector3();
      this.setCamera(...filmView(camera, centre, shift));
    } else {
      const direction = this.direction(name);
      const half = Math.tan((Math.PI * camera.fov) / 360);
      const distance = isFollowing ? viewSize(box) / half : this.distanceToShow(box, direction, half);
      this.setCamera(centre.clone().addScaledVector(direction, distance), centre);
    }
    this.resize();
    this.setChosenView(name);
  }

  /** Return the height, m, of the ground that supports a body at `positions`; in the air, the last known height. */
  private heightOfGround(positions: Float32Array): number {
    return this.isSupported(positions) ? groundChange(lowestOf(positions), this.height) : this.groundHeight;
  }

  /** Return true if a contact of the frame that is shown is at the body at `positions`. */
  private isSupported(positions: Float32Array): boolean {
    const { contacts } = this.frame;
    const margin = CONTACT_DISTANCE * this.height;
    const box = new THREE.Box3().setFromArray(positions).expandByScalar(margin);
    for (let k = 0; k < contacts.length; k += 9) {
      if (box.containsPoint(new THREE.Vector3().fromArray(contacts, k))) return true;
    }
    return false;
  }

  private setChosenView(name: Preset | undefined): void {
    if (name === this.chosenView) return;
    this.chosenView = name;
    this.onChosenView();
  }

  /** Magnification at which the body, turned in any direction, is not cut off at the sides of a narrow window. */
  private liveZoom(): number {
    const box = new THREE.Box3().setFromArray(this.positions);
    const { x, y } = box.getSize(new THREE.Vector3());
    return Math.min(Math.max((FILL * viewSize(box)) / (0.5 * Math.hypot(x, y)), 1), MAX_LIVE_ZOOM);
  }

  /** Turn smoothly to `camera`, which looks at the body. */
  turnTo(camera: FilmCamera): void {
    this.turn.start(...filmView(camera, new THREE.Box3().setFromArray(this.positions).getCenter(new THREE.Vector3())));
    this.invalidate();
  }

  /** Show a view that is given relative to the camera of the film. */
  showView(view: Orbit): void {
    const { camera, height } = this.source.header.facts;
    const { target } = this.controls;
    this.setCamera(target.clone().add(offsetOfView(view, camera.forward, height)), target.clone());
    this.setChosenView(undefined);
  }

  /** Return the unit vector from the body to the camera of a view, for a body that may have turned since the start. */
  private direction(name: Exclude<Preset, "film">): THREE.Vector3 {
    const [ahead, left] = this.source.header.facts.front;
    const yaw = this.yaw();
    const front = new THREE.Vector3(ahead, left, 0).applyAxisAngle(this.camera.up, yaw);
    // The side view is from the left of the body, so the front is at the left of the picture.
    const side = new THREE.Vector3(-left, ahead, 0).applyAxisAngle(this.camera.up, yaw);
    if (name === "top") return front.multiplyScalar(-1e-3).setZ(1).normalize();
    return (name === "front" ? front : side).setZ(0.12).normalize();
  }

  /** Return the angle about the vertical by which the body has turned relative to its rest pose, rad. */
  private yaw(): number {
    // The bodies of a world have different rest poses; their `front` points towards the film's camera.
    if (this.parts !== undefined) return 0;
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

  /** Copy the view of another viewer's camera. */
  copyCamera(from: Viewer): void {
    this.camera.position.copy(from.camera.position);
    this.controls.target.copy(from.controls.target);
    this.camera.lookAt(this.controls.target);
    this.invalidate();
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

  /** Return a JPEG image of the current view as a data URL. */
  picture(): string {
    this.render();
    return this.canvas.toDataURL("image/jpeg", 0.9);
  }

  /** Brighten the splats of the object `active`; `labels` contains the number of each splat's object, 0 for none. */
  mark(labels: Uint8Array, active: number): void {
    this.bodies.mark(labels, active);
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

  /** Return the visible point of the body's surface at a window position, and the nearest node; undefined if the body
   * is not at this position. */
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

  /** Return the point of the ground at a window position; undefined if there is none or it is too far away. */
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
    const part = this.body === undefined ? undefined : this.parts?.[this.body];
    const [first, count] = part?.nodes ?? [0, this.masses.length];
    for (let k = first; k < first + count; k++) {
      const mass = this.masses[k]!;
      total += mass;
      sum.x += mass * positions[3 * k]!;
      sum.y += mass * positions[3 * k + 1]!;
      sum.z += mass * positions[3 * k + 2]!;
    }
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

/** Return the position of `camera`, moved by `shift`, and its target, by default at the depth of `centre`. */
function filmView(
  { position, forward, distance }: FilmCamera,
  centre: THREE.Vector3,
  shift = new THREE.Vector3(),
): [THREE.Vector3, THREE.Vector3] {
  const eye = new THREE.Vector3(...position).add(shift);
  const ahead = new THREE.Vector3(...forward);
  return [eye, eye.clone().addScaledVector(ahead, distance ?? Math.max(centre.clone().sub(eye).dot(ahead), 1e-3))];
}

/** Return half of the height, m, that a following camera shows of a body in a box. */
function viewSize(box: THREE.Box3): number {
  const { x, y, z } = box.getSize(new THREE.Vector3());
  return Math.max(z, WIDE * Math.hypot(x, y));
}

/** Return the height of the lowest node, m. */
function lowestOf(positions: Float32Array): number {
  let lowest = Infinity;
  for (let k = 2; k < positions.length; k += 3) lowest = Math.min(lowest, positions[k]!);
  return lowest;
}

/** Return the change of the ground's height, m, for a lowest node that is higher by `rise`. Pressed soles and small
 * bumps do not count as changes. */
function groundChange(rise: number, height: number): number {
  return Math.sign(rise) * Math.max(Math.abs(rise) - GROUND_CHANGE * height, 0);
}
