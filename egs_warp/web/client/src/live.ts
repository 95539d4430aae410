// Live session: playback clock, control bar, settings, and messages from the session.

import { StylePanel } from "./style_panel";
import { button, element, icon, labelled, opener, save } from "./dom";
import { LiveClock } from "./clock";
import { earlyKeys } from "./early_keys";
import { DOUBLE_CLICK_TIME, InputControls, Pointer, type Action } from "./input";
import { MotionPanel } from "./motion_panel";
import { doingText, nextText } from "./motion_words";
import { Gizmos } from "./gizmos";
import { createKeySheet, SHEET_LABEL, SHEET_TITLE } from "./key_sheet";
import { PushTool } from "./push_tool";
import { takeView } from "./reload";
import { createSlider, type Slider } from "./slider";
import { Toasts } from "./toasts";
import type { LiveSource, News } from "./frame_source";
import type { Viewer } from "./viewer";

type State = Extract<News, { type: "state" }>;
/** Duration of the flash of a button whose key was pressed, ms. */
const FLASH_TIME = 400;
/** Maximum time between a request that changes the state and the session's report of the new state, ms. On a busy
 * machine, a step takes seconds. */
const MAX_ANSWER_TIME = 60_000;
/** Default sag of a body, rho g H / E. */
const DEFAULT_SAG = 0.05;
/** Fraction of real time below which the speed is displayed. */
const MIN_REAL_TIME_SPEED = 0.95;
/** Delay of the picture behind the simulation above which the page shows it, s. */
const MIN_SHOWN_LAG = 1;
const CLICK_HINT = "Double-click the body to push it there; drag it to pull it.";
const HELP: [string[], string][] = [
  [["\u2191", "W"], "forward"],
  [["\u2190", "\u2192", "A", "D"], "turn"],
  [["\u2193", "S"], "turn around"],
  [["Space"], "jump"],
  [["J"], "long jump"],
  [["H"], "hop"],
  [["B"], "push it away from you"],
  [["Esc"], "cancel the next motion"],
  [["P"], "pause"],
  [["."], "one step"],
  [["M"], "more motions"],
  [["R"], "record a take"],
  [["\u232b"], "reset to the start"],
  [["click"], "on the ground: go there"],
  [["2 clicks"], "on the creature: push it there, away from you"],
  [["drag"], "the creature: pull it"],
  [["1", "\u2026", "7"], "show or hide a layer"],
  [["8"], "show or hide the scene, where there is one"],
  [["C"], "curves"],
  [["?"], "these keys"],
];
const TOUCH: [string[], string][] = [
  [["tap"], "on the ground: go there"],
  [["2 taps"], "on the creature: push it there, away from you"],
  [["drag"], "the creature: pull it"],
  [["drag"], "beside the creature: turn the camera"],
  [["two fingers"], "move the camera"],
  [["pinch"], "zoom"],
];

export class Live {
  readonly clock: LiveClock;
  /** Function that is called with the selected body of a world and the motion of each body. */
  onSelect: (index: number | undefined, states: Record<string, string>) => void = () => {};
  /** Latest state of the session. */
  state: State | undefined;
  /** All messages to the user, the newest last. */
  readonly messages: string[] = [];
  private readonly input: InputControls;
  private readonly pointer: Pointer;
  private readonly gizmos: Gizmos;
  private readonly pushTool: PushTool;
  private readonly speedLabel = element("span", { class: "pace", title: "Simulation speed relative to real time" });
  private readonly nextLabel = element("output", { class: "next", title: "Motion that comes next" });
  private readonly pauseButton: HTMLButtonElement;
  private readonly recordButton: HTMLButtonElement;
  /** Says that the body has fallen, for as long as it lies. */
  private readonly fallCard = element("div", { class: "fallen", role: "status", hidden: "" });
  private readonly toasts = new Toasts(this.fallCard);
  private readonly motionPanel: MotionPanel;
  private readonly settingsSheet: HTMLElement;
  private readonly helpSheet: HTMLElement;
  private readonly sliders: { friction: Slider; sag: Slider };
  private readonly stylePanel: StylePanel;
  private busy = false;
  /** Messages about a time that the picture has not reached yet. */
  private readonly laterNews: { time: number; news: News }[] = [];
  private clickHint: ReturnType<typeof setTimeout> | undefined;
  /** Request whose effect the session has not reported yet. */
  private sent: { motion: string; since: number } | undefined;
  /** Motion that the user has requested before the body was ready. */
  private firstAction: Action | undefined;
  private lastMotion = -Infinity;
  private isFacingShown = false;

