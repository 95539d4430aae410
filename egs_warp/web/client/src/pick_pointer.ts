// Pointer on the page of egs-warp pick: clicks and strokes mark objects, handles can be dragged, and other drags turn
// the camera.

import type { Handle, PickGizmos } from "./pick_gizmos";
import type { Viewer } from "./viewer";

/** Minimum movement of the pointer, in pixels, at which a press becomes a drag instead of a click. */
const MAX_CLICK_MOVE = 5;
/** Distance, in pixels, within which a handle is grabbed: with a mouse, and with a finger. */
const GRAB_REACH = 16;
const TOUCH_REACH = 30;
/** Distance between two points of a stroke, pixels; and maximum number of points that are sent. */
const STROKE_STEP = 6;
const MAX_STROKE_POINTS = 12;

export interface PointerActions {
  mark(pixels: [number, number][], inverted: boolean): void;
  moved(handle: Handle): void;
}

export class PickPointer {
  /** True if a drag marks the object instead of turning the camera. */
  isBrush = false;
  private start: { x: number; y: number; id: number } | undefined;
  private handle: Handle | undefined;
  private stroke: [number, number][] | undefined;
  private hasMoved = false;
  private readonly trail = document.createElementNS("http://www.w3.org/2000/svg", "polyline");
  /** Layer above the canvas that shows the stroke. */
  readonly overlay = document.createElementNS("http://www.w3.org/2000/svg", "svg");

  constructor(
    private readonly viewer: Viewer,
    private readonly gizmos: PickGizmos,
    private readonly actions: PointerActions,
  ) {
    this.overlay.classList.add("trail");
    this.overlay.append(this.trail);
    const { canvas } = viewer;
    const container = canvas.parentElement as HTMLElement;
    container.append(this.overlay);
    // Handle the event before the camera controls receive it.
    container.addEventListener("pointerdown", (event) => this.down(event), { capture: true });
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const end of ["pointerup", "pointercancel"] as const) canvas.addEventListener(end, (event) => this.up(event));
  }

  /** Return the position in the canvas. */
  private place(event: PointerEvent): [number, number] {
    const box = this.viewer.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /** Return the handle near a pointer, if any. */
  private handleAt(event: PointerEvent): Handle | undefined {
    const { clientWidth, clientHeight } = this.viewer.canvas;
    const [x, y] = this.place(event);
    const reach = event.pointerType === "touch" ? TOUCH_REACH : GRAB_REACH;
    let nearest: Handle | undefined;
    let least = reach;
    for (const [handle, position] of this.gizmos.handles()) {
      const seen = position.clone().project(this.viewer.camera);
      if (seen.z > 1) continue;
      const distance = Math.hypot(0.5 * (1 + seen.x) * clientWidth - x, 0.5 * (1 - seen.y) * clientHeight - y);
      if (distance >= least) continue;
      least = distance;
      nearest = handle;
    }
    return nearest;
  }

  private down(event: PointerEvent): void {
    if (event.target !== this.viewer.canvas) return;
    if (!event.isPrimary) {
      // A second finger moves the camera, so the stroke is cancelled.
      this.cancel();
      return;
    }
    if (event.button !== 0) return;
    this.start = { x: event.clientX, y: event.clientY, id: event.pointerId };
    this.hasMoved = false;
    this.handle = this.handleAt(event);
    this.stroke = this.handle === undefined && this.isBrush ? [this.place(event)] : undefined;
    if (this.handle === undefined && this.stroke === undefined) return;
    this.viewer.controls.enabled = false;
    this.viewer.canvas.setPointerCapture(event.pointerId);
  }

  private move(event: PointerEvent): void {
    const { start, viewer } = this;
    if (start === undefined) {
      viewer.canvas.classList.toggle("over", event.buttons === 0 && this.handleAt(event) !== undefined);
      return;
    }
    if (event.pointerId !== start.id) return;
    this.hasMoved ||= Math.hypot(event.clientX - start.x, event.clientY - start.y) > MAX_CLICK_MOVE;
    if (this.handle !== undefined && this.hasMoved) {
      this.gizmos.drag(this.handle, viewer.ray(event.clientX, event.clientY));
      viewer.invalidate();
    } else if (this.stroke !== undefined) {
      const [x, y] = this.place(event);
      const [before, after] = this.stroke.at(-1) as [number, number];
      if (Math.hypot(x - before, y - after) < STROKE_STEP) return;
      this.stroke.push([x, y]);
      this.trail.setAttribute("points", this.stroke.map((point) => point.join(",")).join(" "));
    }
  }

  private up(event: PointerEvent): void {
    const { start, handle, stroke } = this;
    if (start === undefined || event.pointerId !== start.id) return;
    this.cancel();
    if (event.type !== "pointerup") return;
    if (handle !== undefined) {
      if (this.hasMoved) this.actions.moved(handle);
    } else if (stroke !== undefined) {
      const step = Math.max(1, (stroke.length - 1) / (MAX_STROKE_POINTS - 1));
      const count = Math.min(stroke.length, MAX_STROKE_POINTS);
      const points = Array.from({ length: count }, (_, k) => stroke[Math.round(k * step)] as [number, number]);
      this.actions.mark(points, event.shiftKey);
    } else if (!this.hasMoved) this.actions.mark([this.place(event)], event.shiftKey);
  }

  private cancel(): void {
    this.start = this.handle = this.stroke = undefined;
    this.trail.setAttribute("points", "");
    this.viewer.controls.enabled = true;
  }
}
