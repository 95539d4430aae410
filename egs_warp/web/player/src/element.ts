// The custom element <egs-player>.

import { button, element } from "../../client/src/dom";
import { marginsOf } from "../../client/src/fit_camera";
import { PlaybackBar } from "../../client/src/playback_bar";
import { Player } from "../../client/src/player";
import { loadBundle, type Bundle } from "./bundle";
import { BundleStage } from "./stage";
import { STYLE } from "./style";

const SPEEDS = [0.25, 0.5, 1, 2];
/** Time per image above which playback waits until the splats are sorted, s. */
const SLOW_FRAME_TIME = 1 / 15;
/** Distance of the element from the window at which its bundle is loaded. */
const LOAD_MARGIN = "300px";

/** Player of a bundle. Attributes: `src`, `poster`, `autoplay`, `loop`, `controls`, `speed`, `background`. Its methods,
 * properties and events have the same names as those of a video element. */
export class EgsPlayer extends HTMLElement {
  static readonly observedAttributes = ["src", "poster", "loop", "controls", "speed", "background"];

  /** Element that contains the canvas of the stage. */
  private readonly frame = element("div", { class: "frame" });
  private readonly image = element("img", { alt: "", hidden: "" });
  private readonly message = element("p", { class: "message", role: "alert", hidden: "" });
  private readonly startButton = button("play", "Play", () => this.play());
  private readonly bar: PlaybackBar;
  private readonly sizes = new ResizeObserver(() => this.resize());
  private readonly sight = new IntersectionObserver((entries) => this.seen(entries), { rootMargin: LOAD_MARGIN });
  private bundle: Bundle | undefined;
  private stage: BundleStage | undefined;
  private readonly player: Player;
  /** True once the splats of the first frame have been drawn in order. */
  private isDrawn = false;
  private isComplete = false;
  private isVisible = false;
  /** Number of the current load; an earlier load that is still in progress is discarded. */
  private loads = 0;
  private isLoading = false;
  private lastTime = 0;
  private frameTime = 0;

  constructor() {
    super();
    // The player calls these functions when the values are known.
    const lastFrame = (): number => (this.bundle?.facts.frames ?? 1) - 1;
    const rate = (): number => this.bundle?.facts.rate ?? 1;
    this.player = new Player(
      {
        get lastFrame() {
          return lastFrame();
        },
        get rate() {
          return rate();
        },
      },
      () => this.update(),
    );
    this.player.loop = false;
    this.bar = new PlaybackBar(this.player, {
      speeds: SPEEDS,
      onToggle: () => this.toggle(),
      onSeek: () => this.dispatchEvent(new Event("seeked")),
    });
    this.bar.element.hidden = true;
    this.startButton.classList.add("start");
    this.frame.addEventListener("pointerdown", () => this.stage?.canvas.focus());
    this.frame.addEventListener("focusin", () => this.allowZoom(true));
    this.frame.addEventListener("focusout", () => this.allowZoom(false));
    this.frame.addEventListener("keydown", (event) => this.keyDown(event));
    const root = this.attachShadow({ mode: "open" });
    root.append(element("style", {}, STYLE), this.frame, this.image, this.startButton, this.bar.element, this.message);
  }

  connectedCallback(): void {
    this.sight.observe(this);
    this.sizes.observe(this);
    this.sizes.observe(this.bar.element);
    this.update();
  }

  disconnectedCallback(): void {
    this.sight.disconnect();
    this.sizes.disconnect();
    this.unload();
  }

  attributeChangedCallback(name: string, before: string | null, value: string | null): void {
    if (before === value) return;
    if (name === "src") {
      this.unload();
      if (this.isVisible) void this.load();
    } else if (name === "poster") {
      this.image.src = value ?? "";
      this.image.hidden = value === null || this.stage !== undefined;
    } else if (name === "loop") this.player.loop = value !== null;
    else if (name === "controls") this.update();
    else if (name === "speed") this.playbackRate = Number(value ?? 1);
    else this.stage?.setBackground(value ?? "");
  }

  /** Current time in the film, s. */
  get currentTime(): number {
    return this.player.seconds;
  }

  set currentTime(seconds: number) {
    this.player.seek(seconds * this.player.rate);
    this.dispatchEvent(new Event("seeked"));
  }

  /** Duration in seconds; NaN before it is known. */
  get duration(): number {
    return this.bundle === undefined ? NaN : this.player.lastFrame / this.player.rate;
  }

  get paused(): boolean {
    return !this.player.playing;
  }

  get playbackRate(): number {
    return this.player.speed;
  }

  set playbackRate(speed: number) {
    if (!(speed > 0)) return;
    this.player.speed = speed;
    this.bar.update();
  }

  /** State of loading, as for a video: 0 without data, 1 when the duration is known, 3 when playback can start, 4 when
   * all data have arrived. */
  get readyState(): number {
    if (this.stage === undefined) return 0;
    if (!this.isDrawn) return 1;
    return this.isComplete ? 4 : 3;
  }

  /** The bundle; undefined before its first frames have arrived. */
  get content(): Bundle | undefined {
    return this.bundle;
  }

  /** Scene, camera and renderer; undefined before the first frames have arrived. */
  get view(): BundleStage | undefined {
    return this.stage;
  }