  constructor(
    private readonly source: LiveSource,
    private readonly viewer: Viewer,
  ) {
    this.clock = new LiveClock(source.frames);
    this.gizmos = new Gizmos(source.header.facts.height);
    viewer.add(this.gizmos.group);
    this.pushTool = new PushTool(viewer, source, this.gizmos);
    this.input = new InputControls(
      source,
      () => this.pushTool.push(),
      (motion, action) => this.showRequest(motion, action),
    );
    this.pointer = new Pointer(
      viewer,
      source,
      (node, isDouble) => this.click(node, isDouble),
      (x, y) => this.go(x, y),
    );
    viewer.headset.onFloor = ({ x, y }) => this.go(x, y);
    this.pauseButton = button("pause", "Pause (p)", () => this.togglePause());
    const recording = "Record a take: a run folder, as animate writes one (r)";
    this.recordButton = button("record", recording, () => this.toggleRecording());
    const { limits } = source.header.facts;
    const [minSag, maxSag] = limits?.sag ?? [0.01, 0.1];
    this.sliders = {
      friction: createSlider(
        "Friction",
        "Coefficient of friction between body and ground",
        limits?.friction ?? [0, 2],
        0.05,
        (value) => value.toFixed(2),
        (friction) => source.send({ type: "set", friction }),
      ),
      // The scale is logarithmic; the body is stiffer to the right.
      sag: createSlider(
        "Stiffness",
        "Stiffness relative to the default; the body is built anew where it stands",
        [-Math.log(maxSag), -Math.log(minSag)],
        "any",
        (value) => `${(DEFAULT_SAG * Math.exp(value)).toFixed(1)}\u00d7`,
        (value) => source.send({ type: "set", sag: Math.min(Math.max(Math.exp(-value), minSag), maxSag) }),
      ),
    };
    const push = createSlider(
      "Push",
      "Impulse of a push, in m \u221a(g H)",
      [0.05, 1],
      0.05,
      (value) => value.toFixed(2),
      (value) => {
        this.pushTool.strength = value;
      },
    );
    push.show(this.pushTool.strength);
    this.stylePanel = new StylePanel(source.header.facts, (style) => source.send({ type: "style", ...style }));
    const sheet = { class: "sheet settings", "aria-label": "Style, body, ground and pushes", hidden: "" };
    this.settingsSheet = element(
      "section",
      sheet,
      ...this.stylePanel.elements,
      this.sliders.friction.element,
      this.sliders.sag.element,
      push.element,
    );
    this.motionPanel = new MotionPanel(
      source.header.facts.motions ?? [],
      (name) => this.perform(name),
      () => source.send({ type: "script" }),
    );
    this.motionPanel.showRefusals(source.header.facts.refusals?.[""] ?? {});
    const fallAction = (word: string, title: string, onClick: () => void): HTMLButtonElement => {
      const created = element("button", { type: "button", class: "action", title }, word);
      created.addEventListener("click", onClick);
      return created;
    };
    this.fallCard.append(
      "The body has fallen.",
      fallAction("Get up", "Let the body get up", () => this.perform("get up")),
      fallAction("Reset", "Reset to the start (backspace)", () => this.source.send({ type: "stand" })),
    );
    this.helpSheet = createKeySheet(HELP, TOUCH);
    // The user may have turned the camera and pressed a key while the body was prepared.
    const view = takeView();
    if (view !== undefined) viewer.showView(view);
    this.firstAction = earlyKeys.action;
    earlyKeys.stop();
    source.onFrame = () => this.clock.addArrival(performance.now() / 1000);
    source.listen((news) => this.receiveNews(news));
    document.addEventListener("keyup", (event) => this.input.keyUp(event));
    window.addEventListener("blur", () => this.input.releaseAll());
  }

