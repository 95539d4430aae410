// The page: lays out the stages and the controls, and keeps time.

import { Curves } from "./curves";
import { button, element, icon, save } from "./dom";
import { FilmRecorder } from "./film";
import { Live } from "./live";
import { Player } from "./player";
import { LiveSource, type FrameSource } from "./source";
import { Stage, type Preset, type Tick } from "./stage";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2];
/** Seconds a picture from which fewer pixels are drawn: of a run, and of a creature that lives. */
const SLOW = 1 / 15;
const SLOW_LIFE = 1 / 25;
const LAYERS: { name: Tick; title: string; on: boolean; key: string }[] = [
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

export class Page {
  readonly stages: Stage[] = [];
  readonly player: Player;
  /** Of a creature that lives. */
  readonly live: Live | undefined;
  private readonly curves: Curves;
  private readonly film = new FilmRecorder();
  private readonly playButton: HTMLButtonElement;
  private readonly slider = element("input", {
    ...{ type: "range", min: "0", step: "any", class: "line", "aria-label": "Time" },
  });
  private readonly clock = element("output", { class: "clock" });
  private readonly boxes = new Map<Tick, HTMLInputElement>();
  private before = 0;
  /** Seconds between two pictures while the run plays, of late. */
  private pace = 0;

  constructor(root: HTMLElement, sources: FrameSource[]) {
    this.player = new Player(sources, () => this.update());
    const views = element("div", { class: sources.length > 1 ? "views two" : "views" });
    const first = sources[0] as FrameSource;
    document.title = `${first.header.facts.title} \u2013 egs_warp`;
    root.replaceChildren(views);
    for (const source of sources) {
      const canvas = element("canvas", { class: "view", tabindex: "0", "aria-label": source.header.facts.title });
      views.append(element("figure", {}, canvas, element("figcaption", {}, source.header.facts.title)));
      const stage = new Stage(canvas, source);
      this.stages.push(stage);
    }
    if (first instanceof LiveSource) this.live = new Live(first, this.stages[0] as Stage);
    for (const stage of this.stages) {
      stage.controls.addEventListener("change", () => {
        for (const other of this.stages) if (other !== stage) other.copyView(stage);
      });
    }
    this.curves = new Curves(first, (place) => this.player.seek(place));
    this.playButton = button("play", "Play (space)", () => this.player.toggle());
    this.playButton.classList.add("play");
    root.append(this.tools(), this.curves.panel, ...(this.live?.parts() ?? [this.dock()]));
    this.curves.panel.hidden = true;
    new ResizeObserver(() => {
      for (const stage of this.stages) stage.resize();
      this.curves.draw(this.place);
    }).observe(views);
    document.addEventListener("keydown", (event) => this.pressed(event));
    if (this.live !== undefined) this.setFollow(true);
    for (const { name, on } of LAYERS) for (const stage of this.stages) stage.tick(name, on && this.shown(name, stage));
    this.update();
    requestAnimationFrame((now) => this.tick(now));
  }

  /** The layer as a user ticks it. */
  setLayer(name: Tick, on: boolean): void {
    const box = this.boxes.get(name);
    if (box !== undefined) box.checked = on;
    for (const stage of this.stages) stage.tick(name, on);
    this.update();
  }

  private shown(name: Tick, stage: Stage): boolean {
    // A captured scene has a ground of its own.
    return name !== "ground" || !stage.hasScene;
  }

  /** Frames, with a fraction between two of them: what is shown. */
  get place(): number {
    return this.live?.clock.place ?? this.player.place;
  }

  private setFollow(on: boolean): void {
    const box = document.getElementById("follow");
    if (box instanceof HTMLInputElement) box.checked = on;
    for (const stage of this.stages) stage.follow = on;
  }

  private tools(): HTMLElement {
    const layers = element("div", { class: "menu", hidden: "" });
    for (const { name, title, on, key } of LAYERS) {
      if (name === "scene" && !this.stages.some((stage) => stage.hasScene)) continue;
      const box = element("input", { type: "checkbox", id: `layer-${name}` });
      box.checked = on && this.stages.some((stage) => this.shown(name, stage));
      box.addEventListener("change", () => this.setLayer(name, box.checked));
      this.boxes.set(name, box);
      layers.append(element("label", {}, box, element("span", {}, title), element("kbd", {}, key)));
    }
    const views = element("div", { class: "menu", hidden: "" });
    for (const { name, title } of PRESETS) {
      const made = element("button", { type: "button", class: "item", id: `view-${name}` }, title);
      made.addEventListener("click", () => {
        for (const stage of this.stages) stage.preset(name);
      });
      views.append(made);
    }
    const follow = element("input", { type: "checkbox", id: "follow" });
    follow.addEventListener("change", () => this.setFollow(follow.checked));
    views.append(element("label", {}, follow, element("span", {}, "Follow the creature")));
    const toggle = (opened: HTMLElement, other: HTMLElement) => () => {
      opened.hidden = !opened.hidden;
      other.hidden = true;
    };
    const what = this.live === undefined ? "Record a video of the whole run" : "Record a video of what is seen";
    const record = button("record", what, () => this.record(record));
    return element(
      "nav",
      { class: "tools", "aria-label": "View" },
      button("layers", "Layers", toggle(layers, views)),
      button("view", "Camera", toggle(views, layers)),
      button("curves", "Curves (c)", () => this.toggleCurves()),
      button("camera", this.live === undefined ? "Screenshot (s)" : "Screenshot", () => void this.screenshot()),
      record,
      layers,
      views,
    );
  }

  private dock(): HTMLElement {
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

  private toggleCurves(): void {
    this.curves.panel.hidden = !this.curves.panel.hidden;
    this.curves.draw(this.place);
  }

  private async screenshot(): Promise<void> {
    this.player.playing = false;
    for (const stage of this.stages) {
      stage.sharpen(1);
      await stage.settle();
      save(await stage.picture(), `${this.fileName()}-${Math.round(this.place)}.png`);
    }
  }

  private record(pressed: HTMLButtonElement): void {
    const [stage] = this.stages;
    if (stage === undefined) return;
    if (this.film.recording) {
      this.film.stop();
      this.player.playing = false;
      pressed.classList.remove("on");
      return;
    }
    const { loop } = this.player;
    if (this.live === undefined) {
      this.player.seek(0);
      this.player.loop = false;
    }
    this.film.start(stage.canvas, (blob, ending) => save(blob, `${this.fileName()}.${ending}`));
    pressed.classList.add("on");
    if (this.live !== undefined) return;
    this.player.playing = true;
    const watch = setInterval(() => {
      if (this.player.playing && this.film.recording) return;
      clearInterval(watch);
      this.film.stop();
      this.player.loop = loop;
      pressed.classList.remove("on");
    }, 50);
  }

  private fileName(): string {
    const { title } = (this.stages[0] as Stage).source.header.facts;
    return title.replace(/[^\p{L}\p{N}]+/gu, "-").replace(/^-|-$/g, "") || "run";
  }

  private pressed(event: KeyboardEvent): void {
    const held = event.ctrlKey || event.metaKey || event.altKey;
    const typed = event.target instanceof HTMLSelectElement || (this.live && event.target instanceof HTMLInputElement);
    if (typed || held) return;
    if (this.live?.keyDown(event)) {
      event.preventDefault();
      return;
    }
    const layer = LAYERS.find(({ key }) => key === event.key);
    if (layer !== undefined) this.setLayer(layer.name, !(this.boxes.get(layer.name)?.checked ?? false));
    else if (event.key === "c") this.toggleCurves();
    else if (this.live !== undefined) return;
    else if (event.key === " ") this.player.toggle();
    else if (event.key === "ArrowRight") this.player.step(1);
    else if (event.key === "ArrowLeft") this.player.step(-1);
    else if (event.key === "s") void this.screenshot();
    else if (event.key === "l") document.getElementById("loop")?.click();
    else return;
    event.preventDefault();
  }

  /** A machine that is slow plays with fewer pixels, as long as it plays. */
  private keepUp(elapsed: number): void {
    if (this.film.recording) return;
    if (this.live === undefined ? !this.player.playing : !this.live.moving) {
      this.pace = 0;
      for (const stage of this.stages) stage.sharpen(1);
      return;
    }
    this.pace = this.pace === 0 ? 1 / 60 : this.pace + 0.05 * (Math.min(elapsed, 0.2) - this.pace);
    if (this.pace <= (this.live === undefined ? SLOW : SLOW_LIFE)) return;
    for (const stage of this.stages) stage.coarsen();
    this.pace = 1 / 60;
  }

  /** Shows where the player stands. */
  private update(): void {
    const { player } = this;
    for (const stage of this.stages) stage.show(this.place);
    this.curves.draw(this.place);
    if (this.live !== undefined) return;
    this.slider.max = String(player.last);
    this.slider.value = String(player.place);
    this.slider.style.setProperty("--done", `${(100 * player.place) / Math.max(player.last, 1)}%`);
    this.clock.textContent = `${player.seconds.toFixed(2)} / ${(player.last / player.rate).toFixed(2)} s`;
    this.playButton.innerHTML = icon(player.playing ? "pause" : "play");
  }

  /** A slow machine waits for its splats to be sorted: as they lay some pictures ago, the ground would hide the
   * body. */
  private get waits(): boolean {
    return this.player.playing && this.pace > SLOW && this.stages.some((stage) => stage.sorting);
  }

  private tick(now: number): void {
    if (this.waits) {
      requestAnimationFrame((next) => this.tick(next));
      return;
    }
    const elapsed = this.before === 0 ? 0 : (now - this.before) / 1000;
    this.before = now;
    if (this.live === undefined) this.player.advance(elapsed);
    else if (this.live.advance(elapsed)) this.update();
    this.keepUp(elapsed);
    for (const stage of this.stages) stage.draw();
    this.live?.drawn();
    requestAnimationFrame((next) => this.tick(next));
  }
}
