// A creature that lives: its clock, the controls under it, and what the session says.

import { Acting } from "./acting";
import { button, element, icon, save } from "./dom";
import { LiveClock } from "./clock";
import { Hands, Pointer, type Action } from "./hands";
import { Marks } from "./marks";
import { Pushes } from "./pushes";
import { slide, type Slide } from "./slide";
import type { LiveSource, News } from "./source";
import type { Stage } from "./stage";

type State = Extract<News, { type: "state" }>;
/** Milliseconds for which a line is shown. */
const SHOWN = 7000;
/** Of a body that was told nothing else. */
const ORDINARY_SAG = 0.05;
/** Slower than this it is said. */
const SLOWER = 0.95;
const HELP: [string[], string][] = [
  [["\u2191", "W"], "forward"],
  [["\u2190", "\u2192", "A", "D"], "turn"],
  [["\u2193", "S"], "turn round"],
  [["Space"], "jump"],
  [["J"], "leap ahead"],
  [["H"], "hop"],
  [["B"], "push it away from you"],
  [["Esc"], "drop what comes next"],
  [["P"], "pause"],
  [["."], "one step"],
  [["R"], "record a take"],
  [["\u232b"], "stand up at the start"],
];

export class Live {
  readonly clock: LiveClock;
  /** What the session said last. */
  state: State | undefined;
  /** Lines for the user, the newest last. */
  readonly told: string[] = [];
  private readonly hands: Hands;
  private readonly pointer: Pointer;
  private readonly marks: Marks;
  private readonly pushes: Pushes;
  private readonly pace = element("output", { class: "pace", title: "How fast it lives, beside real time" });
  private readonly pauseButton: HTMLButtonElement;
  private readonly takeButton: HTMLButtonElement;
  private readonly toasts = element("div", { class: "toasts", role: "status", "aria-live": "polite" });
  private readonly body: HTMLElement;
  private readonly help: HTMLElement;
  private readonly sliders: { friction: Slide; sag: Slide };
  private readonly acting: Acting;
  private busy = false;
  private lastMoved = -Infinity;
  private facing = false;

  constructor(
    private readonly source: LiveSource,
    private readonly stage: Stage,
  ) {
    this.clock = new LiveClock(source.frames);
    this.marks = new Marks(source.header.facts.height);
    stage.add(this.marks.group);
    this.pushes = new Pushes(stage, source, this.marks);
    this.hands = new Hands(source, () => this.pushes.push());
    this.pointer = new Pointer(stage, source, (node) => this.pushes.push(node));
    this.pauseButton = button("pause", "Pause (p)", () => this.togglePause());
    const recording = "Record a take: a run folder, as animate writes one (r)";
    this.takeButton = button("record", recording, () => this.toggleTake());
    const { limits } = source.header.facts;
    const [least, most] = limits?.sag ?? [0.01, 0.1];
    this.sliders = {
      friction: slide("Friction", limits?.friction ?? [0, 2], 0.05, (value) => value.toFixed(2), (friction) =>
        source.send({ type: "set", friction }),
      ),
      // To the right it is stiffer, each way by the same factor.
      sag: slide(
        "Stiffness",
        [-Math.log(most), -Math.log(least)],
        "any",
        (value) => `${(ORDINARY_SAG * Math.exp(value)).toFixed(1)}\u00d7`,
        (value) => source.send({ type: "set", sag: Math.min(Math.max(Math.exp(-value), least), most) }),
      ),
    };
    const push = slide("Push", [0.05, 1], 0.05, (value) => value.toFixed(2), (value) => (this.pushes.strength = value));
    push.show(this.pushes.strength);
    this.acting = new Acting(source.header.facts, (style) => source.send({ type: "style", ...style }));
    const sheet = { class: "sheet", "aria-label": "Style, body, ground and pushes", hidden: "" };
    this.body = element(
      "section",
      sheet,
      ...this.acting.parts,
      element("hr", {}),
      this.sliders.friction.part,
      this.sliders.sag.part,
      push.part,
    );
    this.help = helpSheet();
    source.onFrame = () => this.clock.arrived(performance.now() / 1000);
    source.listen((news) => this.hear(news));
    document.addEventListener("keyup", (event) => this.hands.keyUp(event));
    window.addEventListener("blur", () => this.hands.releaseAll());
  }

  /** Whether something moves, or did a moment ago. */
  get moving(): boolean {
    return performance.now() - this.lastMoved < 500;
  }

  parts(): HTMLElement[] {
    const act = (action: Action, title: string): HTMLButtonElement => {
      const name = action === "back" || action === "hop" ? "forward" : action;
      const made = button(name, title, () => {});
      made.addEventListener("pointerdown", () => this.hands.press(action, title));
      for (const end of ["pointerup", "pointerleave", "pointercancel"]) {
        made.addEventListener(end, () => this.hands.release(title));
      }
      // A keyboard's press of the button itself.
      made.addEventListener("click", (event) => {
        if (event.detail !== 0) return;
        this.hands.press(action, title);
        this.hands.release(title);
      });
      made.id = action;
      return made;
    };
    const open = (sheet: HTMLElement, other: HTMLElement) => () => {
      sheet.hidden = !sheet.hidden;
      other.hidden = true;
    };
    const pad = element(
      "div",
      { class: "pad" },
      act("left", "Turn left (\u2190)"),
      act("forward", "Forward (\u2191)"),
      act("right", "Turn right (\u2192)"),
      act("jump", "Jump (space)"),
      act("leap", "Leap ahead (j)"),
      button("push", "Push it away from you (b)", () => this.pushes.push()),
    );
    const keep = element(
      "div",
      {},
      button("stand", "Stand up at the start (backspace)", () => this.source.send({ type: "stand" })),
      button("sliders", "Style, friction, stiffness, pushes", open(this.body, this.help)),
      this.takeButton,
      button("script", "Save what it did as a script", () => this.source.send({ type: "script" })),
      button("help", "Keys (?)", open(this.help, this.body)),
    );
    const time = element("div", {}, this.pauseButton, button("step", "One step (.)", () => this.step()), this.pace);
    return [element("footer", { class: "dock live" }, time, pad, keep), this.body, this.help, this.toasts];
  }

