// The page: layout of viewers and controls, and animation loop.

import { BodyPanel } from "./body_panel";
import { Charts } from "./charts";
import { listenToClicks } from "./clicks";
import { button, element, labelled, opener, save, viewCanvas } from "./dom";
import { marginsOf } from "./fit_camera";
import { createKeySheet, SHEET_LABEL, SHEET_TITLE } from "./key_sheet";
import { Legend } from "./legend";
import { closeMenus, closeMenusOutside } from "./menus";
import { VideoRecorder, type Video } from "./video_recorder";
import { Live } from "./live";
import { Pick } from "./pick";
import { PlaybackBar } from "./playback_bar";
import { Player } from "./player";
import { Preparation } from "./preparation";
import { RunVideo } from "./run_video";
import { Toasts } from "./toasts";
import { LiveSource, type FrameSource } from "./frame_source";
import { Viewer, type Preset, type LayerToggle } from "./viewer";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2];
/** Time per image above which the resolution is reduced, s: for a recorded run, and for a live session. */
const MAX_FRAME_TIME = 1 / 15;
const MAX_LIVE_FRAME_TIME = 1 / 25;
/** Windows in which a sheet hides the curves, as in style.css. */
const NARROW = "(max-width: 560px)";
/** Distance between the controls at the bottom and the panels above them, pixels. */
const FOOT_GAP = 8;
/** Height of the part of the picture that the controls of a live session cover in a wide window, pixels. */
const DOCK_MARGIN = 68;
const LAYERS: { name: LayerToggle; title: string; on: boolean; key: string }[] = [
  { name: "splats", title: "Creature", on: true, key: "1" },
  { name: "ground", title: "Ground", on: true, key: "2" },
  { name: "cage", title: "Cage", on: false, key: "3" },
  { name: "muscles", title: "Muscles", on: false, key: "4" },
  { name: "contacts", title: "Contacts and forces", on: false, key: "5" },
  { name: "path", title: "Centre of mass", on: false, key: "6" },
  { name: "feet", title: "Feet", on: false, key: "7" },
  // The last one, so that the keys of the others follow each other where there is no scene.
  { name: "scene", title: "Scene", on: true, key: "8" },
];
const PRESETS: { name: Preset; title: string; hint: string }[] = [
  { name: "film", title: "Film", hint: "The camera of the video" },
  { name: "front", title: "Front", hint: "Look at the front of the body" },
  { name: "side", title: "Side", hint: "Look at the left side of the body" },
  { name: "top", title: "Top", hint: "Look from above" },
];
/** Keys of a recorded run; a live session has different keys. */
const HELP: [string[], string][] = [
  [["Space"], "play or pause"],
  [["\u2190", "\u2192"], "one frame back or forward"],
  [["L"], "loop"],
  [["1", "\u2026", "7"], "show or hide a layer"],
  [["8"], "show or hide the scene, where there is one"],
  [["C"], "curves of the audit"],
  [["S"], "save an image"],
  [["drag"], "turn the camera"],
  [["right drag"], "move the camera"],
  [["wheel"], "zoom"],
  [["?"], "these keys"],
];
const TOUCH: [string[], string][] = [
  [["drag"], "turn the camera"],
  [["two fingers"], "move the camera"],
  [["pinch"], "zoom"],
];

/** Return true if the control that has the keyboard focus uses the key of an event. In a recorded run, arrow keys move
 * the time line by frames. */
function isKeyOfControl({ target, key }: KeyboardEvent, isRecorded: boolean): boolean {
  if (!(target instanceof HTMLElement)) return false;
  if (target instanceof HTMLSelectElement) return true;
  if (target.matches("input[type=range]")) return !isRecorded && /^(Arrow|Home|End|Page)/.test(key);
  // The space bar operates playback even after a click on a control.
  return (key === " " || key === "Enter") && target.matches(":is(button, input, summary, a):focus-visible");
}

