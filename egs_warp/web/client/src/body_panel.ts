// Panel of a world: for each body, a row with its name and its line of the report; a click selects the body.

import { element } from "./dom";
import { doingText } from "./motion_words";
import type { BodyPart } from "./packets";

/** States of bodies that have not performed their motions (egs_warp/pipelines/end_state.py). */
const BAD_STATES = ["not as requested", "fallen", "stopped"];

export class BodyPanel {
  readonly element: HTMLElement;
  private readonly rows: HTMLButtonElement[];

  constructor(
    private readonly bodies: BodyPart[],
    failures: string[],
    onSelect: (index: number) => void,
  ) {
    this.rows = bodies.map(({ name, result, state, audit }, index) => {
      const failed = audit !== undefined && audit !== "" && audit !== "audit: passed";
      const stateText = element("small", {}, state ?? "");
      stateText.classList.toggle("wrong", BAD_STATES.includes(state ?? ""));
      const states = element("span", { class: "states" }, stateText);
      const head = element("span", { class: "head" }, element("b", {}, name), states);
      const row = element("button", { type: "button", class: "body", "aria-pressed": "false" }, head);
      row.append(element("span", { class: "detail" }, result ?? ""));
      if (failed) {
        states.append(", ", element("small", { class: "wrong" }, "audit failed"));
        row.append(element("span", { class: "detail wrong" }, audit.replace("audit: FAILED: ", "")));
      }
      row.addEventListener("click", () => onSelect(index));
      return row;
    });
    const joint = failures.map((line) => element("p", { class: "failure" }, line.replace("audit: FAILED: ", "")));
    const label = { class: "panel bodies", "aria-label": "Bodies of the world" };
    this.element = element("section", label, ...this.rows, ...joint);
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
