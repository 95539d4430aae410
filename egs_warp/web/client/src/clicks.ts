// Clicks on a canvas, which differ from drags by the movement of the pointer.

/** Maximum movement of the pointer between press and release that counts as a click, pixels. */
const MAX_CLICK_DISTANCE = 4;

type Point = { clientX: number; clientY: number };

/** Return true if a pointer that was pressed at `start` and is now at `end` has been dragged. */
function isDrag(start: Point, end: Point): boolean {
  return Math.hypot(end.clientX - start.clientX, end.clientY - start.clientY) > MAX_CLICK_DISTANCE;
}

/** Call `onClick` with the position of each click on `canvas`. */
export function listenToClicks(canvas: HTMLElement, onClick: (point: Point) => void): void {
  let start: Point | undefined;
  canvas.addEventListener("pointerdown", ({ clientX, clientY }) => {
    start = { clientX, clientY };
  });
  canvas.addEventListener("pointerup", (event) => {
    if (start !== undefined && !isDrag(start, event)) onClick(event);
  });
}

/** Call `onMove` when the user drags on `canvas` or turns the wheel over it. */
export function listenToMoves(canvas: HTMLElement, onMove: () => void): void {
  const starts = new Map<number, Point>();
  canvas.addEventListener("pointerdown", ({ pointerId, clientX, clientY }) => {
    starts.set(pointerId, { clientX, clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const start = starts.get(event.pointerId);
    if (start !== undefined && isDrag(start, event)) onMove();
  });
  for (const end of ["pointerup", "pointercancel"] as const) {
    canvas.addEventListener(end, ({ pointerId }) => starts.delete(pointerId));
  }
  canvas.addEventListener("wheel", onMove, { passive: true });
}
