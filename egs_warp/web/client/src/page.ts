// The page: layout of viewers and controls, and the animation loop.

import { Charts } from "./charts";
import { button, element, icon, save } from "./dom";
import { createKeySheet } from "./key_sheet";
import { Legend } from "./legend";
import { VideoRecorder } from "./video_recorder";
import { Live } from "./live";
import { Pick } from "./pick";
import { Player } from "./player";
import { Preparation } from "./preparation";
import { LiveSource, type FrameSource } from "./frame_source";
import { Viewer, type Preset, type LayerToggle } from "./viewer";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2];
/** Time per image above which the resolution is reduced, s: for a recorded run and for a live session. */
const MAX_FRAME_TIME = 1 / 15;
const MAX_LIVE_FRAME_TIME = 1 / 25;
const LAYERS: { name: LayerToggle; title: string; on: boolean; key: string }[] = [
  { name: "splats", title: "Creature", on: true, key: "1" },
  { name: "scene", title: "Scene", on: true, key: "2" },
  { name: "ground", title: "Ground", on: true, key: "3" },
  { name: "cage", title: "Cage", on: false, key: "4" },
  { name: "muscles", title: "Muscles", on: false, key: "5" },
  { name: "contacts", title: "Contacts and forces", on: false, key: "6" },
  { name: "path", title: "Centre of mass", on: false, key: "7" },
  { name: "feet", title: "Feet", on: false, key: "8" },
];
const PRESETS: { name: Preset; title: string }[] = [
  { name: "film", title: "Film" },
  { name: "front", title: "Front" },
  { name: "side", title: "Side" },
  { name: "top", title: "Top" },
];
/** Keys of a recorded run; a live session has its own. */
const HELP: [string[], string][] = [
  [["Space"], "play or pause"],
  [["\u2190", "\u2192"], "one frame back or forward"],
  [["L"], "loop"],
  [["1", "\u2026", "8"], "show or hide a layer"],
  [["C"], "curves of the audit"],
  [["S"], "save an image"],
  [["drag"], "turn the camera"],
  [["right drag"], "move the camera"],
  [["wheel"], "zoom"],
  [["?"], "these keys"],
];

export class Page {
  readonly viewers: Viewer[] = [];
  readonly player: Player;
  /** Only for live sessions. */
  readonly live: Live | undefined;
  /** Only where objects are picked. */
  readonly pick: Pick | undefined;
  private readonly charts: Charts;
  private readonly legend: Legend;
  private readonly keySheet = createKeySheet(HELP);
  private readonly recorder = new VideoRecorder();
  private readonly playButton: HTMLButtonElement;
  private readonly slider = element("input", {
    ...{ type: "range", min: "0", step: "any", class: "line", "aria-label": "Time" },
  });
  private readonly clock = element("output", { class: "clock" });
  private readonly checkboxes = new Map<LayerToggle, HTMLInputElement>();
  private lastTime = 0;
  /** Smoothed time between two images during playback, s. */
  private frameTime = 0;

  constructor(root: HTMLElement, sources: FrameSource[]) {
    const film = {
      rate: (sources[0] as FrameSource).header.facts.rate,
      // Shorter runs stay at their last frame.
      get lastFrame(): number {
        return Math.max(...sources.map((source) => source.frames.length)) - 1;
      },
    };
    this.player = new Player(film, () => this.update());
    const views = element("div", { class: sources.length > 1 ? "views two" : "views" });
    const first = sources[0] as FrameSource;
    document.title = `${first.header.facts.title} \u2013 egs_warp`;
    root.replaceChildren(views);
    for (const source of sources) {
      const canvas = element("canvas", { class: "view", tabindex: "0", "aria-label": source.header.facts.title });
      views.append(element("figure", {}, canvas, element("figcaption", {}, source.header.facts.title)));
      const viewer = new Viewer(canvas, source);
      this.viewers.push(viewer);
    }
    const preparation =
      first instanceof LiveSource && first.header.facts.preparing ? new Preparation(first) : undefined;
    if (first instanceof LiveSource && first.header.facts.picking) {
      this.pick = new Pick(first, this.viewers[0] as Viewer);
    } else if (first instanceof LiveSource && preparation === undefined) {
      this.live = new Live(first, this.viewers[0] as Viewer);
    }
    for (const viewer of this.viewers) {
      viewer.controls.addEventListener("change", () => {
        for (const other of this.viewers) if (other !== viewer) other.copyCamera(viewer);
      });
    }
    this.charts = new Charts(first, (framePosition) => this.player.seek(framePosition));
    this.playButton = button("play", "Play (space)", () => this.player.toggle());
    this.playButton.classList.add("play");
    this.legend = new Legend(first.header.arrays.has("plan"));
    const recorded = preparation === undefined ? [this.playbackBar()] : [preparation.element];
    const controls = this.pick?.elements() ?? this.live?.elements() ?? [...recorded, this.keySheet];
    const notes = element("div", { class: "notes" }, this.legend.element, this.charts.panel);
    root.append(this.toolbar(), notes, ...controls);
    this.charts.panel.hidden = true;
    new ResizeObserver(() => {
      for (const viewer of this.viewers) viewer.resize();
      this.charts.draw(this.framePosition);
    }).observe(views);
    document.addEventListener("keydown", (event) => this.keyDown(event));
    if (this.live !== undefined) this.setFollow(true);
    for (const { name, on } of LAYERS) {
      for (const viewer of this.viewers) viewer.setLayerVisible(name, on && this.isShown(name, viewer));
    }
    const isStill = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.player.playing = this.live === undefined && this.player.lastFrame > 0 && !isStill;
    this.update();
    requestAnimationFrame((now) => this.animate(now));
  }

