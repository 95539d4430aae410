// User input by keys, gamepad, buttons and pointer, translated into commands to the session.

import * as THREE from "three";
import type { LiveSource } from "./frame_source";
import type { Viewer } from "./viewer";

export type Action = "forward" | "back" | "left" | "right" | "jump" | "leap" | "hop";

/** Names of the actions for the user. */
export const ACTION_NAMES: Record<Action, string> = {
  forward: "forward",
  back: "turn around",
  left: "turn left",
  right: "turn right",
  jump: "jump",
  leap: "long jump",
  hop: "hop",
};

/** Return the script text of an action; a body that can walk walks, any other body hops. */
export function motionText(action: Action, walks: boolean): string {
  return {
    forward: walks ? "walk 0.2" : "hop 0.4 0.2",
    back: walks ? "walk -0.2" : "twist 180 0 0.25",
    left: walks ? "turn 30" : "twist 45 0 0.2",
    right: walks ? "turn -30" : "twist -45 0 0.2",
    jump: "jump 0 0.25",
    leap: "jump 0.6 0.3",
    hop: "hop 0.4 0.2",
  }[action];
}

/** Driving speeds while a key is held: forward in sqrt(g H), turning in rad per sqrt(H / g). A body that cannot reach
 * them moves at its maximum speed. */
const DRIVES: Partial<Record<Action, { forward?: number; turn?: number }>> = {
  forward: { forward: 0.3 },
  back: { forward: -0.3 },
  left: { turn: 0.3 },
  right: { turn: -0.3 },
};

const KEYS: Record<string, Action> = {
  ArrowUp: "forward",
  KeyW: "forward",
  ArrowDown: "back",
  KeyS: "back",
  ArrowLeft: "left",
  KeyA: "left",
  ArrowRight: "right",
  KeyD: "right",
  Space: "jump",
  KeyJ: "leap",
  KeyH: "hop",
};

/** Return the action of the key of an event; undefined if the key has none. */
export function actionOfKey({ code }: KeyboardEvent): Action | undefined {
  return KEYS[code];
}

/** Button numbers of a standard gamepad. */
const GAMEPAD_BUTTONS: [number, Action][] = [
  [0, "jump"],
  [1, "leap"],
  [2, "hop"],
  [12, "forward"],
  [13, "back"],
  [14, "left"],
  [15, "right"],
];
const GAMEPAD_PUSH_BUTTON = 3;
const STICK_THRESHOLD = 0.6;
/** Time after which a held key repeats its action, s. */
const REPEAT_DELAY = 0.45;

export class InputControls {
  walks = false;
  /** Name of the queued motion, as reported by the session. */
  queued: string | null = null;
  private pressed: { action: Action; source: string; since: number; isRepeating: boolean } | undefined;
  private lastSent = 0;
  private padAction: Action | undefined;
  private padPushPressed = false;

  constructor(
    private readonly source: LiveSource,
    private readonly push: () => void,
    private readonly onRequest: (motion: string, action: Action) => void,
  ) {}

  press(action: Action, source: string): void {
    if (this.pressed?.action === action && this.pressed.source === source) return;
    this.pressed = { action, source, since: performance.now() / 1000, isRepeating: false };
    this.request(action);
  }

  release(source: string): void {
    if (this.pressed?.source !== source) return;
    // Cancel the repetitions that were requested while the key was held.
    if (this.pressed.isRepeating) this.source.send({ type: this.driveFor(this.pressed.action) ? "drive" : "cancel" });
    this.pressed = undefined;
  }

  releaseAll(): void {
    if (this.pressed !== undefined) this.release(this.pressed.source);
  }

  /** Handle a key press; return true if the key moves the creature. */
  keyDown(event: KeyboardEvent): boolean {
    const action = actionOfKey(event);
    if (action === undefined) return false;
    if (!event.repeat) this.press(action, event.code);
    return true;
  }

  keyUp(event: KeyboardEvent): void {
    this.release(event.code);
  }

  /** Poll the gamepad and repeat the action of a held key. */
  tick(): void {
    this.pollGamepad();
    const now = performance.now() / 1000;
    const { pressed } = this;
    const drive = pressed === undefined ? undefined : this.driveFor(pressed.action);
    if (pressed !== undefined && drive !== undefined) {
      if (!pressed.isRepeating && now - pressed.since >= REPEAT_DELAY) {
        this.source.send({ type: "drive", ...drive });
        this.onRequest("drive", pressed.action);
      }
      pressed.isRepeating ||= now - pressed.since >= REPEAT_DELAY;
      return;
    }
    if (pressed === undefined || now - pressed.since < REPEAT_DELAY) return;
    if (this.queued !== null || now - this.lastSent < 0.3) return;
    pressed.isRepeating = true;
    this.request(pressed.action);
  }

  private driveFor(action: Action): { forward?: number; turn?: number } | undefined {
    return this.walks ? DRIVES[action] : undefined;
  }

  /** Request an action once. */
  request(action: Action): void {
    this.lastSent = performance.now() / 1000;
    const text = motionText(action, this.walks);
    this.source.send({ type: "motion", text });
    this.onRequest(text.split(" ", 1)[0]!, action);
  }