export class Page {
  readonly viewers: Viewer[] = [];
  readonly player: Player;
  /** Controls of a live session; undefined for recorded runs. */
  readonly live: Live | undefined;
  /** Controls of the page on which objects are picked; undefined on other pages. */
  readonly pick: Pick | undefined;
  /** Rows of the bodies of a world; undefined for a run with one body. */
  private bodyPanel: BodyPanel | undefined;
  /** Selected body of a world. */
  selected: number | undefined;
  private readonly charts: Charts;
  private readonly legend: Legend;
  private readonly keySheet = createKeySheet(HELP, TOUCH);
  /** Recorder of a live session. */
  private readonly recorder = new VideoRecorder();
  /** Video of a recorded run. */
  private readonly runVideo = new RunVideo();
  private readonly toasts = new Toasts();
  private readonly bar: PlaybackBar;
  private readonly checkboxes = new Map<LayerToggle, HTMLInputElement>();
  /** True once the splats of the first image have been sorted. */
  private isDrawn = false;
  /** Resolves once the first image is drawn with sorted splats. */
  readonly drawn: Promise<void>;
  private lastTime = 0;
  /** Smoothed time between two images during playback, s. */
  private frameTime = 0;

  constructor(
    private readonly root: HTMLElement,
    sources: FrameSource[],
  ) {
    const film = {
      rate: (sources[0] as FrameSource).header.facts.rate,
      // A shorter run stays at its last frame.
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
      const canvas = viewCanvas(source.header.facts.title, "view");
      views.append(element("figure", {}, canvas, element("figcaption", {}, source.header.facts.title)));
      const viewer = new Viewer(canvas, source);
      this.viewers.push(viewer);
    }
    const preparation =
      first instanceof LiveSource && first.header.facts.preparing ? new Preparation(first, this.first) : undefined;
    if (first instanceof LiveSource && first.header.facts.picking) {
      this.pick = new Pick(first, this.first);
    } else if (first instanceof LiveSource && preparation === undefined) {
      this.live = new Live(first, this.first);
    }
    for (const viewer of this.viewers) {
      viewer.controls.addEventListener("change", () => {
        for (const other of this.viewers) if (other !== viewer) other.copyCamera(viewer);
      });
    }
    this.charts = new Charts(first, (framePosition) => this.player.seek(framePosition));
    this.bar = new PlaybackBar(this.player, { speeds: SPEEDS, onToggle: () => this.player.toggle(), hasLoop: true });
    this.legend = new Legend(first.header.arrays.has("plan"));
    const recorded = preparation === undefined ? [this.bar.element] : [preparation.element];
    const sheets = preparation === undefined ? [this.keySheet] : [];
    const controls = this.pick?.elements() ?? this.live?.elements() ?? [...recorded, ...sheets];
    const notes = element("div", { class: "notes" }, this.legend.element, this.charts.panel);
    this.charts.panel.hidden = true;
    // The tools would act on the creature, which is not there yet.
    root.append(...(preparation === undefined ? [this.toolbar()] : []), notes, ...controls);
    // A live session and a page on which objects are picked have their own messages.
    if (this.live === undefined && this.pick === undefined) root.append(this.runVideo.element, this.toasts.element);
    const { bodies } = first.header.facts;
    if (bodies !== undefined && sources.length === 1) {
      const select = (index: number): void => (this.live === undefined ? this.select(index) : this.live.select(index));
      this.bodyPanel = new BodyPanel(bodies, first.header.facts.failures ?? [], select);
      root.append(this.bodyPanel.element);
      if (this.live === undefined) this.selectByClick();
      else this.live.onSelect = (index, states) => this.showSelected(index, states);
    }
    new ResizeObserver(() => {
      if (this.runVideo.recording) return;
      for (const viewer of this.viewers) viewer.resize();
      this.charts.draw(this.framePosition);
    }).observe(views);
    this.avoidPanels(root, controls);
    closeMenusOutside(root);
    // The keys of a preparation are those of the creature (early_keys.ts).
    if (preparation === undefined) document.addEventListener("keydown", (event) => this.keyDown(event));
    if (this.live !== undefined) this.setFollow(true);
    for (const { name, on } of LAYERS) {
      for (const viewer of this.viewers) viewer.setLayerVisible(name, on && this.isShown(name, viewer));
    }
    const isStill = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.player.playing = this.live === undefined && this.player.lastFrame > 0 && !isStill;
    this.update();
    this.drawn = Promise.all(this.viewers.map((viewer) => viewer.drawSorted())).then(() => {
      this.isDrawn = true;
    });
    // In a headset, this is the animation loop of its session.
    this.first.renderer.setAnimationLoop((now) => this.animate(now));
  }

