// A slider with a name and what it stands at.

import { element } from "./dom";

export interface Slide {
  part: HTMLElement;
  show(value: number): void;
}

/** A slider under its name; `set` is told once it is let go of. */
export function slide(
  title: string,
  [least, most]: [number, number],
  step: number | "any",
  said: (value: number) => string,
  set: (value: number) => void,
): Slide {
  const range = { min: String(least), max: String(most), step: String(step) };
  const input = element("input", { type: "range", class: "line", ...range, "aria-label": title });
  const value = element("output", { class: "value" });
  const label = (): void => {
    value.textContent = said(Number(input.value));
    input.style.setProperty("--done", `${(100 * (Number(input.value) - least)) / (most - least)}%`);
  };
  let held = false;
  input.addEventListener("input", () => {
    held = true;
    label();
  });
  input.addEventListener("change", () => {
    held = false;
    set(Number(input.value));
    input.blur();
  });
  return {
    part: element("label", { class: "slide" }, element("span", {}, title), value, input),
    show: (now) => {
      if (held) return;
      input.value = String(now);
      label();
    },
  };
}