  /** Show or hide a layer in all viewers, as its checkbox does. */
  setLayer(name: LayerToggle, on: boolean): void {
    const box = this.checkboxes.get(name);
    if (box !== undefined) box.checked = on;
    for (const viewer of this.viewers) viewer.setLayerVisible(name, on);
    this.legend.show(name, on);
    this.update();
  }

  private isShown(name: LayerToggle, viewer: Viewer): boolean {
    // A captured scene contains its own ground.
    return name !== "ground" || !(viewer.hasScene || this.pick !== undefined);
  }

  /** Fractional index of the frame that is shown. */
  get framePosition(): number {
    return this.live?.clock.framePosition ?? this.player.framePosition;
  }

  private setFollow(on: boolean): void {
    const box = document.getElementById("follow");
    if (box instanceof HTMLInputElement) box.checked = on;
    for (const viewer of this.viewers) viewer.follow = on;
  }

  private toolbar(): HTMLElement {
    const layers = element("div", { class: "menu", hidden: "" });
    for (const { name, title, on, key } of LAYERS) {
      if (name === "scene" && !this.viewers.some((viewer) => viewer.hasScene)) continue;
      const box = element("input", { type: "checkbox", id: `layer-${name}` });
      box.checked = on && this.viewers.some((viewer) => this.isShown(name, viewer));
      box.addEventListener("change", () => this.setLayer(name, box.checked));
      this.checkboxes.set(name, box);
      layers.append(element("label", {}, box, element("span", {}, title), element("kbd", {}, key)));
    }
    const views = element("div", { class: "menu", hidden: "" });
    for (const { name, title } of PRESETS) {
      const item = element("button", { type: "button", class: "item", id: `view-${name}` }, title);
      item.addEventListener("click", () => {
        for (const viewer of this.viewers) viewer.preset(name);
      });
      views.append(item);
    }
    const follow = element("input", { type: "checkbox", id: "follow" });
    follow.addEventListener("change", () => this.setFollow(follow.checked));
    if (this.pick === undefined) {
      views.append(element("label", {}, follow, element("span", {}, "Follow the creature")));
    }
    const toggle = (opened: HTMLElement, other: HTMLElement) => () => {
      opened.hidden = !opened.hidden;
      other.hidden = true;
    };
    const what = this.live === undefined ? "Record a video of the whole run" : "Record a video of this view";
    const record = button("record", what, () => this.record(record));
    const camera = button("view", "Camera", toggle(views, layers));
    if (this.pick !== undefined) {
      const picture = button("camera", "Screenshot", () => void this.screenshot());
      return element("nav", { class: "tools", "aria-label": "View" }, camera, picture, views);
    }
    return element(
      "nav",
      { class: "tools", "aria-label": "View" },
      button("layers", "Layers", toggle(layers, views)),
      camera,
      button("curves", "Curves (c)", () => this.toggleCurves()),
      button("camera", this.live === undefined ? "Screenshot (s)" : "Screenshot", () => void this.screenshot()),
      record,
      ...(this.live === undefined ? [button("help", "Keys (?)", () => this.toggleKeys())] : []),
      layers,
      views,
    );
  }

  private playbackBar(): HTMLElement {
    this.slider.addEventListener("input", () => this.player.seek(Number(this.slider.value)));
    const speed = element("select", { class: "speed", "aria-label": "Speed", title: "Speed" });
    for (const value of SPEEDS) speed.append(element("option", { value: String(value) }, `${value}\u00d7`));
    speed.value = "1";
    speed.addEventListener("change", () => {
      this.player.speed = Number(speed.value);
    });
    const loop = button("loop", "Loop (l)", () => {
      this.player.loop = !this.player.loop;
      loop.setAttribute("aria-pressed", String(this.player.loop));
    });
    loop.id = "loop";
    loop.setAttribute("aria-pressed", "true");
    return element("footer", { class: "dock" }, this.playButton, this.slider, this.clock, speed, loop);
  }

  private toggleKeys(): void {
    this.keySheet.hidden = !this.keySheet.hidden;
  }

  private toggleCurves(): void {
    this.charts.panel.hidden = !this.charts.panel.hidden;
    this.charts.draw(this.framePosition);
  }

