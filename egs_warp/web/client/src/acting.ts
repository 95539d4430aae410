// How it jumps: styles by name, and the numbers that they are made of.

import { element } from "./dom";
import type { Facts, Style } from "./packets";
import { slide, type Slide } from "./slide";

/** Numbers of a style differ by no less. */
const STEP = 0.05;
const NUMBERS: [keyof Style, string, string][] = [
  ["anticipation", "Anticipation", "How deep and long it crouches before a jump"],
  ["squash", "Squash", "How far a landing gives way"],
  ["timing", "Timing", "How long crouch and thrust take: to the left it is quick and hard"],
];

export class Acting {
  readonly parts: HTMLElement[];
  private readonly styles: Record<string, Style>;
  private readonly buttons = new Map<string, HTMLButtonElement>();
  private readonly slides: Record<keyof Style, Slide>;
  private style: Style = { anticipation: 1, squash: 1, timing: 1 };

  /** `set` is told what the user chose. */
  constructor(
    { styles, limits }: Facts,
    private readonly set: (style: Style) => void,
  ) {
    this.styles = styles ?? { usual: this.style };
    const [least, most] = limits?.style ?? [0.5, 2];
    const row = element("div", { class: "choice", role: "group", "aria-label": "Style" });
    for (const [name, style] of Object.entries(this.styles)) {
      const made = element("button", { type: "button", id: `style-${name}`, "aria-pressed": "false" }, name);
      made.addEventListener("click", (event) => {
        this.choose(style);
        if (event.detail > 0) made.blur();
      });
      this.buttons.set(name, made);
      row.append(made);
    }
    // In the middle it is the usual, each way by the same factor.
    const made = NUMBERS.map(([name, title, what]) => {
      const said = (value: number): string => `${rounded(Math.exp(value)).toFixed(2)}\u00d7`;
      const chosen = (value: number): void => this.choose({ ...this.style, [name]: rounded(Math.exp(value)) });
      const one = slide(title, [Math.log(least), Math.log(most)], "any", said, chosen);
      one.part.title = what;
      return [name, one] as const;
    });
    this.slides = Object.fromEntries(made) as Record<keyof Style, Slide>;
    this.parts = [row, ...made.map(([, one]) => one.part)];
    this.show(this.style);
  }

  /** What the session says that it is. */
  show(style: Style): void {
    this.style = style;
    for (const [name] of NUMBERS) this.slides[name].show(Math.log(style[name]));
    for (const [name, made] of this.buttons) {
      const same = NUMBERS.every(([number]) => Math.abs(this.styles[name]![number] - style[number]) < 0.5 * STEP);
      made.setAttribute("aria-pressed", String(same));
    }
  }

  private choose(style: Style): void {
    this.show(style);
    this.set(style);
  }
}

function rounded(value: number): number {
  return Math.round(Math.round(value / STEP) * STEP * 100) / 100;
}