  /** Keep the pictures and the other panels clear of panels that are shown, resized or hidden. */
  private avoidPanels(root: HTMLElement, controls: HTMLElement[]): void {
    const dock = root.querySelector(".dock");
    // The server computes positions of clicks on objects with a camera whose picture has no margins. The picture stays
    // where it is when a layer is shown with its legend, so that the layers can be compared.
    // Messages disappear after a few seconds, so the picture does not move for them.
    const lasting = controls.filter((one) => !one.matches(".toasts"));
    const panels = this.pick === undefined ? [...lasting, this.charts.panel] : [];
    // The picture must not move with each line of text about the preparation.
    if (this.first.source.header.facts.preparing) {
      this.first.setMargins({ top: 0, bottom: DOCK_MARGIN });
      panels.length = 0;
    }
    const sizes = new ResizeObserver(() => {
      const top = dock?.getBoundingClientRect().top ?? window.innerHeight;
      const sheets = controls.filter((one) => one.matches(".sheet:not([hidden])"));
      const sheetTop = Math.min(top, ...sheets.map((one) => one.getBoundingClientRect().top));
      const { style } = document.documentElement;
      style.setProperty("--foot", `${window.innerHeight - top + FOOT_GAP}px`);
      style.setProperty("--above", `${window.innerHeight - sheetTop + FOOT_GAP}px`);
      // Two runs one above the other are shown at the same scale.
      if (panels.length === 0) return;
      const margins = this.viewers.map((viewer) => marginsOf(viewer.canvas, panels));
      const largest = (side: "top" | "bottom"): number => Math.max(...margins.map((one) => one[side]));
      for (const viewer of this.viewers) viewer.setMargins({ top: largest("top"), bottom: largest("bottom") });
    });
    for (const panel of [root, ...controls, ...panels]) sizes.observe(panel);
  }

  /** Show or hide a layer in all viewers, as its checkbox does. */
  setLayer(name: LayerToggle, on: boolean): void {
    const box = this.checkboxes.get(name);
    if (box !== undefined) box.checked = on;
    for (const viewer of this.viewers) viewer.setLayerVisible(name, on);
    this.legend.show(name, on);
    this.update();
  }

  /** Select a body of a world; if the body is selected already, select none. */
  select(index: number): void {
    this.showSelected(this.selected === index ? undefined : index);
  }

  private showSelected(index: number | undefined, states?: Record<string, string>): void {
    if (states !== undefined) this.bodyPanel?.showStates(states);
    if (index === this.selected) return;
    this.selected = index;
    this.first.select(index);
    this.bodyPanel?.show(index);
    this.charts.select(index ?? 0);
    this.update();
  }

  /** Select the body on which the user clicks. */
  private selectByClick(): void {
    listenToClicks(this.first.canvas, ({ clientX, clientY }) => {
      const hit = this.first.pick(clientX, clientY);
      if (hit !== undefined) this.select(this.first.bodyOf(hit.node));
    });
  }

