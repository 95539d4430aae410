// WebXR: buttons, sessions, and the position of the creature in the user's room, in metres.
//
// The scene has z up and its floor at z = 0; the local-floor space of a headset has y up and its floor at y = 0. An
// offset reference space maps one to the other, so that the scene itself does not move.

import * as THREE from "three";
import { button, type Icon } from "./dom";
import type { Stage } from "./stage";

const UP = new THREE.Vector3(0, 1, 0);
/** Rotation from the axes of the scene to the axes of a headset. */
const Z_UP_TO_Y_UP = new THREE.Quaternion().setFromAxisAngle(new THREE.Vector3(1, 0, 0), -Math.PI / 2);
/** Minimum initial distance of the creature from the user, in metres and in body heights. */
const MIN_DISTANCE = 1.2;
const MIN_DISTANCE_IN_HEIGHTS = 1.5;
/** Maximum distance of a point of the floor that can be selected, in metres and in body heights. */
const MAX_REACH = 20;
const MAX_REACH_IN_HEIGHTS = 10;
/** Depth range of a headset, m. */
const NEAR = 0.05;
const FAR = 200;
/** Minimum vertical component of the normal of a surface on which the creature can stand. */
const MIN_FLOOR_NORMAL = 0.9;
const POINTER_COLOUR = 0x7fd1b8;

interface Mode {
  mode: XRSessionMode;
  name: "VR" | "AR";
  icon: Icon;
  hint: string;
}

const MODES: Mode[] = [
  { mode: "immersive-vr", name: "VR", icon: "vr", hint: "the creature at its real size in a headset" },
  { mode: "immersive-ar", name: "AR", icon: "ar", hint: "the creature at its real size on your own floor" },
];

export class Headset {
  /** Button for each kind of session that this browser supports. */
  readonly buttons: HTMLButtonElement[];
  /** Called with the point of the floor that the user selects. If it is undefined, a selection moves the user in
   * virtual reality, and the creature in augmented reality. */
  onFloor: ((point: THREE.Vector3) => void) | undefined;
  private session: XRSession | undefined;
  private mode: XRSessionMode | undefined;
  /** Reference space with its floor at y = 0. */
  private base: XRReferenceSpace | undefined;
  /** Pose of the scene in `base`; undefined until the position of the user is known. */
  private pose: { position: THREE.Vector3; rotation: THREE.Quaternion } | undefined;
  private hits: XRHitTestSource | undefined;
  /** Input source that moves the creature, and the point of the floor at which the source has grabbed it. */
  private grab: { source: XRInputSource; point: THREE.Vector3 } | undefined;
  /** Vector from the target of the page's camera to the camera. */
  private readonly eyeOffset = new THREE.Vector3();
  private readonly pointer = createPointer();
  private readonly disposal = new AbortController();

  constructor(private readonly stage: Stage) {
    this.buttons = MODES.map(({ mode, name, icon, hint }) => {
      const created = button(icon, `Enter ${name}: ${hint}`, () => void this.toggle(mode));
      created.hidden = true;
      return created;
    });
    stage.scene.add(this.pointer.group);
    // This listener runs after three.js has restored the canvas.
    stage.renderer.xr.addEventListener("sessionend", () => this.end());
    navigator.xr?.addEventListener("devicechange", () => void this.showButtons(), { signal: this.disposal.signal });
    void this.showButtons();
  }

  get isPresenting(): boolean {
    return this.session !== undefined;
  }

  /** Start a session. The browser requires a click or a key press of the user. */
  async enter(mode: XRSessionMode): Promise<void> {
    if (navigator.xr === undefined || this.isPresenting) return;
    const { xr } = this.stage.renderer;
    const optionalFeatures = mode === "immersive-ar" ? ["hit-test"] : [];
    const session = await navigator.xr.requestSession(mode, { requiredFeatures: ["local-floor"], optionalFeatures });
    const { camera, controls } = this.stage;
    this.eyeOffset.copy(camera.position).sub(controls.target);
    camera.near = Math.min(camera.near, NEAR);
    camera.far = Math.max(camera.far, FAR);
    controls.enabled = false;
    xr.enabled = true;
    xr.setReferenceSpaceType("local-floor");
    session.addEventListener("select", (event) => this.select(event));
    session.addEventListener("squeezestart", (event) => this.startGrab(event));
    session.addEventListener("squeezeend", () => {
      this.grab = undefined;
    });
    this.session = session;
    this.mode = mode;
    await xr.setSession(session);
    this.base = xr.getReferenceSpace() ?? undefined;
    this.stage.setMode(mode);
    this.showState();
    if (mode === "immersive-ar") await this.requestHits(session);
  }