  /** True if the creature moves or has moved within the last half second. */
  get isMoving(): boolean {
    return performance.now() - this.lastMotion < 500;
  }

  elements(): HTMLElement[] {
    const actionButton = (action: Action, word: string, title: string): HTMLButtonElement => {
      const name = action === "back" || action === "hop" ? "forward" : action;
      const created = button(name, title, () => {});
      created.addEventListener("pointerdown", () => this.input.press(action, title));
      for (const end of ["pointerup", "pointerleave", "pointercancel"]) {
        created.addEventListener(end, () => this.input.release(title));
      }
      // Clicks without a pointer event come from the keyboard.
      created.addEventListener("click", (event) => {
        if (event.detail !== 0) return;
        this.input.press(action, title);
        this.input.release(title);
      });
      created.id = action;
      return labelled(created, word);
    };
    const pad = element(
      "div",
      { class: "pad" },
      actionButton("left", "turn", "Turn left (\u2190)"),
      actionButton("forward", "forward", "Forward (\u2191)"),
      actionButton("right", "turn", "Turn right (\u2192)"),
      actionButton("jump", "jump", "Jump (space)"),
      actionButton("leap", "leap", "Long jump (j)"),
      labelled(button("push", "Push it away from you (b)", () => this.pushTool.push()), "push"),
    );
    const reset = button("stand", "Reset to the start (backspace)", () => this.source.send({ type: "stand" }));
    const actions = element(
      "div",
      {},
      labelled(reset, "reset"),
      labelled(opener("motions", "Motions (m)", this.motionPanel.element, this.sheets), "motions"),
      labelled(opener("sliders", "Style, friction, stiffness, pushes", this.settingsSheet, this.sheets), "style"),
      labelled(this.recordButton, "take"),
      labelled(opener("help", SHEET_TITLE, this.helpSheet, this.sheets), SHEET_LABEL),
    );
    const step = labelled(button("step", "One step (.)", () => this.step()), "step");
    step.id = "step";
    const labels = element("div", { class: "labels" }, this.speedLabel, this.nextLabel);
    const time = element("div", {}, labelled(this.pauseButton, "pause"), step, labels);
    const dock = element("footer", { class: "dock live" }, time, pad, actions);
    return [dock, ...this.sheets, this.toasts.element];
  }

  /** Advance by `elapsed` wall-clock seconds; return true if the displayed time has changed. */
  advance(elapsed: number): boolean {
    this.input.tick();
    this.pushTool.tick(this.state?.paused ?? false);
    const moved = this.clock.advance(elapsed);
    this.handleDueNews();
    if (moved) this.lastMotion = performance.now();
    return moved;
  }

  /** Update the gizmos and the speed label after each rendered image. */
  updateGizmos(): void {
    const { grab } = this.pointer;
    if (grab !== undefined) this.gizmos.showSpring(this.viewer.nodePosition(grab.node), grab.target);
    else this.gizmos.showSpring();
    if (this.state !== undefined && (this.isMoving || !this.isFacingShown)) {
      this.gizmos.showFacing(this.viewer.centreOfMass, this.state.facing, 0.62 * this.source.header.facts.height);
      // The image of a body at rest has already been drawn.
      if (!this.isFacingShown) this.viewer.invalidate();
      this.isFacingShown = true;
    }
    this.updateSpeedLabel();
    this.updateNextLabel();
  }

  /** Show immediately that a request was made, because the session reports its effect only after the next step. */
  private showRequest(motion: string, action?: Action): void {
    if (!this.source.isConnected) return;
    this.sent = { motion, since: performance.now() };
    this.updateNextLabel();
    const pressed = action === undefined ? null : document.getElementById(action);
    pressed?.animate([{ background: "rgb(127 209 184 / 55%)" }, { background: "transparent" }], FLASH_TIME);
  }

  /** Steer another creature of a world. */
  select(index: number): void {
    const part = this.viewer.parts?.[index];
    if (part?.creature) this.source.send({ type: "select", body: part.name });
  }

