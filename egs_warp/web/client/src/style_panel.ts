// Panel for the style of jumps: buttons of the named styles, and a slider for each parameter.

import { element } from "./dom";
import type { Facts, Style } from "./packets";
import { createSlider, type Slider } from "./slider";

/** Step of the sliders of the parameters. */
const STEP = 0.05;
const FIELDS: [keyof Style, string, string][] = [
  ["anticipation", "Anticipation", "Depth and duration of the crouch before a jump"],
  ["squash", "Squash", "Compression of the body on landing"],
  ["bounce", "Bounce", "Swing of the body about its standing height after a landing"],
  ["timing", "Timing", "Duration of crouch and thrust; smaller is faster and harder"],
];

export class StylePanel {
  readonly elements: HTMLElement[];
  private readonly styles: Record<string, Style>;
  private readonly buttons = new Map<string, HTMLButtonElement>();
  private readonly sliders: Map<keyof Style, Slider>;
  private style: Style = { anticipation: 1, squash: 1, bounce: 1, timing: 1 };

  /** Create the panel; `onChange` is called with the style that the user chooses. */
  constructor(
    { styles, limits }: Facts,
    private readonly onChange: (style: Style) => void,
  ) {
    this.styles = styles ?? { usual: this.style };
    const [min, max] = limits?.style ?? [0.5, 2];
    const row = element("div", { class: "choice", role: "group", "aria-label": "Style" });
    for (const [name, style] of Object.entries(this.styles)) {
      const hint = FIELDS.map(([field, title]) => `${title} ${style[field].toFixed(2)}\u00d7`).join(", ");
      const button = element(
        "button",
        { type: "button", id: `style-${name}`, "aria-pressed": "false", title: hint },
        name,
      );
      button.addEventListener("click", (event) => {
        this.choose(style);
        if (event.detail > 0) button.blur();
      });
      this.buttons.set(name, button);
      row.append(button);
    }
    // The scale is logarithmic, with the default in the middle.
    const sliders = FIELDS.map(([name, title, hint]) => {
      const format = (value: number): string => `${rounded(Math.exp(value)).toFixed(2)}\u00d7`;
      const onSlide = (value: number): void => this.choose({ ...this.style, [name]: rounded(Math.exp(value)) });
      const slider = createSlider(title, hint, [Math.log(min), Math.log(max)], "any", format, onSlide);
      return [name, slider] as const;
    });
    this.sliders = new Map(sliders);
    this.elements = [row, ...sliders.map(([, slider]) => slider.element)];
    this.show(this.style);
  }

  /** Show the style reported by the session. */
  show(style: Style): void {
    this.style = style;
    for (const [name, slider] of this.sliders) slider.show(Math.log(style[name]));
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
