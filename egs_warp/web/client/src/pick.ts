// Page of egs-warp pick: marks, objects, ground and front, and buttons for the commands that use the picked object.

import { button, element, opener, type Icon } from "./dom";
import { createKeySheet, SHEET_TITLE } from "./key_sheet";
import { PickGizmos, type Handle } from "./pick_gizmos";
import type { BodyNews, JobNews, PickState } from "./pick_news";
import { PickPanel } from "./pick_panel";
import { PickPointer } from "./pick_pointer";
import { Toasts } from "./toasts";
import type { LiveSource, News } from "./frame_source";
import type { Viewer } from "./viewer";

const HELP: [string[], string][] = [
  [["click"], "add to the object, or remove from it"],
  [["Shift"], "and click: the other of the two"],
  [["A", "D"], "clicks add, clicks remove"],
  [["B"], "brush: drags mark, too"],
  [["drag"], "a handle: turn up and front, move the ground"],
  [["drag"], "elsewhere: turn the camera"],
  [["right drag"], "move the camera"],
  [["wheel"], "zoom"],
  [["Ctrl Z", "Ctrl Y"], "undo, redo"],
  [["N"], "another object"],
  [["O"], "next object"],
  [["S"], "save"],
  [["?"], "these keys"],
];
const TOUCH: [string[], string][] = [
  [["tap"], "add to the object, or remove from it"],
  [["drag"], "a handle: turn up and front, move the ground"],
  [["drag"], "elsewhere: turn the camera"],
  [["two fingers"], "move the camera"],
  [["pinch"], "zoom"],
];

export class Pick {
  /** Latest state of the session. */
  state: PickState | undefined;
  /** Latest measurements of the active object. */
  body: BodyNews | undefined;
  /** Latest progress of each command. */
  readonly jobs = new Map<string, JobNews>();
  /** Current work of the session; empty while it is idle. */
  work = "";
  /** All messages to the user, the newest last. */
  readonly messages: string[] = [];
  readonly gizmos = new PickGizmos();
  readonly pointer: PickPointer;
  private labels = new Uint8Array(0);
  private isAdding = true;
  private readonly panel: PickPanel;
  private readonly toasts = new Toasts();
  private readonly helpSheet = createKeySheet(HELP, TOUCH);
  private readonly workLabel = element("output", { class: "work" });
  private readonly buttons: Record<"add" | "remove" | "brush" | "undo" | "redo" | "save", HTMLButtonElement>;

  constructor(
    private readonly source: LiveSource,
    private readonly viewer: Viewer,
  ) {
    viewer.add(this.gizmos.group);
    this.pointer = new PickPointer(viewer, this.gizmos, {
      mark: (pixels, inverted) => this.mark(pixels, this.isAdding !== inverted),
      moved: (handle) => this.sendHandle(handle),
    });
    const choice = (name: Icon, title: string, onClick: () => void, id: string): HTMLButtonElement => {
      const created = button(name, title, onClick);
      created.id = id;
      return created;
    };
    this.buttons = {
      add: choice("plus", "Clicks add to the object (a)", () => this.setAdding(true), "mark-add"),
      remove: choice("minus", "Clicks remove from the object (d)", () => this.setAdding(false), "mark-remove"),
      brush: choice("brush", "Brush: drags mark, too (b)", () => this.toggleBrush(), "brush"),
      undo: choice("undo", "Undo (Ctrl Z)", () => this.send("undo"), "undo"),
      redo: choice("redo", "Redo (Ctrl Y)", () => this.send("redo"), "redo"),
      save: choice("save", "Save the file (s)", () => this.send("save"), "save"),
    };
    this.panel = new PickPanel((message) => source.send(message));
    this.setAdding(true);
    this.toggleBrush(false);
    source.listen((news) => this.handleNews(news));
  }

  elements(): HTMLElement[] {
    const { add, remove, brush, undo, redo, save } = this.buttons;
    const marks = element("div", { class: "marks" }, add, remove, brush);
    const history = element("div", {}, undo, redo);
    const panelButton = button("sliders", "Objects and motions", () => this.panel.toggle());
    panelButton.classList.add("narrow");
    const more = element("div", {}, save, panelButton, opener("help", SHEET_TITLE, this.helpSheet));
    const dock = element("footer", { class: "dock pick" }, marks, history, this.workLabel, more);
    return [this.panel.element, dock, this.helpSheet, this.toasts.element];
  }