  private async screenshot(): Promise<void> {
    this.player.playing = false;
    for (const viewer of this.viewers) {
      viewer.setResolution(1);
      await viewer.drawSorted();
      save(await viewer.screenshot(), `${this.fileName()}-${Math.round(this.framePosition)}.png`);
    }
  }

  private record(recordButton: HTMLButtonElement): void {
    const [viewer] = this.viewers;
    if (viewer === undefined) return;
    if (this.recorder.recording) {
      this.recorder.stop();
      this.player.playing = false;
      recordButton.classList.remove("on");
      return;
    }
    const { loop } = this.player;
    if (this.live === undefined) {
      this.player.seek(0);
      this.player.loop = false;
    }
    this.recorder.start(viewer.canvas, (blob, ending) => save(blob, `${this.fileName()}.${ending}`));
    recordButton.classList.add("on");
    if (this.live !== undefined) return;
    this.player.playing = true;
    const watch = setInterval(() => {
      if (this.player.playing && this.recorder.recording) return;
      clearInterval(watch);
      this.recorder.stop();
      this.player.loop = loop;
      recordButton.classList.remove("on");
    }, 50);
  }

  private fileName(): string {
    const { title } = (this.viewers[0] as Viewer).source.header.facts;
    return title.replace(/[^\p{L}\p{N}]+/gu, "-").replace(/^-|-$/g, "") || "run";
  }

  private keyDown(event: KeyboardEvent): void {
    const hasModifier = event.ctrlKey || event.metaKey || event.altKey;
    const { target } = event;
    if (this.pick !== undefined) {
      if (!(target instanceof HTMLSelectElement) && this.pick.keyDown(event)) event.preventDefault();
      return;
    }
    const isTyping = target instanceof HTMLSelectElement || (this.live && target instanceof HTMLInputElement);
    if (isTyping || hasModifier) return;
    if (this.live?.keyDown(event)) {
      event.preventDefault();
      return;
    }
    const layer = LAYERS.find(({ key }) => key === event.key);
    if (layer !== undefined) this.setLayer(layer.name, !(this.checkboxes.get(layer.name)?.checked ?? false));
    else if (event.key === "c") this.toggleCurves();
    else if (this.live !== undefined) return;
    else if (event.key === " ") this.player.toggle();
    else if (event.key === "ArrowRight") this.player.step(1);
    else if (event.key === "ArrowLeft") this.player.step(-1);
    else if (event.key === "s") void this.screenshot();
    else if (event.key === "l") document.getElementById("loop")?.click();
    else if (event.key === "?") this.toggleKeys();
    else if (event.key === "Escape") this.keySheet.hidden = true;
    else return;
    event.preventDefault();
  }

  /** Reduce the resolution during playback if the machine is too slow. */
  private adaptResolution(elapsed: number): void {
    if (this.recorder.recording) return;
    if (this.live === undefined ? !this.player.playing : !this.live.isMoving) {
      this.frameTime = 0;
      for (const viewer of this.viewers) viewer.setResolution(1);
      return;
    }
    this.frameTime = this.frameTime === 0 ? 1 / 60 : this.frameTime + 0.05 * (Math.min(elapsed, 0.2) - this.frameTime);
    if (this.frameTime <= (this.live === undefined ? MAX_FRAME_TIME : MAX_LIVE_FRAME_TIME)) return;
    for (const viewer of this.viewers) viewer.reduceResolution();
    this.frameTime = 1 / 60;
  }

  /** Show the current frame in viewers, charts and controls. */
  private update(): void {
    const { player } = this;
    for (const viewer of this.viewers) viewer.show(this.framePosition);
    this.charts.draw(this.framePosition);
    if (this.live !== undefined) return;
    this.slider.max = String(player.lastFrame);
    this.slider.value = String(player.framePosition);
    this.slider.style.setProperty("--done", `${(100 * player.framePosition) / Math.max(player.lastFrame, 1)}%`);
    this.clock.textContent = `${player.seconds.toFixed(2)} / ${(player.lastFrame / player.rate).toFixed(2)} s`;
    this.playButton.innerHTML = icon(player.playing ? "pause" : "play");
  }

  /** True if a slow machine must wait until its splats are sorted. In an outdated order the ground would hide the
   * body. */
  private get isWaitingForSort(): boolean {
    return this.player.playing && this.frameTime > MAX_FRAME_TIME && this.viewers.some((viewer) => viewer.sorting);
  }

  private animate(now: number): void {
    if (this.isWaitingForSort) {
      requestAnimationFrame((next) => this.animate(next));
      return;
    }
    const elapsed = this.lastTime === 0 ? 0 : (now - this.lastTime) / 1000;
    this.lastTime = now;
    if (this.live === undefined) this.player.advance(elapsed);
    else if (this.live.advance(elapsed)) this.update();
    this.adaptResolution(elapsed);
    for (const viewer of this.viewers) viewer.draw();
    this.live?.updateGizmos();
    requestAnimationFrame((next) => this.animate(next));
  }
}