  /** The viewer whose content headsets and videos show. */
  private get first(): Viewer {
    return this.viewers[0]!;
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
      const hint = `Show or hide this layer (${key})`;
      layers.append(element("label", { title: hint }, box, element("span", {}, title), element("kbd", {}, key)));
    }
    const views = element("div", { class: "menu", hidden: "" });
    const items = new Map<Preset, HTMLElement>();
    for (const { name, title, hint } of PRESETS) {
      const item = element("button", { type: "button", class: "item", id: `view-${name}`, title: hint }, title);
      item.addEventListener("click", () => {
        for (const viewer of this.viewers) viewer.preset(name);
      });
      items.set(name, item);
      views.append(item);
    }
    const showChosenView = (): void => {
      for (const [name, item] of items) {
        const isChosen = this.viewers.every(({ chosenView }) => chosenView === name);
        item.setAttribute("aria-pressed", String(isChosen));
      }
    };
    showChosenView();
    for (const viewer of this.viewers) viewer.onChosenView = showChosenView;
    const follow = element("input", { type: "checkbox", id: "follow" });
    follow.addEventListener("change", () => this.setFollow(follow.checked));
    if (this.pick === undefined) {
      const hint = "The camera moves along the ground with the body";
      views.append(element("label", { title: hint }, follow, element("span", {}, "Follow the creature")));
    }
    const camera = opener("view", "Camera", views, [layers]);
    const curves = opener("curves", "Curves (c)", this.charts.panel);
    curves.addEventListener("click", () => this.showCurves());
    const isLive = this.live !== undefined;
    const what = isLive ? "Record a video of this view" : "Record a video of the whole run";
    const record = button("record", what, () => this.record(record));
    if (this.pick !== undefined) {
      const picture = button("camera", "Screenshot", () => void this.screenshot());
      return element("nav", { class: "tools", "aria-label": "View" }, camera, picture, views);
    }
    return element(
      "nav",
      { class: "tools", "aria-label": "View" },
      labelled(opener("layers", "Layers", layers, [views]), "layers"),
      labelled(camera, "camera"),
      labelled(curves, "curves"),
      labelled(button("camera", isLive ? "Screenshot" : "Screenshot (s)", () => void this.screenshot()), "image"),
      labelled(record, "video"),
      // Two runs side by side have no common position in a room.
      ...(this.viewers.length > 1 ? [] : this.first.headset.buttons),
      ...(isLive ? [] : [labelled(opener("help", SHEET_TITLE, this.keySheet), SHEET_LABEL)]),
      layers,
      views,
    );
  }

  /** Hide the list of keys and the menus. */
  private closePanels(): void {
    for (const panel of this.root.querySelectorAll<HTMLElement>(".sheet, .menu")) panel.hidden = true;
  }

  private toggleCurves(): void {
    this.charts.panel.hidden = !this.charts.panel.hidden;
    this.showCurves();
  }

  /** Draw the curves. A narrow window shows either them or a sheet. */
  private showCurves(): void {
    if (!this.charts.panel.hidden && window.matchMedia(NARROW).matches) {
      for (const sheet of this.root.querySelectorAll<HTMLElement>(".sheet")) sheet.hidden = true;
    }
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
    if (this.live === undefined) {
      void this.recordRun(recordButton);
      return;
    }
    const isStarting = !this.recorder.recording;
    if (isStarting) this.recorder.start(this.first.canvas, (video) => this.saveVideo(video));
    else this.recorder.stop();
    recordButton.classList.toggle("on", isStarting);
  }

  /** Record all frames of a run, each once its splats are sorted, and return to the frame that is shown now. */
  private async recordRun(recordButton: HTMLButtonElement): Promise<void> {
    const { player, first, runVideo } = this;
    if (runVideo.recording) return;
    const { framePosition, playing } = player;
    player.playing = false;
    recordButton.classList.add("on");
    this.setRecording(true);
    const draw = async (frame: number): Promise<void> => {
      player.seek(frame);
      await first.drawSorted();
    };
    try {
      const run = { canvas: first.canvas, rate: player.rate, frameCount: player.lastFrame + 1, draw };
      const video = await runVideo.record(run);
      if (video !== undefined) this.saveVideo(video);
    } catch (error) {
      this.toasts.show(`no video: ${error instanceof Error ? error.message : String(error)}`, true);
    }
    this.setRecording(false);
    recordButton.classList.remove("on");
    player.seek(framePosition);
    player.playing = playing;
  }

  /** While a run is recorded, its frames, camera and size must not change. */
  private setRecording(on: boolean): void {
    for (const one of this.root.children) (one as HTMLElement).inert = on && one !== this.runVideo.element;
    for (const viewer of this.viewers) {
      viewer.setResolution(1);
      viewer.resize();
    }
    this.lastTime = 0;
  }

  private saveVideo({ blob, extension }: Video): void {
    save(blob, `${this.fileName()}.${extension}`);
  }

  private fileName(): string {
    const { title } = this.first.source.header.facts;
    return title.replace(/[^\p{L}\p{N}]+/gu, "-").replace(/^-|-$/g, "") || "run";
  }

  private keyDown(event: KeyboardEvent): void {
    const hasModifier = event.ctrlKey || event.metaKey || event.altKey;
    if (this.pick !== undefined) {
      if (event.key === "Escape" && closeMenus(this.root)) return;
      if (!(event.target instanceof HTMLSelectElement) && this.pick.keyDown(event)) event.preventDefault();
      return;
    }
    if (this.runVideo.recording) {
      if (event.key === "Escape") this.runVideo.cancel();
      return;
    }
    if (hasModifier) return;
    if (event.key === "Escape" && closeMenus(this.root)) {
      event.preventDefault();
      return;
    }
    if (isKeyOfControl(event, this.live === undefined)) return;
    if (this.live?.keyDown(event)) {
      event.preventDefault();
      return;
    }
    const layer = LAYERS.find(({ key, name }) => key === event.key && this.checkboxes.has(name));
    if (layer !== undefined) this.setLayer(layer.name, !(this.checkboxes.get(layer.name)?.checked ?? false));
    else if (event.key === "c") this.toggleCurves();
    else if (this.live !== undefined) return;
    else if (event.key === " ") this.player.toggle();
    else if (event.key === "ArrowRight") this.player.step(1);
    else if (event.key === "ArrowLeft") this.player.step(-1);
    else if (event.key === "s") void this.screenshot();
    else if (event.key === "l") this.bar.toggleLoop();
    else if (event.key === "?") this.keySheet.hidden = !this.keySheet.hidden;
    else if (event.key === "Escape") this.closePanels();
    else return;
    event.preventDefault();
  }

  /** Reduce the resolution if the machine is too slow for playback. */
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
    for (const viewer of this.viewers) viewer.show(this.framePosition);
    this.charts.draw(this.framePosition);
    if (this.live !== undefined) return;
    this.bar.update();
  }

  /** True if the splats must be sorted before the next image is drawn: at the start, and on a slow machine. Without an
   * order, only the shadow would be visible; with an outdated order, the ground would hide the body. */
  private get isWaitingForSort(): boolean {
    if (!this.isDrawn) return true;
    const isSlow = this.player.playing && this.frameTime > MAX_FRAME_TIME;
    return isSlow && this.viewers.some((viewer) => viewer.sorting);
  }

  private animate(now: number): void {
    if (this.runVideo.recording) return;
    const { isPresenting } = this.first.headset;
    const isWaiting = this.isWaitingForSort && !isPresenting;
    // The motion of a live session continues.
    if (isWaiting && this.live === undefined) return;
    const elapsed = this.lastTime === 0 ? 0 : (now - this.lastTime) / 1000;
    this.lastTime = now;
    if (this.live === undefined) this.player.advance(elapsed);
    else if (this.live.advance(elapsed)) this.update();
    if (isWaiting) return;
    if (!isPresenting) this.adaptResolution(elapsed);
    for (const viewer of this.viewers) viewer.draw();
    this.live?.updateGizmos();
  }
}