  /** Handle a key press; return true if the key has a function. */
  keyDown(event: KeyboardEvent): boolean {
    const key = event.key.toLowerCase();
    if (event.ctrlKey || event.metaKey) {
      if (key === "z") this.send(event.shiftKey ? "redo" : "undo");
      else if (key === "y") this.send("redo");
      else return false;
      return true;
    }
    if (key === "a") this.setAdding(true);
    else if (key === "d") this.setAdding(false);
    else if (key === "b") this.toggleBrush();
    else if (key === "s") this.send("save");
    else if (key === "n") this.send("add");
    else if (key === "?") this.helpSheet.hidden = !this.helpSheet.hidden;
    else if (key === "escape") this.helpSheet.hidden = true;
    else if (key === "o" && this.state !== undefined && this.state.objects.length > 1) {
      this.source.send({ type: "select", index: (this.state.active + 1) % this.state.objects.length });
    } else return false;
    return true;
  }

  private send(type: "undo" | "redo" | "save" | "add"): void {
    this.source.send({ type });
  }

  private setAdding(isAdding: boolean): void {
    this.isAdding = isAdding;
    this.buttons.add.setAttribute("aria-pressed", String(isAdding));
    this.buttons.remove.setAttribute("aria-pressed", String(!isAdding));
  }

  private toggleBrush(on = !this.pointer.isBrush): void {
    this.pointer.isBrush = on;
    this.buttons.brush.setAttribute("aria-pressed", String(on));
  }

  /** Send a click or stroke at positions of the canvas, and show immediately that it was made. */
  private mark(pixels: [number, number][], inside: boolean): void {
    const { camera, controls, canvas } = this.viewer;
    for (const [x, y] of pixels) this.ping(x, y, inside);
    this.source.send({
      type: "mark",
      inside,
      eye: camera.position.toArray(),
      target: controls.target.toArray(),
      fov: camera.fov,
      width: canvas.clientWidth,
      height: canvas.clientHeight,
      pixels,
    });
  }

  /** Show a ring that grows and fades. */
  private ping(x: number, y: number, inside: boolean): void {
    const ring = element("i", { class: inside ? "ping" : "ping removes" });
    ring.style.translate = `${x}px ${y}px`;
    this.viewer.canvas.parentElement?.append(ring);
    ring.addEventListener("animationend", () => ring.remove());
  }

  private sendHandle(handle: Handle): void {
    const { normal, offset, front } = this.gizmos;
    if (handle === "front") this.source.send({ type: "front", direction: front.toArray() });
    else this.source.send({ type: "plane", normal: normal.toArray(), offset });
  }

  private handleNews(news: News): void {
    if (news.type === "labels") this.labels = bytesOfBase64(news.data);
    else if (news.type === "pick") this.show(news);
    else if (news.type === "view") {
      this.source.header.facts.camera = news.camera;
      // The view that a user has chosen stays.
      if (!this.viewer.turn.isMovedByUser) this.viewer.preset("film");
    }
    else if (news.type === "body") {
      this.body = news;
      if (this.state?.front == null) this.gizmos.showFront(news.front);
      this.panel.showBody(news);
      this.viewer.invalidate();
    } else if (news.type === "ground") {
      this.gizmos.showGround(news.grid);
      this.viewer.invalidate();
    } else if (news.type === "animate" || news.type === "live") {
      this.jobs.set(news.type, news);
      this.panel.showJob(news);
    } else if (news.type === "work") {
      this.work = news.text;
      this.workLabel.textContent = news.text === "" ? "" : `${news.text}\u2026`;
    } else if (news.type === "told") this.showMessage(news.text);
    else if (news.type === undefined) this.showMessage(news.error, true);
  }

  private show(state: PickState): void {
    this.state = state;
    this.body = undefined;
    this.viewer.mark(this.labels, state.active + 1);
    this.gizmos.show(state);
    this.buttons.undo.disabled = !state.undo;
    this.buttons.redo.disabled = !state.redo;
    this.panel.showObjects(state);
    this.viewer.invalidate();
  }

  private showMessage(line: string, isError = false): void {
    this.messages.push(line);
    this.toasts.show(line, isError);
  }
}

function bytesOfBase64(text: string): Uint8Array<ArrayBuffer> {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}