  play(): void {
    if (this.player.playing) return;
    if (this.stage === undefined) void this.load();
    this.player.toggle();
    this.dispatchEvent(new Event("play"));
  }

  pause(): void {
    if (!this.player.playing) return;
    this.player.toggle();
    this.dispatchEvent(new Event("pause"));
  }

  private toggle(): void {
    if (this.paused) this.play();
    else this.pause();
  }

  private seen(entries: IntersectionObserverEntry[]): void {
    this.isVisible = entries.at(-1)?.isIntersecting ?? false;
    this.lastTime = 0;
    if (this.isVisible && this.stage === undefined) void this.load();
  }

  private async load(): Promise<void> {
    const address = this.getAttribute("src");
    if (address === null || this.isLoading) return;
    this.isLoading = true;
    const number = ++this.loads;
    try {
      const bundle = await loadBundle(new URL(address, document.baseURI).href);
      if (number !== this.loads) return;
      await this.show(bundle);
      await bundle.complete;
      if (number !== this.loads) return;
      this.isComplete = true;
      this.dispatchEvent(new Event("canplaythrough"));
    } catch (error) {
      if (number !== this.loads) return;
      this.message.textContent = error instanceof Error ? error.message : String(error);
      this.message.hidden = false;
      this.startButton.hidden = true;
      this.dispatchEvent(new ErrorEvent("error", { error, message: this.message.textContent }));
    } finally {
      if (number === this.loads) this.isLoading = false;
    }
  }

  private async show(bundle: Bundle): Promise<void> {
    this.bundle = bundle;
    const stage = new BundleStage(bundle);
    this.stage = stage;
    this.frame.replaceChildren(stage.canvas);
    this.bar.element.append(...stage.headset.buttons);
    stage.setBackground(this.getAttribute("background") ?? "");
    this.allowZoom(false);
    this.bar.element.hidden = !this.hasAttribute("controls");
    this.resize();
    this.dispatchEvent(new Event("loadedmetadata"));
    await stage.drawSorted();
    if (stage !== this.stage) return;
    this.isDrawn = true;
    this.image.hidden = true;
    const isStill = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    if (this.hasAttribute("autoplay") && !isStill) this.play();
    this.updateControls();
    this.dispatchEvent(new Event("canplay"));
    // In a headset, this is the animation loop of its session.
    stage.renderer.setAnimationLoop((now) => this.tick(now));
  }

  /** Fit the picture to the element, clear of the bar. */
  private resize(): void {
    if (this.stage === undefined) return;
    this.stage.setMargins(marginsOf(this, [this.bar.element]));
    this.stage.resize();
  }

  private unload(): void {
    this.loads++;
    this.isLoading = false;
    for (const one of this.stage?.headset.buttons ?? []) one.remove();
    void this.stage?.dispose();
    this.frame.replaceChildren();
    this.stage = undefined;
    this.bundle = undefined;
    this.isDrawn = false;
    this.isComplete = false;
    this.player.playing = false;
    this.player.framePosition = 0;
    this.message.hidden = true;
    this.image.hidden = !this.hasAttribute("poster");
  }

  /** Let the mouse wheel zoom only while the canvas has the focus; otherwise the wheel scrolls the page. */
  private allowZoom(on: boolean): void {
    if (this.stage !== undefined) this.stage.controls.enableZoom = on;
  }

  private keyDown(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === " ") this.toggle();
    else if (event.key === "ArrowRight") this.player.step(1);
    else if (event.key === "ArrowLeft") this.player.step(-1);
    else return;
    event.preventDefault();
  }

  /** Show the current frame and the state of playback. */
  private update(): void {
    this.stage?.show(this.player.framePosition);
    this.updateControls();
  }

  private updateControls(): void {
    const { player } = this;
    this.bar.element.hidden = !this.hasAttribute("controls") || this.stage === undefined;
    // Without a bar, a player without `autoplay` shows one large button.
    this.startButton.hidden = player.playing || this.hasAttribute("autoplay") || !this.bar.element.hidden;
    this.bar.update();
    if (this.stage !== undefined) this.dispatchEvent(new Event("timeupdate"));
  }

  private tick(now: number): void {
    const { stage, player } = this;
    if (stage === undefined) return;
    const { isPresenting } = stage.headset;
    if (!this.isVisible && !isPresenting) return;
    // With an outdated order, the ground would hide the body.
    if (!isPresenting && player.playing && this.frameTime > SLOW_FRAME_TIME && stage.sorting) return;
    const elapsed = this.lastTime === 0 ? 0 : (now - this.lastTime) / 1000;
    this.lastTime = now;
    this.frameTime += 0.05 * (Math.min(elapsed, 0.2) - this.frameTime);
    const { playing } = player;
    if (this.hasArrived(player.framePosition + elapsed * player.rate * player.speed)) player.advance(elapsed);
    stage.draw();
    if (playing && !player.playing) this.dispatchEvent(new Event("ended"));
  }

  /** Return true if playback can continue to the given frame. */
  private hasArrived(framePosition: number): boolean {
    return this.isComplete || framePosition < (this.bundle?.available ?? 0) - 1;
  }
}