  /**
   * Push the creature that this page steers by a double click; a single click says how. A click on another creature of
   * a world selects that creature.
   */
  private click(node: number, isDouble: boolean): void {
    const { parts } = this.viewer;
    const index = this.viewer.bodyOf(node);
    const isOther = parts?.[index]?.creature === true && parts[index].name !== this.state?.body;
    if (isOther) this.select(index);
    else if (parts?.[index]?.creature !== false) {
      clearTimeout(this.clickHint);
      if (isDouble) this.pushTool.push(node);
      else this.clickHint = setTimeout(() => this.showMessage(CLICK_HINT), DOUBLE_CLICK_TIME);
    }
  }

  /** Sheets of the control bar, of which at most one is shown. */
  private get sheets(): HTMLElement[] {
    return [this.motionPanel.element, this.settingsSheet, this.helpSheet];
  }

  private toggleSheet(sheet: HTMLElement): void {
    for (const one of this.sheets) one.hidden = one !== sheet || !one.hidden;
  }

  private perform(name: string): void {
    this.source.send({ type: "motion", text: name });
    this.showRequest(name);
    this.motionPanel.element.hidden = true;
  }

  private go(x: number, y: number): void {
    if (!this.source.isConnected) return;
    this.source.send({ type: "go", x, y });
    this.gizmos.showGoal([x, y]);
    this.viewer.invalidate();
    this.showRequest("go");
  }

  /** Handle a key press; return true if the key has a function. */
  keyDown(event: KeyboardEvent): boolean {
    if (!this.source.isConnected) return false;
    if (this.input.keyDown(event)) return true;
    if (event.key === "p") this.togglePause();
    else if (event.key === ".") this.step();
    else if (event.key === "r") this.toggleRecording();
    else if (event.key === "m") this.toggleSheet(this.motionPanel.element);
    else if (event.key === "b") {
      if (!event.repeat) this.pushTool.push();
    }
    else if (event.key === "?") this.toggleSheet(this.helpSheet);
    else if (event.key === "Backspace") this.source.send({ type: "stand" });
    else if (event.key === "Escape") {
      this.source.send({ type: "cancel" });
      for (const sheet of this.sheets) sheet.hidden = true;
    } else return false;
    return true;
  }

  /** Handle a message when the picture shows the time to which it belongs. Answers that belong to no time are handled
   * at once, and so is everything in a hidden tab, whose picture stands still. */
  private receiveNews(news: News): void {
    const hasTime = news.type === "state" || news.type === "told" || news.type === "busy";
    const time = this.source.frames.at(-1)?.time ?? 0;
    if (hasTime && !document.hidden && (this.laterNews.length > 0 || time > this.clock.time)) {
      this.laterNews.push({ time, news });
    } else {
      if (document.hidden) this.handleDueNews();
      this.handleNews(news);
    }
  }

  private handleDueNews(): void {
    const { laterNews, clock } = this;
    const isNewest = clock.time >= (this.source.frames.at(-1)?.time ?? 0);
    while (laterNews.length > 0 && (isNewest || document.hidden || laterNews[0]!.time <= clock.time)) {
      this.handleNews(laterNews.shift()!.news);
    }
  }

  private handleNews(news: News): void {
    if (news.type === "state") this.show(news);
    else if (news.type === "told") {
      // A refused request does not change the state.
      this.sent = undefined;
      this.showMessage(news.text);
    }
    else if (news.type === "busy") {
      this.busy = news.on;
      this.clock.resetSpeed();
    } else if (news.type === "script") {
      if (news.motions === 0) this.showMessage("there is no motion to save yet");
      else save(new Blob([news.text], { type: "application/json" }), "script.json");
    } else if (news.type === undefined) {
      this.sent = undefined;
      this.pushTool.cancel();
      this.showMessage(news.error, true);
    }
  }

