// Panel of a world: for each body, a row with its name and its line of the report; a click selects the body.

import { element } from "./dom";
import { doingText } from "./motion_words";
import type { BodyPart } from "./packets";

export class BodyPanel {
  readonly element: HTMLElement;
  private readonly rows: HTMLButtonElement[];

  constructor(
    private readonly bodies: BodyPart[],
    onSelect: (index: number) => void,
  ) {
    this.rows = bodies.map(({ name, result, state, audit }, index) => {
      const failed = audit !== undefined && audit !== "" && audit !== "audit: passed";
      const lines = [result ?? "", failed ? audit : ""].filter((line) => line !== "");
      const detail = element("span", { class: failed ? "detail wrong" : "detail" }, lines.join("; "));
      const head = element("span", { class: "head" }, element("b", {}, name), element("small", {}, state ?? ""));
      const row = element("button", { type: "button", class: "body", "aria-pressed": "false" }, head, detail);
      row.addEventListener("click", () => onSelect(index));
      return row;
    });
    this.element = element("section", { class: "panel bodies", "aria-label": "Bodies of the world" }, ...this.rows);
  }

  /** Highlight the row of the selected body. */
  show(index: number | undefined): void {
    this.rows.forEach((row, k) => row.setAttribute("aria-pressed", String(k === index)));
  }

  /** Show the activity of each body, such as its current motion. */
  showStates(states: Record<string, string>): void {
    this.rows.forEach((row, k) => {
      const small = row.querySelector("small") as HTMLElement;
      const text = doingText(states[this.bodies[k]!.name] ?? "");
      if (small.textContent !== text) small.textContent = text;
    });
  }
}