  /** End the session. */
  async leave(): Promise<void> {
    await this.session?.end();
  }

  /** End the session and release the browser's XR objects, which would keep the stage in memory. */
  async dispose(): Promise<void> {
    this.disposal.abort();
    await this.leave();
  }

  /** Place the creature and the pointer for the next image. */
  update(): void {
    const { xr } = this.stage.renderer;
    const frame = xr.getFrame() as XRFrame | null;
    if (frame === null || this.base === undefined) return;
    if (this.pose === undefined) this.placeInFront(frame, this.base);
    if (this.hits !== undefined) this.placeOnHit(frame, this.hits, this.base);
    if (this.grab !== undefined) {
      const point = this.floorPoint(frame, this.grab.source);
      if (point !== undefined) this.shift(point.sub(this.grab.point));
    }
    this.showPointer(frame);
  }

  private async showButtons(): Promise<void> {
    for (const [k, { mode }] of MODES.entries()) {
      const isSupported = (await navigator.xr?.isSessionSupported(mode).catch(() => false)) ?? false;
      this.buttons[k]!.hidden = !isSupported;
    }
  }

  private async toggle(mode: XRSessionMode): Promise<void> {
    if (this.isPresenting) return this.leave();
    try {
      await this.enter(mode);
    } catch (error) {
      // The user has declined the session, or the device is in use.
      this.buttons[MODES.findIndex((one) => one.mode === mode)]!.title =
        error instanceof Error ? error.message : String(error);
    }
  }

  /** Show on each button whether it enters or leaves a session. */
  private showState(): void {
    for (const [k, { mode, name, hint }] of MODES.entries()) {
      const isOn = this.mode === mode;
      const text = isOn ? `Leave ${name}` : `Enter ${name}: ${hint}`;
      const one = this.buttons[k]!;
      one.title = text;
      one.setAttribute("aria-label", text);
      one.setAttribute("aria-pressed", String(isOn));
    }
  }

  private end(): void {
    const { camera, controls, renderer } = this.stage;
    this.session = this.mode = this.base = this.pose = this.hits = this.grab = undefined;
    this.pointer.group.visible = false;
    renderer.xr.enabled = false;
    controls.enabled = true;
    // Move the camera together with its target, which has followed the creature.
    camera.position.copy(controls.target).add(this.eyeOffset);
    camera.lookAt(controls.target);
    this.stage.setMode(undefined);
    this.showState();
  }

  /** Place the creature in front of the user, such that the user sees the same side as on the page. */
  private placeInFront(frame: XRFrame, base: XRReferenceSpace): void {
    const viewer = frame.getViewerPose(base);
    if (viewer === undefined) return;
    const { position, orientation } = viewer.transform;
    const forward = new THREE.Vector3(0, 0, -1).applyQuaternion(quaternionOf(orientation)).setY(0);
    // A user who looks straight down has no horizontal direction of view.
    if (forward.length() < 1e-3) forward.set(0, 0, -1);
    forward.normalize();
    const yaw = Math.atan2(forward.z, -forward.x) - Math.atan2(this.eyeOffset.y, this.eyeOffset.x);
    const rotation = new THREE.Quaternion().setFromAxisAngle(UP, yaw).multiply(Z_UP_TO_Y_UP);
    const distance = Math.max(MIN_DISTANCE, MIN_DISTANCE_IN_HEIGHTS * this.stage.height);
    this.pose = { position: new THREE.Vector3(), rotation };
    this.standAt(new THREE.Vector3(position.x, 0, position.z).addScaledVector(forward, distance));
  }

  /** Place the creature on the first surface that is detected in front of the user. */
  private placeOnHit(frame: XRFrame, hits: XRHitTestSource, base: XRReferenceSpace): void {
    for (const result of frame.getHitTestResults(hits)) {
      const hit = result.getPose(base)?.transform;
      if (hit === undefined) continue;
      const normal = UP.clone().applyQuaternion(quaternionOf(hit.orientation));
      if (normal.y < MIN_FLOOR_NORMAL) continue;
      this.standAt(new THREE.Vector3(hit.position.x, hit.position.y, hit.position.z));
      hits.cancel();
      this.hits = undefined;
      return;
    }
  }

  private async requestHits(session: XRSession): Promise<void> {
    if (session.requestHitTestSource === undefined) return;
    try {
      const space = await session.requestReferenceSpace("viewer");
      const hits = await session.requestHitTestSource({ space });
      if (this.session === session) this.hits = hits;
    } catch {
      // Without hit tests, the creature stands on the floor of the reference space.
    }
  }

