// A slider that is shown with its name and value.

import { element } from "./dom";

export interface Slider {
  element: HTMLElement;
  show(value: number): void;
}

/** Create a labelled slider with the tooltip `hint`; `onChange` is called when the user releases it. */
export function createSlider(
  title: string,
  hint: string,
  [min, max]: [number, number],
  step: number | "any",
  format: (value: number) => string,
  onChange: (value: number) => void,
): Slider {
  const range = { min: String(min), max: String(max), step: String(step) };
  const input = element("input", { type: "range", class: "line", ...range, "aria-label": title });
  const value = element("span", { class: "value" });
  const label = (): void => {
    value.textContent = format(Number(input.value));
    input.setAttribute("aria-valuetext", value.textContent);
    input.style.setProperty("--done", `${(100 * (Number(input.value) - min)) / (max - min)}%`);
  };
  let isDragging = false;
  let latest: number | undefined;
  const show = (newValue: number): void => {
    input.value = String(newValue);
    label();
  };
  input.addEventListener("input", () => {
    isDragging = true;
    label();
  });
  input.addEventListener("change", () => {
    isDragging = false;
    latest = Number(input.value);
    onChange(latest);
    // Return the keyboard focus to the page, unless the keyboard moves the slider.
    if (!input.matches(":focus-visible")) input.blur();
  });
  input.addEventListener("blur", () => {
    if (latest !== undefined) show(latest);
  });
  return {
    element: element("label", { class: "slide", title: hint }, element("span", {}, title), value, input),
    show: (newValue) => {
      latest = newValue;
      // Outdated values may arrive while the keyboard moves the slider.
      if (!isDragging && !input.matches(":focus")) show(newValue);
    },
  };
}