  /** After `elapsed` seconds; true where the picture is another one. */
  advance(elapsed: number): boolean {
    this.hands.tick();
    this.pushes.tick();
    const moved = this.clock.advance(elapsed);
    if (moved) this.lastMoved = performance.now();
    return moved;
  }

  /** Told after each picture: what follows hand and body. */
  drawn(): void {
    const { pulled } = this.pointer;
    if (pulled !== undefined) this.marks.showSpring(this.stage.node(pulled.node), pulled.hand);
    else this.marks.showSpring();
    if (this.state !== undefined && (this.moving || !this.facing)) {
      this.marks.showFacing(this.stage.middle, this.state.facing, 0.62 * this.source.header.facts.height);
      this.facing = true;
    }
    this.tellPace();
  }

  /** A key; whether it is one of ours. */
  keyDown(event: KeyboardEvent): boolean {
    if (this.hands.keyDown(event)) return true;
    if (event.key === "p") this.togglePause();
    else if (event.key === ".") this.step();
    else if (event.key === "r") this.toggleTake();
    else if (event.key === "b") {
      if (!event.repeat) this.pushes.push();
    }
    else if (event.key === "?") this.help.hidden = !this.help.hidden;
    else if (event.key === "Backspace") this.source.send({ type: "stand" });
    else if (event.key === "Escape") {
      this.source.send({ type: "cancel" });
      this.help.hidden = this.body.hidden = true;
    } else return false;
    return true;
  }

  private hear(news: News): void {
    if (news.type === "state") this.show(news);
    else if (news.type === "told") this.tell(news.text);
    else if (news.type === "busy") {
      this.busy = news.on;
      this.clock.hold();
    } else if (news.type === "script") {
      if (news.motions === 0) this.tell("it has done nothing yet that a script could hold");
      else save(new Blob([news.text], { type: "application/json" }), "script.json");
    } else this.tell(news.error, true);
  }

  private show(state: State): void {
    const before = this.state;
    this.state = state;
    this.hands.walks = state.walks;
    this.hands.queued = state.queued;
    if (state.paused || state.resting) this.clock.hold();
    if (before?.paused !== state.paused) {
      this.pauseButton.innerHTML = icon(state.paused ? "play" : "pause");
      this.pauseButton.title = state.paused ? "Go on (p)" : "Pause (p)";
    }
    this.takeButton.classList.toggle("on", state.recording);
    this.takeButton.setAttribute("aria-pressed", String(state.recording));
    this.sliders.friction.show(state.friction);
    this.sliders.sag.show(-Math.log(state.sag));
    this.acting.show(state.style);
    this.marks.showGoal(state.goal);
    this.stage.invalidate();
  }

  private tellPace(): void {
    const { state, clock } = this;
    let said = "";
    if (this.busy) said = "one moment\u2026";
    else if (state?.paused) said = "paused";
    else if (state?.doing === "fallen") said = "fallen";
    else if (!this.moving || clock.speed === 0) said = "at rest";
    else if (clock.speed < SLOWER) {
      said = `${clock.speed.toFixed(clock.speed < 0.1 ? 2 : 1)}\u00d7 \u00b7 ${state?.doing ?? ""}`;
    }
    else said = `1\u00d7 \u00b7 ${state?.doing ?? ""}`;
    if (this.pace.textContent !== said) this.pace.textContent = said;
  }

  private tell(line: string, wrong = false): void {
    this.told.push(line);
    const toast = element("p", { class: wrong ? "toast wrong" : "toast" }, line);
    this.toasts.append(toast);
    while (this.toasts.childElementCount > 3) this.toasts.firstElementChild?.remove();
    setTimeout(() => toast.remove(), SHOWN);
  }

  private togglePause(): void {
    this.source.send({ type: "pause", on: !(this.state?.paused ?? false) });
  }

  private step(): void {
    if (!this.state?.paused) this.source.send({ type: "pause", on: true });
    this.source.send({ type: "step" });
  }

  private toggleTake(): void {
    this.source.send({ type: "record", on: !(this.state?.recording ?? false) });
  }
}

function helpSheet(): HTMLElement {
  const list = element("dl", { class: "keys" });
  for (const [keys, what] of HELP) {
    const names = keys.flatMap((key) => [" ", element("kbd", {}, key)]);
    list.append(element("dt", {}, ...names), element("dd", {}, what));
  }
  list.append(element("dt", {}, "click"), element("dd", {}, "on the ground: go there"));
  list.append(element("dt", {}, "click"), element("dd", {}, "the creature: push it there, away from you"));
  list.append(element("dt", {}, "drag"), element("dd", {}, "the creature: pull at it"));
  return element("section", { class: "sheet", "aria-label": "Keys", hidden: "" }, list);
}
