// How it jumps: styles by name, and the numbers that they are made of.

import { element } from "./dom";
import type { Facts, Style } from "./packets";
import { createSlider, type Slider } from "./slider";

/** Numbers of a style differ by no less. */
const STEP = 0.05;
const FIELDS: [keyof Style, string, string][] = [
  ["anticipation", "Anticipation", "How deep and long it crouches before a jump"],
  ["squash", "Squash", "How far a landing gives way"],
  ["timing", "Timing", "How long crouch and thrust take: to the left it is quick and hard"],
];

export class StylePanel {
  readonly elements: HTMLElement[];
  private readonly styles: Record<string, Style>;
  private readonly buttons = new Map<string, HTMLButtonElement>();
  private readonly sliders: Record<keyof Style, Slider>;
  private style: Style = { anticipation: 1, squash: 1, timing: 1 };

  /** `set` is told what the user chose. */
  constructor(
    { styles, limits }: Facts,
    private readonly onChange: (style: Style) => void,
  ) {
    this.styles = styles ?? { usual: this.style };
    const [min, max] = limits?.style ?? [0.5, 2];
    const row = element("div", { class: "choice", role: "group", "aria-label": "Style" });
    for (const [name, style] of Object.entries(this.styles)) {
      const button = element("button", { type: "button", id: `style-${name}`, "aria-pressed": "false" }, name);
      button.addEventListener("click", (event) => {
        this.choose(style);
        if (event.detail > 0) button.blur();
      });
      this.buttons.set(name, button);
      row.append(button);
    }
    // In the middle it is the usual, each way by the same factor.
    const sliders = FIELDS.map(([name, title, hint]) => {
      const format = (value: number): string => `${rounded(Math.exp(value)).toFixed(2)}\u00d7`;
      const onSlide = (value: number): void => this.choose({ ...this.style, [name]: rounded(Math.exp(value)) });
      const slider = createSlider(title, [Math.log(min), Math.log(max)], "any", format, onSlide);
      slider.element.title = hint;
      return [name, slider] as const;
    });
    this.sliders = Object.fromEntries(sliders) as Record<keyof Style, Slider>;
    this.elements = [row, ...sliders.map(([, slider]) => slider.element)];
    this.show(this.style);
  }

  /** What the session says that it is. */
  show(style: Style): void {
    this.style = style;
    for (const [name] of FIELDS) this.sliders[name].show(Math.log(style[name]));
    for (const [name, button] of this.buttons) {
      const same = FIELDS.every(([number]) => Math.abs(this.styles[name]![number] - style[number]) < 0.5 * STEP);
      button.setAttribute("aria-pressed", String(same));
    }
  }

  private choose(style: Style): void {
    this.show(style);
    this.onChange(style);
  }
}

function rounded(value: number): number {
  return Math.round(Math.round(value / STEP) * STEP * 100) / 100;
}