  private pollGamepad(): void {
    const pad = navigator.getGamepads?.().find((one) => one !== null && one.mapping === "standard");
    if (!pad) return;
    const pushPressed = pad.buttons[GAMEPAD_PUSH_BUTTON]?.pressed ?? false;
    if (pushPressed && !this.padPushPressed) this.push();
    this.padPushPressed = pushPressed;
    let action = GAMEPAD_BUTTONS.find(([button]) => pad.buttons[button]?.pressed)?.[1];
    const [x = 0, y = 0] = pad.axes;
    if (action === undefined && Math.max(Math.abs(x), Math.abs(y)) > STICK_THRESHOLD) {
      action = Math.abs(x) > Math.abs(y) ? (x < 0 ? "left" : "right") : y < 0 ? "forward" : "back";
    }
    if (action === this.padAction) return;
    this.release("pad");
    if (action !== undefined) this.press(action, "pad");
    this.padAction = action;
  }
}

/** Maximum time and distance between the two clicks of a double click, ms and pixels. */
export const DOUBLE_CLICK_TIME = 400;
const DOUBLE_CLICK_DISTANCE = 12;

/** Pointer on the canvas: dragging the creature pulls it, clicking on it selects it, a double click pushes it,
 * and clicking on the ground sends the creature to the clicked point. */
export class Pointer {
  /** Grabbed node, and the point to which it is pulled. */
  grab: { node: number; target: THREE.Vector3 } | undefined;
  private readonly plane = new THREE.Plane();
  private start: { x: number; y: number; id: number } | undefined;
  private dragged = false;
  private lastSent = 0;
  private lastClick = { x: 0, y: 0, time: -Infinity };

  constructor(
    private readonly viewer: Viewer,
    private readonly source: LiveSource,
    private readonly click: (node: number, isDouble: boolean) => void,
    private readonly go: (x: number, y: number) => void,
  ) {
    const { canvas } = viewer;
    const container = canvas.parentElement as HTMLElement;
    // Handle the event before the camera controls receive it.
    container.addEventListener("pointerdown", (event) => this.down(event), { capture: true });
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const end of ["pointerup", "pointercancel"] as const) canvas.addEventListener(end, (event) => this.up(event));
  }

  private down(event: PointerEvent): void {
    if (!this.source.isConnected || event.target !== this.viewer.canvas) return;
    if (event.button !== 0 || !event.isPrimary) return;
    this.start = { x: event.clientX, y: event.clientY, id: event.pointerId };
    this.dragged = false;
    const hit = this.viewer.pick(event.clientX, event.clientY);
    if (hit === undefined) return;
    this.viewer.controls.enabled = false;
    this.viewer.canvas.setPointerCapture(event.pointerId);
    this.grab = { node: hit.node, target: hit.point };
    this.plane.setFromNormalAndCoplanarPoint(this.viewer.camera.getWorldDirection(new THREE.Vector3()), hit.point);
  }

  private move(event: PointerEvent): void {
    if (this.viewer.controls.enabled) {
      const over = event.buttons === 0 && this.viewer.pick(event.clientX, event.clientY) !== undefined;
      this.viewer.canvas.classList.toggle("over", over);
    }
    if (this.grab === undefined || this.start === undefined) return;
    this.dragged ||= Math.hypot(event.clientX - this.start.x, event.clientY - this.start.y) >= 4;
    if (!this.dragged) return;
    const target = this.viewer.ray(event.clientX, event.clientY).intersectPlane(this.plane, new THREE.Vector3());
    if (target === null) return;
    this.grab.target.copy(target);
    this.viewer.invalidate();
    const now = performance.now();
    if (now - this.lastSent < 30) return;
    this.lastSent = now;
    this.source.send({ type: "pull", node: this.grab.node, x: target.x, y: target.y, z: target.z });
  }

  private up(event: PointerEvent): void {
    const { start, grab } = this;
    if (start === undefined || event.pointerId !== start.id) return;
    this.start = undefined;
    if (grab !== undefined) {
      this.grab = undefined;
      this.viewer.controls.enabled = true;
      this.viewer.invalidate();
      if (this.dragged) this.source.send({ type: "release" });
      else if (event.type === "pointerup") this.click(grab.node, this.isDouble(event));
      return;
    }
    if (event.type !== "pointerup" || Math.hypot(event.clientX - start.x, event.clientY - start.y) > 4) return;
    const point = this.viewer.groundPoint(event.clientX, event.clientY);
    if (point !== undefined) this.go(point.x, point.y);
  }

  /** Return true if a click ends a double click; a third click begins another one. */
  private isDouble({ clientX: x, clientY: y, timeStamp: time }: PointerEvent): boolean {
    const { lastClick } = this;
    const isNear = Math.hypot(x - lastClick.x, y - lastClick.y) <= DOUBLE_CLICK_DISTANCE;
    const isDouble = isNear && time - lastClick.time <= DOUBLE_CLICK_TIME;
    this.lastClick = { x, y, time: isDouble ? -Infinity : time };
    return isDouble;
  }
}
