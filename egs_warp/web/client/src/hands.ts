// What the user does, as what is asked of the session: keys, gamepad, buttons, and the pointer on creature and ground.

import * as THREE from "three";
import type { LiveSource } from "./source";
import type { Stage } from "./stage";

export type Action = "forward" | "back" | "left" | "right" | "jump" | "leap" | "hop";

/** What each action asks for; it walks where it can. */
export function motionOf(action: Action, walks: boolean): string {
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

/** How it is driven while a key is held: sqrt(g H), radians in sqrt(H / g); as fast as it can where that is less. */
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
/** Buttons of a standard gamepad. */
const PAD: [number, Action][] = [
  [0, "jump"],
  [1, "leap"],
  [2, "hop"],
  [12, "forward"],
  [13, "back"],
  [14, "left"],
  [15, "right"],
];
const PAD_PUSH = 3;
const STICK = 0.6;
/** Seconds after which what is held is done again and again. */
const HELD = 0.45;

export class Hands {
  walks = false;
  /** What comes next, as the session says. */
  queued: string | null = null;
  private held: { action: Action; source: string; since: number; again: boolean } | undefined;
  private sent = 0;
  private pad: Action | undefined;
  private padPushes = false;

  constructor(
    private readonly source: LiveSource,
    private readonly push: () => void,
  ) {}

  press(action: Action, source: string): void {
    if (this.held?.action === action && this.held.source === source) return;
    this.held = { action, source, since: performance.now() / 1000, again: false };
    this.ask(action);
  }

  release(source: string): void {
    if (this.held?.source !== source) return;
    // What was asked for by holding on, beyond the first, is not to be done any more.
    if (this.held.again) this.source.send({ type: this.drives(this.held.action) ? "drive" : "cancel" });
    this.held = undefined;
  }

  releaseAll(): void {
    if (this.held !== undefined) this.release(this.held.source);
  }

  /** A key that moves the creature; whether it is one. */
  keyDown(event: KeyboardEvent): boolean {
    const action = KEYS[event.code];
    if (action === undefined) return false;
    if (!event.repeat) this.press(action, event.code);
    return true;
  }

  keyUp(event: KeyboardEvent): void {
    this.release(event.code);
  }

  /** Repeats what is held, and looks at the gamepad. */
  tick(): void {
    this.lookAtPad();
    const now = performance.now() / 1000;
    const { held } = this;
    const drive = held === undefined ? undefined : this.drives(held.action);
    if (held !== undefined && drive !== undefined) {
      if (!held.again && now - held.since >= HELD) this.source.send({ type: "drive", ...drive });
      held.again ||= now - held.since >= HELD;
      return;
    }
    if (held === undefined || now - held.since < HELD || this.queued !== null || now - this.sent < 0.3) return;
    held.again = true;
    this.ask(held.action);
  }

  private drives(action: Action): { forward?: number; turn?: number } | undefined {
    return this.walks ? DRIVES[action] : undefined;
  }

  private ask(action: Action): void {
    this.sent = performance.now() / 1000;
    this.source.send({ type: "motion", text: motionOf(action, this.walks) });
  }

  private lookAtPad(): void {
    const pad = navigator.getGamepads?.().find((one) => one !== null && one.mapping === "standard");
    if (!pad) return;
    const pushes = pad.buttons[PAD_PUSH]?.pressed ?? false;
    if (pushes && !this.padPushes) this.push();
    this.padPushes = pushes;
    let action = PAD.find(([button]) => pad.buttons[button]?.pressed)?.[1];
    const [x = 0, y = 0] = pad.axes;
    if (action === undefined && Math.max(Math.abs(x), Math.abs(y)) > STICK) {
      action = Math.abs(x) > Math.abs(y) ? (x < 0 ? "left" : "right") : y < 0 ? "forward" : "back";
    }
    if (action === this.pad) return;
    this.release("pad");
    if (action !== undefined) this.press(action, "pad");
    this.pad = action;
  }
}

/** The pointer: a drag that begins on the creature pulls at it, a click pushes it; one on the ground sends it there. */
export class Pointer {
  /** What is held, and where the hand is. */
  pulled: { node: number; hand: THREE.Vector3 } | undefined;
  private readonly plane = new THREE.Plane();
  private began: { x: number; y: number; id: number } | undefined;
  private dragged = false;
  private last = 0;

  constructor(
    private readonly stage: Stage,
    private readonly source: LiveSource,
    private readonly push: (node: number) => void,
  ) {
    const { canvas } = stage;
    const around = canvas.parentElement as HTMLElement;
    // Before the camera's own controls hear of it.
    around.addEventListener("pointerdown", (event) => this.down(event), { capture: true });
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const end of ["pointerup", "pointercancel"] as const) canvas.addEventListener(end, (event) => this.up(event));
  }

  private down(event: PointerEvent): void {
    if (event.target !== this.stage.canvas || event.button !== 0 || !event.isPrimary) return;
    this.began = { x: event.clientX, y: event.clientY, id: event.pointerId };
    this.dragged = false;
    const hit = this.stage.pick(event.clientX, event.clientY);
    if (hit === undefined) return;
    this.stage.controls.enabled = false;
    this.stage.canvas.setPointerCapture(event.pointerId);
    this.pulled = { node: hit.node, hand: hit.point };
    this.plane.setFromNormalAndCoplanarPoint(this.stage.camera.getWorldDirection(new THREE.Vector3()), hit.point);
  }

  private move(event: PointerEvent): void {
    if (this.stage.controls.enabled) {
      const over = event.buttons === 0 && this.stage.pick(event.clientX, event.clientY) !== undefined;
      this.stage.canvas.classList.toggle("over", over);
    }
    if (this.pulled === undefined || this.began === undefined) return;
    this.dragged ||= Math.hypot(event.clientX - this.began.x, event.clientY - this.began.y) >= 4;
    if (!this.dragged) return;
    const hand = this.stage.ray(event.clientX, event.clientY).intersectPlane(this.plane, new THREE.Vector3());
    if (hand === null) return;
    this.pulled.hand.copy(hand);
    this.stage.invalidate();
    const now = performance.now();
    if (now - this.last < 30) return;
    this.last = now;
    this.source.send({ type: "pull", node: this.pulled.node, x: hand.x, y: hand.y, z: hand.z });
  }

  private up(event: PointerEvent): void {
    const { began, pulled } = this;
    if (began === undefined || event.pointerId !== began.id) return;
    this.began = undefined;
    if (pulled !== undefined) {
      this.pulled = undefined;
      this.stage.controls.enabled = true;
      this.stage.invalidate();
      if (this.dragged) this.source.send({ type: "release" });
      else if (event.type === "pointerup") this.push(pulled.node);
      return;
    }
    if (event.type !== "pointerup" || Math.hypot(event.clientX - began.x, event.clientY - began.y) > 4) return;
    const point = this.stage.onGround(event.clientX, event.clientY);
    if (point !== undefined) this.source.send({ type: "go", x: point.x, y: point.y });
  }
}