  /** Place the creature at a point of `base`. */
  private standAt(place: THREE.Vector3): void {
    const { pose } = this;
    if (pose === undefined) return;
    pose.position.copy(place).sub(this.stage.standPoint.applyQuaternion(pose.rotation));
    this.applyPose();
  }

  /** Move the scene by a vector along its floor. */
  private shift(along: THREE.Vector3): void {
    this.pose?.position.add(along.clone().setZ(0).applyQuaternion(this.pose.rotation));
    this.applyPose();
  }

  private applyPose(): void {
    if (this.base === undefined || this.pose === undefined) return;
    const { position, rotation } = this.pose;
    const offset = new XRRigidTransform({ x: position.x, y: position.y, z: position.z }, rotation);
    this.stage.renderer.xr.setReferenceSpace(this.base.getOffsetReferenceSpace(offset));
  }

  /** Return the point of the floor at which an input source points, in the axes of the scene. */
  private floorPoint(frame: XRFrame, source: XRInputSource): THREE.Vector3 | undefined {
    const ray = this.rayOf(frame, source);
    const { standPoint, height } = this.stage;
    const floor = new THREE.Plane(new THREE.Vector3(0, 0, 1), -standPoint.z);
    const point = ray?.intersectPlane(floor, new THREE.Vector3()) ?? undefined;
    const reach = Math.max(MAX_REACH, MAX_REACH_IN_HEIGHTS * height);
    return point === undefined || point.distanceTo(ray!.origin) > reach ? undefined : point;
  }

  private rayOf(frame: XRFrame, source: XRInputSource): THREE.Ray | undefined {
    const space = this.stage.renderer.xr.getReferenceSpace();
    const pose = space === null ? undefined : frame.getPose(source.targetRaySpace, space);
    if (!pose) return undefined;
    return new THREE.Ray(new THREE.Vector3(), new THREE.Vector3(0, 0, -1)).applyMatrix4(
      new THREE.Matrix4().fromArray(pose.transform.matrix),
    );
  }

  private select({ frame, inputSource }: XRInputSourceEvent): void {
    const point = this.floorPoint(frame, inputSource);
    if (point === undefined || this.pose === undefined) return;
    // From now on, only the user moves the creature.
    this.hits?.cancel();
    this.hits = undefined;
    if (this.onFloor !== undefined) this.onFloor(point);
    else if (this.mode === "immersive-ar") this.shift(point.sub(this.stage.standPoint));
    else this.shift(this.headPosition().sub(point));
  }

  /** Return the midpoint between the eyes; the combined camera of three.js is behind them. */
  private headPosition(): THREE.Vector3 {
    const { cameras } = this.stage.renderer.xr.getCamera();
    const head = new THREE.Vector3();
    for (const { matrixWorld } of cameras) head.add(new THREE.Vector3().setFromMatrixPosition(matrixWorld));
    return head.divideScalar(Math.max(cameras.length, 1));
  }

  private startGrab({ frame, inputSource }: XRInputSourceEvent): void {
    const point = this.floorPoint(frame, inputSource);
    if (point !== undefined) this.grab = { source: inputSource, point };
  }

  /** Show the ray of the first controller that points at the floor, and a ring where it meets the floor. */
  private showPointer(frame: XRFrame): void {
    const { group, ring, line } = this.pointer;
    group.visible = false;
    for (const source of frame.session.inputSources) {
      if (source.targetRayMode !== "tracked-pointer") continue;
      const ray = this.rayOf(frame, source);
      const point = this.floorPoint(frame, source);
      if (ray === undefined || point === undefined) continue;
      group.visible = true;
      ring.position.copy(point);
      line.geometry.setFromPoints([ray.origin, point]);
      return;
    }
  }
}

function quaternionOf({ x, y, z, w }: DOMPointReadOnly): THREE.Quaternion {
  return new THREE.Quaternion(x, y, z, w);
}

/** Create the ray of a controller, and a ring of 10 cm for the point where it meets the floor. */
function createPointer(): { group: THREE.Group; ring: THREE.Mesh; line: THREE.Line } {
  const look = { color: POINTER_COLOUR, depthTest: false, transparent: true, opacity: 0.8 };
  const ring = new THREE.Mesh(
    new THREE.RingGeometry(0.08, 0.1, 40),
    new THREE.MeshBasicMaterial({ ...look, side: THREE.DoubleSide }),
  );
  const line = new THREE.Line(new THREE.BufferGeometry(), new THREE.LineBasicMaterial(look));
  line.frustumCulled = false;
  const group = new THREE.Group();
  group.add(ring, line);
  group.visible = false;
  return { group, ring, line };
}