  private show(state: State): void {
    const before = this.state;
    this.state = state;
    this.sent = undefined;
    this.input.walks = state.walks;
    this.input.queued = state.queued;
    if (state.paused || state.resting) this.clock.resetSpeed();
    if (before?.paused !== state.paused) {
      this.pauseButton.innerHTML = icon(state.paused ? "play" : "pause");
      this.pauseButton.title = state.paused ? "Continue (p)" : "Pause (p)";
      labelled(this.pauseButton, state.paused ? "go on" : "pause");
    }
    this.recordButton.classList.toggle("on", state.recording);
    this.recordButton.setAttribute("aria-pressed", String(state.recording));
    this.sliders.friction.show(state.friction);
    this.sliders.sag.show(-Math.log(state.sag));
    this.stylePanel.show(state.style);
    this.gizmos.showGoal(state.goal);
    const selected = this.viewer.parts?.findIndex(({ name }) => name === state.body) ?? -1;
    this.onSelect(selected < 0 ? undefined : selected, state.bodies ?? {});
    this.fallCard.hidden = state.doing !== "fallen";
    if (before?.body !== state.body) {
      this.isFacingShown = false;
      this.motionPanel.showRefusals(this.source.header.facts.refusals?.[state.body ?? ""] ?? {});
      // The session reports the pushes of the selected body only.
      if (before !== undefined) this.pushTool.cancel();
    } else if (before !== undefined) {
      if (state.pushes > before.pushes) this.pushTool.showEffect();
      if (state.dropped_pushes > before.dropped_pushes) this.pushTool.cancel();
    }
    if (this.firstAction !== undefined) this.input.request(this.firstAction);
    this.firstAction = undefined;
    this.updateNextLabel();
    this.viewer.invalidate();
  }

  private updateSpeedLabel(): void {
    const { state, clock } = this;
    let text = "";
    if (!this.source.isConnected) text = "not connected";
    else if (this.busy) text = "please wait\u2026";
    else if (state?.paused) text = "paused";
    else if (state?.doing === "fallen") text = "fallen";
    else if (state === undefined || (state.resting && !this.isMoving)) {
      const isWaiting = this.sent !== undefined || this.pushTool.isWaiting;
      text = isWaiting ? "computing\u2026" : "at rest";
      const isSlow = clock.speed > 0 && clock.speed < MIN_REAL_TIME_SPEED;
      if (!isWaiting && isSlow && (state?.motions ?? 0) > 0) text += ` (${speedText(clock.speed)} in motion)`;
    } else text = `${speedText(clock.speed)} \u00b7 ${doingText(state.doing)}`;
    if (this.speedLabel.textContent !== text) this.speedLabel.textContent = text;
  }

  private updateNextLabel(): void {
    if (!this.source.isConnected) this.sent = undefined;
    if (this.sent !== undefined && performance.now() - this.sent.since > MAX_ANSWER_TIME) this.sent = undefined;
    const request = this.sent?.motion ?? this.state?.queued;
    // A body that is walking to the goal does not go there next.
    const next = request === "go" && this.state?.doing === "walk to" ? undefined : request;
    const { lag } = this.clock;
    const late = lag > MIN_SHOWN_LAG && this.isMoving ? `picture ${lag.toFixed(0)} s behind` : "";
    const text = [next ? `next: ${nextText(next)}` : "", this.pushTool.news, late].filter(Boolean).join(" \u00b7 ");
    if (this.nextLabel.textContent !== text) this.nextLabel.textContent = text;
  }

  private showMessage(line: string, isError = false): void {
    this.messages.push(line);
    this.toasts.show(line, isError);
  }

  private togglePause(): void {
    this.source.send({ type: "pause", on: !(this.state?.paused ?? false) });
  }

  private step(): void {
    if (!this.state?.paused) this.source.send({ type: "pause", on: true });
    this.source.send({ type: "step" });
  }

  private toggleRecording(): void {
    this.source.send({ type: "record", on: !(this.state?.recording ?? false) });
  }
}

/** Return the speed relative to real time, or a word if no step has been computed recently. */
function speedText(speed: number): string {
  if (speed === 0) return "computing\u2026";
  if (speed >= MIN_REAL_TIME_SPEED) return "1\u00d7";
  return `${speed.toFixed(speed < 0.1 ? 2 : 1)}\u00d7`;
}
